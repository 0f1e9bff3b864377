// SPDX-License-Identifier: BSD-3-Clause
// The K right-hand sides of one launch: 1, 2, 3, 4 or 8; more are cut into such pieces. They are columns
// offset .. offset + K - 1 of row-major arrays with `stride` columns. Where these are all the columns there
// are, -DPACKED tells the compiler so: addresses get cheaper, a fifth less time at random columns.

#include "common/real.h"

#ifndef K
#error "lanes.h needs -DK=<right-hand sides of one launch: 1, 2, 3, 4 or 8>"
#endif

#ifdef PACKED
#define STRIDE(stride) K
#else
#define STRIDE(stride) (stride)
#endif

// The values of one pixel as one vector.
#if K == 8
typedef real8 lanes;
#define LOAD(x) LOAD8(x)
#define STORE(v, x) STORE8(v, x)
#elif K == 4
typedef real4 lanes;
#define LOAD(x) LOAD4(x)
#define STORE(v, x) STORE4(v, x)
#elif K == 3
typedef real4 lanes;  // the fourth lane is never stored; every ltcl buffer ends in 16 spare bytes for it
#define LOAD(x) LOAD4(x)
#define STORE(v, x) (STORE2((v).lo, x), (x)[2] = (v).s2)
#elif K == 2
typedef float2 lanes;
#define LOAD(x) LOAD2(x)
#define STORE(v, x) STORE2(v, x)
#elif K == 1
typedef real lanes;
#define LOAD(x) (*(x))
#define STORE(v, x) (*(x) = (v))
#else
#error "K must be 1, 2, 3, 4 or 8"
#endif

typedef union {
    lanes vector;
    real item[sizeof(lanes) / sizeof(real)];
} sums;  // of a row, one for each right-hand side
