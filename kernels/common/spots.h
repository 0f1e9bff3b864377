// SPDX-License-Identifier: BSD-3-Clause
// Points and directions in space, one for each of the LANES patches that a work-item handles together.

#ifndef LTCL_SPOTS_H
#define LTCL_SPOTS_H

#include "common/stretch.h"

typedef struct {
    stretch x, y, z;
} spots;

INLINE stretch dot3(spots a, spots b)
{
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

// Space vector number `what` of patches item .. item + LANES - 1; each of its parts is a row of `pitch` reals.
INLINE spots load_spots(global const real *geometry, int pitch, int what, int item)
{
    geometry += 3 * what * pitch + item;
    spots s = {LOAD_STRETCH(geometry), LOAD_STRETCH(geometry + pitch), LOAD_STRETCH(geometry + 2 * pitch)};
    return s;
}

// The same of one patch, in every lane.
INLINE spots spread_spots(global const real *geometry, int pitch, int what, int item)
{
    geometry += 3 * what * pitch + item;
    spots s = {(stretch)(geometry[0]), (stretch)(geometry[pitch]), (stretch)(geometry[2 * pitch])};
    return s;
}

#endif
