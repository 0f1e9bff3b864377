// SPDX-License-Identifier: BSD-3-Clause
// Hat functions of all scales over a picture: level 0 is its pixels, and node (i, j) of level l has
// the bilinear hat max(0, 1 - |row / s - i|) max(0, 1 - |column / s - j|), s = 2^l. A side of n nodes
// has n / 2 + 1 on the next level (rounded down), until no side has more than 2.
// out = a (W x) + b y, where W is
//
//   hats_gather  sums of the pixels under each hat, a level from those of the level before
//   hats_spread  the transpose: to each pixel, the sum of the hats above it, a level from the one above
//
// A hat is the sum of those of the level before: of its own node, and half of its neighbours.
// Arguments, layout and what a work-item does: common/levels.h. Required define: K.

#define SIDE_ABOVE(n) ((n) / 2 + 1)
#include "common/levels.h"

// Share of a node at a distance of -1, 0 or 1 from the middle of a hat of the next level.
INLINE real share(int distance)
{
    return distance == 0 ? (real)1 : (real)0.5;
}

#define SUM_DOWN(p) \
    (LOAD(p) + (real)0.5 * (LOAD((p) - other.w * k) + LOAD((p) + other.w * k)))

INLINE lanes
sum_under_hat(int row, int column, level_place other, global const real *sums, int k)
{
    const int y = 2 * row, bottom = min(y + 1, other.h - 1);
    const int x = 2 * column, right = min(x + 1, other.w - 1);
    if (y > 0 && x > 0 && y + 1 < other.h && x + 1 < other.w) {
        // Within the picture along one side after the other.
        global const real *middle = sums + (y * other.w + x) * k;
        const lanes before = SUM_DOWN(middle - k), after = SUM_DOWN(middle + k);
        return SUM_DOWN(middle) + (real)0.5 * (before + after);
    }
    lanes sum = 0;
    for (int i = max(y - 1, 0); i <= bottom; ++i)
        for (int j = max(x - 1, 0); j <= right; ++j)
            sum += share(i - y) * share(j - x) * LOAD(sums + (i * other.w + j) * k);
    return sum;
}

// A node between two of the level above is half of each.
INLINE lanes nodes_above(int row, int column, level_place other, global const real *sums, int k)
{
    const int top = row >> 1, left = column >> 1;
    const int rows = 1 + (row & 1), columns = 1 + (column & 1);
    lanes around = 0;
    for (int i = 0; i < rows; ++i)
        for (int j = 0; j < columns; ++j)
            around += LOAD(sums + ((top + i) * other.w + left + j) * k);
    return around / (rows * columns);
}

kernel void hats_gather(GATHER_ARGUMENTS)
{
    GATHER(sum_under_hat)
}

kernel void hats_spread(SPREAD_ARGUMENTS)
{
    SPREAD(nodes_above)
}
