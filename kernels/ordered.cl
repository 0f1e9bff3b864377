// SPDX-License-Identifier: BSD-3-Clause
// Pixels in another order: out = scale * (P x) + add, where row i of P x is row order[i] of x.
//
// Work-items stride through the k right-hand sides of a pixel (dimension 0) and through pixels (1), as many as
// there are: a CPU takes one item a pixel, a GPU one a value.

#include "common/real.h"

kernel void ordered_gather(
    int rows, int k, real scale, int adds, global const int *order, global const real *x, global const real *add,
    global real *out)
{
    for (int row = get_global_id(1); row < rows; row += get_global_size(1)) {
        global const real *from = x + order[row] * k;
        for (int c = get_global_id(0); c < k; c += get_global_size(0))
            LTCL_STORE(out, row * k + c, from[c], scale, adds, add);
    }
}
