// SPDX-License-Identifier: BSD-3-Clause
// The small levels of wavelet transforms, all in one launch, in local memory: out = scale (W x) +
// add_scale add, on GPUs. Wide levels before them are those of wavelet.cl.
//
//   wavelet_tail_split  from samples of the first small level to coefficients
//   wavelet_tail_join   from coefficients to samples of that level
//
// A group does all of one right-hand side of one picture (dimension 0), and waits for itself between
// levels. It reads each number of global memory once, before the first level, and writes each once:
// later levels wait for local memory alone, and not for `order` or `add` either.
//
// Required defines: K = 1; PAIRS = 1; TAPS. Layout, odd sides, ORDERED and arguments are those of
// common/wavelet_levels.h, where end_level is `levels`, and
//
//   space            local memory: n0 + n1 numbers of split, n0 + n1 + n2 of join, where n0 is the
//                    number of samples of the first level, n1 and n2 those of the next ones
//
// In it split keeps the samples of the first level, then those of the second. Later levels take the
// place of the first one's: its coefficients are written at once, and theirs wait for the end, as a
// picture of n1 pixels. join keeps the coefficients as a picture of n0 pixels, and then samples.

#include "common/wavelet_levels.h"

#if K != 1 || PAIRS != 1
#error "wavelet_tail.cl needs -DK=1 and -DPAIRS=1"
#endif

// Local memory is near, and a group of 1024 items has 64 registers an item.
#define SPLIT_ROWS 1
#define JOIN_ROWS 1

typedef struct {
    side a, b;             // rows and columns
    int at, k, width;      // right-hand side, of how many; columns of a picture
    int first_pixel;       // of the picture, among those of all
    int evens;             // of split: samples with an even number
    int pitch, low_pitch;  // columns of `coefficients`; of join: of `low`
    bool deepest, first;   // whether it is the last level of the transform, the first of the launch
    real scale, add_scale;  // factors of what is written, and of add
    local const real *low;  // of split: samples; of join: approximations
    // Of split: approximations, but not of the deepest level. Of join: samples, but not of the first.
    local real *to;
    local real *coefficients;  // of split: those of levels after the first
    global const real *add;
    global real *out;  // of split: coefficients; of join: samples of the first level
    constant real *taps;
    global const int *order;  // of coefficients, where ORDERED
} level_arrays;

// Where sample i of a level stands: even ones first, so that items beside each other, which take
// every second one, take neighbours.
INLINE int even_odd(int i, int evens)
{
    return (i & 1) * evens + (i >> 1);
}

INLINE lanes sample(level_arrays l, int row, int column)
{
    return l.low[even_odd(row * l.b.n + column, l.evens)];
}

INLINE lanes approximation(level_arrays l, int row, int column)
{
    return l.low[row * l.low_pitch + column];
}

INLINE lanes coefficient(level_arrays l, int row, int column)
{
    return l.coefficients[row * l.pitch + column];
}

#include "common/wavelet_pairs.h"

INLINE void write_coefficient(level_arrays l, int row, real v)
{
    if (row >= 0)
        put(l.out, row * l.k + l.at, v, 0, l.scale, l.add_scale, l.add);
}

INLINE void keep_coefficient(level_arrays l, bool exist, int row, int column, real v)
{
    if (exist)
        l.coefficients[row * l.pitch + column] = v;
}

INLINE void split_pair(level_arrays l, int pair)
{
    const side a = l.a, b = l.b;
    const int i = pair / b.pairs, j = pair - i * b.pairs;
    const int right = b.pairs + j, below = a.pairs + i;
    const bool at_right = right < b.n, at_below = below < a.n;
    const quad q = split(l, i, j);
    if (l.first) {
        const int upper = l.first_pixel + i * l.width, lower = l.first_pixel + below * l.width;
        const int row00 = coefficient_row(l.order, l.deepest, upper + j);
        const int row01 = coefficient_row(l.order, at_right, upper + right);
        const int row10 = coefficient_row(l.order, at_below, lower + j);
        const int row11 = coefficient_row(l.order, at_right && at_below, lower + right);
        write_coefficient(l, row00, q.v00);
        write_coefficient(l, row01, q.v01);
        write_coefficient(l, row10, q.v10);
        write_coefficient(l, row11, q.v11);
    } else {
        keep_coefficient(l, l.deepest, i, j, q.v00);
        keep_coefficient(l, at_right, i, right, q.v01);
        keep_coefficient(l, at_below, below, j, q.v10);
        keep_coefficient(l, at_right && at_below, below, right, q.v11);
    }
    if (!l.deepest)
        l.to[even_odd(pair, (a.pairs * b.pairs + 1) / 2)] = q.v00;
}

INLINE void keep_sample(level_arrays l, bool exist, int i, real v)
{
    if (!exist)
        return;
    if (l.first)
        put(l.out, (l.first_pixel + i) * l.k + l.at, v, 0, l.scale, l.add_scale, l.add);
    else
        l.to[i] = v;
}

INLINE void join_pair(level_arrays l, int pair)
{
    const side a = l.a, b = l.b;
    const int i = pair / b.pairs, j = pair - i * b.pairs;
    const quad q = join(l, i, j);
    const int left = place(b, j, 0), right = place(b, j, 1);
    const int upper = place(a, i, 0), lower = place(a, i, 1);
    keep_sample(l, true, upper * b.n + left, q.v00);
    keep_sample(l, right < b.n, upper * b.n + right, q.v01);
    keep_sample(l, lower < a.n, lower * b.n + left, q.v10);
    keep_sample(l, right < b.n && lower < a.n, lower * b.n + right, q.v11);
}

#ifdef ORDERED
#define ORDER_OF_ALL order
#else
#define ORDER_OF_ALL 0
#endif
#define ITEM (int)(get_local_id(2) * get_local_size(1) + get_local_id(1))
#define ITEMS (int)(get_local_size(2) * get_local_size(1))

kernel void wavelet_tail_split(TRANSFORM_ARGUMENTS, local real *space)
{
    const int picture = get_global_id(0) / k, at = get_global_id(0) % k;
    const int first_pixel = picture * height * width;
    const side rows = side_at(height, first_level), columns = side_at(width, first_level);
    const int n0 = rows.n * columns.n, n1 = rows.pairs * columns.pairs;
    global const real *samples = x + first_pixel * k;
    if (first_level > 0)
        samples = approximations + (picture * starts[levels] + starts[first_level - 1]) * k;
#pragma unroll 8
    for (int i = ITEM; i < n0; i += ITEMS)
        space[even_odd(i, (n0 + 1) / 2)] = samples[i * k + at];
    level_arrays l = {rows, columns, at, k, width, first_pixel};
    l.coefficients = space;
    l.pitch = columns.pairs;
    l.scale = scale;
    l.add_scale = add_scale;
    l.add = add;
    l.out = out;
    l.taps = taps;
    l.order = ORDER_OF_ALL;
    // Samples of every second level, and those of the others after the first.
    local real *odd = space + n0, *even = space + n1;
    for (int level = first_level; level < levels; ++level) {
        barrier(CLK_LOCAL_MEM_FENCE);
        const int step = level - first_level;
        l.a = side_at(height, level);
        l.b = side_at(width, level);
        l.evens = (l.a.n * l.b.n + 1) / 2;
        l.first = step == 0;
        l.deepest = level + 1 == levels;
        l.low = l.first ? space : step % 2 ? odd : even;
        l.to = step % 2 ? even : odd;
        for (int pair = ITEM; pair < l.a.pairs * l.b.pairs; pair += ITEMS)
            split_pair(l, pair);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    // No item returns before the barrier: PoCL would go wrong, optimized.
    const int kept = first_level + 1 < levels ? n1 : 0;
    for (int i = ITEM; i < kept; i += ITEMS) {
        const int row = i / l.pitch, column = i - row * l.pitch;
        const int pixel = first_pixel + row * width + column;
        write_coefficient(l, coefficient_row(l.order, true, pixel), space[i]);
    }
}

kernel void wavelet_tail_join(TRANSFORM_ARGUMENTS, local real *space)
{
    const int picture = get_global_id(0) / k, at = get_global_id(0) % k;
    const int first_pixel = picture * height * width;
    const side rows = side_at(height, first_level), columns = side_at(width, first_level);
    const int n0 = rows.n * columns.n, n1 = rows.pairs * columns.pairs;
#pragma unroll 8
    for (int i = ITEM; i < n0; i += ITEMS) {
        const int row = i / columns.n, column = i - row * columns.n;
        const int pixel = first_pixel + row * width + column;
        const int place = coefficient_row(ORDER_OF_ALL, true, pixel);
        space[i] = place < 0 ? 0 : x[place * k + at];
    }
    level_arrays l = {rows, columns, at, k, width, first_pixel};
    l.coefficients = space;
    l.pitch = columns.n;
    l.scale = scale;
    l.add_scale = add_scale;
    l.add = add;
    l.out = out;
    if (first_level > 0) {
        l.first_pixel = picture * starts[levels] + starts[first_level - 1];
        l.scale = 1;
        l.add_scale = 0;
        l.out = approximations;
    }
    l.taps = taps;
    // Samples of every second level.
    local real *odd = space + n0, *even = odd + n1;
    for (int level = levels - 1; level >= first_level; --level) {
        barrier(CLK_LOCAL_MEM_FENCE);
        const int step = level - first_level;
        l.a = side_at(height, level);
        l.b = side_at(width, level);
        l.first = step == 0;
        l.deepest = level + 1 == levels;
        l.low = l.deepest ? space : step % 2 ? even : odd;
        l.low_pitch = l.deepest ? l.pitch : l.b.pairs;
        l.to = step % 2 ? odd : even;
        for (int pair = ITEM; pair < l.a.pairs * l.b.pairs; pair += ITEMS)
            join_pair(l, pair);
    }
}
