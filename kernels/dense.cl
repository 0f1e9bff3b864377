// SPDX-License-Identifier: BSD-3-Clause
// Product of a dense row-major matrix with K right-hand sides, steps of an iteration along one (see common/product.h
// for these three kernels, their arguments and defines), and products with its transpose. These read rows, too:
//
//   dense_rmatvec      one work-item a strip of columns, down the rows of chunk get_global_id(1)
//   dense_rmatvec_sum  adds up the chunks, where there are several
//
// Required define besides K: LANES: 8 on CPUs, 1 on GPUs, where neighbouring columns are those of neighbouring items.
// Layout: a slab of `rows` rows of `width` reals.

#include "common/row_sums.h"
#include "common/product.h"
#include "common/stretch.h"

#define SLAB_ARGUMENTS int width, global const real *matrix

kernel void dense_matvec(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    BY_ITEM(dense_add(sum.item, matrix + (size_t)row * width, x + offset, stride, 0, width, 1));
}

kernel void dense_matvec_stream(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    BY_ITEM(sum = dense_sum(matrix + (size_t)row * width, x + offset, stride, 0, width));
}

kernel void dense_matvec_group(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    BY_GROUP(dense_add(sum.item, matrix + (size_t)row * width, x + offset, stride, me, width, items));
}

#ifndef STEP
#define STRIP (LANES == 1 ? 1 : 256)  // neighbouring columns of a work-item: long enough to be read as a stream

// out (width, stride) of each chunk = a (its rows)^T x + b y + c x, where x is multiplied from row `first` on.
kernel void dense_rmatvec(
    int rows, int first, int stride, int offset, real a, real b, real c, global const real *x,
    global const real *y, global real *out, int width, global const real *matrix)
{
    stride = STRIDE(stride);
    const int column = get_global_id(0) * STRIP;
    const int count = min(STRIP, width - column), whole = count / LANES;
    if (count <= 0)
        return;
    const int size = (rows + (int)get_global_size(1) - 1) / (int)get_global_size(1);
    const int begin = get_global_id(1) * size, end = min(rows, begin + size);
    global const real *of = x + first * stride + offset;
    stretch_items sum[STRIP / LANES][K];
    for (int s = 0; s < STRIP / LANES; ++s)
        for (int k = 0; k < K; ++k)
            sum[s][k].vector = 0;
    for (int row = begin; row < end; ++row) {
        global const real *from = matrix + (size_t)row * width + column;
        for (int s = 0; s < whole; ++s) {
            const stretch v = LOAD_STRETCH(from + s * LANES);
            for (int k = 0; k < K; ++k)
                sum[s][k].vector += v * of[row * stride + k];
        }
        for (int lane = whole * LANES; lane < count; ++lane)
            for (int k = 0; k < K; ++k)
                sum[whole][k].item[lane - whole * LANES] += from[lane] * of[row * stride + k];
    }
    out += (size_t)get_global_id(1) * width * stride;
    for (int lane = 0; lane < count; ++lane)
        for (int k = 0; k < K; ++k) {
            const real total = sum[lane / LANES][k].item[lane % LANES];
            finish((column + lane) * stride + offset + k, total, a, b, c, x, y, out);
        }
}

// out = sum of the chunks + b y + c x, one work-item a number of `count`.
kernel void dense_rmatvec_sum(
    int count, int chunks, real b, real c, global const real *x, global const real *y, global real *out,
    global const real *sums)
{
    const int i = get_global_id(0);
    if (i >= count)
        return;
    real value = 0;
    for (int chunk = 0; chunk < chunks; ++chunk)
        value += sums[(size_t)chunk * count + i];
    finish(i, value, 1, b, c, x, y, out);
}
#endif
