// SPDX-License-Identifier: BSD-3-Clause
// Which part of a patch another one sees past opaque boxes: of the rays between their fronts, the share that
// gets through; 1 where no ray leaves and meets a front, and so nothing is hidden.
//
//   visibility_rows   patches first .. first + rows - 1 against all; one work-item LANES neighbours in a row
//   visibility_pairs  listed pairs; one work-item a pair
//
// Ray k runs from point k of one patch to point partner(k) of the other, and partner(partner(k)) = k: both
// directions have the same rays, and the same result to the bit.
//
// Required defines: LANES and BLOCKS, see common/spots.h.
// Layout: starts and ends hold the points of the patches, ends in the order of their partners: for each ray
// three rows (x, y, z) of `pitch` reals, a multiple of LANES, one column a patch; normals is three such rows.
// Lengths are parts of the scene's size.

#include "common/spots.h"

// The share of the rays of patch i to patches j .. j + LANES - 1.
INLINE stretch seen(
    int rays, int pitch, int i, int j, global const real *starts, global const real *ends,
    global const real *normals, global const real *blocks)
{
    const stretch one = 1, none = 0;
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
    return faced > 0 ? open / faced : one;
}

kernel void visibility_rows(
    int rows, int first, int count, int pitch, int rays, global const real *starts, global const real *ends,
    global const real *normals, global const real *blocks, global real *out)
{
    const int j = get_global_id(0) * LANES;
    const int row = get_global_id(1);
    if (j >= count || row >= rows)
        return;
    stretch_items open;
    open.vector = seen(rays, pitch, first + row, j, starts, ends, normals, blocks);
    for (int lane = 0; lane < min(LANES, count - j); ++lane)
        out[(size_t)row * count + j + lane] = open.item[lane];
}

kernel void visibility_pairs(
    int count, int pitch, int rays, global const int *from, global const int *to, global const real *starts,
    global const real *ends, global const real *normals, global const real *blocks, global real *out)
{
    const int n = get_global_id(0);
    if (n >= count)
        return;
    const int start = to[n] / LANES * LANES;
    stretch_items open;
    open.vector = seen(rays, pitch, from[n], start, starts, ends, normals, blocks);
    out[n] = open.item[to[n] - start];
}
