// SPDX-License-Identifier: BSD-3-Clause
// Alias tables for drawing the entries of a row in proportion to |R_ij| (eq. 25): Walker's (1974), by one sweep with a
// pointer to the next light entry, one to the next heavy entry and the mass that the heavy one has left
// (L. Huebschle-Schneider and P. Sanders, Parallel Weighted Random Sampling, ESA 2019).
//
//   alias_rows   one work-item a row; of dense rows `pointers` and `columns` are 0
//
// Arithmetic is in integers: the same to the bit on every device. A row is scaled by the power of two that makes its
// sum C as large as its length n allows; each of n bins has room for C, and entry t has the mass n |R_it|. Rounding
// moves less than 2^-18 of a row's probability, in total variation, in rows of up to 2^20 entries.
// Layout: common/table.h; row `row` of a slab has its record at first + row.

#include "common/table.h"

#define BIT_LENGTH(x) (64 - (int)clz((ulong)(x)))

// |value| 2^(150 + shift) of the bits of a real, rounded to the nearest integer.
static inline ulong scaled(uint value, int shift)
{
    const uint bits = value & 0x7fffffffu, exponent = bits >> 23;
    const ulong significand = exponent ? (bits & 0x7fffffu) | 0x800000u : bits;
    const int left = (int)max(exponent, 1u) + shift;
    if (left >= 0)
        return significand << left;
    return left < -25 ? 0 : ((significand >> (-left - 1)) + 1) >> 1;
}

static inline ulong row_sum(global const uint *values, uint n, int shift)
{
    ulong sum = 0;
    for (uint t = 0; t < n; ++t)
        sum += scaled(values[t], shift);
    return sum;
}

// sum 2^-(150 + shift) as the bits of a real; infinite beyond its range, 0 below 2^-126.
static inline uint real_bits(ulong sum, int shift)
{
    const uint bits = as_uint(convert_float(sum));
    const int exponent = (int)(bits >> 23) - (150 + shift);
    if (exponent >= 255)
        return 0x7f800000u;
    return exponent <= 0 ? 0 : ((uint)exponent << 23) | (bits & 0x7fffffu);
}

#define TARGET(t) ((ulong)(columns ? (uint)columns[t] : t) << 1 | values[t] >> 31)
#define MASS(t) (n * scaled(values[t], shift))
#define NEXT(t, test) \
    do \
        ++t; \
    while (t < n && !(MASS(t) test capacity))

static inline void fill(
    global const uint *values, global const int *columns, uint n, int shift, ulong capacity, global ulong *out)
{
    uint light = ~0u, heavy = ~0u;
    NEXT(light, <=);
    NEXT(heavy, >);
    ulong left = heavy < n ? MASS(heavy) : 0;
    while (light < n || heavy < n) {
        uint own, other;
        ulong mass = capacity;
        if (heavy < n && left > capacity) {  // the light one's bin is filled up by the heavy one
            own = light, other = heavy;
            mass = MASS(light);
            left -= capacity - mass;
            NEXT(light, <=);
        } else if (heavy < n) {  // what the heavy one has left is its own bin, filled up by the next
            own = other = heavy;
            mass = left;
            NEXT(heavy, >);
            if (heavy < n) {
                left += MASS(heavy) - capacity;
                other = heavy;
            }
        } else {  // no mass is lost on the way: these are full
            own = other = light;
            NEXT(light, <=);
        }
        ulong threshold = ((mass << THRESHOLD_BITS) + capacity / 2) / capacity;
        if (threshold >> THRESHOLD_BITS) {
            other = own;
            threshold = 0;
        }
        out[own] = threshold << (2 * TARGET_BITS) | TARGET(own) << TARGET_BITS | TARGET(other);
    }
}

kernel void alias_rows(
    int rows, int first, ulong base, int width, global const int *pointers, global const int *columns,
    global const uint *values, global uint4 *records, global ulong *entries)
{
    const int row = get_global_id(0);
    if (row >= rows)
        return;
    const ulong begin = pointers ? (ulong)pointers[row] : (ulong)row * width, start = base + begin;
    const uint n = pointers ? pointers[row + 1] - pointers[row] : width;
    values += begin;
    columns = columns ? columns + begin : 0;
    uint largest = 0, sum = 0;
    for (uint t = 0; t < n; ++t)
        largest = max(largest, values[t] & 0x7fffffffu);
    if (largest) {  // the sum gets as many bits as fit: n C must be below 2^63, C 2^18 as well
        const int rough = 7 - (int)max(largest >> 23, 1u);  // the largest entry becomes a number of 31 bits
        const int spare = min(45, 63 - BIT_LENGTH(n)) - 1 - BIT_LENGTH(row_sum(values, n, rough) + n);
        const ulong capacity = row_sum(values, n, rough + spare);
        fill(values, columns, n, rough + spare, capacity, entries + start);
        sum = real_bits(capacity, rough + spare);
    }
    records[first + row] = (uint4)((uint)start, (uint)(start >> 32), sum ? n : 0, sum);
}
