// SPDX-License-Identifier: BSD-3-Clause
// Chains of random loads, the yardstick of bench/walk.py: an item follows CHAINS of them side by side, `steps`
// loads each, every place a function of what was loaded before it. `size` words, at most 2^32.
#ifndef CHAINS
#define CHAINS 8
#endif
kernel void random_loads(int items, int steps, uint size, global const ulong *words, global ulong *out)
{
    const int item = get_global_id(0);
    if (item >= items)
        return;
    ulong state[CHAINS], sum = 0;
    for (int c = 0; c < CHAINS; ++c)
        state[c] = (ulong)(item * CHAINS + c + 1) * 0x9E3779B97F4A7C15ul;
    for (int step = 0; step < steps; ++step)
        for (int c = 0; c < CHAINS; ++c) {
            state[c] = state[c] * 6364136223846793005ul + 1442695040888963407ul;
            state[c] ^= words[mul_hi((uint)(state[c] >> 32), size)];
        }
    for (int c = 0; c < CHAINS; ++c)
        sum += state[c];
    out[item] = sum;
}
