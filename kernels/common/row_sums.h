// SPDX-License-Identifier: BSD-3-Clause
// Sums over a row, or parts of it, times x, for K right-hand sides; x points at the first of the launch.
// As in a textbook, by one work-item or by many side by side (_add), and in wide loads (_sum): for CPUs, where a
// row is a stream.

#ifndef LTCL_ROW_SUMS_H
#define LTCL_ROW_SUMS_H

#include "common/lanes.h"

// Every `step`-th entry of a sparse row from j on.
static inline void csr_add(
    real *sum, global const int *columns, global const real *values, global const real *x, int stride, int j,
    int end, int step)
{
    for (; j < end; j += step)
        for (int c = 0; c < K; ++c)
            sum[c] = values[j] * x[columns[j] * stride + c] + sum[c];
}

// Every `step`-th column of a dense row from j on.
static inline void dense_add(
    real *sum, global const real *a, global const real *x, int stride, int j, int end, int step)
{
    for (; j < end; j += step)
        for (int c = 0; c < K; ++c)
            sum[c] = a[j] * x[j * stride + c] + sum[c];
}

#if K == 1

static inline real8 gather8(global const real *x, int stride, global const int *columns)
{
    const int8 c = vload8(0, columns) * stride;
    return (real8)(x[c.s0], x[c.s1], x[c.s2], x[c.s3], x[c.s4], x[c.s5], x[c.s6], x[c.s7]);
}

// The next 16 entries. Columns ascend and are unique, so these are neighbours in x when the ends are 15
// apart: then two wide loads replace 16 gathers. A pixel of a transport sees many such stretches.
#define ADD_STRETCH(x, even, odd) \
    do { \
        const int column = columns[j]; \
        if (stride == 1 && columns[j + 15] == column + 15) { \
            even = LOAD8(values + j) * LOAD8(x + column) + even; \
            odd = LOAD8(values + j + 8) * LOAD8(x + column + 8) + odd; \
        } else { \
            even = LOAD8(values + j) * gather8(x, stride, columns + j) + even; \
            odd = LOAD8(values + j + 8) * gather8(x, stride, columns + j + 8) + odd; \
        } \
    } while (0)

// Entries j .. end of a sparse row.
static inline sums csr_sum(
    global const int *columns, global const real *values, global const real *x, int stride, int j, int end)
{
    real8 even = 0, odd = 0;
    for (; j + 16 <= end; j += 16)
        ADD_STRETCH(x, even, odd);
    sums sum;
    sum.vector = sum8(even + odd);
    for (; j < end; ++j)
        sum.vector = values[j] * x[columns[j] * stride] + sum.vector;
    return sum;
}

// Columns j .. end of a dense row.
static inline sums dense_sum(global const real *a, global const real *x, int stride, int j, int end)
{
    real8 s0 = 0, s1 = 0, s2 = 0, s3 = 0;  // four sums hide the latency of the addition
    if (stride == 1)
        for (; j + 32 <= end; j += 32) {
            s0 = LOAD8(a + j) * LOAD8(x + j) + s0;
            s1 = LOAD8(a + j + 8) * LOAD8(x + j + 8) + s1;
            s2 = LOAD8(a + j + 16) * LOAD8(x + j + 16) + s2;
            s3 = LOAD8(a + j + 24) * LOAD8(x + j + 24) + s3;
        }
    if (stride == 1)
        for (; j + 8 <= end; j += 8)
            s0 = LOAD8(a + j) * LOAD8(x + j) + s0;
    sums sum;
    sum.vector = sum8((s0 + s1) + (s2 + s3));
    for (; j < end; ++j)
        sum.vector = a[j] * x[j * stride] + sum.vector;
    return sum;
}

#else

// A run of 8 neighbouring columns times x, whose 8 K values lie side by side, needs K wide loads and products: each
// number of the row is spread over the lanes of its column. Lane l of part p belongs to right-hand side
// (8 p + l) % K.
#if defined(PACKED) && K < 8
#define RUNS
#if K == 2
#define SPREAD(v) v.s00112233, v.s44556677
#elif K == 3
#define SPREAD(v) v.s00011122, v.s23334445, v.s55666777
#else
#define SPREAD(v) v.s00001111, v.s22223333, v.s44445555, v.s66667777
#endif

typedef union {
    real8 part[K];
    real item[8 * K];
} run_sums;

INLINE void add_run(run_sums *sum, real8 v, global const real *x)
{
    const real8 spread[K] = {SPREAD(v)};
    for (int p = 0; p < K; ++p)
        sum->part[p] = spread[p] * LOAD8(x + 8 * p) + sum->part[p];
}

INLINE lanes total_of_runs(run_sums even, run_sums odd)
{
    lanes_items total = {0};
    for (int i = 0; i < 8 * K; ++i)
        total.item[i % K] += even.item[i] + odd.item[i];
    return total.vector;
}
#endif

// The K values of a pixel lie side by side: one wide load a nonzero.
static inline sums csr_sum(
    global const int *columns, global const real *values, global const real *x, int stride, int j, int end)
{
    lanes s0 = 0, s1 = 0, s2 = 0, s3 = 0;
    sums sum;
#ifdef RUNS
    run_sums even = {{0}}, odd = {{0}};
    for (; j + 16 <= end && columns[j + 15] == columns[j] + 15; j += 16) {
        add_run(&even, LOAD8(values + j), x + columns[j] * K);
        add_run(&odd, LOAD8(values + j + 8), x + (columns[j] + 8) * K);
    }
#endif
    for (; j + 4 <= end; j += 4) {
        s0 = (lanes)(values[j]) * LOAD(x + columns[j] * stride) + s0;
        s1 = (lanes)(values[j + 1]) * LOAD(x + columns[j + 1] * stride) + s1;
        s2 = (lanes)(values[j + 2]) * LOAD(x + columns[j + 2] * stride) + s2;
        s3 = (lanes)(values[j + 3]) * LOAD(x + columns[j + 3] * stride) + s3;
#ifdef RUNS
        for (; j + 20 <= end && columns[j + 19] == columns[j + 4] + 15; j += 16) {
            add_run(&even, LOAD8(values + j + 4), x + columns[j + 4] * K);
            add_run(&odd, LOAD8(values + j + 12), x + (columns[j + 4] + 8) * K);
        }
#endif
    }
    for (; j < end; ++j)
        s0 = (lanes)(values[j]) * LOAD(x + columns[j] * stride) + s0;
    sum.vector = (s0 + s1) + (s2 + s3);
#ifdef RUNS
    sum.vector += total_of_runs(even, odd);
#endif
    return sum;
}

static inline sums dense_sum(global const real *a, global const real *x, int stride, int j, int end)
{
    lanes s0 = 0, s1 = 0, s2 = 0, s3 = 0;
    sums sum;
#ifdef RUNS
    run_sums even = {{0}}, odd = {{0}};
    for (; j + 16 <= end; j += 16) {
        add_run(&even, LOAD8(a + j), x + j * K);
        add_run(&odd, LOAD8(a + j + 8), x + (j + 8) * K);
    }
#endif
    for (; j + 4 <= end; j += 4) {
        s0 = (lanes)(a[j]) * LOAD(x + j * stride) + s0;
        s1 = (lanes)(a[j + 1]) * LOAD(x + (j + 1) * stride) + s1;
        s2 = (lanes)(a[j + 2]) * LOAD(x + (j + 2) * stride) + s2;
        s3 = (lanes)(a[j + 3]) * LOAD(x + (j + 3) * stride) + s3;
    }
    for (; j < end; ++j)
        s0 = (lanes)(a[j]) * LOAD(x + j * stride) + s0;
    sum.vector = (s0 + s1) + (s2 + s3);
#ifdef RUNS
    sum.vector += total_of_runs(even, odd);
#endif
    return sum;
}

#endif

#endif
