// SPDX-License-Identifier: BSD-3-Clause
// Points and directions in space, one for each of the LANES patches that a work-item handles together, and opaque
// boxes along the axes between them. Required defines: LANES, see stretch.h; BLOCKS, the number of boxes.
// Layout: a box is its centre and its half sides, 6 reals; a space vector of patches is three rows of `pitch` reals.

#ifndef LTCL_SPOTS_H
#define LTCL_SPOTS_H

#include "common/stretch.h"

#ifndef BLOCKS
#error "spots.h needs -DBLOCKS=<number of boxes, 0 for none>"
#endif

#define GRAZING 1e-6f  // heights above a plane below this are rounding errors: such points do not see each other

typedef struct {
    stretch x, y, z;
} spots;

INLINE stretch dot3(spots a, spots b)
{
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

INLINE spots between(spots p, spots q)
{
    return (spots){q.x - p.x, q.y - p.y, q.z - p.z};
}

// Space vector number `what` of patches item .. item + LANES - 1, and of one patch in every lane.
INLINE spots load_spots(global const real *geometry, int pitch, int what, int item)
{
    geometry += 3 * what * pitch + item;
    return (spots){LOAD_STRETCH(geometry), LOAD_STRETCH(geometry + pitch), LOAD_STRETCH(geometry + 2 * pitch)};
}

INLINE spots spread_spots(global const real *geometry, int pitch, int what, int item)
{
    geometry += 3 * what * pitch + item;
    return (spots){(stretch)(geometry[0]), (stretch)(geometry[pitch]), (stretch)(geometry[2 * pitch])};
}

// Separating axes of a segment and a box (Ericson, Real-Time Collision Detection, 2005, section 5.3.3): no
// division, no special case, and swapping the two ends changes signs only, so the answer is the same to the bit.
INLINE flags blocked(spots p, spots q, global const real *blocks)
{
    const stretch dx = 0.5f * (q.x - p.x), dy = 0.5f * (q.y - p.y), dz = 0.5f * (q.z - p.z);
    const stretch mx = 0.5f * (q.x + p.x), my = 0.5f * (q.y + p.y), mz = 0.5f * (q.z + p.z);
    const stretch ax = magnitude(dx), ay = magnitude(dy), az = magnitude(dz);
    flags met = 0;
    for (int b = 0; b < BLOCKS; ++b, blocks += 6) {
        const stretch x = mx - blocks[0], y = my - blocks[1], z = mz - blocks[2];
        const real ex = blocks[3], ey = blocks[4], ez = blocks[5];
        met |= (magnitude(x) <= ax + ex) & (magnitude(y) <= ay + ey) & (magnitude(z) <= az + ez)
            & (magnitude(y * dz - z * dy) <= ey * az + ez * ay) & (magnitude(z * dx - x * dz) <= ez * ax + ex * az)
            & (magnitude(x * dy - y * dx) <= ex * ay + ey * ax);
    }
    return met;
}

#endif
