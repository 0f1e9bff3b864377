// SPDX-License-Identifier: BSD-3-Clause
// Stretches of any length in pieces of K values, all of them whole: the last one of a stretch begins early, and
// does not store again what the piece before it does.

#ifndef LTCL_PIECES_H
#define LTCL_PIECES_H

#include "common/lanes.h"

// Values `at` .. at + K - 1, of which the first `skip` are those of the piece before.
typedef struct {
    int at, skip;
} piece;

// Piece p of a stretch of at least K values.
INLINE piece piece_of(int p, int run)
{
    const int at = min(K * p, run - K);
    piece q = {at, K * p - at};
    return q;
}

INLINE int pieces_of(int run)
{
    return (run + K - 1) / K;
}

// out = scale v + add at i .. i + K - 1, but for the first `skip` of them; see LTCL_STORE.
INLINE void put(global real *out, int i, lanes v, int skip, real scale, int adds, global const real *add)
{
    lanes_items items;
    items.vector = adds ? scale * v + LOAD(add + i) : scale * v;
    if (skip == 0) {
        STORE(items.vector, out + i);
        return;
    }
    for (int c = skip; c < K; ++c)
        out[i + c] = items.item[c];
}

#endif
