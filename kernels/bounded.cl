// SPDX-License-Identifier: BSD-3-Clause
// Least squares within bounds between two products (`ltcl/solvers/bounded.py`): x is (rows, k), r is (height, k).
//
// z is -g, or 0 where x is at a bound and -g points out. lower and upper hold one value a row; w, squares of weights,
// counts where weighted == 1. `numbers` holds k columns by rows: alpha, the curvature <A d, A d> of the last d, or 0
// where the next is not conjugate, lambda; from row 4 on the 2 sums of bounded_look by slices; then those of w r r.
// Items, groups, partial sums and `scratch`: common/columns.h.

#include "common/columns.h"

#define STRAIGHT 0.25f  // of d: below, clipping has bent d, which is no longer conjugate; 1/2 refuses every second d
#define NUMBER(row) numbers[(row) * k + s.origin + j]

static inline real bounded_free(real x, real g, real lower, real upper)
{
    return (g > 0 ? x <= lower : x >= upper) ? 0 : -g;
}

// Sums: g.d, d.d; and the largest share of the way to its bound that an entry of x + d has gone; columns with
// resting[column] rest. scratch: 2 more a column.
kernel void bounded_direction(
    int rows, int k, int slices, global const int *resting, global const real *numbers, global const real *lower,
    global const real *upper, global const real *x, global const real *g, global real *d, global real *sums,
    local real *scratch)
{
    const share s = columns_share(rows, k);
    local real *alphas = columns_totals(numbers + 4 * k, slices, 2, 2, k, s, scratch, 0), *betas = alphas + s.width;
    EACH_COLUMN(j) {
        betas[j] = NUMBER(1) > 0 ? -betas[j] / NUMBER(1) : 0;  // -z.h / <A d, A d>
        alphas[j] = resting[s.origin + j] ? 0 : NUMBER(0);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const real alpha = alphas[s.column], beta = betas[s.column];
    real gd = 0, dd = 0, most = 0;
    EACH_VALUE(i, row) {
        const real z = bounded_free(x[i], g[i], lower[row], upper[row]);
        const real p = z == 0 ? 0 : z + beta * d[i];
        const real step = alpha == 0 ? 0 : clamp(x[i] + alpha * p, lower[row], upper[row]) - x[i];
        d[i] = step;
        gd += g[i] * step;
        dd += step * step;
        if (step != 0)
            most = fmax(most, step / ((step > 0 ? upper[row] : lower[row]) - x[i]));
    }
    const int slice = 3 * get_group_id(0);
    for (int n = 0; n < 3; n++)  // one loop: PoCL compiles each function of barriers anew, and more than once
        columns_sum(n == 0 ? gd : n == 1 ? dd : most, sums + (slice + n) * k, n == 2, s, scratch);
}

// `sums` are of bounded_direction, `curvatures` the sums of w Ad Ad; of 0 slices nothing moves. u = w r,
// which may be r where w does not count. scratch: 4 more a column.
kernel void bounded_move(
    int rows, int k, int height, int slices, int weighted, global real *numbers, global const real *sums,
    global const real *curvatures, global const real *lower, global const real *upper,
    global const real *d, global real *x, global const real *w, global const real *Ad, global real *r,
    global real *u, local real *scratch)
{
    share s = columns_share(rows, k);
    local real *totals = columns_totals(sums, slices, 3, 2, k, s, scratch, 0), *lambdas = totals;
    columns_totals(curvatures, slices, 1, 1, k, s, scratch, 3);
    EACH_COLUMN(j) {
        const real gd = totals[j], dd = totals[s.width + j], curvature = totals[3 * s.width + j];
        const bool moves = gd < 0 && curvature > 0 && isfinite(curvature);
        lambdas[j] = moves ? fmin(-gd / curvature, fmax(1 / totals[2 * s.width + j], 1)) : 0;
        if (get_group_id(0) == 0) {
            NUMBER(0) = moves ? dd / curvature : NUMBER(0);  // Barzilai and Borwein
            NUMBER(1) = lambdas[j] >= STRAIGHT ? curvature : 0;
            NUMBER(2) = lambdas[j];
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const real lambda = lambdas[s.column];
    EACH_VALUE(i, row)
        x[i] = lambda == 0 ? x[i] : clamp(x[i] + lambda * d[i], lower[row], upper[row]);
    s = columns_share(height, k);
    real rr = 0;
    EACH_VALUE(i, row) {
        const real left = lambda == 0 ? r[i] : r[i] - lambda * Ad[i], weighed = weighted ? w[i] * left : left;
        r[i] = left;
        u[i] = weighed;
        rr += left * weighed;
    }
    columns_sum(rr, numbers + (4 + 2 * get_num_groups(0) + get_group_id(0)) * k, 0, s, scratch);
}

// g = -q, q = A^T w r; h = (g - last g) / lambda = A^T w A d, which restart == 1 leaves as it is. Sums: the
// Frank-Wolfe gap sum_i max(g_i (x_i - lower_i), g_i (x_i - upper_i)), and z.h.
kernel void bounded_look(
    int rows, int k, int restart, global const real *lower, global const real *upper, global const real *x,
    global const real *q, global real *g, global real *h, global real *numbers, local real *scratch)
{
    const share s = columns_share(rows, k);
    const real lambda = s.first < s.end ? numbers[2 * k + s.origin + s.column] : 0;
    real gap = 0, zh = 0;
    EACH_VALUE(i, row) {
        if (!restart)
            h[i] = lambda == 0 ? 0 : (-q[i] - g[i]) / lambda;
        g[i] = -q[i];
        gap += g[i] * (x[i] - (g[i] > 0 ? lower[row] : upper[row]));
        zh += bounded_free(x[i], g[i], lower[row], upper[row]) * h[i];
    }
    columns_sum(gap, numbers + (4 + 2 * get_group_id(0)) * k, 0, s, scratch);
    columns_sum(zh, numbers + (5 + 2 * get_group_id(0)) * k, 0, s, scratch);
}
