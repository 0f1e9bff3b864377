// SPDX-License-Identifier: BSD-3-Clause
// One block of a Gauss-Seidel or SOR sweep on S = shift I + scale M, as blocked forward substitution.
//
// A sweep takes the blocks in order, each in two launches:
//   1. s_B = b_B - (S x)_B with the x of the moment: new before the block, old inside and after. In parallel:
//        relax_csr, relax_dense  one work-item a row, and as in csr.cl and dense.cl
//        _stream                 the same in wide loads; for CPUs, where a row is a stream
//        _group                  one work-group a row, its items side by side along the row; for GPUs
//      The variant taken is the one that is fastest for the product.
//   2. (D / omega + L)_BB delta = s_B, x_B += delta. In sequence, row by row, in a single work-item:
//        relax_csr_triangle, relax_dense_triangle
// Nothing is written that another work-item of the same launch reads.
//
// The sums of a row are kept apart at its diagonal, L + D and U, so that a sweep also tells the residual r of
// the iterate it started from. With x the sweep before and y the one before that, (D / omega + L)(x - y) =
// b - S y gives r = b - S x = carry - U x, where carry = U y + (1 - omega) s after substitution.
//
// Required define: K, the right-hand sides of one launch: 1, 2, 3, 4 or 8. Optional: PACKED, see common/lanes.h.
// Layout: a block of `rows` rows from row `begin` of a slab, whose row 0 is row `first` of the matrix. x, b, s,
// r and carry are row-major with `stride` reals a row; a launch works on columns offset .. offset + K - 1.
// CSR: middle[i] is the first entry of row i of the slab right of the diagonal.

#include "common/lanes.h"
#include "common/reduce.h"
#include "common/row_sums.h"

// One value of the block's right-hand side, and the residual of the iterate the sweep started from.
#define RELAX_STORE(i, lower, all) \
    do { \
        const real above = scale * ((all) - (lower)); \
        r[i] = carry[i] - above; \
        carry[i] = above; \
        s[i] = (b[i] - shift * x[i]) - scale * (all); \
    } while (0)

kernel void relax_csr(
    int rows, int begin, int first, int stride, int offset, real shift, real scale, global const int *pointers,
    global const int *columns, global const real *values, global const int *middle, global const real *x,
    global const real *b, global real *s, global real *r, global real *carry)
{
    stride = STRIDE(stride);
    if (get_global_id(0) >= rows)
        return;
    const int row = begin + get_global_id(0);
    const int split = middle[row], end = pointers[row + 1];
    real lower[K], upper[K];
    for (int c = 0; c < K; ++c)
        lower[c] = upper[c] = 0;
    int j = pointers[row];
    for (; j < split; ++j)
        for (int c = 0; c < K; ++c)
            lower[c] = values[j] * x[columns[j] * stride + offset + c] + lower[c];
    for (; j < end; ++j)
        for (int c = 0; c < K; ++c)
            upper[c] = values[j] * x[columns[j] * stride + offset + c] + upper[c];
    const int i = (first + row) * stride + offset;
    for (int c = 0; c < K; ++c)
        RELAX_STORE(i + c, lower[c], lower[c] + upper[c]);
}

kernel void relax_dense(
    int rows, int begin, int first, int stride, int offset, real shift, real scale, int width,
    global const real *matrix, global const real *x, global const real *b, global real *s, global real *r,
    global real *carry)
{
    stride = STRIDE(stride);
    if (get_global_id(0) >= rows)
        return;
    const int row = begin + get_global_id(0);
    global const real *a = matrix + (size_t)row * width;
    real lower[K], upper[K];
    for (int c = 0; c < K; ++c)
        lower[c] = upper[c] = 0;
    int j = 0;
    for (; j <= first + row; ++j)
        for (int c = 0; c < K; ++c)
            lower[c] = a[j] * x[j * stride + offset + c] + lower[c];
    for (; j < width; ++j)
        for (int c = 0; c < K; ++c)
            upper[c] = a[j] * x[j * stride + offset + c] + upper[c];
    const int i = (first + row) * stride + offset;
    for (int c = 0; c < K; ++c)
        RELAX_STORE(i + c, lower[c], lower[c] + upper[c]);
}

kernel void relax_csr_stream(
    int rows, int begin, int first, int stride, int offset, real shift, real scale, global const int *pointers,
    global const int *columns, global const real *values, global const int *middle, global const real *x,
    global const real *b, global real *s, global real *r, global real *carry)
{
    stride = STRIDE(stride);
    if (get_global_id(0) >= rows)
        return;
    const int row = begin + get_global_id(0);
    const row_sums sum = csr_sums(
        columns, values, x + offset, stride, pointers[row], middle[row], pointers[row + 1]);
    const int i = (first + row) * stride + offset;
    for (int c = 0; c < K; ++c)
        RELAX_STORE(i + c, sum.lower.item[c], sum.all.item[c]);
}

kernel void relax_dense_stream(
    int rows, int begin, int first, int stride, int offset, real shift, real scale, int width,
    global const real *matrix, global const real *x, global const real *b, global real *s, global real *r,
    global real *carry)
{
    stride = STRIDE(stride);
    if (get_global_id(0) >= rows)
        return;
    const int row = begin + get_global_id(0);
    global const real *a = matrix + (size_t)row * width;
    const sums lower = dense_sum(a, x + offset, stride, 0, first + row + 1);
    const sums upper = dense_sum(a, x + offset, stride, first + row + 1, width);
    const int i = (first + row) * stride + offset;
    for (int c = 0; c < K; ++c)
        RELAX_STORE(i + c, lower.item[c], lower.item[c] + upper.item[c]);
}

kernel void relax_csr_group(
    int rows, int begin, int first, int stride, int offset, real shift, real scale, global const int *pointers,
    global const int *columns, global const real *values, global const int *middle, global const real *x,
    global const real *b, global real *s, global real *r, global real *carry, local real *scratch)
{
    stride = STRIDE(stride);
    const int row = begin + get_group_id(0);  // one group a row exactly: no row is beyond the last
    const int split = middle[row], end = pointers[row + 1];
    real lower[K], upper[K];
    for (int c = 0; c < K; ++c)
        lower[c] = upper[c] = 0;
    int j = pointers[row] + get_local_id(0);
    for (; j < split; j += get_local_size(0))
        for (int c = 0; c < K; ++c)
            lower[c] = values[j] * x[columns[j] * stride + offset + c] + lower[c];
    for (; j < end; j += get_local_size(0))
        for (int c = 0; c < K; ++c)
            upper[c] = values[j] * x[columns[j] * stride + offset + c] + upper[c];
    const int i = (first + row) * stride + offset;
    for (int c = 0; c < K; ++c) {
        const real below = group_sum(lower[c], scratch), beyond = group_sum(upper[c], scratch);
        if (get_local_id(0) == 0)
            RELAX_STORE(i + c, below, below + beyond);
    }
}

kernel void relax_dense_group(
    int rows, int begin, int first, int stride, int offset, real shift, real scale, int width,
    global const real *matrix, global const real *x, global const real *b, global real *s, global real *r,
    global real *carry, local real *scratch)
{
    stride = STRIDE(stride);
    const int row = begin + get_group_id(0);
    global const real *a = matrix + (size_t)row * width;
    real lower[K], upper[K];
    for (int c = 0; c < K; ++c)
        lower[c] = upper[c] = 0;
    int j = get_local_id(0);
    for (; j <= first + row; j += get_local_size(0))
        for (int c = 0; c < K; ++c)
            lower[c] = a[j] * x[j * stride + offset + c] + lower[c];
    for (; j < width; j += get_local_size(0))
        for (int c = 0; c < K; ++c)
            upper[c] = a[j] * x[j * stride + offset + c] + upper[c];
    const int i = (first + row) * stride + offset;
    for (int c = 0; c < K; ++c) {
        const real below = group_sum(lower[c], scratch), beyond = group_sum(upper[c], scratch);
        if (get_local_id(0) == 0)
            RELAX_STORE(i + c, below, below + beyond);
    }
}

// inverse[i] is omega / D_ii. s becomes delta, row by row; i and c are a row of the matrix and a right-hand side.
#define RELAX_ROW(i, c, sum) \
    do { \
        const real left = s[(i)*stride + offset + (c)] - (sum); \
        const real delta = inverse[i] * left; \
        s[(i)*stride + offset + (c)] = delta; \
        x[(i)*stride + offset + (c)] += delta; \
        if (omega != 1) \
            carry[(i)*stride + offset + (c)] += (1 - omega) * left; \
    } while (0)

// pointers, columns and values hold what lies below the diagonal within a block of the slab, times scale.
kernel void relax_csr_triangle(
    int rows, int begin, int first, int stride, int offset, real omega, global const int *pointers,
    global const int *columns, global const real *values, global const real *inverse, global real *x,
    global real *s, global real *carry)
{
    stride = STRIDE(stride);
    if (get_global_id(0) > 0)
        return;
    for (int row = begin; row < begin + rows; ++row) {
        real sum[K];
        for (int c = 0; c < K; ++c)
            sum[c] = 0;
        for (int j = pointers[row]; j < pointers[row + 1]; ++j)
            for (int c = 0; c < K; ++c)
                sum[c] = values[j] * s[columns[j] * stride + offset + c] + sum[c];
        for (int c = 0; c < K; ++c)
            RELAX_ROW(first + row, c, sum[c]);
    }
}

kernel void relax_dense_triangle(
    int rows, int begin, int first, int stride, int offset, real omega, real scale, int width,
    global const real *matrix, global const real *inverse, global real *x, global real *s, global real *carry)
{
    stride = STRIDE(stride);
    if (get_global_id(0) > 0)
        return;
    for (int row = begin; row < begin + rows; ++row) {
        const sums sum = dense_sum(
            matrix + (size_t)row * width, s + offset, stride, first + begin, first + row);
        for (int c = 0; c < K; ++c)
            RELAX_ROW(first + row, c, scale * sum.item[c]);
    }
}
