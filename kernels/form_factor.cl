// SPDX-License-Identifier: BSD-3-Clause
// Product of a matrix of form factors that is never stored: every entry is computed where it is used.
//
//     A = diag(left) G diag(right),    G_ij = mean of  cos(t_i) cos(t_j) / (pi r^2)
//
// over pairs of points on the patches i and j. G is symmetric: with left = albedo and right = area this is
// one bounce, and with the two swapped its transpose.
//
//   form_factor_weigh   z = diag(right) x, each right-hand side as a row of its own; one work-item a patch
//   form_factor_matvec  out = a (A x) + b y + c x, as in common/product.h; one work-item a row
//   form_factor_pairs   G_ij of listed pairs; one work-item a pair. The host corrects near pairs with it
//
// A pair is taken at its two centres where they are OUTER sizes of it or more apart; nearer, the curvature of
// cos cos / r^2 between them is added; within INNER sizes, or where the plane of one patch cuts the other, it
// is taken at eight pairs of points: exact for polynomials of degree 3 in the four coordinates on the two
// patches. Pairs of points whose way is blocked by a box add nothing.
//
// Required defines: K, see common/lanes.h; LANES and BLOCKS, see common/spots.h. Optional: PACKED.
// Layout: geometry is 13 rows of `pitch` reals, a multiple of LANES, one column a patch: centre, right edge,
// down edge, normal (three rows each) and squared size, (right^2 + down^2) / 4; that of a pair is the sum.
// Lengths are parts of the scene's size. Columns beyond the last patch hold patches without a normal. z has a
// row of `pitch` reals for each right-hand side.

#include "common/product.h"
#include "common/spots.h"

enum { CENTRE, RIGHT, DOWN, NORMAL, SIZE };

#define OUTER 64.0f
#define INNER 12.0f
#define PI 3.14159265f  // M_PI_F may be a double
// Radius of the circle that carries the eight points, in edges: sqrt(2/3) / 2. Stroud, Approximate
// Calculation of Multiple Integrals, 1971, C_n 3-1 for n = 4.
#define RADIUS 0.40824829f
#define DIAGONAL 0.28867513f  // RADIUS / sqrt(2)

// A point of a patch: its centre moved by a part of each edge.
INLINE spots moved(spots centre, real a, spots right, real b, spots down)
{
    spots s = {
        centre.x + a * right.x + b * down.x, centre.y + a * right.y + b * down.y,
        centre.z + a * right.z + b * down.z};
    return s;
}

INLINE stretch unless_blocked(stretch value, spots p, spots q, global const real *blocks)
{
    if (BLOCKS && ANY(value > 0))
        return blocked(p, q, blocks) ? (stretch)(0) : value;
    return value;
}

// cos cos / (pi r^2) of points p and q; 0 where one is behind the other's plane, or the way is blocked.
INLINE stretch exchange(spots p, spots p_normal, spots q, spots q_normal, global const real *blocks)
{
    const spots d = between(p, q);
    const stretch here = dot3(d, p_normal), there = -dot3(d, q_normal), r2 = dot3(d, d);
    // What is added to the denominator serves a patch and itself: 0 / 0 otherwise.
    const stretch value = here * there / (PI * r2 * r2 + 1e-30f);
    const flags facing = (here > GRAZING) & (there > GRAZING);
    return unless_blocked(facing ? value : (stretch)(0), p, q, blocks);
}

// Patch i (in all lanes) and patches j .. j + LANES - 1; `sizes` is the square of the size of the pair.
typedef struct {
    spots p, p_normal, p_right, p_down, q, q_normal, q_right, q_down;
    stretch sizes;
} couple;

// The mean over the eight pairs of points. Point k of the rule is at angle k pi / 4 on an ellipse in each
// patch; it meets point 3 k of the other.
INLINE stretch at_eight_points(couple c, global const real *blocks)
{
#define MEET(a, b, u, v) \
    exchange( \
        moved(c.p, a, c.p_right, b, c.p_down), c.p_normal, moved(c.q, u, c.q_right, v, c.q_down), c.q_normal, blocks)
    const real u = RADIUS, v = DIAGONAL;
    const stretch straight = MEET(u, 0, u, 0) + MEET(0, u, 0, -u) + MEET(-u, 0, -u, 0) + MEET(0, -u, 0, u);
    const stretch skew = MEET(v, v, -v, v) + MEET(-v, v, v, v) + MEET(-v, -v, v, -v) + MEET(v, -v, -v, -v);
#undef MEET
    return (straight + skew) * 0.125f;
}

// The value at the centres and, for the spread of the points around them, the second derivative along each
// edge, / 24. With h = cos(t_i) r, g = cos(t_j) r and s = d . e, that of h g / r^4 along an edge e is
// (2 h' g' - 8 (h' g + h g') s / r^2 + h g (24 s^2 / r^2 - 4 e^2) / r^2) / r^4; h' is 0 along edges of i, g' of j.
INLINE stretch curved(couple c, spots d, stretch r2, global const real *blocks)
{
    const stretch h = dot3(d, c.p_normal), g = -dot3(d, c.q_normal), inverse = 1 / r2;
    const stretch a = dot3(d, c.p_right), b = dot3(d, c.p_down), u = dot3(d, c.q_right), v = dot3(d, c.q_down);
    const stretch g_turn = dot3(c.q_normal, c.p_right) * a + dot3(c.q_normal, c.p_down) * b;
    const stretch h_turn = dot3(c.p_normal, c.q_right) * u + dot3(c.p_normal, c.q_down) * v;
    const stretch squares = a * a + b * b + u * u + v * v;
    const stretch turned = 8 * (h * g_turn - g * h_turn);
    const stretch bent = h * g * (24 * squares * inverse - 16 * c.sizes);
    const stretch value = (h * g + (turned + bent) * inverse * (1.0f / 24)) * inverse * inverse * (1 / PI);
    return unless_blocked(value, c.p, c.q, blocks);
}

// G of a couple that is not far apart.
INLINE stretch nearby(couple c, spots d, stretch r2, global const real *blocks)
{
    // How far the patches rise above each other's planes, at most and at least.
    const stretch q_rise = 0.5f * (magnitude(dot3(c.p_normal, c.q_right)) + magnitude(dot3(c.p_normal, c.q_down)));
    const stretch p_rise = 0.5f * (magnitude(dot3(c.q_normal, c.p_right)) + magnitude(dot3(c.q_normal, c.p_down)));
    const stretch h = dot3(d, c.p_normal), g = -dot3(d, c.q_normal);
    const flags facing = (h + q_rise > GRAZING) & (g + p_rise > GRAZING);
    if (!ANY(facing))  // patches of one wall, which are the most
        return 0;
    const flags hard = facing & ((r2 < INNER * INNER * c.sizes) | (h - q_rise < -GRAZING) | (g - p_rise < -GRAZING));
    stretch value = facing ? curved(c, d, r2, blocks) : (stretch)(0);
    if (ANY(hard))
        value = hard ? at_eight_points(c, blocks) : value;
    return value;
}

// Patch i, in all lanes: what entries() needs of it for all its pairs.
typedef struct {
    int number;
    spots centre, normal;
    stretch size;
} patch;

INLINE patch patch_of(int i, global const real *geometry, int pitch)
{
    const patch p = {
        i, spread_spots(geometry, pitch, CENTRE, i), spread_spots(geometry, pitch, NORMAL, i),
        (stretch)(geometry[3 * SIZE * pitch + i])};
    return p;
}

// G of patch p and of patches j .. j + LANES - 1.
INLINE stretch entries(patch p, int j, global const real *geometry, int pitch, global const real *blocks)
{
    const spots q = load_spots(geometry, pitch, CENTRE, j), q_normal = load_spots(geometry, pitch, NORMAL, j);
    const spots d = between(p.centre, q);
    const stretch r2 = dot3(d, d), sizes = p.size + LOAD_STRETCH(geometry + 3 * SIZE * pitch + j);
    const flags close = r2 < OUTER * OUTER * sizes;
    const stretch far = exchange(p.centre, p.normal, q, q_normal, blocks);
    if (!ANY(close))
        return far;
    const couple c = {
        p.centre, p.normal, spread_spots(geometry, pitch, RIGHT, p.number), spread_spots(geometry, pitch, DOWN, p.number),
        q, q_normal, load_spots(geometry, pitch, RIGHT, j), load_spots(geometry, pitch, DOWN, j), sizes};
    return close ? nearby(c, d, r2, blocks) : far;
}

kernel void form_factor_weigh(
    int count, int pitch, int stride, int offset, global const real *right, global const real *x, global real *z)
{
    stride = STRIDE(stride);
    const int j = get_global_id(0);
    if (j < pitch)
        for (int c = 0; c < K; ++c)
            z[c * pitch + j] = j < count ? right[j] * x[j * stride + offset + c] : 0;
}

kernel void form_factor_matvec(
    PRODUCT_ARGUMENTS, int pitch, global const real *geometry, global const real *blocks, global const real *left,
    global const real *z)
{
    ITEM_ROW;
    if (!inside)
        return;
    const patch p = patch_of(first + row, geometry, pitch);
    stretch part[K];
    for (int k = 0; k < K; ++k)
        part[k] = 0;
    for (int j = 0; j < pitch; j += LANES) {
        const stretch g = entries(p, j, geometry, pitch, blocks);
        for (int k = 0; k < K; ++k)
            part[k] = g * LOAD_STRETCH(z + k * pitch + j) + part[k];
    }
    for (int k = 0; k < K; ++k)
        sum.item[k] = left[first + row] * TOTAL(part[k]);
    FINISH_ITEMS(sum);
}

kernel void form_factor_pairs(
    int count, int pitch, global const int *from, global const int *to, global const real *geometry,
    global const real *blocks, global real *out)
{
    const int n = get_global_id(0);
    if (n >= count)
        return;
    // The stretch that the product computes, by the same code, and its lane.
    const int start = to[n] / LANES * LANES;
    stretch_items g;
    g.vector = entries(patch_of(from[n], geometry, pitch), start, geometry, pitch, blocks);
    out[n] = g.item[to[n] - start];
}
