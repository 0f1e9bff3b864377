// SPDX-License-Identifier: BSD-3-Clause
// Random numbers without a state: Philox4x32-10 of Salmon, Moraes, Dror and Shaw, Parallel Random Numbers: As
// Easy as 1, 2, 3 (SC 2011). A block of four words is a function of its counter and key alone, so that a
// sample has the same numbers whatever work-item draws it, on every device.

#ifndef LTCL_RANDOM_H
#define LTCL_RANDOM_H

// The block of counter (x, y, z, w) in its place.
inline void philox(uint *x, uint *y, uint *z, uint *w, uint key, uint other_key)
{
    for (uint round = 0; round < 10; ++round) {
        const ulong a = (ulong)0xD2511F53u * *x;
        const ulong b = (ulong)0xCD9E8D57u * *z;
        *x = (uint)(b >> 32) ^ *y ^ (key + round * 0x9E3779B9u);
        *z = (uint)(a >> 32) ^ *w ^ (other_key + round * 0xBB67AE85u);
        *y = (uint)b;
        *w = (uint)a;
    }
}

// Four of them side by side, each word in the lower half of a lane.
inline void philox4(ulong4 *x, ulong4 *y, ulong4 *z, ulong4 *w, uint key, uint other_key)
{
    const ulong lower = 0xffffffffu;
    for (uint round = 0; round < 10; ++round) {
        const ulong4 a = 0xD2511F53ul * *x;
        const ulong4 b = 0xCD9E8D57ul * *z;
        *x = (b >> 32) ^ *y ^ (ulong)(key + round * 0x9E3779B9u);
        *z = (a >> 32) ^ *w ^ (ulong)(other_key + round * 0xBB67AE85u);
        *y = b & lower;
        *w = a & lower;
    }
}

#endif
