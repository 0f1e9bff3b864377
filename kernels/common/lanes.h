// SPDX-License-Identifier: BSD-3-Clause
// The K right-hand sides of one launch, as one vector of `lanes`.
//
// More right-hand sides than 8 are cut into pieces. Layout: arrays are row-major with `stride`
// columns, of which a launch takes offset .. offset + K - 1.
//
// Required define: K, right-hand sides of one launch. Optional: PACKED, where K = stride, which
// saves a fifth at random columns.

#ifndef LTCL_LANES_H
#define LTCL_LANES_H

#include "real.h"

#if K != 1 && K != 2 && K != 3 && K != 4 && K != 8
#error "lanes.h needs -DK=<right-hand sides of one launch: 1, 2, 3, 4 or 8>"
#endif

#ifdef PACKED
#define STRIDE(stride) K
#else
#define STRIDE(stride) (stride)
#endif

#if K == 3
// The values of one pixel as one vector. The fourth lane is never stored; every buffer of ltcl ends
// in 16 spare bytes, so that it may be loaded.
typedef real4 lanes;
#define LOAD(x) LOAD4(x)
#define STORE(v, x) (STORE2((v).lo, x), (x)[2] = (v).s2)
#else
typedef OF(real, K) lanes;
#define LOAD(x) OF(LOAD, K)(x)
#define STORE(v, x) OF(STORE, K)(v, x)
#endif

// Where K = stride, the values of a pixel begin at a multiple of so many lanes: a GPU loads them at
// once. Buffers begin at multiples of 128 bytes.
#if defined(PACKED) && (K == 2 || K == 4 || K == 8)
#if K == 2
#define ALIGNED_LANES 2
#else
#define ALIGNED_LANES 4
#endif
typedef OF(real, ALIGNED_LANES) aligned_lanes;
typedef union {
    aligned_lanes part[K / ALIGNED_LANES];
    real item[K];
} aligned_pixel;
#endif

// The sums of a row, one for each right-hand side.
typedef union {
    lanes vector;
    real item[sizeof(lanes) / sizeof(real)];
} lane_sums;

// Add v times the K values of a pixel, which lie at p.
INLINE void add_pixel(real *sum, real v, global const real *p)
{
#ifdef ALIGNED_LANES
    aligned_pixel pixel;
    for (int part = 0; part < K / ALIGNED_LANES; ++part)
        pixel.part[part] = ((global const aligned_lanes *)p)[part];
    for (int c = 0; c < K; ++c)
        sum[c] = v * pixel.item[c] + sum[c];
#else
    for (int c = 0; c < K; ++c)
        sum[c] = v * p[c] + sum[c];
#endif
}

// Right-hand sides at .. at + K - 1, of which the first `skip` are those of the piece before.
typedef struct {
    int at, skip;
} piece;

// Piece number p of k right-hand sides, at least K.
INLINE piece piece_of(int p, int k)
{
    const int at = min(K * p, k - K);
    return (piece){at, K * p - at};
}

// out = a v + b y at i .. i + K - 1, but for the first `skip` of them; y is not read where b is 0.
INLINE void put(global real *out, int i, lanes v, int skip, real a, real b, global const real *y)
{
    lane_sums items;
    items.vector = b != 0 ? a * v + b * LOAD(y + i) : a * v;
    if (skip == 0) {
        STORE(items.vector, out + i);
        return;
    }
    for (int c = skip; c < K; ++c)
        out[i + c] = items.item[c];
}

#endif
