// SPDX-License-Identifier: BSD-3-Clause
// The K right-hand sides of one launch: 1, 2, 3, 4 or 8; more are cut into such pieces. They are columns offset ..
// offset + K - 1 of row-major arrays with `stride` columns; -DPACKED where K = stride saves a fifth at random columns.

#include "common/real.h"

#if K != 1 && K != 2 && K != 3 && K != 4 && K != 8
#error "lanes.h needs -DK=<right-hand sides of one launch: 1, 2, 3, 4 or 8>"
#endif

#ifdef PACKED
#define STRIDE(stride) K
#else
#define STRIDE(stride) (stride)
#endif

#if K == 3  // the values of one pixel as one vector
typedef real4 lanes;  // the fourth lane is never stored; every ltcl buffer ends in 16 spare bytes for it
#define LOAD(x) LOAD4(x)
#define STORE(v, x) (STORE2((v).lo, x), (x)[2] = (v).s2)
#else
typedef OF(real, K) lanes;
#define LOAD(x) OF(LOAD, K)(x)
#define STORE(v, x) OF(STORE, K)(v, x)
#endif

typedef union {
    lanes vector;
    real item[sizeof(lanes) / sizeof(real)];
} sums;  // of a row, one for each right-hand side

typedef struct {
    int at, skip;  // right-hand sides at .. at + K - 1, of which the first `skip` are those of the piece before
} piece;

// Piece p of at least K right-hand sides.
static inline piece piece_of(int p, int k)
{
    const int at = min(K * p, k - K);
    return (piece){at, K * p - at};
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
