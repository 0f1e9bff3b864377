// SPDX-License-Identifier: BSD-3-Clause
// Blocks of random words, one work-item a counter: shows that a device computes the published ones.
//
// No defines. counters and out hold four words a block; all blocks have the key of `seed`, low word first.

#include "common/random.h"

kernel void random_philox(int count, ulong seed, global const uint4 *counters, global uint4 *out)
{
    const int i = get_global_id(0);
    if (i < count)
        out[i] = philox(counters[i], (uint2)((uint)seed, (uint)(seed >> 32)));
}
