// SPDX-License-Identifier: BSD-3-Clause
// Kernels over the rows of a matrix: what csr.cl, dense.cl and tile.cl share, and what becomes of the sum of a row.
//
//   without STEP   out = a (A x) + b y + c x
//   with STEP      one step of a stationary iteration on S = a A + c I along the direction x:
//                  iterate += x;  r -= S x;  next_x = keep x + gain r;  and the squares of the new r, summed over a
//                  work-group, to partials[first_group + group]
//
// <format>_matvec takes one work-item a row, in wide loads: for CPUs, and for short rows; <format>_matvec_group one
// work-group, its items side by side: for GPUs. Each is BY_ITEM or BY_GROUP of a statement that adds item `me` of
// `items`' share of row `row` to `sum`.
//
// Required define: K, see common/lanes.h. Optional: STEP, and PACKED, see there.
// Layout: a slab of `rows` rows, the first of which is row `first` of the matrix. Vectors are row-major with `stride`
// reals a row, of which a launch takes offset .. offset + K - 1, and so are partials, with a row for each group. y may
// be out. `scratch` holds K reals a work-item.

#include "common/lanes.h"

// The sum of each of K values over a work-group, in every item.
static inline void group_sums(real *value, local real *scratch)
{
    for (int k = 0; k < K; ++k)
        scratch[get_local_id(0) * K + k] = value[k];
    fold(scratch, K * (int)get_local_size(0), K, K);
    for (int k = 0; k < K; ++k)
        value[k] = scratch[k];
}

#ifdef STEP
#define PRODUCT_ARGUMENTS \
    int rows, int first, int stride, int offset, real a, real c, real keep, real gain, int first_group, \
    global const real *x, global real *iterate, global real *r, global real *next_x, global real *partials
#define PRODUCT_NAMES \
    rows, first, stride, offset, a, c, keep, gain, first_group, x, iterate, r, next_x, partials
#define SUM_SQUARES group_sums(sum.item, scratch)
#define KEEP_SQUARES \
    for (int k = 0; k < K && get_local_id(0) == 0; ++k) \
        partials[(first_group + (int)get_group_id(0)) * stride + offset + k] = sum.item[k]

// The step of one row; `sum` becomes the squares of its residual.
static inline void finish_row(PRODUCT_ARGUMENTS, int row, real *sum)
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
#else
#define PRODUCT_ARGUMENTS \
    int rows, int first, int stride, int offset, real a, real b, real c, global const real *x, \
    global const real *y, global real *out
#define PRODUCT_NAMES rows, first, stride, offset, a, b, c, x, y, out
#define SUM_SQUARES
#define KEEP_SQUARES

static inline void finish_row(PRODUCT_ARGUMENTS, int row, const real *sum)
{
    for (int k = 0; k < K; ++k)
        finish((first + row) * stride + offset + k, sum[k], a, b, c, x, y, out);
}
#endif

#define BY_ITEM(row_sum) \
    stride = STRIDE(stride); \
    const int row = get_global_id(0); \
    sums sum = {0}; \
    if (row < rows) { \
        row_sum; \
        finish_row(PRODUCT_NAMES, row, sum.item); \
    } \
    SUM_SQUARES; \
    KEEP_SQUARES

#define BY_GROUP(row_sum) \
    stride = STRIDE(stride); \
    const int row = get_group_id(0), me = get_local_id(0), items = get_local_size(0); \
    sums sum = {0}; \
    row_sum; \
    group_sums(sum.item, scratch); \
    if (me == 0) \
        finish_row(PRODUCT_NAMES, row, sum.item); \
    KEEP_SQUARES
