// SPDX-License-Identifier: BSD-3-Clause
// One step of Southwell's relaxation on S = shift I + scale M, in each part of the picture:
//
//     r -= scale M[:, i] delta  for the rows i picked before
//     i = argmax |r_i|,   delta_i = r_i / S_ii,   x_i += delta_i
//
// In its range of rows a work-group (dimension 0; right-hand side: 1) applies the `pending` picks
// before to r, and then, unless `picks` is 0, picks a row in each of its parts.
//
// Optional define: DENSE, where the slab is of M in dense rows; else it is of M^T in sparse rows,
// in each of which an item looks up where its own rows begin.
//
// Layout: vectors are (n, k), rows picked and their steps are (parts, k).

#include "common/real.h"

#define ROW_OF(part, parts, n) ((int)((long)(part) * (n) / (parts)))

kernel void southwell_step(
    int n,                       // rows of S
    int parts,                   // of the picture
    int pending,                 // picks before that r does not know of: parts, or 0
    int picks,                   // 1: pick rows after that
    int k,                       // right-hand sides
    real shift,                  // factor of I
    real scale,                  // factor of M
    int rows,                    // rows of the slab
    int first,                   // row of the matrix with which it begins
    int width,                   // DENSE: columns of M
    global const int *pointers,  // where each sparse row begins, counted from 0 within the slab
    global const int *columns,   // of each entry, ascending in a row
    global const real *values,   // of each entry
    global const real *inverse,  // [n], 1 / S_ii
    global real *x,              // the iterate
    global real *r,              // its residual
    global const int *picked,    // rows picked before
    global const real *delta,    // and their steps
    global int *next_picked,     // rows picked now
    global real *next_delta,     // and their steps
    local int *places)           // a number a work-item
{
    const int me = get_local_id(0), items = get_local_size(0);
    const int c = get_global_id(1), group = get_group_id(0);
    const int part_begin = ROW_OF(group, get_num_groups(0), parts);
    const int part_end = ROW_OF(group + 1, get_num_groups(0), parts);
    const int begin = ROW_OF(part_begin, parts, n), end = ROW_OF(part_end, parts, n);
#ifdef DENSE
    const int stop = min(end, first + rows);
    for (int i = max(begin, first) + me; i < stop; i += items) {
        global const real *a = values + (size_t)(i - first) * width;
        real sum = 0;
        for (int part = 0; part < pending; ++part)
            sum = a[picked[part * k + c]] * delta[part * k + c] + sum;
        r[i * k + c] -= scale * sum;
    }
#else
    const int from = begin + ROW_OF(me, items, end - begin);
    const int to = begin + ROW_OF(me + 1, items, end - begin);
    for (int part = 0; part < pending; ++part) {
        const int row = picked[part * k + c] - first;
        if (row < 0 || row >= rows)
            continue;
        const real step = scale * delta[part * k + c];
        // A binary search for the first column that is not below `from`.
        int j = pointers[row];
        for (int stop = pointers[row + 1]; j < stop;) {
            const int middle = j + (stop - j) / 2, below = columns[middle] < from;
            j = below ? middle + 1 : j;
            stop = below ? stop : middle;
        }
        for (; j < pointers[row + 1] && columns[j] < to; ++j)
            r[columns[j] * k + c] -= values[j] * step;
    }
#endif
    barrier(CLK_GLOBAL_MEM_FENCE);
    for (int part = picks ? part_begin : part_end; part < part_end; ++part) {
        const int part_stop = ROW_OF(part + 1, parts, n);
        int place = ROW_OF(part, parts, n);
        for (int i = place + me; i < part_stop; i += items)
            if (fabs(r[i * k + c]) > fabs(r[place * k + c]))
                place = i;
        places[me] = place;
        // A tree; of equal ones the first row.
        for (int left = items; left > 1; left = (left + 1) / 2) {
            barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
            if (me < left / 2) {
                const int rival = places[me + (left + 1) / 2];
                const real gain = fabs(r[rival * k + c]) - fabs(r[places[me] * k + c]);
                const bool wins = gain > 0 || (gain == 0 && rival < places[me]);
                places[me] = wins ? rival : places[me];
            }
        }
        if (me == 0) {
            const int i = places[0] * k + c;
            const real step = inverse[places[0]] * r[i];
            x[i] += step;
            r[i] -= shift * step;
            next_picked[part * k + c] = places[0];
            next_delta[part * k + c] = step;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
    }
}
