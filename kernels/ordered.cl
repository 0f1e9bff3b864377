// SPDX-License-Identifier: BSD-3-Clause
// Pixels in another order, or some of them: out = scale * (P x) + add, where row i of P x is row order[i] of x.
// Its transpose writes the rows order[i] of out, each once, and leaves others as they are.
//
// Work-items stride through pieces of K right-hand sides (dimension 0) and through pixels (1), as many as there
// are: a CPU takes one item a pixel, a GPU one a piece.
//
// Required define: K, the right-hand sides that an item handles together: 1, 2, 3, 4 or 8.

#include "common/pieces.h"

kernel void ordered_gather(
    int rows, int k, real scale, int adds, global const int *order, global const real *x, global const real *add,
    global real *out)
{
    for (int row = get_global_id(1); row < rows; row += get_global_size(1))
        for (int p = get_global_id(0); p < pieces_of(k); p += get_global_size(0)) {
            const piece q = piece_of(p, k);
            put(out, row * k + q.at, LOAD(x + order[row] * k + q.at), q.skip, scale, adds, add);
        }
}

kernel void ordered_scatter(
    int rows, int k, real scale, int adds, global const int *order, global const real *x, global const real *add,
    global real *out)
{
    for (int row = get_global_id(1); row < rows; row += get_global_size(1))
        for (int p = get_global_id(0); p < pieces_of(k); p += get_global_size(0)) {
            const piece q = piece_of(p, k);
            put(out, order[row] * k + q.at, LOAD(x + row * k + q.at), q.skip, scale, adds, add);
        }
}
