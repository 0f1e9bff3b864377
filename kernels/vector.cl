// SPDX-License-Identifier: BSD-3-Clause
// Vectors: what a solver does between two products.
//
// Layout: `count` reals; k right-hand sides of n pixels are stored row-major, so that count = n * k and
// column c is every k-th value from c on. Elementwise kernels do not care: one work-item an element.

#include "common/real.h"
#include "common/reduce.h"

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

// out = a_c x + b_c y with coefficients for each column c: a in ab[0 .. k - 1], b in ab[k .. 2 k - 1]. An
// operand whose coefficient is 0 does not count, whatever it holds. `out` may be x or y.
kernel void vector_axpby_columns(
    int count, int k, global const real *ab, global const real *x, global const real *y, global real *out)
{
    const int i = get_global_id(0);
    if (i < count) {
        const real a = ab[i % k];
        const real b = ab[k + i % k];
        out[i] = (a == 0 ? 0 : a * x[i]) + (b == 0 ? 0 : b * y[i]);
    }
}

// out = diag(d) x for k right-hand sides. `out` may be x.
kernel void vector_scale_rows(int count, int k, global const real *d, global const real *x, global real *out)
{
    const int i = get_global_id(0);
    if (i < count)
        out[i] = d[i / k] * x[i];
}

// The sum of x y for each column. Group (g, c) sums the rows of column c that belong to slice g of
// get_num_groups(0); a second launch with one slice, `rows` partial sums and ones == 1 (y is not read)
// adds up the slices, where there are several. Launches of a fixed shape: the result is the same at every call.
kernel void vector_dot(
    int rows, int k, int ones, global const real *x, global const real *y, global real *out, int first,
    local real *scratch)
{
    const int column = get_group_id(1);
    const int slice = rows / (int)get_num_groups(0) + 1; // of rows side by side, which caches like
    const int begin = get_group_id(0) * slice;
    const int end = begin < rows - slice ? begin + slice : rows;
    real sum = 0;
    for (int row = begin + get_local_id(0); row < end; row += get_local_size(0)) {
        const int i = row * k + column;
        sum += ones ? x[i] : x[i] * y[i];
    }
    sum = group_sum(sum, scratch);
    if (get_local_id(0) == 0)
        out[first + get_group_id(0) * k + column] = sum;
}

// The largest weights[c] squares[c] of k columns, NaN where one of them is.
inline real largest(int k, global const real *weights, global const real *squares)
{
    real worst = 0;
    for (int c = 0; c < k; c++) {
        const real value = weights[c] * squares[c];
        worst = value > worst || isnan(value) ? value : worst;
    }
    return worst;
}

// best = x where row `slot` of squares (slot + 1, k), weighted as above, is at most `lowest` and no row before
// it is lower: the best iterate stays, and the host need not know which it was. Nothing counts after a row
// that is not finite. Each item copies every get_global_size(0)-th value.
kernel void vector_keep(
    int count, int k, int slot, real lowest, global const real *weights, global const real *squares,
    global const real *x, global real *best)
{
    for (int s = 0; s < slot; s++) {
        const real before = largest(k, weights, squares + s * k);
        if (!isfinite(before))
            return;
        lowest = before < lowest ? before : lowest;
    }
    if (!(largest(k, weights, squares + slot * k) <= lowest))
        return;
    for (int i = get_global_id(0); i < count; i += get_global_size(0))
        best[i] = x[i];
}

// out = a b + c: the STREAM triad, the yardstick of bench/.
kernel void vector_triad(int count, real a, global const real8 *b, global const real8 *c, global real8 *out)
{
    const int i = get_global_id(0);
    if (i < count)
        out[i] = a * b[i] + c[i];
}
