// SPDX-License-Identifier: BSD-3-Clause
// Steps of Krylov methods between two products, whose coefficients stay on the device.
//
//   krylov_subtract  GMRES: Gram-Schmidt of a new direction
//   krylov_cg        CG: one step
//   krylov_half      BiCGStab: the first half of a step
//   krylov_bicgstab  BiCGStab: the second half
//
// Items, groups and partial sums: common/columns.h, with its optional define ADJACENT.
//
// Layout: vectors are (rows, k). `state` holds k columns by rows, which have names below: two
// copies of COPY_ROWS numbers, of which a step reads one, by parity, and writes the other, as
// groups that start late still read; then what BiCGStab keeps; from STATE_ROWS on partial sums of
// squared residuals of RESIDUAL_SLOTS steps. ltcl/solvers/krylov_state.py has the rows.

#include "common/columns.h"

// The rows and phases below come from ltcl/solvers/krylov_state.py, which reads the same state.
#if !defined(STATE_ROWS) || !defined(RESIDUAL_SLOTS) || !defined(COPY_ROWS)
#error "krylov.cl needs -DSTATE_ROWS, -DRESIDUAL_SLOTS, -DCOPY_ROWS: the layout of the state"
#endif
// Rows of a copy: <r, r>, alpha, and 1 where there was no positive curvature.
#if !defined(CG_SQUARE) || !defined(CG_ALPHA) || !defined(CG_INDEFINITE)
#error "krylov.cl needs -DCG_SQUARE, -DCG_ALPHA, -DCG_INDEFINITE: rows of a copy"
#endif
// Rows of a copy: rho and the phase. Rows of the state: alpha; |r*|^2; and the square that <r*, v>
// is compared with: |S^T r*|^2 with |p|^2, or |r*|^2 with |v|^2.
#if !defined(BICGSTAB_RHO) || !defined(BICGSTAB_PHASE) || !defined(BICGSTAB_ALPHA) \
    || !defined(BICGSTAB_SHADOW) || !defined(BICGSTAB_AGAINST)
#error "krylov.cl needs -DBICGSTAB_RHO, _PHASE, _ALPHA, _SHADOW, _AGAINST: rows of the state"
#endif
// Phases of a column, real numbers: it moves; restarted with r* = p = r and made no step since;
// waits for a restart by the host; has no step even after a restart.
#if !defined(PHASE_MOVES) || !defined(PHASE_FRESH) || !defined(PHASE_WAITS) \
    || !defined(PHASE_BROKEN)
#error "krylov.cl needs -DPHASE_MOVES, -DPHASE_FRESH, -DPHASE_WAITS, -DPHASE_BROKEN"
#endif

// 2^-20, a cosine: below it a float32 inner product is rounding.
#define ORTHOGONAL 9.5367431640625e-7f

// Of column j, in the copy that `iteration` reads.
#define IN_COPY(iteration, row) state[(((iteration) & 1) * COPY_ROWS + (row)) * k + s.origin + j]
#define IN_STATE(row) state[((row) * k) + s.origin + j]
#define SQUARES_ROW \
    (STATE_ROWS + iteration % RESIDUAL_SLOTS * (int)get_num_groups(0) + (int)get_group_id(0))

// A denominator beyond float32 gives NaN, which the residual tells, not a step of 0.
INLINE real divided(real a, real b)
{
    return a / (isfinite(b) ? b : NAN);
}

// out = w - sum_j h_j V_j, j < count, where the partial sums give h and, last, w * w.
kernel void krylov_subtract(
    int rows,                       // rows of the vectors
    int k,                          // right-hand sides
    int count,                      // directions
    int slices,                     // of the partial sums
    int second_pass,                // 1: first_pass is added to what goes to h
    int unit_length,                // 1: brings out to length 1, which is the next V
    global const real *partials,    // (slices, count + 1, k)
    global const real *first_pass,  // h of the pass before
    global real *h,                 // gets h, and the length of what is left of w, by Pythagoras,
                                    // or 0 where that is rounding
    global real *V,                 // (directions, rows k)
    global const real *w,           // (rows, k)
    global real *out,               // may be w
    local real *scratch)            // a real a work-item, and count + 2 a column
{
    const share s = columns_share(rows, k);
    local real *totals = columns_totals(partials, slices, count + 1, count + 1, k, s, scratch, 0);
    local real *scale = totals + (count + 1) * s.width;
    EACH_COLUMN(j) {
        real squares = 0, all = 0;
        for (int i = 0; i < count; ++i) {
            const real now = totals[i * s.width + j];
            const real sum = second_pass ? now + first_pass[i * k + s.origin + j] : now;
            squares += now * now;
            all += sum * sum;
            if (get_group_id(0) == 0)
                h[i * k + s.origin + j] = sum;
        }
        const real square = totals[count * s.width + j];
        // Not fmax: NaN stays NaN.
        const real left = sqrt(square - (squares > square ? square : squares));
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
            // A column without part in direction j, whatever that holds, keeps its value.
            value = c == 0 ? value : value - c * V[j * size + i];
        }
        if (unit_length)
            V[count * size + i] = value = length == 0 ? 0 : length * value;
        out[i] = value;
    }
}

// p = r + beta p, q = w + beta q, x = x + alpha p, r = r - alpha q.
kernel void krylov_cg(
    int rows,                     // rows of the vectors
    int k,                        // right-hand sides
    int slices,                   // of the partial sums
    int iteration,                // number of the step
    int restart,                  // 1: forgets p and q
    global const int *resting,    // [k], 1 where a column rests
    global const real *partials,  // <r, r> and <w, r>, (slices, 2, k)
    global real *state,           // see above
    global const real *w,         // S r
    global real *p,               // direction, (rows, k)
    global real *q,               // S p
    global real *x,               // iterate, (rows, k)
    global real *r,               // residual, (rows, k)
    local real *scratch)          // a real a work-item, and 2 a column
{
    const share s = columns_share(rows, k);
    local real *alphas = columns_totals(partials, slices, 2, 2, k, s, scratch, 0);
    local real *betas = alphas + s.width;
    EACH_COLUMN(j) {
        const real square = alphas[j], product = betas[j];
        const real previous = IN_COPY(iteration, CG_SQUARE), last = IN_COPY(iteration, CG_ALPHA);
        real broken = IN_COPY(iteration, CG_INDEFINITE);
        bool moves = !resting[s.origin + j] && !(broken > 0);
        real beta = !restart && previous > 0 ? square / previous : 0;
        real curvature = beta == 0 ? product : product - beta * square / last;
        // The recursion has left S: start anew along r.
        if (!(curvature > 0) && product > 0) {
            beta = 0;
            curvature = product;
        }
        if (moves && square > 0 && curvature <= 0)
            broken = 1;
        moves = moves && square != 0 && !(broken > 0);
        const real alpha = divided(square, curvature);
        if (get_group_id(0) == 0) {
            IN_COPY(iteration + 1, CG_SQUARE) = moves ? square : previous;
            IN_COPY(iteration + 1, CG_ALPHA) = moves ? alpha : last;
            IN_COPY(iteration + 1, CG_INDEFINITE) = broken;
        }
        alphas[j] = moves ? alpha : 0;
        betas[j] = beta;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const real alpha = alphas[s.column], beta = betas[s.column];
    real sum = 0;
    EACH_VALUE(i, row) {
        real left = r[i];
        // Else the column rests, whatever it holds.
        if (alpha != 0) {
            const real along = beta == 0 ? left : left + beta * p[i];
            const real moved = beta == 0 ? w[i] : w[i] + beta * q[i];
            p[i] = along;
            q[i] = moved;
            x[i] += alpha * along;
            r[i] = left -= alpha * moved;
        }
        sum += left * left;
    }
    columns_sum(sum, state + SQUARES_ROW * k, 0, s, scratch);
}

// half_way = r - alpha v, alpha = rho / <r*, v>.
kernel void krylov_half(
    int rows,                     // rows of the vectors
    int k,                        // right-hand sides
    int slices,                   // of the partial sums
    int iteration,                // number of the step
    global const real *partials,  // <r*, v> and the square that it is compared with, (slices, 2, k)
    global real *state,           // see above
    global const real *r,         // residual, (rows, k)
    global const real *v,         // S p
    global real *half_way,        // (rows, k)
    local real *scratch)          // a real a work-item, and 2 a column
{
    const share s = columns_share(rows, k);
    local real *totals = columns_totals(partials, slices, 2, 2, k, s, scratch, 0);
    EACH_COLUMN(j) {
        const real sigma = totals[j], square = totals[s.width + j];
        const bool lost =
            fabs(sigma) <= ORTHOGONAL * sqrt(square) * sqrt(IN_STATE(BICGSTAB_AGAINST));
        const bool moves = IN_COPY(iteration, BICGSTAB_PHASE) <= PHASE_FRESH
                           && !(lost && isfinite(square) && isfinite(sigma));
        totals[j] = moves ? divided(IN_COPY(iteration, BICGSTAB_RHO), sigma) : 0;
        if (get_group_id(0) == 0)
            IN_STATE(BICGSTAB_ALPHA) = totals[j];
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const real alpha = totals[s.column];
    EACH_VALUE(i, row)
        half_way[i] = alpha == 0 ? r[i] : r[i] - alpha * v[i];
}

// x = x + alpha p + omega s, r = s - omega t, p = r + beta (p - omega v), with s = half_way.
kernel void krylov_bicgstab(
    int rows,                     // rows of the vectors
    int k,                        // right-hand sides
    int slices,                   // of the partial sums
    int iteration,                // number of the step
    int first,                    // value of next_partials with which the sums begin
    global const real *partials,  // <t, s>, <t, t>, <r*, s>, <r*, t> and <s, s>, (slices, 5, k)
    global real *state,           // see above
    global real *next_partials,   // gets <g, p> and <p, p> of the next step, (groups, 2, k)
    global const real *g,         // S^T r*
    global const real *half_way,  // (rows, k)
    global const real *t,         // S s
    global const real *v,         // S p
    global real *p,               // direction, (rows, k)
    global real *x,               // iterate, (rows, k)
    global real *r,               // residual, (rows, k)
    local real *scratch)          // a real a work-item, and 5 a column
{
    const share s = columns_share(rows, k);
    local real *totals = columns_totals(partials, slices, 5, 5, k, s, scratch, 0);
    local real *alphas = totals, *omegas = totals + s.width, *betas = totals + 2 * s.width;
    EACH_COLUMN(j) {
        const real ts = totals[j], tt = totals[s.width + j], ss = totals[4 * s.width + j];
        const real alpha = IN_STATE(BICGSTAB_ALPHA), phase = IN_COPY(iteration, BICGSTAB_PHASE);
        const real omega = alpha == 0 || tt == 0 ? 0 : divided(ts, tt);
        const real rho = totals[2 * s.width + j] - omega * totals[3 * s.width + j];
        const real square = ss - omega * (2 * ts - omega * tt);  // |r|^2, or about that
        const real least = ORTHOGONAL * sqrt(fmax(square, 0)) * sqrt(IN_STATE(BICGSTAB_SHADOW));
        const bool lost = omega == 0 || fabs(rho) <= least;
        real next_phase = lost ? PHASE_WAITS : PHASE_MOVES;
        if (alpha == 0)
            next_phase = phase == PHASE_FRESH ? PHASE_BROKEN : PHASE_WAITS;
        if (!(phase <= PHASE_FRESH))
            next_phase = phase;
        if (get_group_id(0) == 0) {
            IN_COPY(iteration + 1, BICGSTAB_RHO) = rho;
            IN_COPY(iteration + 1, BICGSTAB_PHASE) = next_phase;
        }
        alphas[j] = alpha;
        omegas[j] = omega;
        const bool moves = next_phase == PHASE_MOVES;
        betas[j] = moves ? rho / IN_COPY(iteration, BICGSTAB_RHO) * (alpha / omega) : 0;
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
    global real *sums = next_partials + first + (int)get_group_id(0) * 2 * k;
    global real *squares = state + SQUARES_ROW * k;
    // One loop: PoCL compiles each function of barriers anew, and more than once.
    for (int n = 0; n < 3; n++) {
        const real value = n == 0 ? along : n == 1 ? square : sum;
        columns_sum(value, n < 2 ? sums + n * k : squares, 0, s, scratch);
    }
}
