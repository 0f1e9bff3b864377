// SPDX-License-Identifier: BSD-3-Clause
// Inverses of lower triangles joined two by two, for sweeps on GPUs (relax.cl): of twice the size
//
//     | A    |^-1   |     A^-1          |
//     | L  C |    = | -C^-1 T    C^-1   |,   T = L A^-1
//
//   triangle_products  T of all pairs; a work-item makes one number
//   triangle_join      the inverses of twice the size; a work-item makes 4 x 4 numbers of -C^-1 T, and
//                      copies as many of A^-1 and of C^-1
//
// L are rows of scale M. Optional define: DENSE, where M has rows of `width` numbers, without
// pointers and columns. Layout: row i of all inverses of `size` rows, zeros right of the diagonal
// among them, is at inverses[i * size]; pair p begins with row 2 p size. The last inverses have fewer
// rows, but no fewer numbers in each.

#include "common/real.h"

#ifdef DENSE
#define FIRST_ENTRY(row, column) (column)
#define END_ENTRY(row) width
#define COLUMN(j) (j)
#define VALUES(row) (values + (size_t)(row) * width)
#else
// The first entry from `column` on, of entries begin .. end - 1 in ascending columns.
INLINE int first_entry(global const int *columns, int begin, int end, int column)
{
    while (begin < end) {
        const int middle = begin + (end - begin) / 2;
        if (columns[middle] < column)
            begin = middle + 1;
        else
            end = middle;
    }
    return begin;
}
#define FIRST_ENTRY(row, column) first_entry(columns, pointers[row], pointers[(row) + 1], column)
#define END_ENTRY(row) pointers[(row) + 1]
#define COLUMN(j) columns[j]
#define VALUES(row) values
#endif

kernel void triangle_products(
    int rows,                     // of the slab of M
    int first,                    // row of M with which it begins
    int size,                     // rows of an inverse
    real scale,                   // of M
    int width,                    // DENSE: columns of M
    global const int *pointers,   // [rows + 1], where each sparse row begins in the slab
    global const int *columns,    // of each entry
    global const real *values,    // of each entry
    global const real *inverses,  // (n, size)
    global real *products)        // (n, size), T in the rows of C
{
    const size_t item = get_global_id(0);
    const int row = item / size, column = item % size, i = first + row;
    const int start = i - i % (2 * size), middle = start + size;
    if (row >= rows || i < middle)
        return;
    real sum = 0;
    // Rows of A^-1 before `column` have a zero there.
    const int end = END_ENTRY(row);
    for (int j = FIRST_ENTRY(row, start + column); j < end && COLUMN(j) < middle; ++j)
        sum += VALUES(row)[j] * inverses[(size_t)COLUMN(j) * size + column];
    products[(size_t)i * size + column] = scale * sum;
}

kernel void triangle_join(
    int n,                        // rows of M
    int size,                     // rows of an inverse, a multiple of 4
    global const real *inverses,  // (n, size)
    global const real *products,  // (n, size), T in the rows of C
    global real *out)             // (n, 2 size)
{
    const int tiles = size / 4;
    const size_t item = get_global_id(0);
    const int tile_row = item / tiles, column = 4 * (int)(item % tiles), pair = tile_row / tiles;
    const int middle = (2 * pair + 1) * size, row = 4 * (tile_row % tiles);
    if (middle - size + row >= n)
        return;
    real4 sums[4] = {0, 0, 0, 0};
    const int end = min(row + 4, n - middle);
    for (int k = 0; k < end; ++k) {
        const real4 product = *(global const real4 *)(products + (size_t)(middle + k) * size + column);
// So that sums stay in registers; here and below.
#pragma unroll
        for (int u = 0; u < 4; ++u)
            sums[u] += inverses[(size_t)min(middle + row + u, n - 1) * size + k] * product;
    }
#pragma unroll
    for (int u = 0; u < 4; ++u) {
        const int lower = middle + row + u, upper = lower - size;
        if (upper < n) {
            global real4 *to = (global real4 *)(out + (size_t)upper * 2 * size + column);
            *to = *(global const real4 *)(inverses + (size_t)upper * size + column);
            to[tiles] = 0;
        }
        if (lower < n) {
            global real4 *to = (global real4 *)(out + (size_t)lower * 2 * size + column);
            *to = -sums[u];
            to[tiles] = *(global const real4 *)(inverses + (size_t)lower * size + column);
        }
    }
}
