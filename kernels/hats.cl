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
// Work-items stride through pieces of K right-hand sides (dimension 0), columns (1) and rows (2). A
// launch of several levels takes one group a piece, which waits for itself between them.
//
// Required define: K, see common/lanes.h. Layout: nodes level by level, the finest first, each
// row-major, right-hand sides side by side.

#include "common/lanes.h"

// Share of a node at a distance of -1, 0 or 1 from the middle of a hat of the next level.
INLINE real share(int distance)
{
    return distance == 0 ? (real)1 : (real)0.5;
}

kernel void hats_gather(
    int height,            // rows of the picture
    int width,             // columns of the picture
    int first_level,       // levels first_level .. end_level - 1 are made,
    int end_level,         // those below are in `sums` already
    int k,                 // right-hand sides
    real a,                // factor of W x
    real b,                // factor of y
    global const real *x,  // the picture, (height width, k)
    global real *sums,     // sums of hats, with a spare one between levels: wide loads reach there
    global const real *y,  // like out; not read where b is 0
    global real *out)      // (nodes, k)
{
    const piece p = piece_of(get_global_id(0), k);
    // The level before this one, and where this one begins.
    int below_height = height, below_width = width, at = 0;
    global const real *below = x + p.at;
    for (int level = 0; level < end_level; ++level) {
        const int h = level ? below_height / 2 + 1 : height;
        const int w = level ? below_width / 2 + 1 : width;
        const int scale = level ? 2 : 1;
        const int reach = level ? 1 : 0;
        global real *here = sums + (at + level) * k + p.at;
        for (int row = get_global_id(2); level >= first_level && row < h; row += get_global_size(2))
            for (int column = get_global_id(1); column < w; column += get_global_size(1)) {
                const int y0 = scale * row, x0 = scale * column;
                const int bottom = min(y0 + reach, below_height - 1);
                const int right = min(x0 + reach, below_width - 1);
                lanes sum = 0;
                for (int i = max(y0 - reach, 0); i <= bottom; ++i)
                    for (int j = max(x0 - reach, 0); j <= right; ++j)
                        sum += share(i - y0) * share(j - x0) * LOAD(below + (i * below_width + j) * k);
                const int node = row * w + column;
                if (level > 0)
                    put(here, node * k, sum, p.skip, 1, 0, x);
                put(out, (at + node) * k + p.at, sum, p.skip, a, b, y);
            }
        if (level > 0)
            below = here;
        below_height = h;
        below_width = w;
        at += h * w;
        barrier(CLK_GLOBAL_MEM_FENCE);
    }
}

// A level: its sides, and where its nodes begin.
typedef struct {
    int h, w, at;
} hats_level;

INLINE hats_level hats_level_at(int height, int width, int level)
{
    hats_level v = {height, width, 0};
    for (; level > 0; --level) {
        v.at += v.h * v.w;
        v.h = v.h / 2 + 1;
        v.w = v.w / 2 + 1;
    }
    return v;
}

kernel void hats_spread(
    int height,            // rows of the picture
    int width,             // columns of the picture
    int first_level,       // levels end_level - 1 .. first_level are made,
    int end_level,         // those above are in `sums` already
    int levels,            // of the hats
    int k,                 // right-hand sides
    real a,                // factor of W^T x
    real b,                // factor of y
    global const real *x,  // (nodes, k)
    global real *sums,     // of a level and all above, with a spare one between levels
    global const real *y,  // like out; not read where b is 0
    global real *out)      // the picture, (height width, k); written where first_level is 0
{
    const piece p = piece_of(get_global_id(0), k);
    for (int level = end_level - 1; level >= first_level; --level) {
        const hats_level here = hats_level_at(height, width, level);
        const hats_level next = hats_level_at(height, width, level + 1);
        const bool is_top = level + 1 == levels;
        global const real *above = sums + (next.at + level + 1) * k + p.at;
        global real *to = sums + (here.at + level) * k + p.at;
        for (int row = get_global_id(2); row < here.h; row += get_global_size(2))
            for (int column = get_global_id(1); column < here.w; column += get_global_size(1)) {
                const int node = row * here.w + column;
                lanes sum = LOAD(x + (here.at + node) * k + p.at);
                if (!is_top) {
                    // A node between two of the level above is half of each.
                    const int top = row >> 1, left = column >> 1;
                    const int rows = 1 + (row & 1), columns = 1 + (column & 1);
                    lanes around = 0;
                    for (int i = 0; i < rows; ++i)
                        for (int j = 0; j < columns; ++j)
                            around += LOAD(above + ((top + i) * next.w + left + j) * k);
                    sum += around / (rows * columns);
                }
                if (level > 0)
                    put(to, node * k, sum, p.skip, 1, 0, x);
                else
                    put(out, node * k + p.at, sum, p.skip, a, b, y);
            }
        barrier(CLK_GLOBAL_MEM_FENCE);
    }
}
