// SPDX-License-Identifier: BSD-3-Clause
// Product of a sparse matrix of tiles with K right-hand sides: out = scale * (A x) + add. A tile is WIDTH
// neighbouring columns of one row: one place for WIDTH numbers, and x is read in wide loads.
//
// Three kernels do the same; the device layer times them and takes the fastest:
//   tile_matvec         one work-item a row, as it reads in a textbook
//   tile_matvec_stream  one work-item a row, in wide loads (common/tile_sums.h); for CPUs
//   tile_matvec_group   one work-group a row, its items side by side along the row; for GPUs
//
// Required defines: K, the right-hand sides of one launch: 1, 2, 3, 4 or 8; WIDTH: 1, 8 or 16; VALUES, the type of
// the numbers, see common/narrow.h.
// Optional: PACKED, see common/lanes.h; LONG: places have 32 bits, not 16; GRANULE: places count in so many columns;
// PAGES: parts of a row, each with places of its own, which in part p count from column p * 65536 * GRANULE.
// Layout: a slab of `rows` rows, the first of which is row `first` of the matrix. pointers[rows * PAGES + 1] counts
// tiles from 0 within the slab; starts (one a tile) and values (WIDTH a tile) follow it, and so do scales (one a tile)
// where values are int8: they are not read elsewhere. Columns that no nonzero claims hold zeros. `last` is the last
// column at which a tile may begin.
// x and out are row-major with `stride` reals a row; the launch works on their columns
// offset .. offset + K - 1. `add` counts where `adds` is 1; see LTCL_STORE in common/real.h.

#ifndef WIDTH
#error "tile.cl needs -DWIDTH=<neighbouring columns of a tile: 1, 8 or 16>"
#endif
#ifndef GRANULE
#define GRANULE 1
#endif
#ifndef PAGES
#define PAGES 1
#endif
#ifdef LONG
typedef int place;
#else
typedef ushort place;
#endif

#include "common/lanes.h"
#include "common/reduce.h"
#include "common/tile_sums.h"

#define ORIGIN(page) ((page) * 65536 * GRANULE)

kernel void tile_matvec(
    int rows, int first, int stride, int offset, real scale, int adds, int last, global const int *pointers,
    global const place *starts, global const narrow *values, global const uchar *scales, global const real *x,
    global const real *add, global real *out)
{
    stride = STRIDE(stride);
    const int row = get_global_id(0);
    if (row >= rows)
        return;
    real sum[K];
    for (int c = 0; c < K; ++c)
        sum[c] = 0;
    pointers += row * PAGES;
    for (int page = 0; page < PAGES; ++page)
        tile_add(
            sum, starts, values, scales, ORIGIN(page), last, x + offset, stride, pointers[page] * WIDTH,
            pointers[page + 1] * WIDTH, 1);
    const int i = (first + row) * stride + offset;
    for (int c = 0; c < K; ++c)
        LTCL_STORE(out, i + c, sum[c], scale, adds, add);
}

kernel void tile_matvec_stream(
    int rows, int first, int stride, int offset, real scale, int adds, int last, global const int *pointers,
    global const place *starts, global const narrow *values, global const uchar *scales, global const real *x,
    global const real *add, global real *out)
{
    stride = STRIDE(stride);
    const int row = get_global_id(0);
    if (row >= rows)
        return;
    pointers += row * PAGES;
    tile_sums sum = tile_sum(starts, values, scales, 0, last, x + offset, stride, pointers[0], pointers[1]);
    for (int page = 1; page < PAGES; ++page)
        sum.vector += tile_sum(
            starts, values, scales, ORIGIN(page), last, x + offset, stride, pointers[page],
            pointers[page + 1]).vector;
    const int i = (first + row) * stride + offset;
    for (int c = 0; c < K; ++c)
        LTCL_STORE(out, i + c, sum.item[c], scale, adds, add);
}

kernel void tile_matvec_group(
    int rows, int first, int stride, int offset, real scale, int adds, int last, global const int *pointers,
    global const place *starts, global const narrow *values, global const uchar *scales, global const real *x,
    global const real *add, global real *out, local real *scratch)
{
    stride = STRIDE(stride);
    const int row = get_group_id(0);  // one group a row exactly: no row is beyond the last
    real sum[K];
    for (int c = 0; c < K; ++c)
        sum[c] = 0;
    pointers += row * PAGES;
    for (int page = 0; page < PAGES; ++page)
        tile_add(
            sum, starts, values, scales, ORIGIN(page), last, x + offset, stride,
            pointers[page] * WIDTH + get_local_id(0), pointers[page + 1] * WIDTH, get_local_size(0));
    const int i = (first + row) * stride + offset;
    for (int c = 0; c < K; ++c) {
        const real total = group_sum(sum[c], scratch);
        if (get_local_id(0) == 0)
            LTCL_STORE(out, i + c, total, scale, adds, add);
    }
}
