// SPDX-License-Identifier: BSD-3-Clause
// Random numbers without a state: Philox4x32-10 of Salmon, Moraes, Dror and Shaw, Parallel Random Numbers: As
// Easy as 1, 2, 3 (SC 2011). A block of four words is a function of its counter and key alone, so that a
// sample has the same numbers whatever work-item draws it, on every device.

#ifndef LTCL_RANDOM_H
#define LTCL_RANDOM_H

// The block of counter (x, y, z, w) in its place. In scalars, so that a loop over blocks becomes vectors.
inline void philox(uint *x, uint *y, uint *z, uint *w, uint key, uint other_key)
{
#ifdef __clang__
#pragma clang loop unroll(full)
#endif
    for (uint round = 0; round < 10; ++round) {
        const ulong a = (ulong)0xD2511F53u * *x;
        const ulong b = (ulong)0xCD9E8D57u * *z;
        *x = (uint)(b >> 32) ^ *y ^ (key + round * 0x9E3779B9u);
        *z = (uint)(a >> 32) ^ *w ^ (other_key + round * 0xBB67AE85u);
        *y = (uint)b;
        *w = (uint)a;
    }
}

#endif
