// SPDX-License-Identifier: BSD-3-Clause
// Sums over entries j .. end of a row of a matrix times x, for K right-hand sides.
//
//   row_add  by many work-items side by side
//   row_sum  by one work-item in wide loads: for CPUs, where a row is a stream
//
// Entry j of a sparse row is in column columns[j], ascending and unique; of a dense row in column
// j. x points at the first right-hand side of the launch. Defines: see lanes.h.

#ifndef LTCL_ROW_SUMS_H
#define LTCL_ROW_SUMS_H

#include "lanes.h"

// Every call says by a constant whether the row is sparse.
#define COLUMN(j) (sparse ? columns[j] : (j))
// 16 columns side by side: most light comes so.
#define RUN(j) ((j) + 16 <= end && COLUMN((j) + 15) == COLUMN(j) + 15)

// Add every `step`-th entry from j on. Four entries are on their way at once: each is a column, and
// then the numbers at it.
INLINE void row_add(
    bool sparse, real *sum, global const int *columns, global const real *values,
    global const real *x, int stride, int j, int end, int step)
{
    for (; j < end - 3 * step; j += 4 * step) {
        int at[4];
        real v[4];
        for (int u = 0; u < 4; ++u) {
            at[u] = COLUMN(j + u * step) * stride;
            v[u] = values[j + u * step];
        }
        for (int u = 0; u < 4; ++u)
            add_pixel(sum, v[u], x + at[u]);
    }
    for (; j < end; j += step)
        add_pixel(sum, values[j], x + COLUMN(j) * stride);
}

// A run of 8 neighbouring columns times x, whose 8 K values lie side by side, needs K wide loads
// and products: each number of the row is spread over the lanes of its column. Lane l of part p is
// of right-hand side (8 p + l) % K. SPREAD8 is not in use: the 8 values of a pixel are one wide
// load.
#define SPREAD1(v) v
#define SPREAD2(v) v.s00112233, v.s44556677
#define SPREAD3(v) v.s00011122, v.s23334445, v.s55666777
#define SPREAD4(v) v.s00001111, v.s22223333, v.s44445555, v.s66667777
#define SPREAD8(v) v
#ifdef PACKED
#define RUNS (K < 8)
#else
#define RUNS false
#endif

typedef union {
    real8 part[K];
    real item[8 * K];
} run_sums;

INLINE void add_run(run_sums *sum, real8 v, global const real *x)
{
    const real8 spread[K] = {OF(SPREAD, K)(v)};
    for (int p = 0; p < K; ++p)
        sum->part[p] = spread[p] * LOAD8(x + 8 * p) + sum->part[p];
}

// The K values of a pixel lie side by side: one wide load an entry.
#define ENTRY_PRODUCT(j) ((lanes)(values[j]) * LOAD(x + COLUMN(j) * stride))
INLINE lanes row_sum(
    bool sparse, global const int *columns, global const real *values, global const real *x,
    int stride, int j, int end)
{
    // Four sums hide the latency of the addition.
    lanes s0 = 0, s1 = 0, s2 = 0, s3 = 0;
    run_sums even = {{0}}, odd = {{0}};
    bool has_runs = false;
    if (!sparse && K == 1 && RUNS) {
        // A dense row of one right-hand side comes so fast that two sums would be waited for.
        run_sums third = {{0}}, fourth = {{0}};
        for (; j + 32 <= end; j += 32) {
            has_runs = true;
            add_run(&even, LOAD8(values + j), x + j);
            add_run(&odd, LOAD8(values + j + 8), x + j + 8);
            add_run(&third, LOAD8(values + j + 16), x + j + 16);
            add_run(&fourth, LOAD8(values + j + 24), x + j + 24);
        }
        even.part[0] += third.part[0];
        odd.part[0] += fourth.part[0];
    }
    while (j + 4 <= end) {
        if (RUNS && RUN(j)) {
            has_runs = true;
            for (; RUN(j); j += 16) {
                add_run(&even, LOAD8(values + j), x + COLUMN(j) * K);
                add_run(&odd, LOAD8(values + j + 8), x + (COLUMN(j) + 8) * K);
            }
        } else {
            s0 = ENTRY_PRODUCT(j) + s0;
            s1 = ENTRY_PRODUCT(j + 1) + s1;
            s2 = ENTRY_PRODUCT(j + 2) + s2;
            s3 = ENTRY_PRODUCT(j + 3) + s3;
            j += 4;
        }
    }
    for (; j < end; ++j)
        s0 = ENTRY_PRODUCT(j) + s0;
    lane_sums total = {(s0 + s1) + (s2 + s3)};
    for (int i = 0; has_runs && i < 8 * K; ++i)
        total.item[i % K] += even.item[i] + odd.item[i];
    return total.vector;
}

#endif
