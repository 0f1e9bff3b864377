// SPDX-License-Identifier: BSD-3-Clause
// Sum and largest over a work-group as binary trees in local memory: the same order every time, any group size.

#ifndef LTCL_REDUCE_H
#define LTCL_REDUCE_H

#include "common/real.h"

// All items of the group must call it. The result is valid in every item. `scratch` holds one real an item.
inline real group_sum(real value, local real *scratch)
{
    const int me = get_local_id(0);
    scratch[me] = value;
    for (int width = get_local_size(0); width > 1;) {
        const int half_width = (width + 1) / 2;  // rounds up, so the size need not be a power of two
        barrier(CLK_LOCAL_MEM_FENCE);
        if (me + half_width < width)
            scratch[me] += scratch[me + half_width];
        width = half_width;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const real total = scratch[0];
    barrier(CLK_LOCAL_MEM_FENCE);  // so that the caller may use scratch again
    return total;
}

// The largest value, in the same way.
inline real group_max(real value, local real *scratch)
{
    const int me = get_local_id(0);
    scratch[me] = value;
    for (int width = get_local_size(0); width > 1;) {
        const int half_width = (width + 1) / 2;
        barrier(CLK_LOCAL_MEM_FENCE);
        if (me + half_width < width)
            scratch[me] = fmax(scratch[me], scratch[me + half_width]);
        width = half_width;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const real largest = scratch[0];
    barrier(CLK_LOCAL_MEM_FENCE);
    return largest;
}

#endif
