// SPDX-License-Identifier: BSD-3-Clause
// What least squares within bounds do between two products (`ltcl/solvers/bounded.py`).
//
//   bounded_look       sums that certify x and choose the next direction
//   bounded_direction  d = clip(x + alpha (z + beta d)) - x, its sums, and how far x may go along it
//   bounded_move       x = clip(x + step d)
//
// g is the gradient at x and z the part of -g that may be followed: 0 where x is at a bound and -g points out.
//
// No defines. x, g, d and h are row-major with k columns; lower and upper hold one value a row. A group takes
// one slice of the rows of column get_global_id(1), a work-item every get_global_size(0)-th row, and leaves its
// numbers at out[(slice * k + column) * numbers]; the host adds up the slices.

#include "common/real.h"
#include "common/reduce.h"

inline real bounded_free(real x, real g, real lower, real upper)
{
    return (g > 0 ? x <= lower : x >= upper) ? 0 : -g;
}

// Of each column: the Frank-Wolfe gap sum_i max(g_i (x_i - lower_i), g_i (x_i - upper_i)), z.z, z.h and z.d.
kernel void bounded_look(
    int rows, int k, global const real *lower, global const real *upper, global const real *x,
    global const real *g, global const real *d, global const real *h, global real *out, local real *scratch)
{
    const int column = get_global_id(1);
    real gap = 0, zz = 0, zh = 0, zd = 0;
    for (int row = get_global_id(0); row < rows; row += get_global_size(0)) {
        const int i = row * k + column;
        const real z = bounded_free(x[i], g[i], lower[row], upper[row]);
        gap += g[i] * (x[i] - (g[i] > 0 ? lower[row] : upper[row]));
        zz += z * z;
        zh += z * h[i];
        zd += z * d[i];
    }
    gap = group_sum(gap, scratch);
    zz = group_sum(zz, scratch);
    zh = group_sum(zh, scratch);
    zd = group_sum(zd, scratch);
    if (get_local_id(0) == 0) {
        global real *own = out + (get_group_id(0) * k + column) * 4;
        own[0] = gap;
        own[1] = zz;
        own[2] = zh;
        own[3] = zd;
    }
}

// Of each column: g.d, d.d and the largest share of the way to its bound that an entry of x + d has gone, at
// most 1: x may move along d by one over it. alpha is in ab[0 .. k - 1], beta in ab[k .. 2 k - 1].
kernel void bounded_direction(
    int rows, int k, global const real *ab, global const real *lower, global const real *upper,
    global const real *x, global const real *g, global real *d, global real *out, local real *scratch)
{
    const int column = get_global_id(1);
    const real alpha = ab[column], beta = ab[k + column];
    real gd = 0, dd = 0, share = 0;
    for (int row = get_global_id(0); row < rows; row += get_global_size(0)) {
        const int i = row * k + column;
        const real z = bounded_free(x[i], g[i], lower[row], upper[row]);
        const real p = z == 0 ? 0 : z + beta * d[i];
        const real step = clamp(x[i] + alpha * p, lower[row], upper[row]) - x[i];
        d[i] = step;
        gd += g[i] * step;
        dd += step * step;
        if (step != 0)
            share = fmax(share, step / ((step > 0 ? upper[row] : lower[row]) - x[i]));
    }
    gd = group_sum(gd, scratch);
    dd = group_sum(dd, scratch);
    share = group_max(share, scratch);
    if (get_local_id(0) == 0) {
        global real *own = out + (get_group_id(0) * k + column) * 3;
        own[0] = gd;
        own[1] = dd;
        own[2] = share;
    }
}

// step holds one number a column; one work-item an entry.
kernel void bounded_move(
    int count, int k, global const real *step, global const real *lower, global const real *upper,
    global const real *d, global real *x)
{
    const int i = get_global_id(0);
    if (i < count)
        x[i] = clamp(x[i] + step[i % k] * d[i], lower[i / k], upper[i / k]);
}
