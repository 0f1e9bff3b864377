// SPDX-License-Identifier: BSD-3-Clause
// out = a (A x) + b y + c x: the end of a row in the kernels of product.h, without STEP.
//
//   rows    rows of the slab
//   first   row of the matrix with which the slab begins
//   stride  right-hand sides in all
//   offset  the first of the K right-hand sides of the launch
//   a b c   factors; y is not read where b is 0, nor x for its own sake where c is 0
//   x       what A is multiplied with
//   y       what is added; may be out
//   out     the result

#ifndef LTCL_PRODUCT_PLAIN_H
#define LTCL_PRODUCT_PLAIN_H

#include "lanes.h"

#define PRODUCT_ARGUMENTS \
    int rows, int first, int stride, int offset, real a, real b, real c, global const real *x, \
        global const real *y, global real *out
#define PRODUCT_NAMES rows, first, stride, offset, a, b, c, x, y, out
#define SUM_SQUARES
#define SUM_ROWS(is_first)
#define KEEP_SQUARES

INLINE void finish_row(PRODUCT_ARGUMENTS, int row, const real *sum)
{
    for (int k = 0; k < K; ++k)
        finish((first + row) * stride + offset + k, sum[k], a, b, c, x, y, out);
}

#endif
