// SPDX-License-Identifier: BSD-3-Clause
// Steps of Krylov methods between two products, whose coefficients stay on the device.
//
// Items, groups, partial sums, `slices` and `scratch`: common/columns.h. `state` holds numbers of k columns by rows;
// from row STATE on the partial sums of squared residuals of SLOTS steps. A step reads one of two copies, by parity,
// and writes the other: groups that start late still read.

#include "common/columns.h"

#define ORTHOGONAL 9.5367431640625e-7f  // 2^-20, a cosine: below, a float32 inner product is rounding
#define STATE 16
#define SLOTS 8
#define OWN(iteration, row) ((((iteration) & 1) * 4 + (row)) * k + s.origin + j)  // of column j in the copy to be read
#define SQUARES (state + (STATE + iteration % SLOTS * (int)get_num_groups(0) + (int)get_group_id(0)) * k)

// A denominator beyond float32 gives NaN, which the residual tells, not a step of 0.
static inline real divided(real a, real b)
{
    return a / (isfinite(b) ? b : NAN);
}

// out = w - sum_j h_j V_j, j < count, with h of the partial sums, the last of which are w * w. `h` gets those numbers,
// added to `first_pass` where second_pass == 1, and the length of what is left of w, by Pythagoras, or 0 where that is rounding.
// unit_length == 1 brings out to length 1, which is the next V. `out` may be w. scratch: count + 2 more a column.
kernel void krylov_subtract(
    int rows, int k, int count, int slices, int second_pass, int unit_length, global const real *partials,
    global const real *first_pass, global real *h, global real *V, global const real *w, global real *out,
    local real *scratch)
{
    const share s = columns_share(rows, k);
    local real *totals = columns_totals(partials, slices, count + 1, count + 1, k, s, scratch, 0);
    local real *scale = totals + (count + 1) * s.width;
    EACH_COLUMN(j) {
        real squares = 0, all = 0;
        for (int i = 0; i < count; ++i) {
            const real now = totals[i * s.width + j], sum = second_pass ? now + first_pass[i * k + s.origin + j] : now;
            squares += now * now;
            all += sum * sum;
            if (get_group_id(0) == 0)
                h[i * k + s.origin + j] = sum;
        }
        const real square = totals[count * s.width + j];
        const real left = sqrt(square - (squares > square ? square : squares));  // NaN stays NaN
        const bool complete = left <= ORTHOGONAL * sqrt(all + left * left);
        scale[j] = complete ? 0 : unit_length ? divided(1, left) : 1;
        if (get_group_id(0) == 0)
            h[count * k + s.origin + j] = complete ? 0 : left;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const real length = scale[s.column];
    const size_t size = (size_t)rows * k;
    EACH_VALUE(i, row) {
        real value = w[i];
        for (int j = 0; j < count; ++j) {
            const real c = totals[j * s.width + s.column];
            value = c == 0 ? value : value - c * V[j * size + i];  // a column without part in it, whatever it holds
        }
        if (unit_length)
            V[count * size + i] = value = length == 0 ? 0 : length * value;
        out[i] = value;
    }
}

// p = r + beta p, q = w + beta q, x = x + alpha p, r = r - alpha q, with the sums <r, r> and <w, r>. state rows,
// twice: <r, r>, alpha, 1 where there was no positive curvature. Columns rest where resting[column]; restart == 1 forgets p
// and q. scratch: 2 more a column.
kernel void krylov_cg(
    int rows, int k, int slices, int iteration, int restart, global const int *resting, global const real *partials,
    global real *state, global const real *w, global real *p, global real *q, global real *x, global real *r,
    local real *scratch)
{
    const share s = columns_share(rows, k);
    local real *alphas = columns_totals(partials, slices, 2, 2, k, s, scratch, 0), *betas = alphas + s.width;
    EACH_COLUMN(j) {
        const real square = alphas[j], product = betas[j];
        const real previous = state[OWN(iteration, 0)], last = state[OWN(iteration, 1)];
        real broken = state[OWN(iteration, 2)];
        bool moves = !resting[s.origin + j] && !(broken > 0);
        real beta = !restart && previous > 0 ? square / previous : 0;
        real curvature = beta == 0 ? product : product - beta * square / last;
        if (!(curvature > 0) && product > 0) {  // the recursion has left S: start anew along r
            beta = 0;
            curvature = product;
        }
        if (moves && square > 0 && curvature <= 0)
            broken = 1;
        moves = moves && square != 0 && !(broken > 0);
        const real alpha = divided(square, curvature);
        if (get_group_id(0) == 0) {
            state[OWN(iteration + 1, 0)] = moves ? square : previous;
            state[OWN(iteration + 1, 1)] = moves ? alpha : last;
            state[OWN(iteration + 1, 2)] = broken;
        }
        alphas[j] = moves ? alpha : 0;
        betas[j] = beta;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const real alpha = alphas[s.column], beta = betas[s.column];
    real sum = 0;
    EACH_VALUE(i, row) {
        real left = r[i];
        if (alpha != 0) {  // else the column rests, whatever it holds
            const real along = beta == 0 ? left : left + beta * p[i];
            const real moved = beta == 0 ? w[i] : w[i] + beta * q[i];
            p[i] = along;
            q[i] = moved;
            x[i] += alpha * along;
            r[i] = left -= alpha * moved;
        }
        sum += left * left;
    }
    columns_sum(sum, SQUARES, 0, s, scratch);
}

// BiCGStab: state rows, twice: rho, what the column does; then, from row 8 on: alpha, |r*|^2, and the square that
// <r*, v> is compared with, |S^T r*|^2 with |p|^2 or |r*|^2 with |v|^2.
#define GOES 0.0f
#define FRESH 1.0f  // started anew with r* = p = r, and made no step since
#define WAITS 2.0f  // to be started anew by the host
#define BROKEN 3.0f  // even a fresh start has no step
#define ALPHA ((8 * k) + s.origin + j)
#define SHADOW ((9 * k) + s.origin + j)
#define AGAINST ((10 * k) + s.origin + j)

// half = r - alpha v, alpha = rho / <r*, v>, with the sums <r*, v> and the square it is compared with.
// scratch: 2 more a column.
kernel void krylov_half(
    int rows, int k, int slices, int iteration, global const real *partials, global real *state, global const real *r,
    global const real *v, global real *half_way, local real *scratch)
{
    const share s = columns_share(rows, k);
    local real *totals = columns_totals(partials, slices, 2, 2, k, s, scratch, 0);
    EACH_COLUMN(j) {
        const real sigma = totals[j], square = totals[s.width + j];
        const bool lost = fabs(sigma) <= ORTHOGONAL * sqrt(square) * sqrt(state[AGAINST]);
        const bool moves = state[OWN(iteration, 1)] <= FRESH && !(lost && isfinite(square) && isfinite(sigma));
        totals[j] = moves ? divided(state[OWN(iteration, 0)], sigma) : 0;
        if (get_group_id(0) == 0)
            state[ALPHA] = totals[j];
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const real alpha = totals[s.column];
    EACH_VALUE(i, row)
        half_way[i] = alpha == 0 ? r[i] : r[i] - alpha * v[i];
}

// x = x + alpha p + omega s, r = s - omega t, p = r + beta (p - omega v), with the sums <t, s>, <t, t>, <r*, s>,
// <r*, t> and <s, s>; and the partial sums <g, p> and <p, p> of the next step, two a slice. scratch: 5 more a column.
kernel void krylov_bicgstab(
    int rows, int k, int slices, int iteration, global const real *partials, global real *state,
    global real *next_partials, global const real *g, global const real *half_way, global const real *t,
    global const real *v, global real *p, global real *x, global real *r, local real *scratch)
{
    const share s = columns_share(rows, k);
    local real *totals = columns_totals(partials, slices, 5, 5, k, s, scratch, 0);
    local real *alphas = totals, *omegas = totals + s.width, *betas = totals + 2 * s.width;
    EACH_COLUMN(j) {
        const real ts = totals[j], tt = totals[s.width + j], ss = totals[4 * s.width + j];
        const real alpha = state[ALPHA], does = state[OWN(iteration, 1)];
        const real omega = alpha == 0 || tt == 0 ? 0 : divided(ts, tt);
        const real rho = totals[2 * s.width + j] - omega * totals[3 * s.width + j];
        const real square = ss - omega * (2 * ts - omega * tt);  // |r|^2, or about that
        const bool lost = omega == 0 || fabs(rho) <= ORTHOGONAL * sqrt(fmax(square, 0)) * sqrt(state[SHADOW]);
        const real goes = alpha == 0 ? (does == FRESH ? BROKEN : WAITS) : lost ? WAITS : GOES;
        const real then = does <= FRESH ? goes : does;
        if (get_group_id(0) == 0) {
            state[OWN(iteration + 1, 0)] = rho;
            state[OWN(iteration + 1, 1)] = then;
        }
        alphas[j] = alpha;
        omegas[j] = omega;
        betas[j] = then == GOES ? rho / state[OWN(iteration, 0)] * (alpha / omega) : 0;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const real alpha = alphas[s.column], omega = omegas[s.column], beta = betas[s.column];
    real sum = 0, along = 0, square = 0;
    EACH_VALUE(i, row) {
        const real left = omega == 0 ? half_way[i] : half_way[i] - omega * t[i];
        const real next = beta == 0 ? left : left + beta * (p[i] - omega * v[i]);
        sum += left * left;
        along += g[i] * next;
        square += next * next;
        x[i] += (alpha == 0 ? 0 : alpha * p[i]) + (omega == 0 ? 0 : omega * half_way[i]);
        r[i] = left;
        p[i] = next;
    }
    global real *sums = next_partials + (int)get_group_id(0) * 2 * k;
    for (int n = 0; n < 3; n++)  // one loop: PoCL compiles each function of barriers anew, and more than once
        columns_sum(n == 0 ? along : n == 1 ? square : sum, n < 2 ? sums + n * k : SQUARES, 0, s, scratch);
}
