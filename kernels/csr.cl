// SPDX-License-Identifier: BSD-3-Clause
// Product of a matrix in compressed sparse rows with K right-hand sides, and steps of an iteration
// along one. The two kernels (a work-item a row, or a work-group for some), their defines and
// PRODUCT_ARGUMENTS: common/product.h.
//
// Layout: a slab of rows.
//   pointers  [rows + 1], where each row begins, counted from 0 within the slab
//   columns   of each entry, ascending and unique in a row
//   values    of each entry
//   scratch   K reals a work-item

#include "common/product.h"
#include "common/row_sums.h"

#define SLAB_ARGUMENTS \
    global const int *pointers, global const int *columns, global const real *values

kernel void csr_matvec(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    global const real *from = x + offset;
    BY_ITEM(
        sum.vector =
            row_sum(true, columns, values, from, stride, pointers[row], pointers[row + 1]));
}

kernel void csr_matvec_group(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    global const real *from = x + offset;
    BY_GROUP(
        row_add(
            true, sum.item, columns, values, from, stride, pointers[row] + me, pointers[row + 1],
            items));
}
