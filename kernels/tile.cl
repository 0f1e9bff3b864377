// SPDX-License-Identifier: BSD-3-Clause
// Product of a sparse matrix of tiles with K right-hand sides, and steps of an iteration along one; see
// common/product.h for what becomes of the sums. A tile is WIDTH neighbouring columns of one row: one column index
// for WIDTH numbers, and x is read in wide loads.
//
// Three kernels do the same; the device layer times them and takes the fastest:
//   tile_matvec         one work-item a row, as it reads in a textbook
//   tile_matvec_stream  one work-item a row, in wide loads (common/tile_sums.h); for CPUs
//   tile_matvec_group   one work-group a row, its items side by side along the row; for GPUs
//
// Required defines: K, the right-hand sides of one launch: 1, 2, 3, 4 or 8; WIDTH: 1 or 8; VALUES, the type of
// the numbers, see common/tile_sums.h.
// Optional: LONG: column indices have 32 bits, not 16; STEP, see common/product.h; PACKED, see common/lanes.h.
// Layout: pointers[rows + 1] counts tiles from 0 within the slab; columns (one a tile, the first of it) and values
// (WIDTH a tile) follow it, and so do scales (one a tile) where values are int8: they are not read elsewhere.
// Columns that no nonzero claims hold zeros, and no tile reaches beyond the end of its row.

#include "common/product.h"
#include "common/tile_sums.h"

#define SLAB_ARGUMENTS \
    global const int *pointers, global const place *columns, global const narrow *values, global const uchar *scales

kernel void tile_matvec(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    ITEM_ROW;
    if (inside)
        tile_add(
            sum.item, columns, values, scales, x + offset, stride, pointers[row] * WIDTH, pointers[row + 1] * WIDTH, 1);
    FINISH_ITEMS(sum);
}

kernel void tile_matvec_stream(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    ITEM_ROW;
    if (inside)
        sum = tile_sum(columns, values, scales, x + offset, stride, pointers[row], pointers[row + 1]);
    FINISH_ITEMS(sum);
}

kernel void tile_matvec_group(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    GROUP_ROW;
    tile_add(
        sum.item, columns, values, scales, x + offset, stride, pointers[row] * WIDTH + me, pointers[row + 1] * WIDTH,
        items);
    FINISH_GROUP(sum);
}
