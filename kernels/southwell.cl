// SPDX-License-Identifier: BSD-3-Clause
// One step of Southwell's relaxation on S = shift I + scale M: the largest residual of each part of the picture
// is made zero, and all residuals learn of it through the columns of S.
//
//   southwell_pick   one work-item a part and right-hand side: i = argmax |r_i|, delta = r_i / S_ii, x_i += delta
//   southwell_csr    r -= scale M[:, i] delta, M^T in sparse rows; one work-item a stretch of r, which looks up
//                    where the stretch begins in each column: no two items write one value, so no atomics
//   southwell_dense  the same of a dense slab; one work-item a row
//
// No defines. x, r, picked and delta are row-major with k columns; parts are equal to one row.

#include "common/real.h"

kernel void southwell_pick(
    int rows, int parts, int k, real shift, global const real *inverse, global real *x, global real *r,
    global int *picked, global real *delta)
{
    const int part = get_global_id(0), c = get_global_id(1);
    if (part >= parts)
        return;
    const int start = (int)((long)part * rows / parts), stop = (int)((long)(part + 1) * rows / parts);
    int largest = start;
    for (int i = start + 1; i < stop; ++i)
        if (fabs(r[i * k + c]) > fabs(r[largest * k + c]))
            largest = i;
    const real step = inverse[largest] * r[largest * k + c];
    x[largest * k + c] += step;
    r[largest * k + c] -= shift * step;
    picked[part * k + c] = largest;
    delta[part * k + c] = step;
}

// Rows first .. first + rows of M^T are the columns of M in this slab.
kernel void southwell_csr(
    int stretches, int size, int rows, int first, int parts, int k, real scale, global const int *pointers,
    global const int *columns, global const real *values, global const int *picked, global const real *delta,
    global real *r)
{
    const int stretch = get_global_id(0), c = get_global_id(1);
    if (stretch >= stretches)
        return;
    for (int part = 0; part < parts; ++part) {
        const int row = picked[part * k + c] - first;
        if (row < 0 || row >= rows)
            continue;
        const real step = scale * delta[part * k + c];
        const int end = pointers[row + 1];
        int low = pointers[row], high = end;  // the first entry at or after the start of the stretch
        while (low < high) {
            const int half_way = low + (high - low) / 2;
            if (columns[half_way] < stretch * size)
                low = half_way + 1;
            else
                high = half_way;
        }
        for (; low < end && columns[low] < (stretch + 1) * size; ++low)
            r[columns[low] * k + c] -= values[low] * step;
    }
}

kernel void southwell_dense(
    int rows, int first, int parts, int k, real scale, int width, global const real *matrix,
    global const int *picked, global const real *delta, global real *r)
{
    const int row = get_global_id(0), c = get_global_id(1);
    if (row >= rows)
        return;
    global const real *a = matrix + (size_t)row * width;
    real sum = 0;
    for (int part = 0; part < parts; ++part)
        sum = a[picked[part * k + c]] * delta[part * k + c] + sum;
    r[(first + row) * k + c] -= scale * sum;
}
