// SPDX-License-Identifier: BSD-3-Clause
// out (columns, rows) = which part of patches from to[row] on, a multiple of LANES, patch from[row] sees past opaque
// boxes: of the rays between their fronts, the share that gets through; 1 where no ray leaves and meets a front. One
// work-item a row and LANES columns.
//
// Ray k runs from point k of one patch to point partner(k) of the other, and partner(partner(k)) = k: both
// directions have the same rays, and the same result to the bit.
//
// Required defines: LANES and BLOCKS, see common/spots.h.
// Layout: starts and ends hold the points of the patches, ends in the order of their partners: for each ray three
// rows of `pitch` reals, a multiple of LANES; normals is three such rows.

#include "common/spots.h"

kernel void visibility_rows(
    int rows, int pitch, int rays, global const int *from, global const int *to, global const real *starts,
    global const real *ends, global const real *normals, global const real *blocks, global real *out)
{
    const int row = get_global_id(0), column = get_global_id(1) * LANES;
    if (row >= rows)
        return;
    const stretch one = 1, none = 0;
    const int i = from[row], j = to[row] + column;
    const spots p_normal = spread_spots(normals, pitch, 0, i), q_normal = load_spots(normals, pitch, 0, j);
    stretch open = 0, faced = 0;
    for (int k = 0; k < rays; ++k) {
        const spots p = spread_spots(starts, pitch, k, i), q = load_spots(ends, pitch, k, j);
        const spots d = between(p, q);
        const flags facing = (dot3(d, p_normal) > GRAZING) & (-dot3(d, q_normal) > GRAZING);
        if (!ANY(facing))
            continue;
        const stretch counted = facing ? one : none;
        faced += counted;
        open += blocked(p, q, blocks) ? none : counted;
    }
    stretch_items share;
    share.vector = faced > 0 ? open / faced : one;
    for (int lane = 0; lane < LANES; ++lane)
        out[(size_t)(column + lane) * rows + row] = share.item[lane];
}
