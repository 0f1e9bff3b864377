// SPDX-License-Identifier: BSD-3-Clause
// The K right-hand sides of one pixel as one vector. K is 2, 3, 4 or 8; more are cut into such pieces.

#ifndef LTCL_LANES_H
#define LTCL_LANES_H

#include "common/real.h"

#ifndef K
#error "lanes.h needs -DK=<right-hand sides of one launch: 1, 2, 3, 4 or 8>"
#endif

#if K == 8
typedef real8 lanes;
#define LOAD(x) vload8(0, x)
#elif K == 4
typedef real4 lanes;
#define LOAD(x) vload4(0, x)
#elif K == 3
typedef real4 lanes;  // the fourth lane stays 0; reading a fourth value could leave the buffer
#define LOAD(x) ((real4)((x)[0], (x)[1], (x)[2], 0))
#elif K == 2
typedef float2 lanes;
#define LOAD(x) vload2(0, x)
#elif K != 1
#error "K must be 1, 2, 3, 4 or 8"
#endif

#if K > 1
typedef union {
    lanes vector;
    real item[sizeof(lanes) / sizeof(real)];
} lanes_items;
#endif

#endif
