// SPDX-License-Identifier: BSD-3-Clause
// Product of a sparse matrix of tiles with K right-hand sides, and steps of an iteration along one.
// The two kernels (a work-item a row, or a work-group for some) and PRODUCT_ARGUMENTS: common/product.h.
//
// A tile is WIDTH neighbouring columns of one row: one column index for WIDTH numbers, and x is
// read in wide loads. Columns that no nonzero claims hold zeros, and no tile reaches beyond the end
// of its row.
//
// Required defines: K, see common/product.h; WIDTH, 1 or 8; PLACE, the type of column indices,
// ushort or int; VALUES, the type of the numbers: 0 float32, 1 float16, 2 int8.
//
// Layout: a slab of rows.
//   pointers  [rows + 1], where the tiles of each row begin, counted from 0 within the slab
//   columns   the first column of each tile
//   values    WIDTH numbers a tile
//   scales    one a tile where VALUES is 2; else they are not read
//   scratch   K reals a work-item

#include "common/product.h"

#if WIDTH != 1 && WIDTH != 8
#error "tile.cl needs -DWIDTH=<neighbouring columns of a tile: 1 or 8>"
#endif
#ifndef PLACE
#error "tile.cl needs -DPLACE=<type of column indices: ushort or int>"
#endif
#ifndef VALUES
#error "tile.cl needs -DVALUES=<type of the numbers: 0 float32, 1 float16, 2 int8>"
#endif
#define X(j) (x + columns[j] * stride)

// Numbers as reals, one or eight neighbours, from any address: see LOAD8 in common/real.h.
#ifdef __clang__
typedef ushort8 ushort8_packed __attribute__((aligned(2)));
typedef uchar8 uchar8_packed __attribute__((aligned(1)));
#define LOAD8_USHORT(p) (*(global const ushort8_packed *)(p))
#define LOAD8_UCHAR(p) (*(global const uchar8_packed *)(p))
#else
#define LOAD8_USHORT(p) vload8(0, p)
#define LOAD8_UCHAR(p) vload8(0, (global const uchar *)(p))
#endif

#if VALUES == 0
typedef real narrow;
#define WIDEN(p) (*(p))
#define WIDEN8(p) LOAD8(p)
#elif VALUES == 1
// Sign, exponent and fraction move to their places in a float32, whose exponents count from 112
// lower. No stored number is subnormal. PoCL compiles vload_half() to a call.
typedef ushort narrow;
#define WIDEN(p) (as_float(((int)((uint) * (p) << 16) >> 3) & (int)0x8fffffff) * 0x1p112f)
#define FROM_HALVES(v) \
    (as_float8((as_int8(convert_uint8(v) << 16) >> 3) & (int)0x8fffffff) * 0x1p112f)
#define WIDEN8(p) FROM_HALVES(LOAD8_USHORT(p))
#elif VALUES == 2
typedef char narrow;
#define WIDEN(p) ((real) * (p))
#define WIDEN8(p) convert_float8(as_char8(LOAD8_UCHAR(p)))
#else
#error "tile.cl needs -DVALUES=<type of the numbers: 0 float32, 1 float16, 2 int8>"
#endif

// The scale that the numbers of tile j share: 5 bits of exponent and 3 of fraction.
#if VALUES == 2
#define SCALE(j) *as_float(((uint)scales[j] + 112 * 8) << 20)
#define SCALE8(j) *as_float8((convert_uint8(LOAD8_UCHAR(scales + (j))) + 112 * 8) << 20)
#else
#define SCALE(j)
#define SCALE8(j)
#endif

// Tile j of eight numbers, which begins at a multiple of its size.
#define TILE(j) (WIDEN8(values + (j) * 8) SCALE(j))
#if VALUES == 0
#define ALIGNED_TILE(j) (*(global const real8 *)(values + (j) * 8))
#elif VALUES == 1
#define ALIGNED_TILE(j) FROM_HALVES(*(global const ushort8 *)(values + (j) * 8))
#else
#define ALIGNED_TILE(j) (convert_float8(*(global const char8 *)(values + (j) * 8)) SCALE(j))
#endif

// Add every `step`-th tile from j on: an item takes a tile, whose numbers are one load.
INLINE void tile_add(
    real *sum, global const PLACE *columns, global const narrow *values, global const uchar *scales,
    global const real *x, int stride, int j, int end, int step)
{
    for (; j < end; j += step) {
#if WIDTH == 1
        add_pixel(sum, WIDEN(values + j) SCALE(j), X(j));
#else
        const real8 v = ALIGNED_TILE(j);
        global const real *y = X(j);
        add_pixel(sum, v.s0, y);
        add_pixel(sum, v.s1, y + stride);
        add_pixel(sum, v.s2, y + 2 * stride);
        add_pixel(sum, v.s3, y + 3 * stride);
        add_pixel(sum, v.s4, y + 4 * stride);
        add_pixel(sum, v.s5, y + 5 * stride);
        add_pixel(sum, v.s6, y + 6 * stride);
        add_pixel(sum, v.s7, y + 7 * stride);
#endif
    }
}

INLINE lanes tile_sum(
    global const PLACE *columns, global const narrow *values, global const uchar *scales,
    global const real *x, int stride, int j, int end)
{
    // Four sums hide the latency of the addition.
    lanes s0 = 0, s1 = 0, s2 = 0, s3 = 0;
#if WIDTH == 1
#define TILE_PRODUCT(j) ((lanes)(WIDEN(values + (j)) SCALE(j)) * LOAD(X(j)))
#if K == 1
    real8 eight = 0;
    for (; j + 8 <= end; j += 8)
        eight += WIDEN8(values + j) SCALE8(j)
                 * (real8)(*X(j), *X(j + 1), *X(j + 2), *X(j + 3), *X(j + 4), *X(j + 5), *X(j + 6),
                           *X(j + 7));
    s0 = sum8(eight);
#endif
    for (; j + 4 <= end; j += 4) {
        s0 = TILE_PRODUCT(j) + s0;
        s1 = TILE_PRODUCT(j + 1) + s1;
        s2 = TILE_PRODUCT(j + 2) + s2;
        s3 = TILE_PRODUCT(j + 3) + s3;
    }
    for (; j < end; ++j)
        s0 = TILE_PRODUCT(j) + s0;
#else
#if K == 1
    if (stride == 1) {
        real8 t0 = 0, t1 = 0, t2 = 0, t3 = 0;
        for (; j + 4 <= end; j += 4) {
            t0 = TILE(j) * LOAD8(X(j)) + t0;
            t1 = TILE(j + 1) * LOAD8(X(j + 1)) + t1;
            t2 = TILE(j + 2) * LOAD8(X(j + 2)) + t2;
            t3 = TILE(j + 3) * LOAD8(X(j + 3)) + t3;
        }
        for (; j < end; ++j)
            t0 = TILE(j) * LOAD8(X(j)) + t0;
        s0 = sum8((t0 + t1) + (t2 + t3));
    }
#endif
    // The K values of a pixel lie side by side: one wide load a number.
    for (; j < end; ++j) {
        global const real *y = X(j);
        const real8 v = TILE(j);
        s0 = (lanes)(v.s0) * LOAD(y) + s0;
        s1 = (lanes)(v.s1) * LOAD(y + stride) + s1;
        s2 = (lanes)(v.s2) * LOAD(y + 2 * stride) + s2;
        s3 = (lanes)(v.s3) * LOAD(y + 3 * stride) + s3;
        s0 = (lanes)(v.s4) * LOAD(y + 4 * stride) + s0;
        s1 = (lanes)(v.s5) * LOAD(y + 5 * stride) + s1;
        s2 = (lanes)(v.s6) * LOAD(y + 6 * stride) + s2;
        s3 = (lanes)(v.s7) * LOAD(y + 7 * stride) + s3;
    }
#endif
    return (s0 + s1) + (s2 + s3);
}

#define SLAB_ARGUMENTS \
    global const int *pointers, global const PLACE *columns, global const narrow *values, \
        global const uchar *scales

kernel void tile_matvec(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    global const real *from = x + offset;
    BY_ITEM(
        sum.vector =
            tile_sum(columns, values, scales, from, stride, pointers[row], pointers[row + 1]));
}

kernel void tile_matvec_group(PRODUCT_ARGUMENTS, SLAB_ARGUMENTS, local real *scratch)
{
    global const real *from = x + offset;
    BY_GROUP(
        tile_add(
            sum.item, columns, values, scales, from, stride, pointers[row] + me, pointers[row + 1],
            items));
}
