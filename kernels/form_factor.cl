// SPDX-License-Identifier: BSD-3-Clause
// Light between flat patches, past opaque boxes along the axes: form factors that are computed
// where they are used,
//
//     A = diag(left) G diag(right)
//     G_ij = mean of  cos(t_i) cos(t_j) / (pi r^2)  over pairs of points on patches i and j
//
// With left = albedo and right = area A is one bounce, and with the two swapped its transpose.
//
//   form_factor_weigh    z = diag(right) x; one work-item a patch
//   form_factor_matvec   out = a (A x) + b y + c x; one work-item a row
//   form_factor_pairs    G_ij of listed pairs, to the bit as in the product; one work-item a pair
//   form_factor_visible  the share of the rays between two patches that no box stops; one work-item
//                        a row and LANES columns
//
// A pair at least OUTER sizes apart is taken at its centres; nearer, the curvature of cos cos / r^2
// is added; within INNER sizes, or where the plane of one patch cuts the other, the pair is taken
// at eight pairs of points.
//
// Required defines: K, see common/lanes.h; LANES, patches that an item takes; BLOCKS, boxes.
//
// Layout: lengths are parts of the scene's size.
//   pitch     patches, rounded up to a multiple of LANES; those added have no normal
//   geometry  13 rows of `pitch` reals: centre, right edge, down edge, normal (three rows each),
//             and squared size, (right^2 + down^2) / 4, of which a pair has the sum
//   blocks    6 reals a box: its centre and its half sides
//   z         K rows of `pitch` reals

#include "common/product.h"

#ifndef LANES
#error "form_factor.cl needs -DLANES=<patches that an item takes: 8 on CPUs, 1 on GPUs>"
#endif
#ifndef BLOCKS
#error "form_factor.cl needs -DBLOCKS=<number of boxes>"
#endif

// stretch: a value of LANES patches side by side; flags: the result of comparing two
typedef OF(real, LANES) stretch;
#define LOAD_STRETCH(a) OF(LOAD, LANES)(a)
#if LANES == 8
typedef int8 flags;
#define ANY(flags) any(flags)
#define TOTAL(v) sum8(v)
#else
typedef int flags;
#define ANY(flags) (flags)
#define TOTAL(v) (v)
#endif

// PoCL compiles fabs() of eight lanes to a call.
INLINE stretch magnitude(stretch v)
{
    return v < 0 ? -v : v;
}

// Heights above a plane below this are rounding errors: such points do not see each other.
#define GRAZING 1e-6f

// Points or directions in space, one a lane.
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

// Space vector number `what` of patches item .. item + LANES - 1, or that of patch `item` in every
// lane.
INLINE spots load_spots(global const real *geometry, int pitch, int what, int item, bool spread)
{
    global const real *x = geometry + 3 * what * pitch + item, *y = x + pitch, *z = y + pitch;
    return spread ? (spots){(stretch)(*x), (stretch)(*y), (stretch)(*z)}
                  : (spots){LOAD_STRETCH(x), LOAD_STRETCH(y), LOAD_STRETCH(z)};
}

// `value`, or 0 where a box is between p and q: separating axes of a segment and a box (Ericson,
// Real-Time Collision Detection, 2005, section 5.3.3). Swapping the ends changes signs only, so the
// answer is the same to the bit.
INLINE stretch unless_blocked(stretch value, spots p, spots q, global const real *blocks)
{
    if (!ANY(value > 0))
        return value;
    const stretch dx = 0.5f * (q.x - p.x), dy = 0.5f * (q.y - p.y), dz = 0.5f * (q.z - p.z);
    const stretch mx = 0.5f * (q.x + p.x), my = 0.5f * (q.y + p.y), mz = 0.5f * (q.z + p.z);
    const stretch ax = magnitude(dx), ay = magnitude(dy), az = magnitude(dz);
    flags met = 0;
    for (int b = 0; b < BLOCKS; ++b, blocks += 6) {
        const stretch x = mx - blocks[0], y = my - blocks[1], z = mz - blocks[2];
        const real ex = blocks[3], ey = blocks[4], ez = blocks[5];
        met |= (magnitude(x) <= ax + ex) & (magnitude(y) <= ay + ey) & (magnitude(z) <= az + ez)
               & (magnitude(y * dz - z * dy) <= ey * az + ez * ay)
               & (magnitude(z * dx - x * dz) <= ez * ax + ex * az)
               & (magnitude(x * dy - y * dx) <= ex * ay + ey * ax);
    }
    return met ? (stretch)(0) : value;
}

#define OUTER 64.0f
#define INNER 12.0f
#define PI 3.14159265f  // M_PI_F may be a double

typedef struct {
    spots centre, right, down, normal;
} patch;
#define LOAD_ROWS(what, item, spread) load_spots(geometry, pitch, what, item, spread)
#define LOAD_PATCH(i, spread) \
    {LOAD_ROWS(0, i, spread), LOAD_ROWS(1, i, spread), LOAD_ROWS(2, i, spread), \
     LOAD_ROWS(3, i, spread)}

// The centre moved by a part of each edge.
INLINE spots moved(patch p, real a, real b)
{
    return (spots){
        p.centre.x + a * p.right.x + b * p.down.x, p.centre.y + a * p.right.y + b * p.down.y,
        p.centre.z + a * p.right.z + b * p.down.z};
}

// cos cos / (pi r^2) of points p and q; 0 where one is behind the other's plane, or the way is
// blocked.
INLINE stretch exchange(spots p, spots p_normal, spots q, spots q_normal, global const real *blocks)
{
    const spots d = between(p, q);
    const stretch here = dot3(d, p_normal), there = -dot3(d, q_normal), r2 = dot3(d, d);
    // What is added to the denominator serves a patch and itself: 0 / 0 otherwise.
    const stretch value = here * there / (PI * r2 * r2 + 1e-30f);
    const flags facing = (here > GRAZING) & (there > GRAZING);
    return unless_blocked(facing ? value : (stretch)(0), p, q, blocks);
}

// The mean over eight pairs of points, exact for cubics (Stroud, Approximate Calculation of
// Multiple Integrals, 1971, C_n 3-1 for n = 4). Point k of the rule is at angle k pi / 4 on an
// ellipse in each patch; it meets point 3 k there.
INLINE stretch at_eight_points(patch p, patch q, global const real *blocks)
{
#define MEET(a, b, u, v) exchange(moved(p, a, b), p.normal, moved(q, u, v), q.normal, blocks)
    // Radius of the ellipse in edges, and that / sqrt(2).
    const real u = 0.40824829f, v = 0.28867513f;
    const stretch straight =
        MEET(u, 0, u, 0) + MEET(0, u, 0, -u) + MEET(-u, 0, -u, 0) + MEET(0, -u, 0, u);
    const stretch skew =
        MEET(v, v, -v, v) + MEET(-v, v, v, v) + MEET(-v, -v, v, -v) + MEET(v, -v, -v, -v);
    return (straight + skew) * 0.125f;
}

// G of patches that are not far apart; d from p to q, `sizes` the squared size of the pair.
INLINE stretch
nearby(patch p, patch q, stretch sizes, spots d, stretch r2, global const real *blocks)
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
    // The value at the centres and the second derivative along each edge e, / 24. That of h g / r^4
    // is, with s = d . e,
    //     (2 h' g' - 8 (h' g + h g') s / r^2 + h g (24 s^2 / r^2 - 4 e^2) / r^2) / r^4
    // where h' is 0 along edges of p, and g' along those of q.
    const stretch a = dot3(d, p.right), b = dot3(d, p.down);
    const stretch u = dot3(d, q.right), v = dot3(d, q.down);
    const stretch turned = 8 * (h * (p_right * a + p_down * b) - g * (q_right * u + q_down * v));
    const stretch bent = h * g * (24 * (a * a + b * b + u * u + v * v) * inverse - 16 * sizes);
    const stretch curved =
        (h * g + (turned + bent) * inverse * (1.0f / 24)) * inverse * inverse * (1 / PI);
    stretch value = facing ? unless_blocked(curved, p.centre, q.centre, blocks) : (stretch)(0);
    const flags hard =
        facing & ((r2 < INNER * INNER * sizes) | (h - q_rise < -GRAZING) | (g - p_rise < -GRAZING));
    if (ANY(hard))
        value = hard ? at_eight_points(p, q, blocks) : value;
    return value;
}

// G of patch i and of patches j .. j + LANES - 1.
INLINE stretch
entries(int i, int j, global const real *geometry, int pitch, global const real *blocks)
{
    const patch p = LOAD_PATCH(i, true), q = LOAD_PATCH(j, false);
    const spots d = between(p.centre, q.centre);
    global const real *squared_sizes = geometry + 12 * pitch;
    const stretch sizes = squared_sizes[i] + LOAD_STRETCH(squared_sizes + j), r2 = dot3(d, d);
    const stretch far = exchange(p.centre, p.normal, q.centre, q.normal, blocks);
    const flags close = r2 < OUTER * OUTER * sizes;
    if (!ANY(close))
        return far;
    return close ? nearby(p, q, sizes, d, r2, blocks) : far;
}

// z = diag(right) x, each right-hand side as a row of `pitch` reals.
kernel void form_factor_weigh(
    int count,                 // patches
    int pitch,                 // the same, rounded up
    int stride,                // right-hand sides in all
    int offset,                // the first of the K of the launch
    global const real *right,  // [count]
    global const real *x,      // (count, stride)
    global real *z)            // gets 0 where no patch is
{
    stride = STRIDE(stride);
    const int j = get_global_id(0);
    if (j < pitch)
        for (int c = 0; c < K; ++c)
            z[c * pitch + j] = j < count ? right[j] * x[j * stride + offset + c] : 0;
}

INLINE void patch_sum(
    real *sum, int i, real left, int pitch, global const real *geometry, global const real *blocks,
    global const real *z)
{
    stretch part[K] = {0};
    for (int j = 0; j < pitch; j += LANES) {
        const stretch g = entries(i, j, geometry, pitch, blocks);
        for (int k = 0; k < K; ++k)
            part[k] = g * LOAD_STRETCH(z + k * pitch + j) + part[k];
    }
    for (int k = 0; k < K; ++k)
        sum[k] = left * TOTAL(part[k]);
}

kernel void form_factor_matvec(
    PRODUCT_ARGUMENTS,
    int pitch,                    // patches, rounded up
    global const real *geometry,  // see above
    global const real *blocks,    // see above
    global const real *left,      // [patches]
    global const real *z)         // of form_factor_weigh
{
    BY_ITEM(patch_sum(sum.item, first + row, left[first + row], pitch, geometry, blocks, z));
}

kernel void form_factor_pairs(
    int count,                       // pairs
    int pitch,                       // patches, rounded up
    global const int *from_patches,  // [count], patch i
    global const int *to_patches,    // [count], patch j
    global const real *geometry,     // see above
    global const real *blocks,       // see above
    global real *out)                // [count], G_ij
{
    const int n = get_global_id(0);
    if (n >= count)
        return;
    const int lane = to_patches[n] % LANES;
    const stretch g = entries(from_patches[n], to_patches[n] - lane, geometry, pitch, blocks);
    out[n] = ((const real *)&g)[lane];
}

// The share of the rays between the fronts of two patches that gets through; 1 where there are
// none. Ray k ends at point partner(k) of the other patch, and partner(partner(k)) = k: both
// directions have the same rays, and the same result to the bit.
kernel void form_factor_visible(
    int rows,                        // rows of this launch
    int pitch,                       // patches, rounded up
    int rays,                        // of a pair
    global const int *from_patches,  // [rows], the patch of each row
    global const int *to_patches,    // [rows], the patch of its first column, a multiple of LANES
    global const real *starts,       // three rows of `pitch` reals for each ray
    global const real *ends,         // likewise
    global const real *normals,      // three rows of `pitch` reals
    global const real *blocks,       // see above
    global real *out)                // (columns, rows)
{
    const int row = get_global_id(0), column = get_global_id(1) * LANES;
    if (row >= rows)
        return;
    const int i = from_patches[row], j = to_patches[row] + column;
    const spots p_normal = load_spots(normals, pitch, 0, i, true);
    const spots q_normal = load_spots(normals, pitch, 0, j, false);
    const stretch none = 0, one = 1;
    stretch open = 0, faced = 0;
    for (int k = 0; k < rays; ++k) {
        const spots p = load_spots(starts, pitch, k, i, true);
        const spots q = load_spots(ends, pitch, k, j, false);
        const spots d = between(p, q);
        const flags facing = (dot3(d, p_normal) > GRAZING) & (-dot3(d, q_normal) > GRAZING);
        const stretch counts = facing ? one : none;
        faced += counts;
        open += unless_blocked(counts, p, q, blocks);
    }
    const stretch share = faced > 0 ? open / faced : one;
    for (int lane = 0; lane < LANES; ++lane)
        out[(size_t)(column + lane) * rows + row] = ((const real *)&share)[lane];
}
