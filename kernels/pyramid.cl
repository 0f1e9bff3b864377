// SPDX-License-Identifier: BSD-3-Clause
// A quad-tree over a picture: level 0 is its pixels, and a cell of each further level covers 2 x 2
// of the one before, fewer at the edges, until one cell is left. out = a (W x) + b y, where W is
//
//   pyramid_gather  sums of the pixels in each cell, a level from those of the level before
//   pyramid_spread  the transpose: to each pixel, the sum of the cells that it lies in, a level from
//                   the one above
//
// Arguments, layout and what a work-item does: common/levels.h. Required define: K.

#define SIDE_ABOVE(n) (((n) + 1) / 2)
#include "common/levels.h"

INLINE lanes
sum_of_cells(int row, int column, level_place other, global const real *sums, int k)
{
    const int bottom = min(2 * row + 2, other.h), right = min(2 * column + 2, other.w);
    lanes sum = 0;
    for (int i = 2 * row; i < bottom; ++i)
        for (int j = 2 * column; j < right; ++j)
            sum += LOAD(sums + (i * other.w + j) * k);
    return sum;
}

INLINE lanes cell_above(int row, int column, level_place other, global const real *sums, int k)
{
    return LOAD(sums + ((row >> 1) * other.w + (column >> 1)) * k);
}

kernel void pyramid_gather(GATHER_ARGUMENTS)
{
    GATHER(sum_of_cells)
}

kernel void pyramid_spread(SPREAD_ARGUMENTS)
{
    SPREAD(cell_above)
}
