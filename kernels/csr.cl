// SPDX-License-Identifier: BSD-3-Clause
// Product of a matrix in compressed sparse rows with K right-hand sides, and steps of an iteration along one; see
// common/product.h for the two kernels, their arguments and defines.
//
// Layout: pointers[rows + 1] counts from 0 within the slab; columns, ascending and unique in a row, and values.

#include "common/row_sums.h"
#include "common/product.h"

#define SLAB_ARGUMENTS global const int *pointers, global const int *columns, global const real *values

kernel void csr_matvec(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    BY_ITEM(sum.vector = row_sum(true, columns, values, x + offset, stride, pointers[row], pointers[row + 1]));
}

kernel void csr_matvec_group(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    const int begin = pointers[get_group_id(0)] + get_local_id(0), end = pointers[get_group_id(0) + 1];
    BY_GROUP(row_add(true, sum.item, columns, values, x + offset, stride, begin, end, items));
}
