// SPDX-License-Identifier: BSD-3-Clause
// Sums over tiles j .. end of a row times x, for K right-hand sides: as in a textbook, by one work-item or by many
// side by side (tile_add), and in wide loads (tile_sum). x points at the first right-hand side of the launch.

#ifndef LTCL_TILE_SUMS_H
#define LTCL_TILE_SUMS_H

#include "common/lanes.h"
#include "common/narrow.h"

// First column of a tile. The last tiles of a row are moved back so that none reaches beyond column N.
#define COLUMN(j) min(origin + (int)starts[j] * GRANULE, last)

// Every `step`-th number from number `n` of the tiles on.
inline void tile_add(
    real *sum, global const place *starts, global const narrow *values, int origin, int last,
    global const real *x, int stride, int n, int end, int step)
{
    for (; n < end; n += step) {
        const real v = WIDEN(values + n);
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
    global const place *starts, global const narrow *values, int origin, int last, global const real *x, int stride,
    int j, int end)
{
    real8 even = 0, odd = 0;
#if WIDTH == 1
    for (; j + 8 <= end; j += 8) {
        const real8 y = (real8)(
            x[COLUMN(j) * stride], x[COLUMN(j + 1) * stride], x[COLUMN(j + 2) * stride], x[COLUMN(j + 3) * stride],
            x[COLUMN(j + 4) * stride], x[COLUMN(j + 5) * stride], x[COLUMN(j + 6) * stride],
            x[COLUMN(j + 7) * stride]);
        even = WIDEN8(values + j) * y + even;
    }
#else
    if (stride == 1) {
#if WIDTH == 8
        for (; j + 2 <= end; j += 2) {
            even = WIDEN8(values + j * 8) * LOAD8(x + COLUMN(j)) + even;
            odd = WIDEN8(values + j * 8 + 8) * LOAD8(x + COLUMN(j + 1)) + odd;
        }
        for (; j < end; ++j)
            even = WIDEN8(values + j * 8) * LOAD8(x + COLUMN(j)) + even;
#else
        for (; j < end; ++j) {
            const int column = COLUMN(j);
            even = WIDEN8(values + j * 16) * LOAD8(x + column) + even;
            odd = WIDEN8(values + j * 16 + 8) * LOAD8(x + column + 8) + odd;
        }
#endif
    } else
        for (int n = j * (WIDTH / 8); n < end * (WIDTH / 8); ++n) {
            const int i = (COLUMN(n / (WIDTH / 8)) + n % (WIDTH / 8) * 8) * stride;
            even = WIDEN8(values + n * 8) * EIGHT(i, stride) + even;
        }
#endif
    tile_sums sum;
    sum.vector = sum8(even + odd);
#if WIDTH == 1
    for (; j < end; ++j)
        sum.vector = WIDEN(values + j) * x[COLUMN(j) * stride] + sum.vector;
#endif
    return sum;
}

#else

typedef lanes_items tile_sums;

// The K values of a pixel lie side by side: one wide load a number, whose neighbours are widened together.
inline tile_sums tile_sum(
    global const place *starts, global const narrow *values, int origin, int last, global const real *x, int stride,
    int j, int end)
{
    lanes s0 = 0, s1 = 0, s2 = 0, s3 = 0;
#if WIDTH == 1
    for (; j + 4 <= end; j += 4) {
        s0 = (lanes)(WIDEN(values + j)) * LOAD(x + COLUMN(j) * stride) + s0;
        s1 = (lanes)(WIDEN(values + j + 1)) * LOAD(x + COLUMN(j + 1) * stride) + s1;
        s2 = (lanes)(WIDEN(values + j + 2)) * LOAD(x + COLUMN(j + 2) * stride) + s2;
        s3 = (lanes)(WIDEN(values + j + 3)) * LOAD(x + COLUMN(j + 3) * stride) + s3;
    }
    for (; j < end; ++j)
        s0 = (lanes)(WIDEN(values + j)) * LOAD(x + COLUMN(j) * stride) + s0;
#else
    for (; j < end; ++j) {
        global const real *y = x + COLUMN(j) * stride;
        for (int part = 0; part < WIDTH; part += 8, y += 8 * stride) {
            const real8 v = WIDEN8(values + j * WIDTH + part);
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
