// SPDX-License-Identifier: BSD-3-Clause
// Product of a sparse matrix of tiles with K right-hand sides, and steps of an iteration along one; see
// common/product.h for the three kernels, their arguments and defines. A tile is WIDTH neighbouring columns of one
// row: one column index for WIDTH numbers, and x is read in wide loads.
//
// Required defines besides K: WIDTH: 1 or 8; VALUES, the type of the numbers, see common/tile_sums.h.
// Optional: LONG: column indices have 32 bits, not 16.
// Layout: pointers[rows + 1] counts tiles from 0 within the slab; columns (one a tile, the first of it) and values
// (WIDTH a tile) follow it, and so do scales (one a tile) where values are int8: they are not read elsewhere.
// Columns that no nonzero claims hold zeros, and no tile reaches beyond the end of its row.

#include "common/product.h"
#include "common/tile_sums.h"

#define SLAB_ARGUMENTS \
    global const int *pointers, global const place *columns, global const narrow *values, global const uchar *scales
#define ADD(first, step) \
    tile_add( \
        sum.item, columns, values, scales, x + offset, stride, pointers[row] * WIDTH + first, \
        pointers[row + 1] * WIDTH, step)

kernel void tile_matvec(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    BY_ITEM(ADD(0, 1));
}

kernel void tile_matvec_stream(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    BY_ITEM(sum.vector = tile_sum(columns, values, scales, x + offset, stride, pointers[row], pointers[row + 1]));
}

kernel void tile_matvec_group(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    BY_GROUP(ADD(me, items));
}
