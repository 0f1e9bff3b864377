// SPDX-License-Identifier: BSD-3-Clause
// Random numbers without a state: Philox4x32-10 of Salmon, Moraes, Dror and Shaw, Parallel Random Numbers: As
// Easy as 1, 2, 3 (SC 2011). A block of four words is a function of its counter and key alone, so that a
// sample has the same numbers whatever work-item draws it, on every device.

#ifndef LTCL_RANDOM_H
#define LTCL_RANDOM_H

inline uint4 philox(uint4 counter, uint2 key)
{
    for (int round = 0; round < 10; ++round) {
        const ulong a = (ulong)0xD2511F53u * counter.x;
        const ulong b = (ulong)0xCD9E8D57u * counter.z;
        counter = (uint4)(
            (uint)(b >> 32) ^ counter.y ^ key.x, (uint)b, (uint)(a >> 32) ^ counter.w ^ key.y, (uint)a);
        key += (uint2)(0x9E3779B9u, 0xBB67AE85u);
    }
    return counter;
}

#endif
