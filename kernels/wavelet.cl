// SPDX-License-Identifier: BSD-3-Clause
// Orthonormal wavelet transforms of pictures, periodized: out = scale (W x) + add_scale add.
//
//   wavelet_split  from pixels to coefficients
//   wavelet_join   from coefficients to pixels
//
// A level halves both sides at once: from the values that the filters reach, two by two are made.
// Work-items stride through pieces of K right-hand sides (dimension 0), pairs of columns (1) and of
// rows (2). A launch of several levels, on CPUs only, takes one group a piece, which waits for itself
// between levels. Where K is 1, dimension 0 counts the right-hand sides of a picture, and then pictures, which
// stand one below the other. With PAIRS an item makes two whole rows: the filters run down the
// columns first, side by side, into a buffer, and then along it.
//
// Required defines: K, see common/lanes.h; TAPS, length of the filters; PAIRS, of columns that an
// item makes at a time: 1, or 8 where there is one right-hand side, on CPUs. Layout, odd sides,
// ORDERED and the arguments are those of common/wavelet_levels.h. wavelet_split begins with the first
// of its levels, wavelet_join with the last of them.

#include "common/wavelet_levels.h"

// Rows of a pair whose loads are on their way at the same time, on GPUs; more take registers.
#define SPLIT_ROWS 2
#define JOIN_ROWS 1
// A GPU makes one level a launch, and the small ones by wavelet_tail.cl; a loop takes registers, too.
#if K == 1 && PAIRS == 1
#define END_LEVEL (first_level + 1)
#define WAIT_FOR_LEVEL (void)0
#else
#define END_LEVEL end_level
#define WAIT_FOR_LEVEL barrier(CLK_GLOBAL_MEM_FENCE)
#endif

// A level of a transform.
typedef struct {
    side a, b;              // rows and columns
    piece p;                // of the right-hand sides
    int k, width;           // right-hand sides; columns of a picture
    int pitch;              // columns of the array of approximations
    bool deepest;           // whether approximations are coefficients, too
    real scale, add_scale;  // factors of what is written, and of add; of split: of details
    real near_scale, near_add_scale;  // of split: of approximations
    global const real *low;           // of split: samples; of join: approximations
    global const real *x;             // of join: details
    global const real *add;
    global real *to;   // of split: approximations; of join: samples
    global real *out;  // of split: details
    constant real *taps;
    global const int *order;  // of coefficients, where ORDERED
} level_arrays;

// out = scale v + add_scale add of the coefficient of a row, if there is one.
INLINE void put_coefficient(level_arrays l, int row, lanes v)
{
    if (row >= 0)
        put(l.out, row * l.k + l.p.at, v, l.p.skip, l.scale, l.add_scale, l.add);
}

// A coefficient of a transform back.
INLINE lanes coefficient(level_arrays l, int row_of_picture, int column)
{
    const int pixel = row_of_picture * l.width + column;
#ifdef ORDERED
    const int row = l.order[pixel];
    return row < 0 ? (lanes)(0) : LOAD(l.x + row * l.k);
#else
    return LOAD(l.x + pixel * l.k);
#endif
}

INLINE lanes sample(level_arrays l, int row, int column)
{
    return LOAD(l.low + (row * l.b.n + column) * l.k);
}

INLINE lanes approximation(level_arrays l, int row, int column)
{
#ifdef ORDERED
    if (l.deepest)
        return coefficient(l, row, column);
#endif
    return LOAD(l.low + (row * l.pitch + column) * l.k);
}

#include "common/wavelet_pairs.h"

// out = a v + b y at i, where such a sample exists.
INLINE void
store(bool exist, global real *out, int i, lanes v, int skip, real a, real b, global const real *y)
{
    if (exist)
        put(out, i, v, skip, a, b, y);
}

INLINE void split_pair(level_arrays l, int i, int j)
{
    const side a = l.a, b = l.b;
    const int pixel = i * l.width + j, right = b.pairs, below = a.pairs * l.width;
    const bool at_right = right + j < b.n, at_below = a.pairs + i < a.n;
    const quad q = split(l, i, j);
    const int row00 = coefficient_row(l.order, l.deepest, pixel);
    const int row01 = coefficient_row(l.order, at_right, pixel + right);
    const int row10 = coefficient_row(l.order, at_below, pixel + below);
    const int row11 = coefficient_row(l.order, at_right && at_below, pixel + below + right);
    if (!l.deepest)
        put(l.to, (i * l.pitch + j) * l.k, q.v00, l.p.skip, 1, 0, l.add);
    put_coefficient(l, row00, q.v00);
    put_coefficient(l, row01, q.v01);
    put_coefficient(l, row10, q.v10);
    put_coefficient(l, row11, q.v11);
}

INLINE void join_pair(level_arrays l, int i, int j)
{
    const side a = l.a, b = l.b;
    const int k = l.k;
    const quad q = join(l, i, j);
    const int left = place(b, j, 0), right = place(b, j, 1);
    const int upper = place(a, i, 0) * b.n, lower = place(a, i, 1) * b.n;
    const bool at_right = right < b.n, at_below = lower < a.n * b.n;
    const bool both = at_right && at_below;
    const int skip = l.p.skip;
    const real u = l.scale, v = l.add_scale;
    store(true, l.to, (upper + left) * k, q.v00, skip, u, v, l.add);
    store(at_right, l.to, (upper + right) * k, q.v01, skip, u, v, l.add);
    store(at_below, l.to, (lower + left) * k, q.v10, skip, u, v, l.add);
    store(both, l.to, (lower + right) * k, q.v11, skip, u, v, l.add);
}

#if PAIRS == 8
// Pairs of columns of a buffer.
#define CHUNK 128
#ifdef __clang__
#define NEAR8(p) (*(const real8_packed *)(p))
#define SET8(p, v) (*(real8_packed *)(p) = (v))
#else
#define NEAR8(p) vload8(0, p)
#define SET8(p, v) vstore8(v, 0, p)
#endif

INLINE void store8(global real *out, int i, real8 v, real a, real b, global const real *y)
{
    STORE8(b != 0 ? a * v + b * LOAD8(y + i) : a * v, out + i);
}

// Both rows of pair i of rows.
INLINE void split_rows(level_arrays l, int i)
{
    const side a = l.a, b = l.b;
    constant real *taps = l.taps;
    real near[2 * CHUNK + TAPS + 8], detail[2 * CHUNK + TAPS + 8];
    const bool at_below = a.pairs + i < a.n;
    // Outside the loop over columns: they divide.
    term rows[TAPS];
    int row = split_start(a, i);
    for (int s = 0; s < TAPS; ++s) {
        rows[s] = split_term(a, i, s, row, false, taps);
        row = split_next(a, row, false);
    }
    int done = 0;
    for (int start = 0; start + 8 <= b.regular; start = done) {
        const int pairs = min(CHUNK, b.regular - start) / 8 * 8;
        // Down the columns.
        const int first = 2 * start + 1 - HALF, count = 2 * pairs - 2 + TAPS;
        for (int c = 0; c < count;) {
            const int column = first + c;
            const bool wide = column >= 0 && column + 8 <= 2 * b.regular;
            global const real *p = l.low + (wide ? column : wrapped(column, 2 * b.regular));
            real8 u = 0, v = 0;
            for (int s = 0; s < TAPS; ++s) {
                const term r = rows[s];
                const real8 x = wide ? LOAD8(p + r.low * b.n) : (real8)(p[r.low * b.n]);
                u = r.w[0] * x + u;
                v = r.w[1] * x + v;
            }
            SET8(near + c, u);
            SET8(detail + c, v);
            c += wide ? 8 : 1;
        }
        // Along the rows.
        for (int m = 0; m < pairs; m += 8) {
            real8 v00 = 0, v01 = 0, v10 = 0, v11 = 0;
            for (int t = 0; t < TAPS; t += 2) {
                const int c = 2 * m + t;
                const real8 n0 = NEAR8(near + c), n1 = NEAR8(near + c + 8);
                const real8 d0 = NEAR8(detail + c), d1 = NEAR8(detail + c + 8);
                const real8 n_even = (real8)(n0.even, n1.even), n_odd = (real8)(n0.odd, n1.odd);
                const real8 d_even = (real8)(d0.even, d1.even), d_odd = (real8)(d0.odd, d1.odd);
                v00 = taps[t] * n_even + (taps[t + 1] * n_odd + v00);
                v01 = taps[TAPS + t] * n_even + (taps[TAPS + t + 1] * n_odd + v01);
                v10 = taps[t] * d_even + (taps[t + 1] * d_odd + v10);
                v11 = taps[TAPS + t] * d_even + (taps[TAPS + t + 1] * d_odd + v11);
            }
            const int j = start + m, here = i * l.width + j, below = here + a.pairs * l.width;
            store8(l.to, i * l.pitch + j, v00, l.near_scale, l.near_add_scale, l.add);
            store8(l.out, here + b.pairs, v01, l.scale, l.add_scale, l.add);
            if (at_below) {
                store8(l.out, below, v10, l.scale, l.add_scale, l.add);
                store8(l.out, below + b.pairs, v11, l.scale, l.add_scale, l.add);
            }
        }
        done = start + pairs;
    }
    for (int j = done; j < b.pairs; ++j)
        split_pair(l, i, j);
}

// Both rows of pair i of rows.
INLINE void join_rows(level_arrays l, int i)
{
    const side a = l.a, b = l.b;
    constant real *taps = l.taps;
    // Of the upper and of the lower row, by the columns' approximations and details.
    real low0[CHUNK + HALF + 8], low1[CHUNK + HALF + 8];
    real high0[CHUNK + HALF + 8], high1[CHUNK + HALF + 8];
    const int upper = place(a, i, 0) * b.n, lower = place(a, i, 1) * b.n;
    const bool at_below = lower < a.n * b.n;
    // The last pair of columns may stand at both ends of a row.
    const int whole = b.regular - FIRST;
    // Outside the loop over columns: they divide.
    term rows[HALF];
    int row = join_start(a, i);
    for (int s = 0; s < HALF; ++s) {
        rows[s] = join_term(a, i, s, row, false, taps);
        row = join_next(a, row, false);
    }
    int done = 0;
    for (int start = 0; start + 8 <= whole; start = done) {
        const int pairs = min(CHUNK, whole - start) / 8 * 8;
        // Down the columns.
        const int first = start + HALF / 2 + 1 - HALF, count = pairs - 1 + HALF;
        for (int c = 0; c < count;) {
            const int column = first + c;
            const bool wide = column >= 0 && column + 8 <= b.regular;
            const int at = wide ? column : wrapped(column, b.regular);
            global const real *near = l.low + at, *x = l.x + at;
            real8 l0 = 0, l1 = 0, h0 = 0, h1 = 0;
            for (int s = 0; s < HALF; ++s) {
                const term r = rows[s];
                const int right = r.low * l.width + b.pairs, below = r.high * l.width;
                global const real *ll = near + r.low * l.pitch, *lh = x + right;
                global const real *hl = x + below, *hh = hl + b.pairs;
                const real8 u = wide ? LOAD8(ll) : (real8)(*ll),
                            v = wide ? LOAD8(hl) : (real8)(*hl);
                const real8 p = wide ? LOAD8(lh) : (real8)(*lh),
                            q = wide ? LOAD8(hh) : (real8)(*hh);
                l0 = r.w[0] * u + (r.w[1] * v + l0);
                l1 = r.w[2] * u + (r.w[3] * v + l1);
                h0 = r.w[0] * p + (r.w[1] * q + h0);
                h1 = r.w[2] * p + (r.w[3] * q + h1);
            }
            SET8(low0 + c, l0);
            SET8(low1 + c, l1);
            SET8(high0 + c, h0);
            SET8(high1 + c, h1);
            c += wide ? 8 : 1;
        }
        // Along the rows.
        for (int m = 0; m < pairs; m += 8) {
            real8 v00 = 0, v01 = 0, v10 = 0, v11 = 0;
            for (int t = 0; t < HALF; ++t) {
                const int tap = TAPS - 2 - 2 * t;
                const real w0 = taps[tap], w1 = taps[TAPS + tap];
                const real w2 = taps[tap + 1], w3 = taps[TAPS + tap + 1];
                const real8 l0 = NEAR8(low0 + m + t), l1 = NEAR8(low1 + m + t);
                const real8 h0 = NEAR8(high0 + m + t), h1 = NEAR8(high1 + m + t);
                v00 = w0 * l0 + (w1 * h0 + v00);
                v01 = w2 * l0 + (w3 * h0 + v01);
                v10 = w0 * l1 + (w1 * h1 + v10);
                v11 = w2 * l1 + (w3 * h1 + v11);
            }
            const int left = place(b, start + m, 0);
            real8 u, v;
            u.even = v00.lo, u.odd = v01.lo, v.even = v00.hi, v.odd = v01.hi;
            store8(l.to, upper + left, u, l.scale, l.add_scale, l.add);
            store8(l.to, upper + left + 8, v, l.scale, l.add_scale, l.add);
            if (at_below) {
                u.even = v10.lo, u.odd = v11.lo, v.even = v10.hi, v.odd = v11.hi;
                store8(l.to, lower + left, u, l.scale, l.add_scale, l.add);
                store8(l.to, lower + left + 8, v, l.scale, l.add_scale, l.add);
            }
        }
        done = start + pairs;
    }
    for (int j = done; j < b.pairs; ++j)
        join_pair(l, i, j);
}
#define ROWS_OF(name, l) \
    for (int i = get_global_id(2); i < l.a.pairs; i += get_global_size(2)) \
    name##_rows(l, i)
#else
#define ROWS_OF(name, l) \
    for (int i = get_global_id(2); i < l.a.pairs; i += get_global_size(2)) \
        for (int j = get_global_id(1); j < l.b.pairs; j += get_global_size(1)) \
    name##_pair(l, i, j)
#endif

kernel void wavelet_split(TRANSFORM_ARGUMENTS)
{
    CHOOSE_PICTURE;
    CHOOSE_PIXELS(x);
    CHOOSE_COEFFICIENTS(add);
    CHOOSE_COEFFICIENTS(out);
    for (int level = first_level; level < END_LEVEL; ++level) {
        const bool deepest = level + 1 == levels;
        level_arrays l = {side_at(height, level), side_at(width, level), p, k, width};
        l.pitch = deepest ? width : l.b.pairs;
        l.deepest = deepest;
        l.scale = scale;
        l.add_scale = add_scale;
        l.near_scale = deepest ? scale : 1;
        l.near_add_scale = deepest ? add_scale : 0;
        l.low = (level ? approximations + starts[level - 1] * k : x) + p.at;
        l.add = add;
        l.to = deepest ? out + p.at : approximations + starts[level] * k + p.at;
        l.out = out;
        l.taps = taps;
        l.order = ORDER;
        ROWS_OF(split, l);
        WAIT_FOR_LEVEL;
    }
}

// Levels end_level - 1 .. first_level; `out` gets the picture where first_level is 0.
kernel void wavelet_join(TRANSFORM_ARGUMENTS)
{
    CHOOSE_PICTURE;
    CHOOSE_COEFFICIENTS(x);
    CHOOSE_PIXELS(add);
    CHOOSE_PIXELS(out);
    for (int level = END_LEVEL - 1; level >= first_level; --level) {
        const bool deepest = level + 1 == levels;
        level_arrays l = {side_at(height, level), side_at(width, level), p, k, width};
        l.pitch = deepest ? width : l.b.pairs;
        l.deepest = deepest;
        l.scale = level ? 1 : scale;
        l.add_scale = level ? 0 : add_scale;
        l.low = deepest ? x + p.at : approximations + starts[level] * k + p.at;
        l.x = x + p.at;
        l.add = add + p.at;
        l.to = (level ? approximations + starts[level - 1] * k : out) + p.at;
        l.taps = taps;
        l.order = ORDER;
        ROWS_OF(join, l);
        WAIT_FOR_LEVEL;
    }
}
