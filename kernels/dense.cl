// SPDX-License-Identifier: BSD-3-Clause
// Product of a dense row-major matrix with K right-hand sides: out = scale * (A x) + add, and with A^T.
//
// Three kernels do the same; the device layer times them and takes the fastest:
//   dense_matvec         one work-item a row, as it reads in a textbook
//   dense_matvec_stream  one work-item a row, in wide loads (common/row_sums.h); for CPUs
//   dense_matvec_group   one work-group a row, its items side by side along the row; for GPUs
// dense_rmatvec          the transpose: one work-item LANES neighbouring columns, down the rows of a slab
//
// Required defines: K, the right-hand sides of one launch: 1, 2, 3, 4 or 8; LANES: 1 or 8.
// Optional: PACKED, see common/lanes.h.
// Layout: a slab of `rows` rows of `width` reals, the first of which is row `first` of the matrix. x and
// out are row-major with `stride` reals a row; the launch works on their columns offset .. offset + K - 1.

#include "common/lanes.h"
#include "common/reduce.h"
#include "common/row_sums.h"
#include "common/stretch.h"

kernel void dense_matvec(
    int rows, int first, int stride, int offset, real scale, int adds, int width, global const real *matrix,
    global const real *x, global const real *add, global real *out)
{
    stride = STRIDE(stride);
    const int row = get_global_id(0);
    if (row >= rows)
        return;
    global const real *a = matrix + (size_t)row * width;
    real sum[K];
    for (int c = 0; c < K; ++c)
        sum[c] = 0;
    dense_add(sum, a, x + offset, stride, 0, width, 1);
    const int i = (first + row) * stride + offset;
    for (int c = 0; c < K; ++c)
        LTCL_STORE(out, i + c, sum[c], scale, adds, add);
}

kernel void dense_matvec_stream(
    int rows, int first, int stride, int offset, real scale, int adds, int width, global const real *matrix,
    global const real *x, global const real *add, global real *out)
{
    stride = STRIDE(stride);
    const int row = get_global_id(0);
    if (row >= rows)
        return;
    const sums sum = dense_sum(matrix + (size_t)row * width, x + offset, stride, 0, width);
    const int i = (first + row) * stride + offset;
    for (int c = 0; c < K; ++c)
        LTCL_STORE(out, i + c, sum.item[c], scale, adds, add);
}

kernel void dense_matvec_group(
    int rows, int first, int stride, int offset, real scale, int adds, int width, global const real *matrix,
    global const real *x, global const real *add, global real *out, local real *scratch)
{
    stride = STRIDE(stride);
    const int row = get_group_id(0);  // one group a row exactly: no row is beyond the last
    global const real *a = matrix + (size_t)row * width;
    real sum[K];
    for (int c = 0; c < K; ++c)
        sum[c] = 0;
    dense_add(sum, a, x + offset, stride, get_local_id(0), width, get_local_size(0));
    const int i = (first + row) * stride + offset;
    for (int c = 0; c < K; ++c) {
        const real total = group_sum(sum[c], scratch);
        if (get_local_id(0) == 0)
            LTCL_STORE(out, i + c, total, scale, adds, add);
    }
}

// out = scale * (slab^T x) + add, where x is read from row `first` on. The host adds the slabs up, one
// launch after the other, so the sum has one order.
kernel void dense_rmatvec(
    int rows, int first, int stride, int offset, real scale, int adds, int width, global const real *matrix,
    global const real *x, global const real *add, global real *out)
{
    stride = STRIDE(stride);
    const int item = get_global_id(0) * LANES;
    if (item >= width)
        return;
    // The last item moves back to a full stretch where it can; what it shares it does not store again.
    const int column = width < LANES ? 0 : min(item, width - LANES);
    const int lanes_here = min(LANES, width);
    global const real *a = matrix + column;
    x += first * stride + offset;
    stretch_items sum[K];
    for (int c = 0; c < K; ++c)
        for (int lane = 0; lane < LANES; ++lane)
            sum[c].item[lane] = 0;
    if (lanes_here == LANES) {
        stretch s[K];
        for (int c = 0; c < K; ++c)
            s[c] = 0;
        for (int row = 0; row < rows; ++row) {
            const stretch v = LOAD_STRETCH(a + (size_t)row * width);
            for (int c = 0; c < K; ++c)
                s[c] = v * x[row * stride + c] + s[c];
        }
        for (int c = 0; c < K; ++c)
            sum[c].vector = s[c];
    } else {
        for (int row = 0; row < rows; ++row)
            for (int lane = 0; lane < lanes_here; ++lane)
                for (int c = 0; c < K; ++c)
                    sum[c].item[lane] = a[(size_t)row * width + lane] * x[row * stride + c] + sum[c].item[lane];
    }
    for (int lane = item - column; lane < lanes_here; ++lane)
        for (int c = 0; c < K; ++c) {
            const int i = (column + lane) * stride + offset + c;
            LTCL_STORE(out, i, sum[c].item[lane], scale, adds, add);
        }
}
