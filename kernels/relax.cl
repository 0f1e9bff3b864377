// SPDX-License-Identifier: BSD-3-Clause
// Sweeps over the rows of S = shift I + scale M, in place: Gauss-Seidel, SOR, block Gauss-Seidel.
//
//     P_BB delta_B = s_B,   s_B = b_B - (S x)_B with the x of the moment,   x_B += delta_B
//
// block B after block. P_BB is the lower triangle of S_BB with D / omega, or all of it.
//
//   relax_strips  CPUs: a panel of many blocks; a work-item takes a block of rows, which is a strip
//                 of the panel
//   relax_rows    GPUs: s_B; a work-group a row
//   relax_correct GPUs: x_B += P_BB^-1 s_B; a work-group a row. A launch of each for each block
//
// A strip first sums what no other strip changes before its turn. The rest, a narrow window of
// columns, is added strip by strip by the item that ends the sums of a strip or the strip before
// it, whichever is later: none waits. Assumed beyond OpenCL 1.2, true of CPU drivers: mem_fence and
// atomics order writes across the work-groups of a launch.
//
// A row is split at column i where its correction is omega s_i / S_ii at once (by_inverses 0), else
// at the first column of its block. The sum below, of the x before, stays in carry = b - sum: with
// the sum above it gives r of that x.
//
// Required define: K, see common/lanes.h. Optional: PACKED, see there; DENSE, where M has rows of
// `width` numbers, without pointers, columns and windows. Layout: vectors are row-major with
// `stride` right-hand sides. The first two kernels have the arguments
//
//   begin end            rows of this launch, in the panel or block
//   first                row of M with which the slab begins
//   panel_start          first row of the panel or block
//   stride offset        right-hand sides in all, and the first of the K of the launch
//   shift scale          of S
//   width                DENSE: columns of M
//   pointers             [rows + 1], where each sparse row begins, counted from 0 within the slab
//   columns values       of each entry
//   windows              [2 rows], the first entry of the window of a row; that from the split on
//   x b s r carry        iterate, right-hand side, s_B, residual of the x before, b - sum below

#include "common/product.h"
#include "common/row_sums.h"

#define RELAX_ARGUMENTS \
    int begin, int end, int first, int panel_start, int stride, int offset, real shift, \
        real scale, int width, global const int *pointers, global const int *columns, \
        global const real *values, global const int *windows, global real *x, \
        global const real *b, global real *s, global real *r, global real *carry
#define ADD_OFFSET \
    (stride = STRIDE(stride), x += offset, b += offset, s += offset, r += offset, carry += offset)
#define ROW_SUM(row, from, to) \
    ((lane_sums){row_sum(SPARSE, columns, VALUES(row), x, stride, from, to)})
#ifdef DENSE
#define SPARSE false
#else
#define SPARSE true
#endif
#define VALUES(row) (SPARSE ? values : values + (size_t)(row) * width)
#define ROW_BEGIN(row) (SPARSE ? pointers[row] : 0)
#define ROW_END(row) (SPARSE ? pointers[(row) + 1] : width)
#define WINDOW_BEGIN(row, column) (SPARSE ? windows[2 * (row)] : (column))
#define WINDOW_END(row, column) (SPARSE ? windows[2 * (row) + 1] : (column))

kernel void relax_strips(
    RELAX_ARGUMENTS,
    int strips,                     // of the launch
    int n,                          // rows of S
    int block,                      // rows of a block
    int by_inverses,                // 1: weights are inverses of blocks, 0: of the diagonal
    real omega,                     // relaxation factor, where by_inverses is 0
    global const real *weights,     // rows of P_BB^-1, `block` numbers each, or 1 / S_ii
    volatile global int *arrivals,  // [0] counts the strips begun, [i] what strip i waited for;
                                    // all are 0 between launches
    global real *before)            // gets the x before
{
    ADD_OFFSET;
    before += offset;
    int strip = atomic_inc(arrivals);
    int top = (begin / block + strip) * block;  // first row of the block
    for (int i = max(begin, top); i < min(end, top + block); ++i) {
        const int row = i - first;
        const lane_sums lower = ROW_SUM(row, ROW_BEGIN(row), WINDOW_BEGIN(row, panel_start));
        const lane_sums upper = ROW_SUM(row, WINDOW_END(row, by_inverses ? top : i), ROW_END(row));
        for (int c = 0, j = i * stride; c < K; ++c, ++j) {
            before[j] = x[j];
            s[j] = shift * x[j] + scale * upper.item[c];
            r[j] = carry[j] - s[j];
            carry[j] = b[j] - scale * lower.item[c];
        }
    }
    for (; strip < strips; ++strip, top += block) {
        mem_fence(CLK_GLOBAL_MEM_FENCE);
        // Its sums or the strip before it are at work: who ends later goes on here.
        if (strip > 0 && atomic_inc(arrivals + strip) == 0)
            return;
        mem_fence(CLK_GLOBAL_MEM_FENCE);
        if (strip > 0)
            arrivals[strip] = 0;
        for (int i = max(begin, top); i < min(end, top + block); ++i) {
            const int row = i - first;
            const lane_sums lower = ROW_SUM(
                row, WINDOW_BEGIN(row, panel_start), WINDOW_END(row, by_inverses ? top : i));
            for (int c = 0, j = i * stride; c < K; ++c, ++j) {
                carry[j] -= scale * lower.item[c];
                s[j] = carry[j] - s[j];
                if (!by_inverses)
                    x[j] += omega * weights[i] * s[j];
            }
        }
        // A block may end in the next slab.
        const int bottom = min(top + block, n);
        for (int i = top; by_inverses && bottom <= end && i < bottom; ++i) {
            global const real *inverse = weights + (size_t)i * block;
            const lane_sums delta = {
                row_sum(false, 0, inverse, s + top * stride, stride, 0, bottom - top)};
            for (int c = 0; c < K; ++c)
                x[i * stride + c] += delta.item[c];
        }
    }
    arrivals[0] = 0;
}

kernel void relax_rows(RELAX_ARGUMENTS,
                       local real *scratch)  // 2 K reals a work-item
{
    ADD_OFFSET;
    // One group a row exactly: no row is beyond the last.
    const int row = begin - first + get_group_id(0);
    const int me = get_local_id(0), items = get_local_size(0);
    const int split = WINDOW_END(row, panel_start);
    real sum[2 * K] = {0};
    row_add(SPARSE, sum, columns, VALUES(row), x, stride, ROW_BEGIN(row) + me, split, items);
    row_add(SPARSE, sum + K, columns, VALUES(row), x, stride, split + me, ROW_END(row), items);
    group_sums(sum, scratch);
    // Other memory: the tree of the first sums may be at work.
    group_sums(sum + K, scratch + K * get_local_size(0));
    for (int c = 0, j = (first + row) * stride; me == 0 && c < K; ++c, ++j) {
        const real from_x = shift * x[j] + scale * sum[K + c];
        r[j] = carry[j] - from_x;
        carry[j] = b[j] - scale * sum[c];
        s[j] = carry[j] - from_x;
    }
}

kernel void relax_correct(
    int rows,                    // of the block
    int start,                   // its first row
    int block,                   // numbers in a row of `weights`
    int is_triangle,             // 1: numbers right of the diagonal are 0, and are not read
    int stride,                  // right-hand sides in all
    int offset,                  // the first of the K of the launch
    global const real *weights,  // rows of P_BB^-1
    global const real *s,        // s_B in the rows of the block
    global real *x,              // the iterate
    local real *scratch)         // K reals a work-item
{
    stride = STRIDE(stride);
    // One group a row exactly.
    const int row = get_group_id(0), me = get_local_id(0), items = get_local_size(0);
    global const real *inverse = weights + (size_t)(start + row) * block;
    global const real *from = s + start * stride + offset;
    real sum[K] = {0};
    row_add(false, sum, 0, inverse, from, stride, me, is_triangle ? row + 1 : rows, items);
    group_sums(sum, scratch);
    for (int c = 0; me == 0 && c < K; ++c)
        x[(start + row) * stride + offset + c] += sum[c];
}
