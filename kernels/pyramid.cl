// SPDX-License-Identifier: BSD-3-Clause
// A quad-tree over a picture: level 0 is its pixels, and a cell of each further level covers 2 x 2
// of the one before, fewer at the edges, until one cell is left. out = a (W x) + b y, where W is
//
//   pyramid_gather  sums of the pixels in each cell, a level from those of the level before
//   pyramid_spread  the transpose: to each pixel, the sum of the cells that it lies in, a level from
//                   the one above
//
// Work-items stride through pieces of K right-hand sides (dimension 0), columns (1) and rows (2). A
// launch of several levels takes one group a piece, which waits for itself between them.
//
// Required define: K, see common/lanes.h. Layout: cells level by level, the finest first, each
// row-major, right-hand sides side by side.

#include "common/lanes.h"

kernel void pyramid_gather(
    int height,            // rows of the picture
    int width,             // columns of the picture
    int first_level,       // levels first_level .. end_level - 1 are made,
    int end_level,         // those below are in `sums` already
    int k,                 // right-hand sides
    real a,                // factor of W x
    real b,                // factor of y
    global const real *x,  // the picture, (height width, k)
    global real *sums,     // sums of cells, with a spare one between levels: wide loads reach there
    global const real *y,  // like out; not read where b is 0
    global real *out)      // (cells, k)
{
    const piece p = piece_of(get_global_id(0), k);
    // The level before this one, and where this one begins.
    int below_height = height, below_width = width, at = 0;
    global const real *below = x + p.at;
    for (int level = 0; level < end_level; ++level) {
        const int h = level ? (below_height + 1) / 2 : height;
        const int w = level ? (below_width + 1) / 2 : width;
        const int reach = level ? 2 : 1;
        global real *here = sums + (at + level) * k + p.at;
        for (int row = get_global_id(2); level >= first_level && row < h; row += get_global_size(2))
            for (int column = get_global_id(1); column < w; column += get_global_size(1)) {
                lanes sum = 0;
                for (int i = reach * row; i < min(reach * (row + 1), below_height); ++i)
                    for (int j = reach * column; j < min(reach * (column + 1), below_width); ++j)
                        sum += LOAD(below + (i * below_width + j) * k);
                const int cell = row * w + column;
                if (level > 0)
                    put(here, cell * k, sum, p.skip, 1, 0, x);
                put(out, (at + cell) * k + p.at, sum, p.skip, a, b, y);
            }
        if (level > 0)
            below = here;
        below_height = h;
        below_width = w;
        at += h * w;
        barrier(CLK_GLOBAL_MEM_FENCE);
    }
}

// A level: its sides, and where its cells begin.
typedef struct {
    int h, w, at;
} pyramid_level;

INLINE pyramid_level pyramid_level_at(int height, int width, int level)
{
    pyramid_level v = {height, width, 0};
    for (; level > 0; --level) {
        v.at += v.h * v.w;
        v.h = (v.h + 1) / 2;
        v.w = (v.w + 1) / 2;
    }
    return v;
}

kernel void pyramid_spread(
    int height,            // rows of the picture
    int width,             // columns of the picture
    int first_level,       // levels end_level - 1 .. first_level are made,
    int end_level,         // those above are in `sums` already
    int levels,            // of the tree
    int k,                 // right-hand sides
    real a,                // factor of W^T x
    real b,                // factor of y
    global const real *x,  // (cells, k)
    global real *sums,     // of a level and all above, with a spare one between levels
    global const real *y,  // like out; not read where b is 0
    global real *out)      // the picture, (height width, k); written where first_level is 0
{
    const piece p = piece_of(get_global_id(0), k);
    for (int level = end_level - 1; level >= first_level; --level) {
        const pyramid_level here = pyramid_level_at(height, width, level);
        const pyramid_level next = pyramid_level_at(height, width, level + 1);
        const bool is_top = level + 1 == levels;
        global const real *above = sums + (next.at + level + 1) * k + p.at;
        global real *to = sums + (here.at + level) * k + p.at;
        for (int row = get_global_id(2); row < here.h; row += get_global_size(2))
            for (int column = get_global_id(1); column < here.w; column += get_global_size(1)) {
                const int cell = row * here.w + column;
                lanes sum = LOAD(x + (here.at + cell) * k + p.at);
                if (!is_top)
                    sum += LOAD(above + ((row >> 1) * next.w + (column >> 1)) * k);
                if (level > 0)
                    put(to, cell * k, sum, p.skip, 1, 0, x);
                else
                    put(out, cell * k + p.at, sum, p.skip, a, b, y);
            }
        barrier(CLK_GLOBAL_MEM_FENCE);
    }
}
