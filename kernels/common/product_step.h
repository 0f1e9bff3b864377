// SPDX-License-Identifier: BSD-3-Clause
// One step of a stationary iteration on S = a A + c I along the direction x: the end of a row in
// the kernels of product.h, with STEP.
//
//     iterate += x;   r -= S x;   next_x = keep x + gain r
//
// and the squares of the new r, summed over a work-group.
//
//   rows         rows of the slab
//   first        row of the matrix with which the slab begins
//   stride       right-hand sides in all
//   offset       the first of the K right-hand sides of the launch
//   a c          factors of S
//   keep gain    factors of the next direction
//   first_group  number of the first work-group of this launch among those of the step
//   x            the direction
//   iterate      moved along x
//   r            residual of the iterate
//   next_x       the next direction; not x, which other groups read
//   partials     row first_group + group, of `stride` reals, gets the squares

#ifndef LTCL_PRODUCT_STEP_H
#define LTCL_PRODUCT_STEP_H

#include "lanes.h"

#define PRODUCT_ARGUMENTS \
    int rows, int first, int stride, int offset, real a, real c, real keep, real gain, \
        int first_group, global const real *x, global real *iterate, global real *r, \
        global real *next_x, global real *partials
#define PRODUCT_NAMES \
    rows, first, stride, offset, a, c, keep, gain, first_group, x, iterate, r, next_x, partials
#define SUM_SQUARES group_sums(sum.item, scratch)
// The squares of the rows of a group, which their first items have.
#if ROWS > 1
#define SUM_ROWS(is_first) \
    for (int k = 0; k < K; ++k) \
        sum.item[k] = is_first ? sum.item[k] : 0; \
    barrier(CLK_LOCAL_MEM_FENCE); \
    group_sums(sum.item, scratch)
#else
#define SUM_ROWS(is_first)
#endif
#define KEEP_SQUARES \
    for (int k = 0; k < K && get_local_id(0) == 0; ++k) \
    partials[(first_group + (int)get_group_id(0)) * stride + offset + k] = sum.item[k]

// The step of one row; `sum` becomes the squares of its residual.
INLINE void finish_row(PRODUCT_ARGUMENTS, int row, real *sum)
{
    const int i = (first + row) * stride + offset;
    for (int k = 0; k < K; ++k) {
        const real d = x[i + k], left = r[i + k] - (a * sum[k] + c * d);
        iterate[i + k] += d;
        r[i + k] = left;
        next_x[i + k] = keep * d + gain * left;
        sum[k] = left * left;
    }
}

#endif
