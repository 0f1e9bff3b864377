// SPDX-License-Identifier: BSD-3-Clause
// Vectors: what a solver does between two products.
//
//   vector_fill, vector_axpby, vector_scale_rows  one work-item a value
//   vector_dots, vector_step, vector_sums         sums over rows, see common/columns.h
//
// Layout: (rows, k) row-major, count = rows k values in all. Optional define: ADJACENT, see
// common/columns.h.

#include "common/columns.h"

// out = value.
kernel void vector_fill(
    int count,         // values
    real value,        // number
    global real *out)  // [count]
{
    const int i = get_global_id(0);
    if (i < count)
        out[i] = value;
}

// out = a x + b y.
kernel void vector_axpby(
    int count,             // values
    real a,                // factor of x
    global const real *x,  // (rows, k)
    real b,                // factor of y
    global const real *y,  // (rows, k)
    global real *out)      // may be x or y
{
    const int i = get_global_id(0);
    if (i < count)
        out[i] = a * x[i] + b * y[i];
}

// out = diag(d) x.
kernel void vector_scale_rows(
    int count,             // values
    int k,                 // right-hand sides
    global const real *d,  // [rows]
    global const real *x,  // (rows, k)
    global real *out)      // may be x
{
    const int i = get_global_id(0);
    if (i < count)
        out[i] = d[k == 1 ? i : i / k] * x[i];
}

// Partial sums of left * right * weight over the rows of each column, for pair number
// j = get_group_id(1) of get_num_groups(1).
kernel void vector_dots(
    int rows,                    // rows of the vectors
    int k,                       // right-hand sides
    int first,                   // value of `partials` with which the sums begin
    int pairs,                   // 4 bits a pair: left + 4 right, where a is 0, b 1 and c 2; or 0:
                                 // left is a[j * rows * k] on, b for the last j, and right is b
    int weighted,                // 1: the weights count, 0: they are not read
    global const real *weights,  // (rows, k)
    global const real *a,        // (rows, k), or as many as pairs but one
    global const real *b,        // (rows, k)
    global const real *c,        // (rows, k)
    global real *partials,       // (slices, pairs, k) from `first` on
    local real *scratch)         // a real a work-item
{
    const share s = columns_share(rows, k);
    const size_t j = get_group_id(1), count = get_num_groups(1);
    const int codes = j < 8 ? pairs >> (4 * j) : 0, left = codes & 3, right = codes >> 2 & 3;
    global const real *x = left == 0 ? a : left == 1 ? b : c;
    global const real *y = right == 0 ? a : right == 1 ? b : c;
    if (!pairs) {
        x = j + 1 < count ? a + j * rows * k : b;
        y = b;
    }
    global real *sums = partials + first + (get_group_id(0) * count + j) * k;
    columns_sum(dot_share(x, y, weighted ? weights : 0, s), sums, 0, s, scratch);
}

#define MOVE(number, LOAD, STORE, i) \
    { \
        const number direction = LOAD(d + i), residual = LOAD(r + i) - LOAD(p + i); \
        STORE(LOAD(x + i) + direction, x + i); \
        STORE(residual, r + i); \
        STORE(keep * direction + gain * residual, d + i); \
    }

// One step with p = S d: x += d, r -= p, d = keep d + gain r, and the squares of r, summed by
// columns. Items with the same neighbouring rows take turns, eight values at a time.
kernel void vector_step(
    int rows,              // rows of the vectors
    int k,                 // right-hand sides
    real keep,             // factor of the direction before
    real gain,             // factor of the new residual
    int first,             // value of `squares` with which the sums begin
    global const real *p,  // S d
    global real *x,        // the iterate
    global real *r,        // its residual
    global real *d,        // the direction
    global real *squares,  // (slices, k) from `first` on
    local real *scratch)   // a real a work-item
{
    const share s = columns_share(rows, k);
    const int width = ADJACENT && s.width == k ? 8 : 1;
    int i = width == 8 ? s.row * k + 8 * s.column : s.first;
    for (; max(i, s.first) < s.end; i += width * s.step)
        if (width == 8 && i + 8 <= s.end)
            MOVE(real8, LOAD8, STORE8, i)
        else
            for (int j = i; j < min(i + width, s.end); ++j)
                MOVE(real, LOAD1, STORE1, j)
    barrier(CLK_GLOBAL_MEM_FENCE);
    columns_sum(dot_share(r, r, 0, s), squares + first + get_group_id(0) * k, 0, s, scratch);
}

// Partial sums added up over their rows, for slot number get_group_id(1).
kernel void vector_sums(
    int rows,                 // partial sums of a slot and column
    int k,                    // columns
    global const real *sums,  // (slots, rows, k)
    global real *out,         // (slots, k) from `first` on
    int first,                // value of `out` with which the results begin
    local real *scratch)      // a real a work-item
{
    const share s = columns_share(rows, k);
    const int slot = get_group_id(1);
    real sum = 0;
    EACH_VALUE(i, row)
        sum += sums[slot * rows * k + i];
    columns_sum(sum, out + first + slot * k, 0, s, scratch);
}
