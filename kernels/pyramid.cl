// SPDX-License-Identifier: BSD-3-Clause
// A quad-tree over a picture: level 0 is its pixels, and a cell of each further level covers 2 x 2 of the one
// before, fewer at the edges, until one cell is left.
//
//   pyramid_gather  sums of the pixels in each cell of one level, from those of the level before
//   pyramid_spread  to each cell of one level, the sum of those that it lies in, from those of the level after
//
// Work-items stride through pieces of K right-hand sides (dimension 0), columns (1) and rows (2), as many as
// there are.
//
// Required define: K, the right-hand sides that an item handles together: 1, 2, 3, 4 or 8.
// Layout: the cells of all levels one after another, the finest first, each level row-major, right-hand
// sides side by side. height and width are the picture's. sums is scratch for as many, of which level 0 is not
// used, with a spare cell between levels: wide loads reach beyond the last of a level.

#include "common/pieces.h"

// Cells of one level, and the first of them among all.
typedef struct {
    int height, width, at;
} cells;

INLINE cells cells_at(int height, int width, int level)
{
    cells a = {height, width, 0};
    for (; level > 0; --level) {
        a.at += a.height * a.width;
        a.height = (a.height + 1) / 2;
        a.width = (a.width + 1) / 2;
    }
    return a;
}

kernel void pyramid_gather(
    int height, int width, int level, int levels, int k, real scale, int adds, global const real *x,
    global real *sums, global const real *add, global real *out)
{
    const cells a = cells_at(height, width, level), below = cells_at(height, width, max(level - 1, 0));
    const int reach = level == 0 ? 1 : 2;
    global const real *of = level < 2 ? x : sums + (below.at + level - 1) * k;
    for (int row = get_global_id(2); row < a.height; row += get_global_size(2))
        for (int column = get_global_id(1); column < a.width; column += get_global_size(1))
            for (int p = get_global_id(0); p < pieces_of(k); p += get_global_size(0)) {
                const piece q = piece_of(p, k);
                lanes sum = 0;
                for (int i = reach * row; i < min(reach * (row + 1), below.height); ++i)
                    for (int j = reach * column; j < min(reach * (column + 1), below.width); ++j)
                        sum += LOAD(of + (i * below.width + j) * k + q.at);
                const int cell = (a.at + row * a.width + column) * k + q.at;
                if (level > 0 && level + 1 < levels)
                    put(sums, level * k + cell, sum, q.skip, 1, 0, x);
                put(out, cell, sum, q.skip, scale, adds, add);
            }
}

// Level 0 goes to out. The last of `levels` is alone in the sum.
kernel void pyramid_spread(
    int height, int width, int level, int levels, int k, real scale, int adds, global const real *x,
    global real *sums, global const real *add, global real *out)
{
    const cells a = cells_at(height, width, level), above = cells_at(height, width, level + 1);
    for (int row = get_global_id(2); row < a.height; row += get_global_size(2))
        for (int column = get_global_id(1); column < a.width; column += get_global_size(1))
            for (int p = get_global_id(0); p < pieces_of(k); p += get_global_size(0)) {
                const piece q = piece_of(p, k);
                const int cell = (a.at + row * a.width + column) * k + q.at;
                lanes sum = LOAD(x + cell);
                if (level + 1 < levels)
                    sum += LOAD(sums + (above.at + level + 1 + row / 2 * above.width + column / 2) * k + q.at);
                if (level > 0)
                    put(sums, level * k + cell, sum, q.skip, 1, 0, x);
                else
                    put(out, cell, sum, q.skip, scale, adds, add);
            }
}
