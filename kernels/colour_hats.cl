// SPDX-License-Identifier: BSD-3-Clause
// Products of three colours with matrices between hat functions, all in one pass:
//
//   out = a A x + b y + c x,    A = diag(outer) (W^T K W + diag(own)) diag(inner)
//
// or A M diag(columns), or diag(columns) M A. W are the sums under the hats of all levels
// (hats.cl), K the coefficients of nodes, a matrix a colour; M mixes the colours of a pixel. The
// three values of a node lie side by side in four reals, the last of which is 0, so that an entry
// of K is one wide product for all colours.
//
//   colour_hats_scale   nodes of level 0: diag(inner) x, with x mixed where that comes first
//   colour_hats_rows    K times the nodes, for the rows of all coarser levels
//   colour_hats_finish  K times the nodes, for the rows of pixels, with the light between the nodes
//                       of level 1 and all else
//
// hats.cl makes the levels between. A work-item takes a row of K, or some neighbouring pixels.
//
// Optional defines: NARROW, 1 where entries of rows of pixels are narrow; INNER, OUTER, OWN and
// COLUMNS, 1 if these factors count, else they are not read; MIXED, 1 where colours of x are mixed,
// 2 where those of the result are; BLOCK, pixels of an item, 1 by default.
//
// Layout: x, y, out, inner, outer, columns are planes, (3, pixels); nodes and light are (nodes, 4).
//   pointers  [rows + 1], where the entries of each row begin
//   entries   four numbers each: those of the colours and a column. Wide ones are the bits of three
//             reals, and a node. Narrow ones are the upper halves of the bits of three reals, and
//             2 d + far: the node is d, from -16384 to 16383, behind that of the pixel itself, or
//             where far is 1 behind `bases`

#include "common/real.h"

#ifndef NARROW
#define NARROW 0
#endif
#ifndef INNER
#define INNER 0
#endif
#ifndef OUTER
#define OUTER 0
#endif
#ifndef OWN
#define OWN 0
#endif
#ifndef MIXED
#define MIXED 0
#endif
#ifndef COLUMNS
#define COLUMNS 0
#endif
#ifndef BLOCK
#define BLOCK 1
#endif

#define COLOURS 3
// Without the fourth number of an entry, which is no light.
#define COLOURS_OF(v) as_float4((v) & (uint4)(~0u, ~0u, ~0u, 0u))

#if COLUMNS
#define COLUMN(i) (columns[i])
#else
#define COLUMN(i) 1
#endif

// A plane of the light of some pixels, in private memory: loops over one thing each, so that a CPU
// takes wide registers.
#define EACH_PIXEL(p) for (int p = 0; p < count; ++p)

kernel void colour_hats_scale(
    int pixels,                  // of a plane
    constant real *mixing,       // M, (3, 3); not read without it
    global const real *columns,  // factors
    global const real *inner,    // factors
    global const real *x,        // operand
    global real4 *nodes)         // of which the first are those of pixels
{
    const int first = (int)get_global_id(0) * BLOCK, count = min(BLOCK, pixels - first);
    real light[COLOURS * BLOCK];
    for (int c = 0; c < COLOURS; ++c)
        EACH_PIXEL(p) {
#if MIXED == 1
            real sum = 0;
            for (int d = 0; d < COLOURS; ++d) {
                const int i = first + p + d * pixels;
                sum += mixing[COLOURS * c + d] * (COLUMN(i) * x[i]);
            }
            light[c * BLOCK + p] = sum;
#else
            light[c * BLOCK + p] = x[first + p + c * pixels];
#endif
        }
#if INNER
    for (int c = 0; c < COLOURS; ++c)
        EACH_PIXEL(p)
            light[c * BLOCK + p] *= inner[first + p + c * pixels];
#endif
    EACH_PIXEL(p)
        nodes[first + p] = (real4)(light[p], light[BLOCK + p], light[2 * BLOCK + p], 0);
}

INLINE real4
wide_sum(global const uint4 *entries, global const real4 *nodes, int j, int end)
{
    real4 even = 0, odd = 0;
    for (; j + 2 <= end; j += 2) {
        const uint4 first = entries[j], second = entries[j + 1];
        even += COLOURS_OF(first) * nodes[first.s3];
        odd += COLOURS_OF(second) * nodes[second.s3];
    }
    if (j < end) {
        const uint4 last = entries[j];
        even += COLOURS_OF(last) * nodes[last.s3];
    }
    return even + odd;
}

INLINE real4 narrow_sum(
    global const ushort4 *entries, global const real4 *nodes, int pixel, int base, int j, int end)
{
    real4 sum = 0;
    for (; j < end; ++j) {
        const ushort4 entry = entries[j];
        const int code = (short)entry.s3;
        const int node = (code & 1 ? base : pixel) + (code >> 1);
        sum += COLOURS_OF(convert_uint4(entry) << 16) * nodes[node];
    }
    return sum;
}

kernel void colour_hats_rows(
    int first,                    // node of the first row
    int rows,                     // rows
    global const int *pointers,   // see above
    global const uint4 *entries,  // wide
    global const real4 *nodes,    // sums under all hats
    global real4 *light)          // of all nodes, of which these rows are written
{
    const int row = get_global_id(0);
    if (row < rows)
        light[first + row] = wide_sum(entries, nodes, pointers[row], pointers[row + 1]);
}

// A node between two of the level above is half of each.
INLINE real4 light_between(int row, int column, int width_above, global const real4 *above)
{
    const int at = (row >> 1) * width_above + (column >> 1);
    real4 sum = above[at];
    if (column & 1)
        sum = (real)0.5 * (sum + above[at + 1]);
    if (row & 1) {
        real4 below = above[at + width_above];
        if (column & 1)
            below = (real)0.5 * (below + above[at + width_above + 1]);
        sum = (real)0.5 * (sum + below);
    }
    return sum;
}

kernel void colour_hats_finish(
    int height,                  // rows of pixels
    int width,                   // columns of pixels
    int levels,                  // of hats; of one there is no light from above
    global const int *pointers,  // see above
    global const int *bases,     // a node a pixel; not read unless entries are narrow
#if NARROW
    global const ushort4 *entries,  // narrow
#else
    global const uint4 *entries,  // wide
#endif
    global const real4 *nodes,   // sums under all hats
    global const real4 *sums,    // of hats_spread, in which level 1 stands behind a spare one
    global const real *outer,    // factors
    global const real4 *own,     // factors of nodes of level 0, (pixels, 4)
    constant real *mixing,       // M, (3, 3); not read without it
    global const real *columns,  // factors
    real a,                      // factor of A x
    real b,                      // factor of y
    real c,                      // factor of x
    global const real *x,        // operand
    global const real *y,        // what is added; not read where b is 0
    global real *out)            // may be y
{
    const int column = (int)get_global_id(0) * BLOCK, row = get_global_id(1);
    if (row >= height)
        return;
    const int count = min(BLOCK, width - column), first = row * width + column;
    const int pixels = height * width;
    real values[COLOURS * BLOCK];
    EACH_PIXEL(p) {
        const int pixel = first + p, begin = pointers[pixel], end = pointers[pixel + 1];
        real4 sum = 0;
        if (levels > 1)
            sum = light_between(row, column + p, width / 2 + 1, sums + pixels + 1);
#if NARROW
        sum += narrow_sum(entries, nodes, pixel, bases[pixel], begin, end);
#else
        sum += wide_sum(entries, nodes, begin, end);
#endif
#if OWN
        sum += own[pixel] * nodes[pixel];
#endif
        values[p] = sum.s0;
        values[BLOCK + p] = sum.s1;
        values[2 * BLOCK + p] = sum.s2;
    }
#if OUTER
    for (int d = 0; d < COLOURS; ++d)
        EACH_PIXEL(p)
            values[d * BLOCK + p] *= outer[first + p + d * pixels];
#endif
    for (int d = 0; d < COLOURS; ++d)
        EACH_PIXEL(p) {
#if MIXED == 2
            real sum = 0;
            for (int e = 0; e < COLOURS; ++e)
                sum += mixing[COLOURS * d + e] * values[e * BLOCK + p];
            const real value = COLUMN(first + p + d * pixels) * sum;
#else
            const real value = values[d * BLOCK + p];
#endif
            finish(first + p + d * pixels, value, a, b, c, x, y, out);
        }
}
