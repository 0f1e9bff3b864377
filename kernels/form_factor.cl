// SPDX-License-Identifier: BSD-3-Clause
// Product of a matrix of form factors that is never stored: every entry is computed where it is used.
//
//     out = scale * diag(left) G diag(right) x + add,    G_ij = mean of  cos(t_i) cos(t_j) / (pi r^2)
//
// over pairs of points on the patches i and j. G is symmetric: with left = albedo and right = area this is
// one bounce A, and with the two swapped its transpose. cos(t) r is a dot product with a normal, so there is
// no square root.
//
//   form_factor_weigh   z = diag(right) x, each right-hand side as a row of its own; one work-item a patch
//   form_factor_matvec  the product; one work-item a row, LANES patches j at a time
//   form_factor_pairs   G_ij of listed pairs; one work-item a pair. The host corrects near pairs with it
//
// A pair is taken at its two centres where they are far apart for the size of the patches, else at eight
// pairs of points: exact for polynomials of degree 3 in the four coordinates on the two patches. Pairs of
// points whose way is blocked by a box add nothing.
//
// Required defines: K, the right-hand sides of one launch: 1, 2, 3, 4 or 8; LANES: 1 or 8; BLOCKS, see
// common/blocks.h. Optional: PACKED, see common/lanes.h.
// Layout: geometry is 13 rows of `pitch` reals, a multiple of LANES, one column a patch: centre, right edge,
// down edge, normal (three rows each) and reach; centres are closer than the sum of two reaches, squared,
// where eight points are taken. Lengths are parts of the scene's size. Columns beyond the last patch hold
// patches without a normal. z has a row of `pitch` reals for each right-hand side.

#include "common/blocks.h"
#include "common/lanes.h"
#include "common/spots.h"

enum { CENTRE, RIGHT, DOWN, NORMAL, REACH };

#define PI 3.14159265f  // M_PI_F may be a double
// Radius of the circle that carries the eight points, in edges: sqrt(2/3) / 2. Stroud, Approximate
// Calculation of Multiple Integrals, 1971, C_n 3-1 for n = 4.
#define RADIUS 0.40824829f
#define DIAGONAL 0.28867513f  // RADIUS / sqrt(2)
// Heights above a plane below this are rounding errors: such points do not see each other.
#define GRAZING 1e-6f

// A point of a patch: its centre moved by a part of each edge.
INLINE spots moved(spots centre, real a, spots right, real b, spots down)
{
    spots s = {
        centre.x + a * right.x + b * down.x, centre.y + a * right.y + b * down.y,
        centre.z + a * right.z + b * down.z};
    return s;
}

INLINE spots between(spots p, spots q)
{
    spots s = {q.x - p.x, q.y - p.y, q.z - p.z};
    return s;
}

// cos cos / (pi r^2) of points p and q; 0 where one is behind the other's plane, or the way is blocked.
INLINE stretch exchange(spots p, spots p_normal, spots q, spots q_normal, global const real *blocks)
{
    const spots d = between(p, q);
    const stretch here = dot3(d, p_normal), there = -dot3(d, q_normal), r2 = dot3(d, d);
    // What is added to the denominator serves a patch and itself: 0 / 0 otherwise.
    const stretch value = here * there / (PI * r2 * r2 + 1e-30f);
    const flags facing = (here > GRAZING) & (there > GRAZING);
    const stretch open = facing ? value : (stretch)(0);
#if BLOCKS
    if (ANY(facing))
        return ltcl_blocked(p, q, blocks) ? (stretch)(0) : open;
#endif
    return open;
}

// Point k of the rule is at angle k pi / 4 on an ellipse in each patch; it meets point 3 k of the other.
INLINE stretch at_eight_points(
    spots p, spots p_normal, spots q, spots q_normal, global const real *geometry, int pitch, int i, int j,
    global const real *blocks)
{
    const spots p_right = spread_spots(geometry, pitch, RIGHT, i), q_right = load_spots(geometry, pitch, RIGHT, j);
    const spots p_down = spread_spots(geometry, pitch, DOWN, i), q_down = load_spots(geometry, pitch, DOWN, j);
    // Patches of one wall are the most: they leave before any point is made.
    const stretch q_rise = magnitude(dot3(p_normal, q_right)) + magnitude(dot3(p_normal, q_down));
    const stretch p_rise = magnitude(dot3(q_normal, p_right)) + magnitude(dot3(q_normal, p_down));
    const stretch here = dot3(between(p, q), p_normal), there = dot3(between(q, p), q_normal);
    if (!ANY((here + 0.5f * q_rise > GRAZING) & (there + 0.5f * p_rise > GRAZING)))
        return 0;
#define MEET(a, b, c, d) \
    exchange(moved(p, a, p_right, b, p_down), p_normal, moved(q, c, q_right, d, q_down), q_normal, blocks)
    const real u = RADIUS, v = DIAGONAL;
    const stretch straight = MEET(u, 0, u, 0) + MEET(0, u, 0, -u) + MEET(-u, 0, -u, 0) + MEET(0, -u, 0, u);
    const stretch skew = MEET(v, v, -v, v) + MEET(-v, v, v, v) + MEET(-v, -v, v, -v) + MEET(v, -v, -v, -v);
#undef MEET
    return (straight + skew) * 0.125f;
}

// G of patch i, given in all lanes, and of patches j .. j + LANES - 1.
INLINE stretch entries(
    int i, spots p, spots p_normal, stretch p_reach, int j, global const real *geometry, int pitch,
    global const real *blocks)
{
    const spots q = load_spots(geometry, pitch, CENTRE, j), q_normal = load_spots(geometry, pitch, NORMAL, j);
    const spots d = between(p, q);
    const flags close = dot3(d, d) < p_reach + LOAD_STRETCH(geometry + 3 * REACH * pitch + j);
    const stretch far = exchange(p, p_normal, q, q_normal, blocks);
    if (!ANY(close))
        return far;
    return close ? at_eight_points(p, p_normal, q, q_normal, geometry, pitch, i, j, blocks) : far;
}

kernel void form_factor_weigh(
    int count, int pitch, int stride, int offset, global const real *right, global const real *x,
    global real *z)
{
    stride = STRIDE(stride);
    const int j = get_global_id(0);
    if (j < pitch)
        for (int c = 0; c < K; ++c)
            z[c * pitch + j] = j < count ? right[j] * x[j * stride + offset + c] : 0;
}

kernel void form_factor_matvec(
    int rows, int first, int pitch, int stride, int offset, real scale, int adds, global const real *geometry,
    global const real *blocks, global const real *left, global const real *z, global const real *add,
    global real *out)
{
    stride = STRIDE(stride);
    const int row = get_global_id(0);
    if (row >= rows)
        return;
    const int i = first + row;
    const spots p = spread_spots(geometry, pitch, CENTRE, i), normal = spread_spots(geometry, pitch, NORMAL, i);
    const stretch reach = (stretch)(geometry[3 * REACH * pitch + i]);
    stretch sum[K];
    for (int c = 0; c < K; ++c)
        sum[c] = 0;
    for (int j = 0; j < pitch; j += LANES) {
        const stretch g = entries(i, p, normal, reach, j, geometry, pitch, blocks);
        for (int c = 0; c < K; ++c)
            sum[c] = g * LOAD_STRETCH(z + c * pitch + j) + sum[c];
    }
    for (int c = 0; c < K; ++c)
        LTCL_STORE(out, i * stride + offset + c, left[i] * TOTAL(sum[c]), scale, adds, add);
}

kernel void form_factor_pairs(
    int count, int pitch, global const int *from, global const int *to, global const real *geometry,
    global const real *blocks, global real *out)
{
    const int n = get_global_id(0);
    if (n >= count)
        return;
    // The stretch that the product computes, by the same code, and its lane.
    const int i = from[n], start = to[n] / LANES * LANES;
    const spots p = spread_spots(geometry, pitch, CENTRE, i), normal = spread_spots(geometry, pitch, NORMAL, i);
    const stretch reach = (stretch)(geometry[3 * REACH * pitch + i]);
    stretch_items g;
    g.vector = entries(i, p, normal, reach, start, geometry, pitch, blocks);
    out[n] = g.item[to[n] - start];
}
