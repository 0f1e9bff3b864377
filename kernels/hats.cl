// SPDX-License-Identifier: BSD-3-Clause
// Hat functions of all scales over a picture: level 0 is its pixels, and node (i, j) of level l has
// the bilinear hat max(0, 1 - |row / s - i|) max(0, 1 - |column / s - j|), s = 2^l. A side of n nodes
// has n / 2 + 1 on the next level (rounded down), until no side has more than 2.
// out = a (W x) + b y, where W is
//
//   hats_gather  sums of the pixels under each hat, a level from those of the level before
//   hats_spread  the transpose: to each pixel, the sum of the hats above it
//
// A hat is the sum of those of the level before: of its own node, and half of its neighbours.
// Work-items stride through pieces of K right-hand sides (dimension 0), columns (1) and rows (2). A
// launch of hats_gather of several levels takes one group a piece, which waits for itself between
// them.
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

kernel void hats_spread(
    int height,            // rows of the picture
    int width,             // columns of the picture
    int levels,            // of the hats
    int k,                 // right-hand sides
    real a,                // factor of W^T x
    real b,                // factor of y
    global const real *x,  // (nodes, k)
    global const real *y,  // like out; not read where b is 0
    global real *out)      // the picture, (height width, k)
{
    const piece p = piece_of(get_global_id(0), k);
    for (int row = get_global_id(2); row < height; row += get_global_size(2))
        for (int column = get_global_id(1); column < width; column += get_global_size(1)) {
            lanes sum = 0;
            for (int level = 0, h = height, w = width, at = 0; level < levels; ++level) {
                const int top = row >> level, left = column >> level;
                // Distances from the node above and to the left, in those of two nodes.
                const real down = ldexp((real)(row - (top << level)), -level);
                const real across = ldexp((real)(column - (left << level)), -level);
                // A pixel on a node has no node behind it that counts, and at the rim none at all.
                const int rows = down > 0 ? 2 : 1, columns = across > 0 ? 2 : 1;
                for (int i = 0; i < rows; ++i)
                    for (int j = 0; j < columns; ++j) {
                        const real vertical = i ? down : 1 - down;
                        const real horizontal = j ? across : 1 - across;
                        const int node = at + (top + i) * w + left + j;
                        sum += vertical * horizontal * LOAD(x + node * k + p.at);
                    }
                at += h * w;
                h = h / 2 + 1;
                w = w / 2 + 1;
            }
            put(out, (row * width + column) * k + p.at, sum, p.skip, a, b, y);
        }
}
