// SPDX-License-Identifier: BSD-3-Clause
// Kernels over the rows of a matrix A: what csr.cl, dense.cl, tile.cl and form_factor.cl share.
//
// A format has two kernels, each the body BY_ITEM or BY_GROUP around a statement that adds up one
// row:
//
//   <format>_matvec        one work-item a row, in wide loads: for CPUs, and for short rows
//   <format>_matvec_group  one work-group for ROWS rows, the items of a row side by side: for GPUs
//
// What becomes of the sum of a row, and with it PRODUCT_ARGUMENTS, depends on a define:
//
//   without STEP  out = a (A x) + b y + c x, see product_plain.h
//   with STEP     a step of a stationary iteration along x, see product_step.h
//
// Required define: K. Optional: STEP, PACKED, see lanes.h; ROWS of a work-group, 1 without it, a
// power of two that is at most its size. Layout: a slab of `rows` rows, the first
// of which is row `first` of the matrix. Vectors are row-major with `stride` reals a row, of which
// a launch takes offset .. offset + K - 1. `scratch` holds K reals a work-item.

#ifndef LTCL_PRODUCT_H
#define LTCL_PRODUCT_H

#include "lanes.h"

#ifndef ROWS
#define ROWS 1
#endif

// The sum of each of K values over a work-group, in every item.
INLINE void group_sums(real *value, local real *scratch)
{
    for (int k = 0; k < K; ++k)
        scratch[get_local_id(0) * K + k] = value[k];
    fold(scratch, K * (int)get_local_size(0), K, K);
    for (int k = 0; k < K; ++k)
        value[k] = scratch[k];
}

// The same over the items of a row, of ROWS rows in a work-group.
#if ROWS > 1
INLINE void row_totals(real *value, local real *scratch)
{
    const int items = get_local_size(0) / ROWS, row = get_local_id(0) / items;
    const int me = (int)get_local_id(0) - row * items;
    for (int k = 0; k < K; ++k)
        scratch[(me * ROWS + row) * K + k] = value[k];
    fold(scratch, K * ROWS * items, K * ROWS, K * ROWS);
    for (int k = 0; k < K; ++k)
        value[k] = scratch[row * K + k];
}
#else
#define row_totals group_sums
#endif

#ifdef STEP
#include "product_step.h"
#else
#include "product_plain.h"
#endif

// `row_sum` adds row number `row` of the slab to `sum`.
#define BY_ITEM(row_sum) \
    stride = STRIDE(stride); \
    const int row = get_global_id(0); \
    lane_sums sum = {0}; \
    if (row < rows) { \
        row_sum; \
        finish_row(PRODUCT_NAMES, row, sum.item); \
    } \
    SUM_SQUARES; \
    KEEP_SQUARES

// `row_sum` adds the share of item `me` of `items` of row number `row` of the slab to `sum`.
#define BY_GROUP(row_sum) \
    stride = STRIDE(stride); \
    const int items = get_local_size(0) / ROWS, place = get_local_id(0) / items; \
    const int row = get_group_id(0) * ROWS + place, me = (int)get_local_id(0) - place * items; \
    lane_sums sum = {0}; \
    if (row < rows) \
        row_sum; \
    row_totals(sum.item, scratch); \
    const bool is_first = me == 0 && row < rows; \
    if (is_first) \
        finish_row(PRODUCT_NAMES, row, sum.item); \
    SUM_ROWS(is_first); \
    KEEP_SQUARES

#endif
