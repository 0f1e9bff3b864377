// SPDX-License-Identifier: BSD-3-Clause
// Vectors: what a solver does between two products, one work-item an element where nothing is added up.
// Layout: k right-hand sides are row-major, count reals in all. Items and partial sums: common/columns.h.

#include "common/columns.h"

kernel void vector_fill(int count, real value, global real *out)
{
    const int i = get_global_id(0);
    if (i < count)
        out[i] = value;
}

// out = a x + b y. `out` may be x or y.
kernel void vector_axpby(int count, real a, global const real *x, real b, global const real *y, global real *out)
{
    const int i = get_global_id(0);
    if (i < count)
        out[i] = a * x[i] + b * y[i];
}

// out = diag(d) x for k right-hand sides. `out` may be x.
kernel void vector_scale_rows(int count, int k, global const real *d, global const real *x, global real *out)
{
    const int i = get_global_id(0);
    if (i < count)
        out[i] = d[i / k] * x[i];
}

// Sums of left * right * weight over the rows of each column, for pair j = get_group_id(1), to partial sums from
// `first` on: 4 bits of `pairs` name two of a, b and c. Where it is 0, left is a[j * rows * k] on, b for the last j,
// and right is b. `weights` are like b and count where weighted == 1.
kernel void vector_dots(
    int rows, int k, int first, int pairs, int weighted, global const real *weights, global const real *a,
    global const real *b, global const real *c, global real *partials, local real *scratch)
{
    const share s = columns_share(rows, k);
    const size_t j = get_group_id(1), count = get_num_groups(1);
    const int codes = j < 8 ? pairs >> (4 * j) : 0, left = codes & 3, right = codes >> 2 & 3;
    global const real *x = left == 0 ? a : left == 1 ? b : c, *y = right == 0 ? a : right == 1 ? b : c;
    if (!pairs) {
        x = j + 1 < count ? a + j * rows * k : b;
        y = b;
    }
    global real *sums = partials + first + (get_group_id(0) * count + j) * k;
    columns_sum(dot_share(x, y, weighted ? weights : 0, s), sums, 0, s, scratch);
}

#define STEP(number, LOAD, STORE, i) \
    { \
        const number direction = LOAD(d + i), residual = LOAD(r + i) - LOAD(p + i); \
        STORE(LOAD(x + i) + direction, x + i); \
        STORE(residual, r + i); \
        STORE(keep * direction + gain * residual, d + i); \
    }

// One step with p = S d: x += d, r -= p, d = keep d + gain r, and the squares of r, summed by columns, to squares
// (groups, k) from `first` on. Items with the same neighbouring rows take turns, eight values at a time.
kernel void vector_step(
    int rows, int k, real keep, real gain, int first, global const real *p, global real *x, global real *r,
    global real *d, global real *squares, local real *scratch)
{
    const share s = columns_share(rows, k);
    const int width = ADJACENT && s.width == k ? 8 : 1;
    for (int i = width == 8 ? s.row * k + 8 * s.column : s.first; max(i, s.first) < s.end; i += width * s.step)
        if (width == 8 && i + 8 <= s.end)
            STEP(real8, LOAD8, STORE8, i)
        else
            for (int j = i; j < min(i + width, s.end); ++j)
                STEP(real, LOAD1, STORE1, j)
    barrier(CLK_GLOBAL_MEM_FENCE);
    columns_sum(dot_share(r, r, 0, s), squares + first + get_group_id(0) * k, 0, s, scratch);
}

// out (slots, k) from `first` on = sums (slots, rows, k) added up over the rows. Slot get_group_id(1).
kernel void vector_sums(
    int rows, int k, global const real *sums, global real *out, int first, local real *scratch)
{
    const share s = columns_share(rows, k);
    const int slot = get_group_id(1);
    real sum = 0;
    EACH_VALUE(i, row) sum += sums[slot * rows * k + i];
    columns_sum(sum, out + first + slot * k, 0, s, scratch);
}
