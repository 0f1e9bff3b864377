// SPDX-License-Identifier: BSD-3-Clause
// Soft threshold: what is nearer to zero than t becomes zero, all else comes nearer by t.
//
// One work-item is one number of x. `common/real.h` is that of ltcl.
#include "common/real.h"

__kernel void soft_threshold(
    const uint count,            // numbers in x
    const real t,                // threshold, at least 0
    __global const real* x,      // (count,)
    __global real* out)          // (count,)
{
    const uint i = get_global_id(0);
    if (i < count) out[i] = copysign(fmax(fabs(x[i]) - t, (real)0), x[i]);
}
