// SPDX-License-Identifier: BSD-3-Clause
// Vectors: what a solver does between two products, one work-item an element where nothing is added up.
// Layout: k right-hand sides are row-major, count reals in all. ADJACENT: see common/columns.h; 1 if left out.

#ifndef ADJACENT
#define ADJACENT 1
#endif
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

// Sums of x y over the rows of each column, to sums (groups, k) from `first` on; items as common/columns.h has them.
kernel void vector_dot(
    int rows, int k, global const real *x, global const real *y, global real *sums, int first, local real *scratch)
{
    const share s = columns_share(rows, k);
    columns_sum(dot_share(x, y, 0, s), sums + first + get_group_id(0) * k, 0, s, scratch);
}

#define LOAD1(a) (*(a))
#define STORE1(v, a) (*(a) = (v))
#define STEP(number, LOAD, STORE, i)                                                                \
    {                                                                                               \
        const number direction = LOAD(d + i), residual = LOAD(r + i) - LOAD(p + i);                 \
        STORE(LOAD(x + i) + direction, x + i);                                                      \
        STORE(residual, r + i);                                                                     \
        STORE(keep * direction + gain * residual, d + i);                                           \
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

// out (slots, k) from `first` on = sums (slots, groups, k) added up over the groups. Slot get_group_id(1).
kernel void vector_sums(
    int groups, int k, global const real *sums, global real *out, int first, local real *scratch)
{
    const share s = columns_share(groups, k);
    const int slot = get_group_id(1);
    real sum = 0;
    EACH_VALUE(i, row) sum += sums[slot * groups * k + i];
    columns_sum(sum, out + first + slot * k, 0, s, scratch);
}
