// SPDX-License-Identifier: BSD-3-Clause
// Product of a matrix in compressed sparse rows with K right-hand sides, and steps of an iteration along one;
// see common/product.h for what becomes of the sums.
//
// Three kernels do the same; the device layer times them and takes the fastest:
//   csr_matvec         one work-item a row, as it reads in a textbook
//   csr_matvec_stream  one work-item a row, in wide loads (common/row_sums.h); for CPUs
//   csr_matvec_group   one work-group a row, its items side by side along the row; for GPUs
//
// Required define: K, the right-hand sides of one launch: 1, 2, 3, 4 or 8.
// Optional: STEP, see common/product.h; PACKED, see common/lanes.h.
// Layout: pointers[rows + 1] counts from 0 within the slab; columns and values follow it, columns ascending and
// unique within a row.

#include "common/row_sums.h"
#include "common/product.h"

#define SLAB_ARGUMENTS global const int *pointers, global const int *columns, global const real *values

kernel void csr_matvec(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    ITEM_ROW;
    if (inside)
        csr_add(sum.item, columns, values, x + offset, stride, pointers[row], pointers[row + 1], 1);
    FINISH_ITEMS(sum);
}

kernel void csr_matvec_stream(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    ITEM_ROW;
    if (inside)
        sum = csr_sum(columns, values, x + offset, stride, pointers[row], pointers[row + 1]);
    FINISH_ITEMS(sum);
}

kernel void csr_matvec_group(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    GROUP_ROW;
    csr_add(sum.item, columns, values, x + offset, stride, pointers[row] + me, pointers[row + 1], items);
    FINISH_GROUP(sum);
}
