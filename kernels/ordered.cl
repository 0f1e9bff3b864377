// SPDX-License-Identifier: BSD-3-Clause
// Pixels in another order, or some of them.
//
//   ordered_gather   out = a (P x) + b y, where row i of P x is row order[i] of x, or 0 where that
//                    is negative
//   ordered_scatter  row order[i] of out is row i of x; other rows stay as they are
//
// Work-items stride through pieces of K right-hand sides (dimension 0) and pixels (1). Required
// define: K, see common/lanes.h. Layout: row-major, k right-hand sides side by side.

#include "common/lanes.h"

kernel void ordered_gather(
    int rows,                 // rows of out
    int k,                    // right-hand sides
    real a,                   // factor of P x
    real b,                   // factor of y
    global const int *order,  // [rows], the row of x, or a negative number
    global const real *x,     // (rows of x, k)
    global const real *y,     // not read where b is 0; may be out
    global real *out)         // (rows, k)
{
    const piece p = piece_of(get_global_id(0), k);
    for (int row = get_global_id(1); row < rows; row += get_global_size(1)) {
        const lanes v = order[row] < 0 ? (lanes)(0) : LOAD(x + order[row] * k + p.at);
        put(out, row * k + p.at, v, p.skip, a, b, y);
    }
}

kernel void ordered_scatter(
    int rows,                 // rows of x
    int k,                    // right-hand sides
    global const int *order,  // [rows], the row of out, each once
    global const real *x,     // (rows, k)
    global real *out)         // (rows of out, k)
{
    const piece p = piece_of(get_global_id(0), k);
    for (int row = get_global_id(1); row < rows; row += get_global_size(1)) {
        const lanes v = LOAD(x + row * k + p.at);
        put(out, order[row] * k + p.at, v, p.skip, 1, 0, x);
    }
}
