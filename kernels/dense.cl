// SPDX-License-Identifier: BSD-3-Clause
// Product of a dense row-major matrix with K right-hand sides, steps of an iteration along one (see common/product.h
// for these two kernels, their arguments and defines), and products with its transpose:
//
//   dense_rmatvec  one work-item a strip of columns, down the rows of chunk get_global_id(1); the sums of several
//                  chunks are a matrix, whose transpose is multiplied by ones
//
// Required define besides K: STRIP: 256 on CPUs, read as a stream, 1 on GPUs. Layout: `rows` rows of `width` reals.

#include "common/row_sums.h"
#include "common/product.h"

#ifndef STRIP
#error "dense.cl needs -DSTRIP=<neighbouring columns of a work-item of dense_rmatvec>"
#endif

#define SLAB_ARGUMENTS int width, global const real *matrix

kernel void dense_matvec(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    BY_ITEM(sum.vector = row_sum(false, 0, matrix + (size_t)row * width, x + offset, stride, 0, width));
}

kernel void dense_matvec_group(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    BY_GROUP(row_add(false, sum.item, 0, matrix + (size_t)row * width, x + offset, stride, me, width, items));
}

// out (width, stride) of each chunk = a (its rows)^T x, of the first + b y + c x; x is multiplied from row `first` on.
kernel void dense_rmatvec(
    int rows, int first, int stride, int offset, real a, real b, real c, global const real *x,
    global const real *y, global real *out, int width, global const real *matrix)
{
    stride = STRIDE(stride);
    const int column = get_global_id(0) * STRIP, count = min(STRIP, width - column);
    const int size = (rows + (int)get_global_size(1) - 1) / (int)get_global_size(1);
    const int begin = get_global_id(1) * size, end = min(rows, begin + size);
    real sum[K][STRIP] = {{0}};
    for (int row = begin; row < end; row += 2) {  // two at a time: fewer loads and stores of the sums
        const int second = row + 1 < end ? 1 : 0, i = (first + row) * stride + offset;
        global const real *from = matrix + (size_t)row * width + column, *next = from + second * width;
        for (int k = 0; k < K; ++k) {
            const real u = x[i + k], v = second ? x[i + stride + k] : 0;
            for (int lane = 0; lane < count; ++lane)
                sum[k][lane] += from[lane] * u + next[lane] * v;
        }
    }
    out += (size_t)get_global_id(1) * width * stride;
    if (get_global_id(1) > 0)
        b = c = 0;
    for (int lane = 0; lane < count; ++lane)
        for (int k = 0; k < K; ++k)
            finish((column + lane) * stride + offset + k, sum[k][lane], a, b, c, x, y, out);
}
