// SPDX-License-Identifier: BSD-3-Clause
// Pixels in another order, or some of them: out = a (P x) + b y, where row i of P x is row order[i] of x, or 0 where
// that is negative. Items stride through pieces of K right-hand sides, see common/lanes.h, and (dimension 1) pixels.

#include "common/lanes.h"

kernel void ordered_gather(
    int rows, int k, real a, real b, global const int *order, global const real *x, global const real *y,
    global real *out)
{
    const piece p = piece_of(get_global_id(0), k);
    for (int row = get_global_id(1); row < rows; row += get_global_size(1)) {
        const lanes v = order[row] < 0 ? (lanes)(0) : LOAD(x + order[row] * k + p.at);
        put(out, row * k + p.at, v, p.skip, a, b, y);
    }
}
