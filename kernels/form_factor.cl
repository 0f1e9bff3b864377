// SPDX-License-Identifier: BSD-3-Clause
// Product of a matrix of form factors that is never stored: every entry is computed where it is used.
//
//     A = diag(left) G diag(right),    G_ij = mean of  cos(t_i) cos(t_j) / (pi r^2)  over pairs of points on i and j
//
// With left = albedo and right = area this is one bounce, and with the two swapped its transpose.
//
//   form_factor_weigh   z = diag(right) x, each right-hand side as a row of `pitch` reals; one work-item a patch
//   form_factor_matvec  out = a (A x) + b y + c x, as in common/product.h; one work-item a row
//   form_factor_pairs   G_ij of listed pairs; one work-item a pair
//
// A pair at least OUTER sizes apart is taken at its centres; nearer, the curvature of cos cos / r^2 is added; within
// INNER sizes, or where the plane of one patch cuts the other, it is taken at eight pairs of points, which is exact
// for polynomials of degree 3. Pairs of points with a box between them add nothing.
//
// Required defines: K, see common/lanes.h; LANES and BLOCKS, see common/spots.h. Optional: PACKED.
// Layout: geometry is 13 rows of `pitch` reals, a multiple of LANES, one column a patch, the last without a normal:
// centre, right edge, down edge, normal (three rows each), and squared size, (right^2 + down^2) / 4, of which a pair
// has the sum. Lengths are parts of the scene's size.

#include "common/product.h"
#include "common/spots.h"

enum { CENTRE, RIGHT, DOWN, NORMAL, SIZE };

#define OUTER 64.0f
#define INNER 12.0f
#define PI 3.14159265f  // M_PI_F may be a double
// Radius of the circle that carries the eight points, in edges, and that / sqrt(2). Stroud, Approximate Calculation
// of Multiple Integrals, 1971, C_n 3-1 for n = 4.
#define RADIUS 0.40824829f
#define DIAGONAL 0.28867513f

// Patches j .. j + LANES - 1, or one patch in all lanes.
typedef struct {
    spots centre, normal, right, down;
} patch;

// The centre moved by a part of each edge.
INLINE spots moved(patch p, real a, real b)
{
    return (spots){
        p.centre.x + a * p.right.x + b * p.down.x, p.centre.y + a * p.right.y + b * p.down.y,
        p.centre.z + a * p.right.z + b * p.down.z};
}

INLINE stretch unless_blocked(stretch value, spots p, spots q, global const real *blocks)
{
    return ANY(value > 0) && BLOCKS ? (blocked(p, q, blocks) ? (stretch)(0) : value) : value;
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

// The mean over the eight pairs of points. Point k of the rule is at angle k pi / 4 on an ellipse in each
// patch; it meets point 3 k of the other.
INLINE stretch at_eight_points(patch p, patch q, global const real *blocks)
{
#define MEET(a, b, u, v) exchange(moved(p, a, b), p.normal, moved(q, u, v), q.normal, blocks)
    const real u = RADIUS, v = DIAGONAL;
    const stretch straight = MEET(u, 0, u, 0) + MEET(0, u, 0, -u) + MEET(-u, 0, -u, 0) + MEET(0, -u, 0, u);
    const stretch skew = MEET(v, v, -v, v) + MEET(-v, v, v, v) + MEET(-v, -v, v, -v) + MEET(v, -v, -v, -v);
    return (straight + skew) * 0.125f;
}

// G of patches that are not far apart; d from p to q, `sizes` the squared size of the pair.
INLINE stretch nearby(patch p, patch q, stretch sizes, spots d, stretch r2, global const real *blocks)
{
    const stretch h = dot3(d, p.normal), g = -dot3(d, q.normal), inverse = 1 / r2;
    const stretch q_right = dot3(p.normal, q.right), q_down = dot3(p.normal, q.down);
    const stretch p_right = dot3(q.normal, p.right), p_down = dot3(q.normal, p.down);
    // How far the patches rise above each other's planes, at most and at least.
    const stretch q_rise = 0.5f * (magnitude(q_right) + magnitude(q_down));
    const stretch p_rise = 0.5f * (magnitude(p_right) + magnitude(p_down));
    const flags facing = (h + q_rise > GRAZING) & (g + p_rise > GRAZING);
    if (!ANY(facing))  // patches of one wall, which are the most
        return 0;
    // The value at the centres and the second derivative along each edge e, / 24: of h g / r^4, with s = d . e, it is
    // (2 h' g' - 8 (h' g + h g') s / r^2 + h g (24 s^2 / r^2 - 4 e^2) / r^2) / r^4; h' is 0 along edges of i, g' of j.
    const stretch a = dot3(d, p.right), b = dot3(d, p.down), u = dot3(d, q.right), v = dot3(d, q.down);
    const stretch turned = 8 * (h * (p_right * a + p_down * b) - g * (q_right * u + q_down * v));
    const stretch bent = h * g * (24 * (a * a + b * b + u * u + v * v) * inverse - 16 * sizes);
    const stretch curved = (h * g + (turned + bent) * inverse * (1.0f / 24)) * inverse * inverse * (1 / PI);
    stretch value = facing ? unless_blocked(curved, p.centre, q.centre, blocks) : (stretch)(0);
    const flags hard = facing & ((r2 < INNER * INNER * sizes) | (h - q_rise < -GRAZING) | (g - p_rise < -GRAZING));
    if (ANY(hard))
        value = hard ? at_eight_points(p, q, blocks) : value;
    return value;
}

// G of patch i and of patches j .. j + LANES - 1.
INLINE stretch entries(int i, int j, global const real *geometry, int pitch, global const real *blocks)
{
    patch p = {spread_spots(geometry, pitch, CENTRE, i), spread_spots(geometry, pitch, NORMAL, i)};
    patch q = {load_spots(geometry, pitch, CENTRE, j), load_spots(geometry, pitch, NORMAL, j)};
    const spots d = between(p.centre, q.centre);
    global const real *squares = geometry + 3 * SIZE * pitch;
    const stretch r2 = dot3(d, d), sizes = squares[i] + LOAD_STRETCH(squares + j);
    const flags close = r2 < OUTER * OUTER * sizes;
    const stretch far = exchange(p.centre, p.normal, q.centre, q.normal, blocks);
    if (!ANY(close))
        return far;
    p.right = spread_spots(geometry, pitch, RIGHT, i);
    p.down = spread_spots(geometry, pitch, DOWN, i);
    q.right = load_spots(geometry, pitch, RIGHT, j);
    q.down = load_spots(geometry, pitch, DOWN, j);
    return close ? nearby(p, q, sizes, d, r2, blocks) : far;
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
    stretch part[K];
    for (int k = 0; k < K; ++k)
        part[k] = 0;
    for (int j = 0; j < pitch; j += LANES) {
        const stretch g = entries(first + row, j, geometry, pitch, blocks);
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
    g.vector = entries(from[n], start, geometry, pitch, blocks);
    out[n] = g.item[to[n] - start];
}
