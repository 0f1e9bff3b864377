// SPDX-License-Identifier: BSD-3-Clause
// A pair of rows and one of columns of a level of wavelets, two by two values: what wavelet.cl and
// wavelet_tail.cl share. A file defines, before it is included, `level_arrays` with the rows `a` and
// columns `b` of a level and `taps`, and where the numbers are:
//
//   INLINE lanes sample(level_arrays l, int row, int column)         of split
//   INLINE lanes approximation(level_arrays l, int row, int column)  of join
//   INLINE lanes coefficient(level_arrays l, int row, int column)    of join: a detail
//
// and SPLIT_ROWS and JOIN_ROWS, how many rows of a pair are unrolled on GPUs, where K is 1 and PAIRS.

#ifndef LTCL_WAVELET_PAIRS_H
#define LTCL_WAVELET_PAIRS_H

#include "wavelet_levels.h"

// The values of a pair of rows and one of columns: v01 is of the rows' first and the columns'
// second.
typedef struct {
    lanes v00, v01, v10, v11;
} quad;

INLINE quad split_terms(level_arrays l, int i, int j, bool inside)
{
    const side a = l.a, b = l.b;
    quad q = {0, 0, 0, 0};
    int row = split_start(a, i);
    const int first_column = split_start(b, j);
#if K == 1 && PAIRS == 1
#pragma unroll SPLIT_ROWS
#endif
    for (int s = 0; s < TAPS; ++s) {
        const term r = split_term(a, i, s, row, inside, l.taps);
        lanes near = 0, detail = 0;
        int column = first_column;
        for (int t = 0; t < TAPS; ++t) {
            const term c = split_term(b, j, t, column, inside, l.taps);
            const lanes v = sample(l, r.low, c.low);
            near = c.w[0] * v + near;
            detail = c.w[1] * v + detail;
            column = split_next(b, column, inside);
        }
        q.v00 = r.w[0] * near + q.v00;
        q.v01 = r.w[0] * detail + q.v01;
        q.v10 = r.w[1] * near + q.v10;
        q.v11 = r.w[1] * detail + q.v11;
        row = split_next(a, row, inside);
    }
    return q;
}

INLINE quad join_terms(level_arrays l, int i, int j, bool inside)
{
    const side a = l.a, b = l.b;
    quad q = {0, 0, 0, 0};
    int row = join_start(a, i);
    const int first_column = join_start(b, j);
#if K == 1 && PAIRS == 1
#pragma unroll JOIN_ROWS
#endif
    for (int s = 0; s < HALF; ++s) {
        const term r = join_term(a, i, s, row, inside, l.taps);
        lanes low0 = 0, low1 = 0, high0 = 0, high1 = 0;
        int column = first_column;
        for (int t = 0; t < HALF; ++t) {
            const term c = join_term(b, j, t, column, inside, l.taps);
            const lanes ll = approximation(l, r.low, c.low);
            const lanes lh = coefficient(l, r.low, c.high);
            const lanes hl = coefficient(l, r.high, c.low);
            const lanes hh = coefficient(l, r.high, c.high);
            low0 = c.w[0] * ll + (c.w[1] * lh + low0);
            low1 = c.w[2] * ll + (c.w[3] * lh + low1);
            high0 = c.w[0] * hl + (c.w[1] * hh + high0);
            high1 = c.w[2] * hl + (c.w[3] * hh + high1);
            column = join_next(b, column, inside);
        }
        q.v00 = r.w[0] * low0 + (r.w[1] * high0 + q.v00);
        q.v01 = r.w[0] * low1 + (r.w[1] * high1 + q.v01);
        q.v10 = r.w[2] * low0 + (r.w[3] * high0 + q.v10);
        q.v11 = r.w[2] * low1 + (r.w[3] * high1 + q.v11);
        row = join_next(a, row, inside);
    }
    return q;
}

// Of pair i of rows and j of columns.
INLINE quad split(level_arrays l, int i, int j)
{
    const side a = l.a, b = l.b;
    const int row = 2 * i + 1 - HALF, column = 2 * j + 1 - HALF;
    const bool inside =
        row >= 0 && row + TAPS <= 2 * a.regular && column >= 0 && column + TAPS <= 2 * b.regular;
    return inside ? split_terms(l, i, j, true) : split_terms(l, i, j, false);
}

INLINE quad join(level_arrays l, int i, int j)
{
    const side a = l.a, b = l.b;
    const int row = i + HALF / 2 + 1 - HALF, column = j + HALF / 2 + 1 - HALF;
    const bool inside =
        row >= 0 && row + HALF <= a.regular && column >= 0 && column + HALF <= b.regular;
    return inside ? join_terms(l, i, j, true) : join_terms(l, i, j, false);
}

#endif
