// SPDX-License-Identifier: BSD-3-Clause
// Product of a matrix in compressed sparse rows with K right-hand sides: out = scale * (A x) + add.
//
// Three kernels do the same; the device layer times them and takes the fastest:
//   csr_matvec         one work-item a row, as it reads in a textbook
//   csr_matvec_stream  one work-item a row, in wide loads; for CPUs, where a row is a stream
//   csr_matvec_group   one work-group a row, its items side by side along the row; for GPUs
//
// Required define: K, the right-hand sides of one launch: 1, 2, 3, 4 or 8.
// Optional: PACKED, see common/lanes.h; STRIDE() there turns `stride` into a constant where it is one.
// Layout: a slab of `rows` rows, the first of which is row `first` of the matrix. pointers[rows + 1]
// counts from 0 within the slab; columns and values follow it, columns ascending and unique within a row.
// x and out are row-major with `stride` reals a row; the launch works on their columns
// offset .. offset + K - 1. `add` counts where `adds` is 1; see LTCL_STORE in common/real.h.

#include "common/lanes.h"
#include "common/reduce.h"

kernel void csr_matvec(
    int rows, int first, int stride, int offset, real scale, int adds, global const int *pointers,
    global const int *columns, global const real *values, global const real *x, global const real *add,
    global real *out)
{
    stride = STRIDE(stride);
    const int row = get_global_id(0);
    if (row >= rows)
        return;
    real sum[K];
    for (int c = 0; c < K; ++c)
        sum[c] = 0;
    const int end = pointers[row + 1];
    for (int j = pointers[row]; j < end; ++j)
        for (int c = 0; c < K; ++c)
            sum[c] = values[j] * x[columns[j] * stride + offset + c] + sum[c];
    const int i = (first + row) * stride + offset;
    for (int c = 0; c < K; ++c)
        LTCL_STORE(out, i + c, sum[c], scale, adds, add);
}

#if K == 1

inline real8 gather8(global const real *x, int stride, global const int *columns)
{
    const int8 c = vload8(0, columns) * stride;
    return (real8)(x[c.s0], x[c.s1], x[c.s2], x[c.s3], x[c.s4], x[c.s5], x[c.s6], x[c.s7]);
}

// One right-hand side. 16 ascending columns are neighbours in x when the ends are 15 apart: then two wide
// loads replace 16 gathers. A pixel of a transport sees many such stretches.
kernel void csr_matvec_stream(
    int rows, int first, int stride, int offset, real scale, int adds, global const int *pointers,
    global const int *columns, global const real *values, global const real *x, global const real *add,
    global real *out)
{
    stride = STRIDE(stride);
    const int row = get_global_id(0);
    if (row >= rows)
        return;
    x += offset;
    real8 even = 0, odd = 0;
    int j = pointers[row];
    const int end = pointers[row + 1];
    for (; j + 16 <= end; j += 16) {
        const int column = columns[j];
        if (stride == 1 && columns[j + 15] == column + 15) {
            even = LOAD8(values + j) * LOAD8(x + column) + even;
            odd = LOAD8(values + j + 8) * LOAD8(x + column + 8) + odd;
        } else {
            even = LOAD8(values + j) * gather8(x, stride, columns + j) + even;
            odd = LOAD8(values + j + 8) * gather8(x, stride, columns + j + 8) + odd;
        }
    }
    real sum = sum8(even + odd);
    for (; j < end; ++j)
        sum = values[j] * x[columns[j] * stride] + sum;
    const int i = (first + row) * stride + offset;
    LTCL_STORE(out, i, sum, scale, adds, add);
}

#else

// Several right-hand sides: the K values of a pixel lie side by side, one wide load a nonzero.
kernel void csr_matvec_stream(
    int rows, int first, int stride, int offset, real scale, int adds, global const int *pointers,
    global const int *columns, global const real *values, global const real *x, global const real *add,
    global real *out)
{
    stride = STRIDE(stride);
    const int row = get_global_id(0);
    if (row >= rows)
        return;
    x += offset;
    lanes s0 = 0, s1 = 0, s2 = 0, s3 = 0;  // four sums hide the latency of the addition
    int j = pointers[row];
    const int end = pointers[row + 1];
    for (; j + 4 <= end; j += 4) {
        s0 = (lanes)(values[j]) * LOAD(x + columns[j] * stride) + s0;
        s1 = (lanes)(values[j + 1]) * LOAD(x + columns[j + 1] * stride) + s1;
        s2 = (lanes)(values[j + 2]) * LOAD(x + columns[j + 2] * stride) + s2;
        s3 = (lanes)(values[j + 3]) * LOAD(x + columns[j + 3] * stride) + s3;
    }
    for (; j < end; ++j)
        s0 = (lanes)(values[j]) * LOAD(x + columns[j] * stride) + s0;
    lanes_items sum;
    sum.vector = (s0 + s1) + (s2 + s3);
    const int i = (first + row) * stride + offset;
    for (int c = 0; c < K; ++c)
        LTCL_STORE(out, i + c, sum.item[c], scale, adds, add);
}

#endif

kernel void csr_matvec_group(
    int rows, int first, int stride, int offset, real scale, int adds, global const int *pointers,
    global const int *columns, global const real *values, global const real *x, global const real *add,
    global real *out, local real *scratch)
{
    stride = STRIDE(stride);
    const int row = get_group_id(0);  // one group a row exactly: no row is beyond the last
    real sum[K];
    for (int c = 0; c < K; ++c)
        sum[c] = 0;
    const int end = pointers[row + 1];
    for (int j = pointers[row] + get_local_id(0); j < end; j += get_local_size(0))
        for (int c = 0; c < K; ++c)
            sum[c] = values[j] * x[columns[j] * stride + offset + c] + sum[c];
    const int i = (first + row) * stride + offset;
    for (int c = 0; c < K; ++c) {
        const real total = group_sum(sum[c], scratch);
        if (get_local_id(0) == 0)
            LTCL_STORE(out, i + c, total, scale, adds, add);
    }
}
