// SPDX-License-Identifier: BSD-3-Clause
// Orthonormal wavelet transforms of pictures, periodized: out = scale (W x) + add_scale add.
//
//   wavelet_split  from pixels to coefficients
//   wavelet_join   from coefficients to pixels
//
// A level halves both sides at once: from the values that the filters reach, two by two are made.
// Work-items stride through pieces of K right-hand sides (dimension 0), pairs of columns (1) and of
// rows (2). A launch of several levels takes one group a piece, which waits for itself between
// levels. Where K is 1, dimension 0 counts pictures, which stand one below the other. With PAIRS an
// item makes two whole rows: the filters run down the columns first, side by side, into a buffer,
// and then along it.
//
// Required defines: K, see common/lanes.h; TAPS, length of the filters; PAIRS, of columns that an
// item makes at a time: 1, or 8 where there is one right-hand side, on CPUs.
//
// Layout: a picture is row-major, its k right-hand sides side by side. Coefficients stand as in
// PyWavelets' coeffs_to_array: of each side the approximation first, ceil(n / 2) of n.
//
// Of the ceil(pixels / 2^level) samples of a side the last may stand for fewer pixels. It stays out
// of the filters; where an odd number of whole ones is left, a rotation turns the last two into one
// of the approximation and a detail, which is 0 of a constant: orthonormal, and a constant has one
// coefficient on any grid. Both kernels have the arguments
//
//   height width     rows and columns of the picture
//   first_level      levels first_level .. end_level - 1 are done by this launch; wavelet_split
//   end_level        begins with the first, wavelet_join with the last of them
//   levels           of the transform
//   k                right-hand sides
//   scale add_scale  factors; add is not read where add_scale is 0
//   starts           pixel of `approximations` with which that of level i + 1 begins
//   taps             [2 TAPS]: low-pass, high-pass filter, in the order of the samples
//   x                picture or coefficients to be transformed
//   approximations   of levels 1 .. levels - 1, scratch
//   add              like out; may be out
//   out              the result; wavelet_join writes it where first_level is 0

#include "common/lanes.h"

#ifndef TAPS
#error "wavelet.cl needs -DTAPS=<length of the filters: 2, 4, ...>"
#endif
#ifndef PAIRS
#error "wavelet.cl needs -DPAIRS=<of columns: 1, or 8 where K is 1, on CPUs>"
#endif

#define HALF (TAPS / 2)
#define WRAPPED(i, n) (((i) % (n) + (n)) % (n))
// Where the samples of pair 0 begin that need the same coefficients.
#define FIRST ((HALF + 1) % 2)

// One side of the picture at one level.
typedef struct {
    int n;        // samples
    int pairs;    // of them, which is the number of samples of the approximation
    int regular;  // pairs that the filters reach
    real c, s;    // cosine and sine for the last two samples, where they are not a regular pair
} side;

INLINE side side_at(int pixels, int level)
{
    const int size = 1 << level, whole = pixels >> level, rest = pixels & (size - 1);
    const int n = whole + (rest > 0);
    const real total = size + rest;
    return (side){n, (n + 1) / 2, whole / 2, sqrt(size / total), sqrt(rest / total)};
}

// Term t of pair m. Of analysis: sample `low`, and its weights in approximation and detail. Of
// synthesis: approximation `low`, detail `high`, and the weights of both in the first sample and in
// the second.
typedef struct {
    int low, high;
    real w[4];
} term;

INLINE term split_term(side a, int m, int t, bool inside, constant real *taps)
{
    term v = {2 * m + 1 - HALF + t, 0, {taps[t], taps[TAPS + t], 0, 0}};
    if (inside)
        return v;
    if (m < a.regular) {
        v.low = WRAPPED(v.low, 2 * a.regular);
        return v;
    }
    const bool two = a.n % 2 == 0;
    v.low = a.n - 1 - (two && t == 0);
    v.w[0] = t > two ? 0 : !two ? 1 : t ? a.s : a.c;
    v.w[1] = t > two || !two ? 0 : t ? -a.c : a.s;
    return v;
}

INLINE term join_term(side a, int m, int t, bool inside, constant real *taps)
{
    const int i = m + HALF / 2 + 1 - HALF + t, tap = TAPS - 2 - 2 * t;
    term v = {i, a.pairs + i, {taps[tap], taps[TAPS + tap], taps[tap + 1], taps[TAPS + tap + 1]}};
    if (inside)
        return v;
    if (m < a.regular) {
        v.low = WRAPPED(i, a.regular);
        v.high = a.pairs + v.low;
        return v;
    }
    const bool two = a.n % 2 == 0;
    v.low = m;
    v.high = two ? a.pairs + m : m;
    v.w[0] = t ? 0 : two ? a.c : 1;
    v.w[1] = v.w[2] = t || !two ? 0 : a.s;
    v.w[3] = t || !two ? 0 : -a.c;
    return v;
}

// Where sample 0 or 1 of pair m stands; a.n: there is none.
INLINE int place(side a, int m, int which)
{
    const int i = 2 * m + which;
    return m < a.regular ? (i + FIRST) % (2 * a.regular) : i;
}

// The values of a pair of rows and one of columns: v01 is of the rows' first and the columns'
// second.
typedef struct {
    lanes v00, v01, v10, v11;
} quad;

INLINE quad
split(side a, int i, side b, int j, bool inside, global const real *x, int k, constant real *taps)
{
    quad q = {0, 0, 0, 0};
    for (int s = 0; s < TAPS; ++s) {
        const term r = split_term(a, i, s, inside, taps);
        lanes near = 0, detail = 0;
        for (int t = 0; t < TAPS; ++t) {
            const term c = split_term(b, j, t, inside, taps);
            const lanes v = LOAD(x + (r.low * b.n + c.low) * k);
            near = c.w[0] * v + near;
            detail = c.w[1] * v + detail;
        }
        q.v00 = r.w[0] * near + q.v00;
        q.v01 = r.w[0] * detail + q.v01;
        q.v10 = r.w[1] * near + q.v10;
        q.v11 = r.w[1] * detail + q.v11;
    }
    return q;
}

// Approximations come from `near`, whose rows have near_pitch pixels, details from x.
INLINE quad join(
    side a, int i, side b, int j, bool inside, global const real *near, int near_pitch,
    global const real *x, int pitch, int k, constant real *taps)
{
    quad q = {0, 0, 0, 0};
    for (int s = 0; s < HALF; ++s) {
        const term r = join_term(a, i, s, inside, taps);
        lanes low0 = 0, low1 = 0, high0 = 0, high1 = 0;
        for (int t = 0; t < HALF; ++t) {
            const term c = join_term(b, j, t, inside, taps);
            const lanes ll = LOAD(near + (r.low * near_pitch + c.low) * k);
            const lanes lh = LOAD(x + (r.low * pitch + c.high) * k);
            const lanes hl = LOAD(x + (r.high * pitch + c.low) * k);
            const lanes hh = LOAD(x + (r.high * pitch + c.high) * k);
            low0 = c.w[0] * ll + (c.w[1] * lh + low0);
            low1 = c.w[2] * ll + (c.w[3] * lh + low1);
            high0 = c.w[0] * hl + (c.w[1] * hh + high0);
            high1 = c.w[2] * hl + (c.w[3] * hh + high1);
        }
        q.v00 = r.w[0] * low0 + (r.w[1] * high0 + q.v00);
        q.v01 = r.w[0] * low1 + (r.w[1] * high1 + q.v01);
        q.v10 = r.w[2] * low0 + (r.w[3] * high0 + q.v10);
        q.v11 = r.w[2] * low1 + (r.w[3] * high1 + q.v11);
    }
    return q;
}

// out = a v + b y at i, where such a sample exists.
INLINE void
store(bool exist, global real *out, int i, lanes v, int skip, real a, real b, global const real *y)
{
    if (exist)
        put(out, i, v, skip, a, b, y);
}

// A level of a transform.
typedef struct {
    side a, b;              // rows and columns
    piece p;                // of the right-hand sides
    int k, width;           // right-hand sides; columns of a picture
    int pitch;              // columns of the array of approximations
    real scale, add_scale;  // factors of what is written, and of add; of split: of details
    real near_scale, near_add_scale;  // of split: of approximations
    global const real *low;           // of split: samples; of join: approximations
    global const real *x;             // of join: details
    global const real *add;
    global real *to;   // of split: approximations; of join: samples
    global real *out;  // of split: details
    constant real *taps;
} level_arrays;

INLINE void split_pair(level_arrays l, int i, int j)
{
    const side a = l.a, b = l.b;
    const int k = l.k, row = 2 * i + 1 - HALF, column = 2 * j + 1 - HALF;
    const bool inside =
        row >= 0 && row + TAPS <= 2 * a.regular && column >= 0 && column + TAPS <= 2 * b.regular;
    const quad q = inside ? split(a, i, b, j, true, l.low, k, l.taps)
                          : split(a, i, b, j, false, l.low, k, l.taps);
    const int right = b.pairs * k, below = a.pairs * l.width * k;
    const int here = (i * l.width + j) * k + l.p.at, near = (i * l.pitch + j) * k;
    const bool at_right = b.pairs + j < b.n, at_below = a.pairs + i < a.n;
    const bool both = at_right && at_below;
    const int skip = l.p.skip;
    const real u = l.scale, v = l.add_scale;
    store(true, l.to, near, q.v00, skip, l.near_scale, l.near_add_scale, l.add + l.p.at);
    store(at_right, l.out, here + right, q.v01, skip, u, v, l.add);
    store(at_below, l.out, here + below, q.v10, skip, u, v, l.add);
    store(both, l.out, here + below + right, q.v11, skip, u, v, l.add);
}

INLINE void join_pair(level_arrays l, int i, int j)
{
    const side a = l.a, b = l.b;
    const int k = l.k, row = i + HALF / 2 + 1 - HALF, column = j + HALF / 2 + 1 - HALF;
    const bool inside =
        row >= 0 && row + HALF <= a.regular && column >= 0 && column + HALF <= b.regular;
    const quad q = inside ? join(a, i, b, j, true, l.low, l.pitch, l.x, l.width, k, l.taps)
                          : join(a, i, b, j, false, l.low, l.pitch, l.x, l.width, k, l.taps);
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
    for (int s = 0; s < TAPS; ++s)
        rows[s] = split_term(a, i, s, false, taps);
    int done = 0;
    for (int start = 0; start + 8 <= b.regular; start = done) {
        const int pairs = min(CHUNK, b.regular - start) / 8 * 8;
        // Down the columns.
        const int first = 2 * start + 1 - HALF, count = 2 * pairs - 2 + TAPS;
        for (int c = 0; c < count;) {
            const int column = first + c;
            const bool wide = column >= 0 && column + 8 <= 2 * b.regular;
            global const real *p = l.low + (wide ? column : WRAPPED(column, 2 * b.regular));
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
    for (int s = 0; s < HALF; ++s)
        rows[s] = join_term(a, i, s, false, taps);
    int done = 0;
    for (int start = 0; start + 8 <= whole; start = done) {
        const int pairs = min(CHUNK, whole - start) / 8 * 8;
        // Down the columns.
        const int first = start + HALF / 2 + 1 - HALF, count = pairs - 1 + HALF;
        for (int c = 0; c < count;) {
            const int column = first + c;
            const bool wide = column >= 0 && column + 8 <= b.regular;
            const int at = wide ? column : WRAPPED(column, b.regular);
            global const real *near = l.low + at, *x = l.x + at;
            real8 l0 = 0, l1 = 0, h0 = 0, h1 = 0;
            for (int s = 0; s < HALF; ++s) {
                const term r = rows[s];
                const int row = r.low * l.width + b.pairs, below = r.high * l.width;
                global const real *ll = near + r.low * l.pitch, *lh = x + row;
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

#define TRANSFORM_ARGUMENTS \
    int height, int width, int first_level, int end_level, int levels, int k, real scale, \
        real add_scale, constant int *starts, constant real *taps, global const real *x, \
        global real *approximations, global const real *add, global real *out

// Where K is 1: the arrays of picture number get_global_id(0).
#if K == 1
#define CHOOSE_PICTURE \
    const int picture = get_global_id(0), first_pixel = picture * height * width; \
    x += first_pixel, add += first_pixel, out += first_pixel; \
    approximations += picture * starts[levels]; \
    const piece p = {0, 0}
#else
#define CHOOSE_PICTURE const piece p = piece_of(get_global_id(0), k)
#endif

kernel void wavelet_split(TRANSFORM_ARGUMENTS)
{
    CHOOSE_PICTURE;
    for (int level = first_level; level < end_level; ++level) {
        const bool deepest = level + 1 == levels;
        level_arrays l = {side_at(height, level), side_at(width, level), p, k, width};
        l.pitch = deepest ? width : l.b.pairs;
        l.scale = scale;
        l.add_scale = add_scale;
        l.near_scale = deepest ? scale : 1;
        l.near_add_scale = deepest ? add_scale : 0;
        l.low = (level ? approximations + starts[level - 1] * k : x) + p.at;
        l.add = add;
        l.to = deepest ? out + p.at : approximations + starts[level] * k + p.at;
        l.out = out;
        l.taps = taps;
        ROWS_OF(split, l);
        barrier(CLK_GLOBAL_MEM_FENCE);
    }
}

// Levels end_level - 1 .. first_level; `out` gets the picture where first_level is 0.
kernel void wavelet_join(TRANSFORM_ARGUMENTS)
{
    CHOOSE_PICTURE;
    for (int level = end_level - 1; level >= first_level; --level) {
        const bool deepest = level + 1 == levels;
        level_arrays l = {side_at(height, level), side_at(width, level), p, k, width};
        l.pitch = deepest ? width : l.b.pairs;
        l.scale = level ? 1 : scale;
        l.add_scale = level ? 0 : add_scale;
        l.low = deepest ? x + p.at : approximations + starts[level] * k + p.at;
        l.x = x + p.at;
        l.add = add + p.at;
        l.to = (level ? approximations + starts[level - 1] * k : out) + p.at;
        l.taps = taps;
        ROWS_OF(join, l);
        barrier(CLK_GLOBAL_MEM_FENCE);
    }
}
