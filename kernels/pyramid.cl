// SPDX-License-Identifier: BSD-3-Clause
// A quad-tree over a picture: level 0 is its pixels, and a cell of each further level covers 2 x 2 of the one before,
// fewer at the edges, until one cell is left.
//
//   pyramid_gather  sums of the pixels in each cell of one level, from those of the level before
//   pyramid_spread  to each pixel, the sum of the cells that it lies in, one of each level
//
// Work-items stride through the k right-hand sides (dimension 0), columns (1) and rows (2), as many as there are.
// Layout: the cells of all levels one after another, the finest first, each level row-major, right-hand
// sides side by side. height and width are the picture's.

#include "common/real.h"

// Cells of one level, and the first of them among all.
typedef struct {
    int height, width, at;
} cells;

INLINE cells next(cells a)
{
    cells b = {(a.height + 1) / 2, (a.width + 1) / 2, a.at + a.height * a.width};
    return b;
}

// out = scale * sums + add. sums (cells, k) is scratch, whose level 0 is not used: it is x.
kernel void pyramid_gather(
    int height, int width, int level, int k, real scale, int adds, global const real *x, global real *sums,
    global const real *add, global real *out)
{
    cells a = {height, width, 0}, below = a;
    for (int l = 0; l < level; ++l) {
        below = a;
        a = next(a);
    }
    const int reach = level == 0 ? 1 : 2;
    global const real *of = level < 2 ? x : sums + below.at * k;
    for (int row = get_global_id(2); row < a.height; row += get_global_size(2))
        for (int column = get_global_id(1); column < a.width; column += get_global_size(1))
            for (int c = get_global_id(0); c < k; c += get_global_size(0)) {
                real sum = 0;
                for (int i = reach * row; i < min(reach * (row + 1), below.height); ++i)
                    for (int j = reach * column; j < min(reach * (column + 1), below.width); ++j)
                        sum += of[(i * below.width + j) * k + c];
                const int cell = (a.at + row * a.width + column) * k + c;
                if (level > 0)
                    sums[cell] = sum;
                LTCL_STORE(out, cell, sum, scale, adds, add);
            }
}

kernel void pyramid_spread(
    int height, int width, int levels, int k, real scale, int adds, global const real *x, global const real *add,
    global real *out)
{
    for (int row = get_global_id(2); row < height; row += get_global_size(2))
        for (int column = get_global_id(1); column < width; column += get_global_size(1))
            for (int c = get_global_id(0); c < k; c += get_global_size(0)) {
                cells a = {height, width, 0};
                real sum = 0;
                for (int level = 0; level < levels; ++level, a = next(a))
                    sum += x[(a.at + (row >> level) * a.width + (column >> level)) * k + c];
                LTCL_STORE(out, (row * width + column) * k + c, sum, scale, adds, add);
            }
}
