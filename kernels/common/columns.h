// SPDX-License-Identifier: BSD-3-Clause
// Sums over the rows of arrays (rows, k), column by column, and updates with coefficients of each
// column. Kernels that include it are launched by `Columns` in ltcl/solvers and by
// ltcl/device/vectors.py.
//
// A work-item has neighbouring rows of one column, for caches of CPUs, or with -DADJACENT=0 every
// so many, so that loads of neighbouring items lie side by side. A group has up to its size of the
// columns, the first by get_group_id(2). It leaves partial sums at [slice][sum][column], which
// every group of the next kernel adds up, in one order, with the same get_num_groups(0).
//
// With -DPLANES=1 columns stand one below the other, as the colours of one picture do.
//
// `scratch` holds a real a work-item and those that a kernel names. Optional defines: ADJACENT and
// PLANES, 1 or 0.

#ifndef LTCL_COLUMNS_H
#define LTCL_COLUMNS_H

#include "real.h"

#ifndef ADJACENT
#define ADJACENT 1
#endif
#ifndef PLANES
#define PLANES 0
#endif

// The part of a work-item: values first, first + step, ... below end, in the rows row, row + rows,
// ..., of column origin + column; its group has `width` columns from `origin` on.
typedef struct {
    int first, step, end, column, origin, width, row, rows;
} share;

#define EACH_COLUMN(j) for (int j = get_local_id(0); j < s.width; j += get_local_size(0))
#define EACH_VALUE(i, row) for (int i = s.first, row = s.row; i < s.end; i += s.step, row += s.rows)

INLINE share columns_share(int rows, int k)
{
    const int me = get_local_id(0), items = get_local_size(0);
    share s;
    s.origin = get_group_id(2) * items;
    s.width = min(items, k - s.origin);
    s.column = me % s.width;
    const int together = items / s.width, parts = together * get_num_groups(0);
    const int part = get_group_id(0) * together + me / s.width;
    const int height = (rows + parts - 1) / parts;
    s.row = ADJACENT ? min(part * height, rows) : part;
    s.rows = ADJACENT ? 1 : parts;
    const int last = ADJACENT ? min(s.row + height, rows) : rows;
    const int column = s.origin + s.column;
    s.end = PLANES ? column * rows + last : last * k;
    s.first = PLANES ? column * rows + s.row : s.row * k + column;
    if (me >= together * s.width)
        s.first = s.end;
    s.step = PLANES ? s.rows : s.rows * k;
    return s;
}

INLINE real4 four(global const real *x, int i, int step)
{
    return step == 1 ? LOAD4(x + i) : (real4)(x[i], x[i + step], x[i + 2 * step], x[i + 3 * step]);
}

// The item's sum of x * y * weights, without weights where that is 0: four sums at a time, none of
// which waits for another.
INLINE real
dot_share(global const real *x, global const real *y, global const real *weights, share s)
{
    real4 sums = 0;
    int i = s.first;
    for (; i + 3L * s.step < s.end; i += 4 * s.step)
        sums += four(x, i, s.step) * four(y, i, s.step) * (weights ? four(weights, i, s.step) : 1);
    for (; i < s.end; i += s.step)
        sums.s0 += x[i] * y[i] * (weights ? weights[i] : 1);
    return (sums.s0 + sums.s1) + (sums.s2 + sums.s3);
}

// Leave the sum of the items' values, or the largest, at out[column]. `scratch` holds a real an
// item.
INLINE void
columns_sum(real value, global real *out, int largest, share s, local real *scratch)
{
    scratch[get_local_id(0)] = value;
    fold(scratch, get_local_size(0), s.width, largest ? 0 : s.width);
    EACH_COLUMN(j)
        out[s.origin + j] = scratch[j];
    barrier(CLK_LOCAL_MEM_FENCE);
}

// Add up the partial sums of the group's columns over the slices.
//   partials   (slices, count, k)
//   slices     groups that left them
//   count      sums of each column
//   largest    from this sum on, the largest partial in place of the sum
//   k          columns
//   scratch    a real an item; behind it (first + count, width) totals
//   first      totals that are kept before these
// Returns where these totals begin: that of sum n of column j is at [n * width + j].
INLINE local real *columns_totals(
    global const real *partials, int slices, int count, int largest, int k, share s,
    local real *scratch, int first)
{
    const int me = get_local_id(0), items = get_local_size(0);
    local real *totals = scratch + items + first * s.width;
    const int entries = count * s.width, together = max(items / entries, 1);
    // Several items for each entry, or several entries for each item.
    local real *values = entries <= items ? scratch : totals;
    for (int value = me; value < together * entries; value += items) {
        const int entry = value % entries;
        real sum = 0;
        for (int slice = value / entries; slice < slices; slice += together) {
            const int row = slice * count + entry / s.width;
            const real partial = partials[row * k + s.origin + entry % s.width];
            sum = entry < largest * s.width ? sum + partial : fmax(sum, partial);
        }
        values[value] = sum;
    }
    fold(values, together * entries, entries, largest * s.width);
    for (int entry = me; entry < entries; entry += items)
        totals[entry] = values[entry];
    barrier(CLK_LOCAL_MEM_FENCE);
    return totals;
}

#endif
