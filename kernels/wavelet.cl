// SPDX-License-Identifier: BSD-3-Clause
// Orthonormal wavelet transforms of pictures, periodized: out = scale (W x) + add_scale add.
//
//   wavelet_split  from pixels to coefficients
//   wavelet_join   from coefficients to pixels
//
// A level halves both sides at once: from the values that the filters reach, two by two are made,
// or two by 2 PAIRS. Work-items stride through pieces of K right-hand sides (dimension 0), pairs of
// columns (1) and of rows (2). A launch of several levels takes one group a piece, which waits for
// itself between levels. Where K is 1, dimension 0 counts pictures, which stand one below the other.
//
// Required defines: K, see common/lanes.h; TAPS, length of the filters; PAIRS, of columns: 1, or 8
// where K is 1, on CPUs.
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

// PAIRS neighbours, of samples every second one; at the edges all lanes are equal. SHUFFLE
// interleaves the first and the second samples of pairs.
#if PAIRS == 8
typedef real8 wide;
#define SAMPLES(p) ((real8)(LOAD8(p).even, LOAD8((p) + 8).even))
#define NEIGHBOURS(p) LOAD8(p)
#define ONE(v) ((v).s0)
#define SHUFFLE(u, v) \
    do { \
        const wide first = u, second = v; \
        u.even = first.lo, u.odd = second.lo, v.even = first.hi, v.odd = second.hi; \
    } while (0)
#else
typedef lanes wide;
#define SAMPLES(p) LOAD(p)
#define NEIGHBOURS(p) LOAD(p)
#define ONE(v) (v)
#define SHUFFLE(u, v)
#endif

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

// The values of a pair of rows and PAIRS of columns: v01 is of the rows' first and the columns'
// second.
typedef struct {
    wide v00, v01, v10, v11;
} quad;

INLINE quad
split(side a, int i, side b, int j, bool inside, global const real *x, int k, constant real *taps)
{
    quad q = {0, 0, 0, 0};
    for (int s = 0; s < TAPS; ++s) {
        const term r = split_term(a, i, s, inside, taps);
        wide near = 0, detail = 0;
        for (int t = 0; t < TAPS; ++t) {
            const term c = split_term(b, j, t, inside, taps);
            global const real *p = x + (r.low * b.n + c.low) * k;
            const wide v = inside ? SAMPLES(p) : (wide)(LOAD(p));
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
#define COEFFICIENT(from, pixel) \
    (inside ? NEIGHBOURS(from + (pixel) * k) : (wide)(LOAD(from + (pixel) * k)))
    quad q = {0, 0, 0, 0};
    for (int s = 0; s < HALF; ++s) {
        const term r = join_term(a, i, s, inside, taps);
        wide low0 = 0, low1 = 0, high0 = 0, high1 = 0;
        for (int t = 0; t < HALF; ++t) {
            const term c = join_term(b, j, t, inside, taps);
            const wide ll = COEFFICIENT(near, r.low * near_pitch + c.low);
            const wide lh = COEFFICIENT(x, r.low * pitch + c.high);
            const wide hl = COEFFICIENT(x, r.high * pitch + c.low);
            const wide hh = COEFFICIENT(x, r.high * pitch + c.high);
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
    if (inside) {
        SHUFFLE(q.v00, q.v01);
        SHUFFLE(q.v10, q.v11);
    }
    return q;
}

// out = a v + b y at i .., where such samples exist.
INLINE void store(
    bool exist, global real *out, int i, wide v, bool inside, int skip, real a, real b,
    global const real *y)
{
#if PAIRS == 8
    if (exist && inside)
        STORE8(b != 0 ? a * v + b * LOAD8(y + i) : a * v, out + i);
    else
#endif
        if (exist)
        put(out, i, ONE(v), skip, a, b, y);
}

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
        const side a = side_at(height, level), b = side_at(width, level);
        const bool deepest = level + 1 == levels;
        global const real *from = (level ? approximations + starts[level - 1] * k : x) + p.at;
        global real *to = deepest ? out + p.at : approximations + starts[level] * k + p.at;
        const real u = deepest ? scale : 1, v = deepest ? add_scale : 0;
        for (int i = get_global_id(2); i < a.pairs; i += get_global_size(2))
            for (int j = get_global_id(1), done; j < b.pairs; j += done * get_global_size(1)) {
                const int row = 2 * i + 1 - HALF, column = 2 * j + 1 - HALF;
                const bool inside = row >= 0 && row + TAPS <= 2 * a.regular && column >= 0
                                    && column + 2 * (PAIRS - 1) + TAPS <= 2 * b.regular;
                const quad q = inside ? split(a, i, b, j, true, from, k, taps)
                                      : split(a, i, b, j, false, from, k, taps);
                const int right = b.pairs * k, below = a.pairs * width * k;
                const int here = (i * width + j) * k + p.at;
                const int low = (i * (deepest ? width : b.pairs) + j) * k;
                const bool at_right = b.pairs + j < b.n, at_below = a.pairs + i < a.n;
                const bool both = at_right && at_below;
                store(true, to, low, q.v00, inside, p.skip, u, v, add + p.at);
                store(at_right, out, here + right, q.v01, inside, p.skip, scale, add_scale, add);
                store(at_below, out, here + below, q.v10, inside, p.skip, scale, add_scale, add);
                store(
                    both, out, here + below + right, q.v11, inside, p.skip, scale, add_scale, add);
                done = inside ? PAIRS : 1;
            }
        barrier(CLK_GLOBAL_MEM_FENCE);
    }
}

// Levels end_level - 1 .. first_level; `out` gets the picture where first_level is 0.
kernel void wavelet_join(TRANSFORM_ARGUMENTS)
{
    CHOOSE_PICTURE;
    x += p.at;
    add += p.at;
    for (int level = end_level - 1; level >= first_level; --level) {
        const side a = side_at(height, level), b = side_at(width, level);
        const bool deepest = level + 1 == levels;
        global const real *low = deepest ? x : approximations + starts[level] * k + p.at;
        const int pitch = deepest ? width : b.pairs;
        global real *to = (level ? approximations + starts[level - 1] * k : out) + p.at;
        const real u = level ? 1 : scale, v = level ? 0 : add_scale;
        for (int i = get_global_id(2); i < a.pairs; i += get_global_size(2))
            for (int j = get_global_id(1), done; j < b.pairs; j += done * get_global_size(1)) {
                const int row = i + HALF / 2 + 1 - HALF, column = j + HALF / 2 + 1 - HALF;
                const int left = place(b, j, 0);
                const bool inside = row >= 0 && row + HALF <= a.regular && column >= 0
                                    && column + PAIRS - 1 + HALF <= b.regular
                                    && left + 2 * PAIRS <= 2 * b.regular;
                const quad q = inside ? join(a, i, b, j, true, low, pitch, x, width, k, taps)
                                      : join(a, i, b, j, false, low, pitch, x, width, k, taps);
                const int right = inside ? left + PAIRS : place(b, j, 1);
                const int upper = place(a, i, 0) * b.n, lower = place(a, i, 1) * b.n;
                const bool at_right = right < b.n, at_below = lower < a.n * b.n;
                const bool both = at_right && at_below;
                store(true, to, (upper + left) * k, q.v00, inside, p.skip, u, v, add);
                store(at_right, to, (upper + right) * k, q.v01, inside, p.skip, u, v, add);
                store(at_below, to, (lower + left) * k, q.v10, inside, p.skip, u, v, add);
                store(both, to, (lower + right) * k, q.v11, inside, p.skip, u, v, add);
                done = inside ? PAIRS : 1;
            }
        barrier(CLK_GLOBAL_MEM_FENCE);
    }
}
