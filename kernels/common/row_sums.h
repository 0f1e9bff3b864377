// SPDX-License-Identifier: BSD-3-Clause
// Sums over entries j .. end of a row times x, for K right-hand sides; x points at the first of the launch. As in a
// textbook, by one work-item or by many side by side (_add), and in wide loads (_sum): for CPUs, where a row is a
// stream. Entry j of a sparse row is in column columns[j], ascending and unique; of a dense one in column j.

#include "common/lanes.h"

#define COLUMN(j) (sparse ? columns[j] : (j))  // every call says by a constant whether the row is sparse
#define csr_add(sum, columns, values, x, stride, j, end, step) \
    row_add(true, sum, columns, values, x, stride, j, end, step)
#define dense_add(sum, values, x, stride, j, end, step) row_add(false, sum, 0, values, x, stride, j, end, step)

// Every `step`-th entry from j on.
static inline void row_add(
    bool sparse, real *sum, global const int *columns, global const real *values, global const real *x, int stride,
    int j, int end, int step)
{
    for (; j < end; j += step)
        for (int c = 0; c < K; ++c)
            sum[c] = values[j] * x[COLUMN(j) * stride + c] + sum[c];
}

// A function that returned the union would not build under Oclgrind.
#define csr_sum(columns, values, x, stride, j, end) ((sums){row_sum(true, columns, values, x, stride, j, end)})
#define dense_sum(values, x, stride, j, end) ((sums){row_sum(false, 0, values, x, stride, j, end)})
// 16 entries side by side: a pixel of a transport sees many such runs.
#define RUN(j) (COLUMN((j) + 15) == COLUMN(j) + 15)

#if K == 1

static inline real8 gather8(bool sparse, global const real *x, int stride, global const int *columns, int j)
{
    const int8 c = (sparse ? vload8(0, columns + j) : j + (int8)(0, 1, 2, 3, 4, 5, 6, 7)) * stride;
    return (real8)(x[c.s0], x[c.s1], x[c.s2], x[c.s3], x[c.s4], x[c.s5], x[c.s6], x[c.s7]);
}

static inline lanes row_sum(
    bool sparse, global const int *columns, global const real *values, global const real *x, int stride, int j, int end)
{
    real8 even = 0, odd = 0;
    for (; j + 16 <= end; j += 16)
        if (stride == 1 && RUN(j)) {  // two wide loads replace 16 gathers
            even = LOAD8(values + j) * LOAD8(x + COLUMN(j)) + even;
            odd = LOAD8(values + j + 8) * LOAD8(x + COLUMN(j) + 8) + odd;
        } else {
            even = LOAD8(values + j) * gather8(sparse, x, stride, columns, j) + even;
            odd = LOAD8(values + j + 8) * gather8(sparse, x, stride, columns, j + 8) + odd;
        }
    lanes sum = sum8(even + odd);
    for (; j < end; ++j)
        sum = values[j] * x[COLUMN(j) * stride] + sum;
    return sum;
}

#else

// A run of 8 neighbouring columns times x, whose 8 K values lie side by side, needs K wide loads and products: each
// number of the row is spread over the lanes of its column. Lane l of part p is of right-hand side (8 p + l) % K.
#if defined(PACKED) && K < 8
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
// All runs from entry j + ahead on.
#define ADD_RUNS(ahead) \
    for (; j + (ahead) + 16 <= end && RUN(j + (ahead)); j += 16) { \
        add_run(&even, LOAD8(values + j + (ahead)), x + COLUMN(j + (ahead)) * K); \
        add_run(&odd, LOAD8(values + j + (ahead) + 8), x + (COLUMN(j + (ahead)) + 8) * K); \
    }
#else
#define ADD_RUNS(ahead) ;
#endif

// The K values of a pixel lie side by side: one wide load an entry.
static inline lanes row_sum(
    bool sparse, global const int *columns, global const real *values, global const real *x, int stride, int j, int end)
{
    lanes s0 = 0, s1 = 0, s2 = 0, s3 = 0;
    sums total = {0};
#ifdef SPREAD
    run_sums even = {{0}}, odd = {{0}};
#endif
    ADD_RUNS(0)
    for (; j + 4 <= end; j += 4) {
        s0 = (lanes)(values[j]) * LOAD(x + COLUMN(j) * stride) + s0;
        s1 = (lanes)(values[j + 1]) * LOAD(x + COLUMN(j + 1) * stride) + s1;
        s2 = (lanes)(values[j + 2]) * LOAD(x + COLUMN(j + 2) * stride) + s2;
        s3 = (lanes)(values[j + 3]) * LOAD(x + COLUMN(j + 3) * stride) + s3;
        if (sparse)
            ADD_RUNS(4)
    }
    for (; j < end; ++j)
        s0 = (lanes)(values[j]) * LOAD(x + COLUMN(j) * stride) + s0;
#ifdef SPREAD
    for (int i = 0; i < 8 * K; ++i)
        total.item[i % K] += even.item[i] + odd.item[i];
#endif
    return (s0 + s1) + (s2 + s3) + total.vector;
}
#endif
