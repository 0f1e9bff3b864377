// SPDX-License-Identifier: BSD-3-Clause
// Sums over tiles j .. end of a row times x, for K right-hand sides: as in a textbook, by one work-item or by many
// side by side (tile_add), and in wide loads (tile_sum). x points at the first right-hand side of the launch.

#ifndef LTCL_TILE_SUMS_H
#define LTCL_TILE_SUMS_H

#include "common/lanes.h"
#include "common/narrow.h"

// First column of a tile. None may reach beyond the end of the row: where places count in more than one column,
// the last tiles are moved back. PoCL compiles min() to a call.
#if GRANULE == 1
#define COLUMN(j) (origin + (int)starts[j])
#else
#define PLACED(j) (origin + (int)starts[j] * GRANULE)
#define COLUMN(j) (PLACED(j) < last ? PLACED(j) : last)
#endif

// The scale that the numbers of tile j share: 5 bits of exponent and 3 of fraction.
#if VALUES == 3
#define SCALE(j) *as_float(((uint)scales[j] + 112 * 8) << 20)
#define SCALE8(j) *as_float8((convert_uint8(LOAD8_UCHAR(scales + (j))) + 112 * 8) << 20)
#else
#define SCALE(j)
#define SCALE8(j)
#endif

// Every `step`-th number from number `n` of the tiles on.
inline void tile_add(
    real *sum, global const place *starts, global const narrow *values, global const uchar *scales, int origin,
    int last, global const real *x, int stride, int n, int end, int step)
{
    for (; n < end; n += step) {
        const real v = WIDEN(values + n) SCALE(n / WIDTH);
        const int i = (COLUMN(n / WIDTH) + n % WIDTH) * stride;
        for (int c = 0; c < K; ++c)
            sum[c] = v * x[i + c] + sum[c];
    }
}

#if K == 1

typedef union {
    real vector;
    real item[1];
} tile_sums;

#define EIGHT(i, step) \
    ((real8)( \
        x[i], x[(i) + (step)], x[(i) + 2 * (step)], x[(i) + 3 * (step)], x[(i) + 4 * (step)], x[(i) + 5 * (step)], \
        x[(i) + 6 * (step)], x[(i) + 7 * (step)]))

inline tile_sums tile_sum(
    global const place *starts, global const narrow *values, global const uchar *scales, int origin, int last,
    global const real *x, int stride, int j, int end)
{
    real8 s0 = 0, s1 = 0, s2 = 0, s3 = 0;  // four sums hide the latency of the addition
#if WIDTH == 1
    for (; j + 8 <= end; j += 8) {
        const real8 y = (real8)(
            x[COLUMN(j) * stride], x[COLUMN(j + 1) * stride], x[COLUMN(j + 2) * stride], x[COLUMN(j + 3) * stride],
            x[COLUMN(j + 4) * stride], x[COLUMN(j + 5) * stride], x[COLUMN(j + 6) * stride],
            x[COLUMN(j + 7) * stride]);
        s0 = WIDEN8(values + j) SCALE8(j) * y + s0;
    }
#else
    if (stride == 1) {
#define PART(s, j, part) s = WIDEN8(values + (j) * WIDTH + (part)) SCALE(j) * LOAD8(x + COLUMN(j) + (part)) + s
#if WIDTH == 8
        for (; j + 4 <= end; j += 4) {
            PART(s0, j, 0);
            PART(s1, j + 1, 0);
            PART(s2, j + 2, 0);
            PART(s3, j + 3, 0);
        }
        for (; j < end; ++j)
            PART(s0, j, 0);
#else
        for (; j + 2 <= end; j += 2) {
            PART(s0, j, 0);
            PART(s1, j, 8);
            PART(s2, j + 1, 0);
            PART(s3, j + 1, 8);
        }
        if (j < end) {
            PART(s0, j, 0);
            PART(s1, j, 8);
        }
#endif
#undef PART
    } else
        for (; j < end; ++j)
            for (int part = 0; part < WIDTH; part += 8) {
                const int i = (COLUMN(j) + part) * stride;
                s0 = WIDEN8(values + j * WIDTH + part) SCALE(j) * EIGHT(i, stride) + s0;
            }
#endif
    tile_sums sum;
    sum.vector = sum8((s0 + s1) + (s2 + s3));
#if WIDTH == 1
    for (; j < end; ++j)
        sum.vector = WIDEN(values + j) SCALE(j) * x[COLUMN(j) * stride] + sum.vector;
#endif
    return sum;
}

#else

typedef lanes_items tile_sums;

// The K values of a pixel lie side by side: one wide load a number, whose neighbours are widened together.
inline tile_sums tile_sum(
    global const place *starts, global const narrow *values, global const uchar *scales, int origin, int last,
    global const real *x, int stride, int j, int end)
{
    lanes s0 = 0, s1 = 0, s2 = 0, s3 = 0;
#if WIDTH == 1
    for (; j + 4 <= end; j += 4) {
        s0 = (lanes)(WIDEN(values + j) SCALE(j)) * LOAD(x + COLUMN(j) * stride) + s0;
        s1 = (lanes)(WIDEN(values + j + 1) SCALE(j + 1)) * LOAD(x + COLUMN(j + 1) * stride) + s1;
        s2 = (lanes)(WIDEN(values + j + 2) SCALE(j + 2)) * LOAD(x + COLUMN(j + 2) * stride) + s2;
        s3 = (lanes)(WIDEN(values + j + 3) SCALE(j + 3)) * LOAD(x + COLUMN(j + 3) * stride) + s3;
    }
    for (; j < end; ++j)
        s0 = (lanes)(WIDEN(values + j) SCALE(j)) * LOAD(x + COLUMN(j) * stride) + s0;
#else
    for (; j < end; ++j) {
        global const real *y = x + COLUMN(j) * stride;
        for (int part = 0; part < WIDTH; part += 8, y += 8 * stride) {
            const real8 v = WIDEN8(values + j * WIDTH + part) SCALE(j);
            s0 = (lanes)(v.s0) * LOAD(y) + s0;
            s1 = (lanes)(v.s1) * LOAD(y + stride) + s1;
            s2 = (lanes)(v.s2) * LOAD(y + 2 * stride) + s2;
            s3 = (lanes)(v.s3) * LOAD(y + 3 * stride) + s3;
            s0 = (lanes)(v.s4) * LOAD(y + 4 * stride) + s0;
            s1 = (lanes)(v.s5) * LOAD(y + 5 * stride) + s1;
            s2 = (lanes)(v.s6) * LOAD(y + 6 * stride) + s2;
            s3 = (lanes)(v.s7) * LOAD(y + 7 * stride) + s3;
        }
    }
#endif
    tile_sums sum;
    sum.vector = (s0 + s1) + (s2 + s3);
    return sum;
}

#endif

#endif
