// SPDX-License-Identifier: BSD-3-Clause
// Least squares within bounds between two products (ltcl/solvers/bounded.py): a step by a projected
// and conjugated gradient, with step lengths of Barzilai and Borwein.
//
//   bounded_direction  the direction d, and the sums that its step length needs
//   bounded_move       x and r a step along d
//   bounded_look       the gradient g, h = A^T w A d, and the Frank-Wolfe gap
//
// z is -g, or 0 where x is at a bound and -g points out. Items, groups and partial sums:
// common/columns.h, with its optional defines ADJACENT and PLANES.
//
// Layout: x, g, d, h are (rows, k), r is (height, k), lower and upper hold one value a row; with
// PLANES all are planes (k, rows) or (k, height), and so are lower and upper.
// `numbers` holds k columns by rows, which have names below: the step length alpha, the curvature,
// lambda; from NUMBER_SUMS on the 2 sums of bounded_look by slices; then those of w r r.

#include "common/columns.h"

// Rows of `numbers`.
#define NUMBER_ALPHA 0
#define NUMBER_CURVATURE 1  // <A d, A d> of the last d, or 0 where the next is not conjugate
#define NUMBER_LAMBDA 2     // the share of d that x moved
#define NUMBER_SUMS 4
#define NUMBER(row) numbers[(row) * k + s.origin + j]

// The bound of value i, which is in that row.
#define BOUND(bounds, i, row) bounds[PLANES ? (i) : (row)]

// Shorter shares of d are due to clipping, which has bent d: it is no longer conjugate. 1/2 refuses
// every second d.
#define STRAIGHT 0.25f

INLINE real bounded_free(real x, real g, real lower, real upper)
{
    return (g > 0 ? x <= lower : x >= upper) ? 0 : -g;
}

// d = clip(x + alpha (z + beta d)) - x. Sums: g.d, d.d; and the largest share of the way to its
// bound that an entry of x + d has gone.
kernel void bounded_direction(
    int rows,                    // rows of x
    int k,                       // right-hand sides
    int slices,                  // of the sums of bounded_look
    global const int *resting,   // [k], 1 where a column rests
    global const real *numbers,  // see above
    global const real *lower,    // [rows]
    global const real *upper,    // [rows]
    global const real *x,        // (rows, k)
    global const real *g,        // gradient, (rows, k)
    global real *d,              // direction, (rows, k)
    global real *sums,           // (slices, 3, k)
    local real *scratch)         // a real a work-item, and 2 a column
{
    const share s = columns_share(rows, k);
    global const real *looks = numbers + NUMBER_SUMS * k;
    local real *alphas = columns_totals(looks, slices, 2, 2, k, s, scratch, 0);
    local real *betas = alphas + s.width;
    EACH_COLUMN(j) {
        const real curvature = NUMBER(NUMBER_CURVATURE);
        betas[j] = curvature > 0 ? -betas[j] / curvature : 0;  // -z.h / <A d, A d>
        alphas[j] = resting[s.origin + j] ? 0 : NUMBER(NUMBER_ALPHA);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const real alpha = alphas[s.column], beta = betas[s.column];
    real gd = 0, dd = 0, most = 0;
    EACH_VALUE(i, row) {
        const real low = BOUND(lower, i, row), high = BOUND(upper, i, row);
        const real z = bounded_free(x[i], g[i], low, high);
        // Two statements: LLVM 18 of PoCL 6 fails on the conditional expression.
        real p = z + beta * d[i];
        if (z == 0)
            p = 0;
        const real step = alpha == 0 ? 0 : clamp(x[i] + alpha * p, low, high) - x[i];
        d[i] = step;
        gd += g[i] * step;
        dd += step * step;
        if (step != 0)
            most = fmax(most, step / ((step > 0 ? high : low) - x[i]));
    }
    const int slice = 3 * get_group_id(0);
    // One loop: PoCL compiles each function of barriers anew, and more than once.
    for (int n = 0; n < 3; n++)
        columns_sum(n == 0 ? gd : n == 1 ? dd : most, sums + (slice + n) * k, n == 2, s, scratch);
}

// x += lambda d within the bounds, r -= lambda A d, u = w r.
kernel void bounded_move(
    int rows,                       // rows of x
    int k,                          // right-hand sides
    int height,                     // rows of r
    int slices,                     // of the partial sums; of 0 nothing moves
    int weighted,                   // 1: w counts
    global real *numbers,           // see above
    global const real *sums,        // of bounded_direction
    global const real *curvatures,  // sums of w Ad Ad, (slices, k)
    global const real *lower,       // [rows]
    global const real *upper,       // [rows]
    global const real *d,           // direction, (rows, k)
    global real *x,                 // (rows, k)
    global const real *w,           // squares of weights, (height, k)
    global const real *Ad,          // A d, (height, k)
    global real *r,                 // b - A x, (height, k)
    global real *u,                 // may be r where w does not count
    local real *scratch)            // a real a work-item, and 4 a column
{
    share s = columns_share(rows, k);
    local real *totals = columns_totals(sums, slices, 3, 2, k, s, scratch, 0), *lambdas = totals;
    columns_totals(curvatures, slices, 1, 1, k, s, scratch, 3);
    EACH_COLUMN(j) {
        const real gd = totals[j], dd = totals[s.width + j], share_of_way = totals[2 * s.width + j];
        const real curvature = totals[3 * s.width + j];
        const bool moves = gd < 0 && curvature > 0 && isfinite(curvature);
        lambdas[j] = moves ? fmin(-gd / curvature, fmax(1 / share_of_way, 1)) : 0;
        if (get_group_id(0) == 0) {
            NUMBER(NUMBER_ALPHA) = moves ? dd / curvature : NUMBER(NUMBER_ALPHA);
            NUMBER(NUMBER_CURVATURE) = lambdas[j] >= STRAIGHT ? curvature : 0;
            NUMBER(NUMBER_LAMBDA) = lambdas[j];
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const real lambda = lambdas[s.column];
    EACH_VALUE(i, row) {
        const real low = BOUND(lower, i, row), high = BOUND(upper, i, row);
        x[i] = lambda == 0 ? x[i] : clamp(x[i] + lambda * d[i], low, high);
    }
    s = columns_share(height, k);
    real rr = 0;
    EACH_VALUE(i, row) {
        const real left = lambda == 0 ? r[i] : r[i] - lambda * Ad[i];
        const real weighed = weighted ? w[i] * left : left;
        r[i] = left;
        u[i] = weighed;
        rr += left * weighed;
    }
    const int row = NUMBER_SUMS + 2 * get_num_groups(0) + get_group_id(0);
    columns_sum(rr, numbers + row * k, 0, s, scratch);
}

// g = -q, q = A^T w r; h = (g - last g) / lambda = A^T w A d. Sums: the Frank-Wolfe gap
// sum_i max(g_i (x_i - lower_i), g_i (x_i - upper_i)), and z.h.
kernel void bounded_look(
    int rows,                  // rows of x
    int k,                     // right-hand sides
    int restart,               // 1: h stays as it is
    global const real *lower,  // [rows]
    global const real *upper,  // [rows]
    global const real *x,      // (rows, k)
    global const real *q,      // A^T w r, (rows, k)
    global real *g,            // gradient, (rows, k)
    global real *h,            // A^T w A d, (rows, k)
    global real *numbers,      // see above
    local real *scratch)       // a real a work-item
{
    const share s = columns_share(rows, k);
    global const real *lambdas = numbers + NUMBER_LAMBDA * k;
    const real lambda = s.first < s.end ? lambdas[s.origin + s.column] : 0;
    real gap = 0, zh = 0;
    EACH_VALUE(i, row) {
        const real low = BOUND(lower, i, row), high = BOUND(upper, i, row);
        if (!restart)
            h[i] = lambda == 0 ? 0 : (-q[i] - g[i]) / lambda;
        g[i] = -q[i];
        gap += g[i] * (x[i] - (g[i] > 0 ? low : high));
        zh += bounded_free(x[i], g[i], low, high) * h[i];
    }
    global real *sums = numbers + (NUMBER_SUMS + 2 * get_group_id(0)) * k;
    columns_sum(gap, sums, 0, s, scratch);
    columns_sum(zh, sums + k, 0, s, scratch);
}
