// SPDX-License-Identifier: BSD-3-Clause
// Sum and largest over a work-group as a binary tree in local memory: the same order every time, any group size.
// All items of the group must call it.

#ifndef LTCL_REDUCE_H
#define LTCL_REDUCE_H

#include "common/real.h"

// values[j], j < period, becomes the sum of values[j], values[j + period], ... below count, or the largest of them.
static inline void fold(local real *values, int count, int period, int largest)
{
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int rows = (count + period - 1) / period; rows > 1; rows = (rows + 1) / 2) {
        const int upper = (rows + 1) / 2 * period;  // rounds up, so the rows need not be a power of two
        for (int j = get_local_id(0); j + upper < count; j += get_local_size(0))
            values[j] = largest ? fmax(values[j], values[j + upper]) : values[j] + values[j + upper];
        count = upper;
        barrier(CLK_LOCAL_MEM_FENCE);
    }
}

#endif
