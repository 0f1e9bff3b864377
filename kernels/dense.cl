// SPDX-License-Identifier: BSD-3-Clause
// Product of a dense row-major matrix with K right-hand sides, steps of an iteration along one, and
// products with the transpose.
//
//   dense_matvec        one work-item a row
//   dense_matvec_group  one work-group a row
//   dense_rmatvec       one work-item a strip of columns and a slice of the rows; a work-group has
//                       STRIPS neighbouring strips (fewer where it is smaller) and all rows
//
// Required defines: K, see common/product.h, which has PRODUCT_ARGUMENTS, too; STRIP, columns of a
// work-item of dense_rmatvec: 256 on CPUs, read as a stream by one item a group, 1 on GPUs; STRIPS.
//
// Layout: a slab of rows.
//   width    columns of the matrix
//   matrix   [rows * width]
//   scratch  K reals a work-item

#include "common/product.h"
#include "common/row_sums.h"

#if !defined(STRIP) || !defined(STRIPS)
#error "dense.cl needs -DSTRIP=<columns of an item of dense_rmatvec>, -DSTRIPS=<strips of a group>"
#endif

#define SLAB_ARGUMENTS int width, global const real *matrix

kernel void dense_matvec(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    BY_ITEM(
        sum.vector = row_sum(false, 0, matrix + (size_t)row * width, x + offset, stride, 0, width));
}

kernel void dense_matvec_group(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    BY_GROUP(row_add(
        false, sum.item, 0, matrix + (size_t)row * width, x + offset, stride, me, width, items));
}

kernel void dense_rmatvec(
    int rows,                   // rows of the slab
    int first,                  // row of x that belongs to the first of them
    int stride,                 // right-hand sides in all
    int offset,                 // the first of the K of the launch
    real a,                     // factor of each sum
    real b,                     // factor of y
    real c,                     // factor of x
    global const real *x,       // what the transpose is multiplied with
    global const real *y,       // not read where b is 0
    global real *out,           // (width, stride), a (the slab)^T x + b y + c x
    int width,                  // columns of the matrix
    global const real *matrix,  // [rows * width]
    local real *scratch)        // K reals a work-item
{
    stride = STRIDE(stride);
    const int me = get_local_id(0), items = get_local_size(0);
    const int strips = min(STRIPS, items), slices = items / strips, slice = me / strips;
    const int column = ((int)get_group_id(0) * strips + me % strips) * STRIP;
    const int count = min(STRIP, width - column);
    const int size = (rows + slices - 1) / slices;
    const int begin = slice * size, end = min(rows, begin + size);
    real sum[K][STRIP] = {{0}};
    // Two rows at a time: fewer loads and stores of the sums.
    for (int row = begin; row < end; row += 2) {
        const int second = row + 1 < end ? 1 : 0, i = (first + row) * stride + offset;
        global const real *upper = matrix + (size_t)row * width + column;
        global const real *lower = upper + second * width;
        for (int k = 0; k < K; ++k) {
            const real u = x[i + k], v = second ? x[i + stride + k] : 0;
            for (int lane = 0; lane < count; ++lane)
                sum[k][lane] += upper[lane] * u + lower[lane] * v;
        }
    }
#if STRIP == 1
    // Items beyond the last whole slice have no rows.
    for (int k = 0; k < K && slice < slices; ++k)
        scratch[me * K + k] = sum[k][0];
    fold(scratch, slices * strips * K, strips * K, strips * K);
    for (int k = 0; k < K && slice == 0 && count > 0; ++k)
        finish(column * stride + offset + k, scratch[me * K + k], a, b, c, x, y, out);
#else
    for (int lane = 0; lane < count; ++lane)
        for (int k = 0; k < K; ++k)
            finish((column + lane) * stride + offset + k, sum[k][lane], a, b, c, x, y, out);
#endif
}
