// SPDX-License-Identifier: BSD-3-Clause
// Does the straight way between two points pass through a box? Boxes are opaque and stand along the axes.
//
// Separating axes of a segment and a box (Ericson, Real-Time Collision Detection, 2005, section 5.3.3): no
// division, no special case, and swapping the two ends changes signs only, so that the answer is the same
// to the bit. Layout: each box is its centre and its half sides, 6 reals.

#ifndef LTCL_BLOCKS_H
#define LTCL_BLOCKS_H

#include "common/spots.h"

#ifndef BLOCKS
#error "blocks.h needs -DBLOCKS=<number of boxes, 0 for none>"
#endif

INLINE flags ltcl_blocked(spots p, spots q, global const real *blocks)
{
    const stretch dx = 0.5f * (q.x - p.x), dy = 0.5f * (q.y - p.y), dz = 0.5f * (q.z - p.z);
    const stretch mx = 0.5f * (q.x + p.x), my = 0.5f * (q.y + p.y), mz = 0.5f * (q.z + p.z);
    const stretch ax = magnitude(dx), ay = magnitude(dy), az = magnitude(dz);
    flags blocked = 0;
    for (int b = 0; b < BLOCKS; ++b) {
        global const real *box = blocks + 6 * b;
        const stretch x = mx - box[0], y = my - box[1], z = mz - box[2];
        const real ex = box[3], ey = box[4], ez = box[5];
        blocked |= (magnitude(x) <= ax + ex) & (magnitude(y) <= ay + ey) & (magnitude(z) <= az + ez)
            & (magnitude(y * dz - z * dy) <= ey * az + ez * ay) & (magnitude(z * dx - x * dz) <= ez * ax + ex * az)
            & (magnitude(x * dy - y * dx) <= ex * ay + ey * ax);
    }
    return blocked;
}

#endif
