// SPDX-License-Identifier: BSD-3-Clause
// Sums over a row, or parts of it, times x, for K right-hand sides; x points at the first of the launch.
// As in a textbook, by one work-item or by many side by side (_add), and in wide loads (_sum, _sums): for CPUs,
// where a row is a stream.

#ifndef LTCL_ROW_SUMS_H
#define LTCL_ROW_SUMS_H

#include "common/lanes.h"

// Every `step`-th entry of a sparse row from j on.
inline void csr_add(
    real *sum, global const int *columns, global const real *values, global const real *x, int stride, int j,
    int end, int step)
{
    for (; j < end; j += step)
        for (int c = 0; c < K; ++c)
            sum[c] = values[j] * x[columns[j] * stride + c] + sum[c];
}

// Every `step`-th column of a dense row from j on.
inline void dense_add(
    real *sum, global const real *a, global const real *x, int stride, int j, int end, int step)
{
    for (; j < end; j += step)
        for (int c = 0; c < K; ++c)
            sum[c] = a[j] * x[j * stride + c] + sum[c];
}

#if K == 1

typedef union {
    real vector;
    real item[1];
} sums;

typedef struct {
    sums lower, upper;
} row_sums;

inline real8 gather8(global const real *x, int stride, global const int *columns)
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
inline sums csr_sum(
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

inline real8 gather8_of_two(
    global const real *y, global const real *x, int start, int stride, global const int *columns)
{
#define PICK(c) ((c) < start ? y : x)[(c) * stride]
    const int8 c = vload8(0, columns);
    return (real8)(PICK(c.s0), PICK(c.s1), PICK(c.s2), PICK(c.s3), PICK(c.s4), PICK(c.s5), PICK(c.s6), PICK(c.s7));
#undef PICK
}

// Entries j .. split of a row, whose columns are below `start`, times y, and split .. end times x. One loop, since
// nobody can foretell how often two would run; the stretch that the split cuts is masked.
inline row_sums csr_sums(
    global const int *columns, global const real *values, global const real *y, global const real *x, int start,
    int stride, int j, int split, int end)
{
    real8 s0 = 0, s1 = 0, low = 0;
    global const real *from = y;
    for (; j + 16 <= end; j += 16) {
        const int left = split - j;
        if ((uint)left < 16) {
            low = s0 + s1;
            s0 = s1 = 0;
            from = x;
            if (left > 0) {
                const int8 lane = (int8)(0, 1, 2, 3, 4, 5, 6, 7);
                const real8 even = LOAD8(values + j) * gather8_of_two(y, x, start, stride, columns + j);
                const real8 odd = LOAD8(values + j + 8) * gather8_of_two(y, x, start, stride, columns + j + 8);
                low += select((real8)(0), even, lane < left) + select((real8)(0), odd, lane + 8 < left);
                s0 = select(even, (real8)(0), lane < left);
                s1 = select(odd, (real8)(0), lane + 8 < left);
                continue;
            }
        }
        ADD_STRETCH(from, s0, s1);
    }
    if (j <= split) {
        low = s0 + s1;
        s0 = s1 = 0;
    }
    row_sums sum;
    sum.lower.vector = sum8(low);
    sum.upper.vector = sum8(s0 + s1);
    for (; j < split; ++j)
        sum.lower.vector = values[j] * y[columns[j] * stride] + sum.lower.vector;
    for (; j < end; ++j)
        sum.upper.vector = values[j] * x[columns[j] * stride] + sum.upper.vector;
    return sum;
}

// Columns j .. end of a dense row.
inline sums dense_sum(global const real *a, global const real *x, int stride, int j, int end)
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

typedef lanes_items sums;

typedef struct {
    sums lower, upper;
} row_sums;

// The K values of a pixel lie side by side: one wide load a nonzero.
inline sums csr_sum(
    global const int *columns, global const real *values, global const real *x, int stride, int j, int end)
{
    lanes s0 = 0, s1 = 0, s2 = 0, s3 = 0;
    for (; j + 4 <= end; j += 4) {
        s0 = (lanes)(values[j]) * LOAD(x + columns[j] * stride) + s0;
        s1 = (lanes)(values[j + 1]) * LOAD(x + columns[j + 1] * stride) + s1;
        s2 = (lanes)(values[j + 2]) * LOAD(x + columns[j + 2] * stride) + s2;
        s3 = (lanes)(values[j + 3]) * LOAD(x + columns[j + 3] * stride) + s3;
    }
    for (; j < end; ++j)
        s0 = (lanes)(values[j]) * LOAD(x + columns[j] * stride) + s0;
    sums sum;
    sum.vector = (s0 + s1) + (s2 + s3);
    return sum;
}

inline row_sums csr_sums(
    global const int *columns, global const real *values, global const real *y, global const real *x, int start,
    int stride, int j, int split, int end)
{
    row_sums sum;
    sum.lower = csr_sum(columns, values, y, stride, j, split);
    sum.upper = csr_sum(columns, values, x, stride, split, end);
    return sum;
}

inline sums dense_sum(global const real *a, global const real *x, int stride, int j, int end)
{
    lanes s0 = 0, s1 = 0, s2 = 0, s3 = 0;
    for (; j + 4 <= end; j += 4) {
        s0 = (lanes)(a[j]) * LOAD(x + j * stride) + s0;
        s1 = (lanes)(a[j + 1]) * LOAD(x + (j + 1) * stride) + s1;
        s2 = (lanes)(a[j + 2]) * LOAD(x + (j + 2) * stride) + s2;
        s3 = (lanes)(a[j + 3]) * LOAD(x + (j + 3) * stride) + s3;
    }
    for (; j < end; ++j)
        s0 = (lanes)(a[j]) * LOAD(x + j * stride) + s0;
    sums sum;
    sum.vector = (s0 + s1) + (s2 + s3);
    return sum;
}

#endif

#endif
