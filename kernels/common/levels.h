// SPDX-License-Identifier: BSD-3-Clause
// Sums of a picture at all scales: what pyramid.cl and hats.cl share. Level 0 is its pixels, and
// SIDE_ABOVE(n) the side of a level above one of n. out = a (W x) + b y, by the bodies of two kernels:
//
//   GATHER(sum_below)  W: sums of each level from those of the level below
//   SPREAD(sum_above)  W^T: to each sum, from those of the level above, down to the pixels
//
// A file writes, for a row and column of a level, where `other` is the level below or above, whose
// sums begin at `sums`:
//
//   INLINE lanes sum_below(int row, int column, level_place other, global const real *sums, int k)
//
// Work-items stride through pieces of K right-hand sides (dimension 0), columns (1) and rows (2). A
// launch of several levels takes one group a piece, which waits for itself between them.
//
// Required define: K, see lanes.h. Layout: sums level by level, the finest first, each row-major,
// right-hand sides side by side. Both kernels have the arguments
//
//   height width  rows and columns of the picture
//   first_level   GATHER makes levels first_level .. end_level - 1; those below are in `sums`
//   end_level     already. SPREAD makes end_level - 1 .. first_level; those above are
//   levels        in all; GATHER does not have it
//   k             right-hand sides
//   a b           factors of W x or W^T x, and of y
//   x             the picture, (height width, k); of SPREAD (all sums, k)
//   sums          of all levels, with a spare one between levels: wide loads reach there
//   y             like out; not read where b is 0
//   out           (all sums, k); of SPREAD the picture, written where first_level is 0

#ifndef LTCL_LEVELS_H
#define LTCL_LEVELS_H

#include "lanes.h"

#ifndef SIDE_ABOVE
#error "levels.h needs SIDE_ABOVE(n), the side of a level above one of n"
#endif

#define LEVELS_ARGUMENTS \
    int k, real a, real b, global const real *x, global real *sums, global const real *y, \
        global real *out
#define GATHER_ARGUMENTS int height, int width, int first_level, int end_level, LEVELS_ARGUMENTS
#define SPREAD_ARGUMENTS \
    int height, int width, int first_level, int end_level, int levels, LEVELS_ARGUMENTS

// A level: its sides, and where its sums begin.
typedef struct {
    int h, w, at;
} level_place;

INLINE level_place level_at(int height, int width, int level)
{
    level_place v = {height, width, 0};
    for (; level > 0; --level) {
        v.at += v.h * v.w;
        v.h = SIDE_ABOVE(v.h);
        v.w = SIDE_ABOVE(v.w);
    }
    return v;
}

#define FOR_PLACES(row, column, level) \
    for (int row = get_global_id(2); row < (level).h; row += get_global_size(2)) \
        for (int column = get_global_id(1); column < (level).w; column += get_global_size(1))

#define GATHER(sum_below) \
    const piece p = piece_of(get_global_id(0), k); \
    for (int level = first_level; level < end_level; ++level) { \
        const level_place here = level_at(height, width, level); \
        const level_place other = level_at(height, width, level - 1); \
        global const real *below = level > 1 ? sums + (other.at + level - 1) * k : x; \
        global real *to = sums + (here.at + level) * k + p.at; \
        FOR_PLACES(row, column, here) \
        { \
            const int place = row * here.w + column; \
            const lanes sum = level > 0 ? sum_below(row, column, other, below + p.at, k) \
                                        : LOAD(x + place * k + p.at); \
            if (level > 0) \
                put(to, place * k, sum, p.skip, 1, 0, x); \
            put(out, (here.at + place) * k + p.at, sum, p.skip, a, b, y); \
        } \
        barrier(CLK_GLOBAL_MEM_FENCE); \
    }

#define SPREAD(sum_above) \
    const piece p = piece_of(get_global_id(0), k); \
    for (int level = end_level - 1; level >= first_level; --level) { \
        const level_place here = level_at(height, width, level); \
        const level_place other = level_at(height, width, level + 1); \
        global const real *above = sums + (other.at + level + 1) * k + p.at; \
        global real *to = sums + (here.at + level) * k + p.at; \
        FOR_PLACES(row, column, here) \
        { \
            const int place = row * here.w + column; \
            lanes sum = LOAD(x + (here.at + place) * k + p.at); \
            if (level + 1 < levels) \
                sum += sum_above(row, column, other, above, k); \
            if (level > 0) \
                put(to, place * k, sum, p.skip, 1, 0, x); \
            else \
                put(out, place * k + p.at, sum, p.skip, a, b, y); \
        } \
        barrier(CLK_GLOBAL_MEM_FENCE); \
    }

#endif
