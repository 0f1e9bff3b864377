// SPDX-License-Identifier: BSD-3-Clause
// Product of a matrix in compressed sparse rows with K right-hand sides: out = scale * (A x) + add.
//
// Three kernels do the same; the device layer times them and takes the fastest:
//   csr_matvec         one work-item a row, as it reads in a textbook
//   csr_matvec_stream  one work-item a row, in wide loads (common/row_sums.h); for CPUs
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
#include "common/row_sums.h"

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
    csr_add(sum, columns, values, x + offset, stride, pointers[row], pointers[row + 1], 1);
    const int i = (first + row) * stride + offset;
    for (int c = 0; c < K; ++c)
        LTCL_STORE(out, i + c, sum[c], scale, adds, add);
}

kernel void csr_matvec_stream(
    int rows, int first, int stride, int offset, real scale, int adds, global const int *pointers,
    global const int *columns, global const real *values, global const real *x, global const real *add,
    global real *out)
{
    stride = STRIDE(stride);
    const int row = get_global_id(0);
    if (row >= rows)
        return;
    const sums sum = csr_sum(columns, values, x + offset, stride, pointers[row], pointers[row + 1]);
    const int i = (first + row) * stride + offset;
    for (int c = 0; c < K; ++c)
        LTCL_STORE(out, i + c, sum.item[c], scale, adds, add);
}

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
    csr_add(
        sum, columns, values, x + offset, stride, pointers[row] + get_local_id(0), pointers[row + 1],
        get_local_size(0));
    const int i = (first + row) * stride + offset;
    for (int c = 0; c < K; ++c) {
        const real total = group_sum(sum[c], scratch);
        if (get_local_id(0) == 0)
            LTCL_STORE(out, i + c, total, scale, adds, add);
    }
}
