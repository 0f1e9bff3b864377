// SPDX-License-Identifier: BSD-3-Clause
// k right-hand sides in whole pieces of K: the last one begins early, and does not store again what the piece before
// it does.

#include "common/lanes.h"

// Right-hand sides `at` .. at + K - 1, of which the first `skip` are those of the piece before.
typedef struct {
    int at, skip;
} piece;

// Piece p of at least K right-hand sides.
static inline piece piece_of(int p, int k)
{
    const int at = min(K * p, k - K);
    piece q = {at, K * p - at};
    return q;
}

// out = a v + b y at i .. i + K - 1, but for the first `skip` of them. Where b is 0, y is not read.
INLINE void put(global real *out, int i, lanes v, int skip, real a, real b, global const real *y)
{
    sums items;
    items.vector = b != 0 ? a * v + b * LOAD(y + i) : a * v;
    if (skip == 0) {
        STORE(items.vector, out + i);
        return;
    }
    for (int c = skip; c < K; ++c)
        out[i + c] = items.item[c];
}
