// SPDX-License-Identifier: BSD-3-Clause
// Levels of wavelet transforms: what wavelet.cl and wavelet_tail.cl share, but for the sums, which are
// in wavelet_pairs.h.
//
// Layout: a picture is row-major, its k right-hand sides side by side. Coefficients stand as in
// PyWavelets' coeffs_to_array: of each side the approximation first, ceil(n / 2) of n.
//
// Of the ceil(pixels / 2^level) samples of a side the last may stand for fewer pixels. It stays out
// of the filters; where an odd number of whole ones is left, a rotation turns the last two into one
// of the approximation and a detail, which is 0 of a constant: orthonormal, and a constant has one
// coefficient on any grid.
//
// Required defines: K, see lanes.h; TAPS, length of the filters; PAIRS, see wavelet.cl. Optional:
// ORDERED, where coefficients stand in another order, or only some of them; K is 1 then, and PAIRS.
// All kernels have the arguments
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
//   order            ORDERED: of all pictures, the row of each coefficient, or a negative number:
//                    it is not written then, or is 0

#ifndef LTCL_WAVELET_LEVELS_H
#define LTCL_WAVELET_LEVELS_H

#include "lanes.h"

#ifndef TAPS
#error "wavelet_levels.h needs -DTAPS=<length of the filters: 2, 4, ...>"
#endif
#ifndef PAIRS
#error "wavelet_levels.h needs -DPAIRS=<of columns: 1, or 8 where K is 1, on CPUs>"
#endif

#if defined(ORDERED) && (K != 1 || PAIRS != 1)
#error "wavelet_levels.h takes -DORDERED with -DK=1 and -DPAIRS=1 only"
#endif

#define HALF (TAPS / 2)
// Where the samples of pair 0 begin that need the same coefficients.
#define FIRST ((HALF + 1) % 2)

// i modulo n. It is near, and a GPU divides in tens of instructions.
INLINE int wrapped(int i, int n)
{
    while (i < 0)
        i += n;
    while (i >= n)
        i -= n;
    return i;
}

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
    side a = {n, (n + 1) / 2, whole / 2, 1, 0};
    if (rest > 0) {
        const real total = size + rest;
        a.c = sqrt(size / total);
        a.s = sqrt(rest / total);
    }
    return a;
}

// The samples, or approximations, that the terms of pair m take: `low` of the first, and of the one
// after `low`. They go around the end of the regular pairs; those of a pair inside do not reach it.
INLINE int split_start(side a, int m)
{
    return m < a.regular ? wrapped(2 * m + 1 - HALF, 2 * a.regular) : 0;
}

INLINE int join_start(side a, int m)
{
    return m < a.regular ? wrapped(m + HALF / 2 + 1 - HALF, a.regular) : 0;
}

INLINE int split_next(side a, int low, bool inside)
{
    return !inside && low + 1 == 2 * a.regular ? 0 : low + 1;
}

INLINE int join_next(side a, int low, bool inside)
{
    return !inside && low + 1 == a.regular ? 0 : low + 1;
}

// Term t of pair m. Of analysis: sample `low`, and its weights in approximation
// and detail. Of synthesis: approximation `low`, detail `high`, and the weights of both in the first
// sample and in the second.
typedef struct {
    int low, high;
    real w[4];
} term;

INLINE term split_term(side a, int m, int t, int low, bool inside, constant real *taps)
{
    term v = {low, 0, {taps[t], taps[TAPS + t], 0, 0}};
    if (inside || m < a.regular)
        return v;
    const bool two = a.n % 2 == 0;
    v.low = a.n - 1 - (two && t == 0);
    v.w[0] = t > two ? 0 : !two ? 1 : t ? a.s : a.c;
    v.w[1] = t > two || !two ? 0 : t ? -a.c : a.s;
    return v;
}

INLINE term join_term(side a, int m, int t, int low, bool inside, constant real *taps)
{
    const int tap = TAPS - 2 - 2 * t;
    term v = {low, a.pairs + low};
    v.w[0] = taps[tap];
    v.w[1] = taps[TAPS + tap];
    v.w[2] = taps[tap + 1];
    v.w[3] = taps[TAPS + tap + 1];
    if (inside || m < a.regular)
        return v;
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
    return m < a.regular ? wrapped(i + FIRST, 2 * a.regular) : i;
}

// Where the coefficient at `pixel` stands, if it exists; a negative number: nowhere. There is
// no branch, so that the loads of a pair are on their way at the same time.
INLINE int coefficient_row(global const int *order, bool exist, int pixel)
{
#ifdef ORDERED
    const int row = order[exist ? pixel : 0];
#else
    const int row = pixel;
#endif
    return exist ? row : -1;
}

#ifdef ORDERED
#define ORDER_ARGUMENT , global const int *order
#else
#define ORDER_ARGUMENT
#endif
#define TRANSFORM_ARGUMENTS \
    int height, int width, int first_level, int end_level, int levels, int k, real scale, \
        real add_scale, constant int *starts, constant real *taps, global const real *x, \
        global real *approximations, global const real *add, global real *out ORDER_ARGUMENT

// Where K is 1: the pieces and arrays of picture number get_global_id(0) / k. With PAIRS, k is 1.
#if PAIRS > 1
#define PICTURE (int)get_global_id(0)
#define PIECE ((piece){0, 0})
#elif K == 1
#define PICTURE ((int)get_global_id(0) / k)
#define PIECE ((piece){(int)get_global_id(0) % k, 0})
#else
#define PICTURE 0
#define PIECE piece_of(get_global_id(0), k)
#endif
#ifdef ORDERED
#define CHOOSE_COEFFICIENTS(pointer) (void)0
#define ORDER (order + first_pixel)
#else
#define CHOOSE_COEFFICIENTS(pointer) CHOOSE_PIXELS(pointer)
#define ORDER 0
#endif
#define CHOOSE_PIXELS(pointer) (pointer += first_pixel * k)
#define CHOOSE_PICTURE \
    const int first_pixel = PICTURE * height * width; \
    const piece p = PIECE; \
    approximations += PICTURE * starts[levels] * k

#endif
