// SPDX-License-Identifier: BSD-3-Clause
// One block of a sweep x -> y by rows of S = shift I + scale M: Gauss-Seidel, SOR and block Gauss-Seidel.
//
// A sweep solves P_BB delta_B = b_B - (S x with y before the block)_B, y_B = x_B + delta_B, block after block;
// P_BB is what the method makes of S_BB: its lower triangle with D / omega, or all of it. A launch does, side by
// side, either or both of
//   product  s_B = b_B - (S x with y before row `start`)_B, for the rows of a block B
//   finish   P_AA delta_A = s_A - S_AO delta_O, y_A = x_A + delta_A, for a block A that begins in row `start`
// In one launch, A is the block before B, and O before that had its turn while the product for A ran: nothing is
// written that another work-item reads. In two, O is empty, A is B, and x and y may be one array.
//
//   relax_csr, relax_dense  one work-item a row, and as in csr.cl and dense.cl
//   _stream                 the same in wide loads; for CPUs, where a row is a stream
//   _group                  one work-group a row, its items side by side along the row; for GPUs
// The first `lead` work-groups finish A by inverse, as rows of a dense product with [-P_AA^-1 S_AO, P_AA^-1], which
// `weights` is.
//
//   relax_substitute        finishes A in a launch of its own, in place: a single work-item goes through the rows
//                           that have entries left of the diagonal within A, while others correct the rest.
//
// The sums of a row are kept apart where y ends and x begins, so that a sweep also tells the residual of x: what
// this sweep takes from x, the one before took from y, and left the rest in carry = b - (S y)_lower.
//
// Required define: K, the right-hand sides of one launch: 1, 2, 3, 4 or 8. Optional: PACKED, see common/lanes.h.
// Layout: B is `rows` rows from row `begin` of a slab, whose row 0 is row `first` of the matrix; A is `count` rows
// of the matrix from row `start`, O ends there and starts at row `before`. x, y, b, s, delta, r and carry are
// row-major with `stride` reals a row; a launch works on columns offset .. offset + K - 1.
// CSR: middle[i] is the first entry of row i of the slab in a column from `start` on.
// With K = 3 the fourth lane of a load may be a value that another work-item writes; nothing is made of it.

#include "common/lanes.h"
#include "common/reduce.h"
#include "common/row_sums.h"

// One row of B: its right-hand side, and the residual of the iterate the sweep started from.
#define RELAX_STORE(i, lower, upper) \
    do { \
        const real from_x = shift * x[i] + scale * (upper); \
        r[i] = carry[i] - from_x; \
        carry[i] = b[i] - scale * (lower); \
        s[i] = carry[i] - from_x; \
    } while (0)

#define RELAX_CORRECT(i, value) \
    do { \
        const real correction = value; \
        delta[i] = correction; \
        y[i] = x[i] + correction; \
    } while (0)

// Work-items that each have a row of their own.
inline void relax_finish(
    int item, int start, int count, int before, int stride,
    global const real *weights, global const real *x,
    global real *y, global const real *s, global real *delta)
{
    if (item >= count)
        return;
    const int known = start - before;
    global const real *a = weights + (size_t)item * (known + count);
    const sums old = dense_sum(a, delta + before * stride, stride, 0, known);
    const sums own = dense_sum(a + known, s + start * stride, stride, 0, count);
    const int i = (start + item) * stride;
    for (int c = 0; c < K; ++c)
        RELAX_CORRECT(i + c, old.item[c] + own.item[c]);
}

// A work-group with a row of its own.
inline void relax_finish_group(
    int item, int start, int count, int before, int stride,
    global const real *weights, global const real *x,
    global real *y, global const real *s, global real *delta, local real *scratch)
{
    const int me = get_local_id(0), step = get_local_size(0), known = start - before;
    global const real *a = weights + (size_t)item * (known + count);
    real sum[K];
    for (int c = 0; c < K; ++c)
        sum[c] = 0;
    dense_add(sum, a, delta + before * stride, stride, me, known, step);
    dense_add(sum, a + known, s + start * stride, stride, me, count, step);
    const int i = (start + item) * stride;
    for (int c = 0; c < K; ++c) {
        const real total = group_sum(sum[c], scratch);
        if (me == 0)
            RELAX_CORRECT(i + c, total);
    }
}

kernel void relax_csr(
    int rows, int begin, int first, int lead, int start, int count, int before, int stride,
    int offset, real shift, real scale, global const int *pointers, global const int *columns,
    global const real *values, global const int *middle,
    global const real *weights, global const real *x, global real *y, global const real *b, global real *s, global real *delta, global real *r,
    global real *carry)
{
    stride = STRIDE(stride);
    x += offset, y += offset, b += offset, s += offset, delta += offset, r += offset, carry += offset;
    if (get_group_id(0) < lead) {
        relax_finish(
            get_global_id(0), start, count, before, stride, weights, x, y, s,
            delta);
        return;
    }
    const int row = begin + get_global_id(0) - lead * get_local_size(0);
    if (row >= begin + rows)
        return;
    real lower[K], upper[K];
    for (int c = 0; c < K; ++c)
        lower[c] = upper[c] = 0;
    csr_add(lower, columns, values, y, stride, pointers[row], middle[row], 1);
    csr_add(upper, columns, values, x, stride, middle[row], pointers[row + 1], 1);
    const int i = (first + row) * stride;
    for (int c = 0; c < K; ++c)
        RELAX_STORE(i + c, lower[c], upper[c]);
}

kernel void relax_dense(
    int rows, int begin, int first, int lead, int start, int count, int before, int stride,
    int offset, real shift, real scale, int width, global const real *matrix,
    global const real *weights, global const real *x, global real *y, global const real *b, global real *s, global real *delta, global real *r,
    global real *carry)
{
    stride = STRIDE(stride);
    x += offset, y += offset, b += offset, s += offset, delta += offset, r += offset, carry += offset;
    if (get_group_id(0) < lead) {
        relax_finish(
            get_global_id(0), start, count, before, stride, weights, x, y, s,
            delta);
        return;
    }
    const int row = begin + get_global_id(0) - lead * get_local_size(0);
    if (row >= begin + rows)
        return;
    global const real *a = matrix + (size_t)row * width;
    real lower[K], upper[K];
    for (int c = 0; c < K; ++c)
        lower[c] = upper[c] = 0;
    dense_add(lower, a, y, stride, 0, start, 1);
    dense_add(upper, a, x, stride, start, width, 1);
    const int i = (first + row) * stride;
    for (int c = 0; c < K; ++c)
        RELAX_STORE(i + c, lower[c], upper[c]);
}

kernel void relax_csr_stream(
    int rows, int begin, int first, int lead, int start, int count, int before, int stride,
    int offset, real shift, real scale, global const int *pointers, global const int *columns,
    global const real *values, global const int *middle,
    global const real *weights, global const real *x, global real *y, global const real *b, global real *s, global real *delta, global real *r,
    global real *carry)
{
    stride = STRIDE(stride);
    x += offset, y += offset, b += offset, s += offset, delta += offset, r += offset, carry += offset;
    if (get_group_id(0) < lead) {
        relax_finish(
            get_global_id(0), start, count, before, stride, weights, x, y, s,
            delta);
        return;
    }
    const int row = begin + get_global_id(0) - lead * get_local_size(0);
    if (row >= begin + rows)
        return;
    const row_sums sum = csr_sums(
        columns, values, y, x, start, stride, pointers[row], middle[row], pointers[row + 1]);
    const int i = (first + row) * stride;
    for (int c = 0; c < K; ++c)
        RELAX_STORE(i + c, sum.lower.item[c], sum.upper.item[c]);
}

kernel void relax_dense_stream(
    int rows, int begin, int first, int lead, int start, int count, int before, int stride,
    int offset, real shift, real scale, int width, global const real *matrix,
    global const real *weights, global const real *x, global real *y, global const real *b, global real *s, global real *delta, global real *r,
    global real *carry)
{
    stride = STRIDE(stride);
    x += offset, y += offset, b += offset, s += offset, delta += offset, r += offset, carry += offset;
    if (get_group_id(0) < lead) {
        relax_finish(
            get_global_id(0), start, count, before, stride, weights, x, y, s,
            delta);
        return;
    }
    const int row = begin + get_global_id(0) - lead * get_local_size(0);
    if (row >= begin + rows)
        return;
    global const real *a = matrix + (size_t)row * width;
    row_sums sum;
    sum.lower = dense_sum(a, y, stride, 0, start);
    sum.upper = dense_sum(a, x, stride, start, width);
    const int i = (first + row) * stride;
    for (int c = 0; c < K; ++c)
        RELAX_STORE(i + c, sum.lower.item[c], sum.upper.item[c]);
}

kernel void relax_csr_group(
    int rows, int begin, int first, int lead, int start, int count, int before, int stride,
    int offset, real shift, real scale, global const int *pointers, global const int *columns,
    global const real *values, global const int *middle,
    global const real *weights, global const real *x, global real *y, global const real *b, global real *s, global real *delta, global real *r,
    global real *carry, local real *scratch)
{
    stride = STRIDE(stride);
    x += offset, y += offset, b += offset, s += offset, delta += offset, r += offset, carry += offset;
    if (get_group_id(0) < lead) {
        relax_finish_group(
            get_group_id(0), start, count, before, stride, weights, x, y, s,
            delta, scratch);
        return;
    }
    const int row = begin + get_group_id(0) - lead;  // one group a row exactly: no row is beyond the last
    real lower[K], upper[K];
    for (int c = 0; c < K; ++c)
        lower[c] = upper[c] = 0;
    const int me = get_local_id(0), step = get_local_size(0), split = middle[row];
    csr_add(lower, columns, values, y, stride, pointers[row] + me, split, step);
    csr_add(upper, columns, values, x, stride, split + me, pointers[row + 1], step);
    const int i = (first + row) * stride;
    for (int c = 0; c < K; ++c) {
        const real below = group_sum(lower[c], scratch), beyond = group_sum(upper[c], scratch);
        if (me == 0)
            RELAX_STORE(i + c, below, beyond);
    }
}

kernel void relax_dense_group(
    int rows, int begin, int first, int lead, int start, int count, int before, int stride,
    int offset, real shift, real scale, int width, global const real *matrix,
    global const real *weights, global const real *x, global real *y, global const real *b, global real *s, global real *delta, global real *r,
    global real *carry, local real *scratch)
{
    stride = STRIDE(stride);
    x += offset, y += offset, b += offset, s += offset, delta += offset, r += offset, carry += offset;
    if (get_group_id(0) < lead) {
        relax_finish_group(
            get_group_id(0), start, count, before, stride, weights, x, y, s,
            delta, scratch);
        return;
    }
    const int row = begin + get_group_id(0) - lead;  // one group a row exactly: no row is beyond the last
    global const real *a = matrix + (size_t)row * width;
    real lower[K], upper[K];
    for (int c = 0; c < K; ++c)
        lower[c] = upper[c] = 0;
    const int me = get_local_id(0), step = get_local_size(0);
    dense_add(lower, a, y, stride, me, start, step);
    dense_add(upper, a, x, stride, start + me, width, step);
    const int i = (first + row) * stride;
    for (int c = 0; c < K; ++c) {
        const real below = group_sum(lower[c], scratch), beyond = group_sum(upper[c], scratch);
        if (me == 0)
            RELAX_STORE(i + c, below, beyond);
    }
}

// `places` are first the rows of A, those `chained` ones with entries before the others, and `weights` 1 / D_ii there.
// From starts[p] on follow the columns of row p of these, and its entries over the D of their columns. In s, rows
// become D / omega times their correction, which those without entries are from the start.
kernel void relax_substitute(
    int count, int chained, int stride, int offset, real omega, global const int *starts,
    global const int *places, global const real *weights, global real *x, global real *s)
{
    stride = STRIDE(stride);
    x += offset, s += offset;
    const int other = chained + (int)get_global_id(0) - (int)get_local_size(0);  // not for the first group
    if (get_group_id(0) > 0 && other < count)
        for (int c = 0, i = places[other] * stride; c < K; ++c)
            x[i + c] += omega * weights[other] * s[i + c];
    if (get_global_id(0) > 0)
        return;
    for (int row = 0; row < chained; ++row) {
        const int i = places[row] * stride, end = starts[row + 1];
        real sum[K];
        for (int c = 0; c < K; ++c)
            sum[c] = 0;
        for (int j = starts[row]; j < end; ++j)
            for (int c = 0; c < K; ++c)
                sum[c] = weights[j] * s[places[j] * stride + c] + sum[c];
        for (int c = 0; c < K; ++c) {
            s[i + c] -= omega * sum[c];
            x[i + c] += omega * weights[row] * s[i + c];
        }
    }
}
