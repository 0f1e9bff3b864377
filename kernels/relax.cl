// SPDX-License-Identifier: BSD-3-Clause
// One block of a Gauss-Seidel or SOR sweep on S = shift I + scale M, as blocked forward substitution.
//
// A sweep takes the blocks in order, each in two launches:
//   1. s_B = b_B - (S x)_B with the x of the moment: new before the block, old inside and after. In parallel:
//        relax_csr, relax_dense              one work-item a row; for CPUs, where a row is a stream
//        relax_csr_group, relax_dense_group  one work-group a row, its items side by side along the row
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

#if K == 1

typedef union {
    real vector;
    real item[1];
} sums;

typedef struct {
    sums lower, all;
} row_sums;

inline real8 relax_gather8(global const real *x, int stride, global const int *columns)
{
    const int8 c = vload8(0, columns) * stride;
    return (real8)(x[c.s0], x[c.s1], x[c.s2], x[c.s3], x[c.s4], x[c.s5], x[c.s6], x[c.s7]);
}

#define RELAX_STRETCH(even, odd) \
    do { \
        const int column = columns[j]; \
        if (stride == 1 && columns[j + 15] == column + 15) { \
            even = LOAD8(values + j) * LOAD8(x + column) + even; \
            odd = LOAD8(values + j + 8) * LOAD8(x + column + 8) + odd; \
        } else { \
            even = LOAD8(values + j) * relax_gather8(x, stride, columns + j) + even; \
            odd = LOAD8(values + j + 8) * relax_gather8(x, stride, columns + j + 8) + odd; \
        } \
    } while (0)

// Entries j .. end of a row, and those up to `split` of them. Stretches of 16 as in csr.cl; the one that the
// split cuts is masked, which leaves no more single entries than the product has.
inline row_sums csr_sums(
    global const int *columns, global const real *values, global const real *x, int stride, int j, int split,
    int end)
{
    real8 s0 = 0, s1 = 0;
    for (; j + 16 <= split; j += 16)
        RELAX_STRETCH(s0, s1);
    real8 low = s0 + s1;
    if (j < split && j + 16 <= end) {
        const int8 lane = (int8)(0, 1, 2, 3, 4, 5, 6, 7);
        real8 even = 0, odd = 0;
        RELAX_STRETCH(even, odd);
        low += select((real8)(0), even, lane < split - j) + select((real8)(0), odd, lane + 8 < split - j);
        s0 += even;
        s1 += odd;
        j += 16;
    }
    for (; j + 16 <= end; j += 16)
        RELAX_STRETCH(s0, s1);
    row_sums sum;
    sum.lower.vector = sum8(low);
    sum.all.vector = sum8(s0 + s1);
    for (; j < end; ++j) {
        const real product = values[j] * x[columns[j] * stride];
        sum.all.vector += product;
        if (j < split)
            sum.lower.vector += product;
    }
    return sum;
}

// Columns j .. end of a dense row.
inline sums dense_sum(global const real *a, global const real *x, int stride, int j, int end)
{
    real8 s0 = 0, s1 = 0, s2 = 0, s3 = 0;  // four sums hide the latency of the addition
    if (stride == 1)
        for (; j + 32 <= end; j += 32) {
            s0 = LOAD8(a + j) * LOAD8(x + j) + s0;
            s1 = LOAD8(a + j + 8) * LOAD8(x + j + 8) + s1;
            s2 = LOAD8(a + j + 16) * LOAD8(x + j + 16) + s2;
            s3 = LOAD8(a + j + 24) * LOAD8(x + j + 24) + s3;
        }
    if (stride == 1)
        for (; j + 8 <= end; j += 8)
            s0 = LOAD8(a + j) * LOAD8(x + j) + s0;
    sums sum;
    sum.vector = sum8((s0 + s1) + (s2 + s3));
    for (; j < end; ++j)
        sum.vector = a[j] * x[j * stride] + sum.vector;
    return sum;
}

#else

typedef lanes_items sums;

typedef struct {
    sums lower, all;
} row_sums;

inline sums csr_sum(
    global const int *columns, global const real *values, global const real *x, int stride, int j, int end)
{
    lanes s0 = 0, s1 = 0, s2 = 0, s3 = 0;
    for (; j + 4 <= end; j += 4) {
        s0 = (lanes)(values[j]) * LOAD(x + columns[j] * stride) + s0;
        s1 = (lanes)(values[j + 1]) * LOAD(x + columns[j + 1] * stride) + s1;
        s2 = (lanes)(values[j + 2]) * LOAD(x + columns[j + 2] * stride) + s2;
        s3 = (lanes)(values[j + 3]) * LOAD(x + columns[j + 3] * stride) + s3;
    }
    for (; j < end; ++j)
        s0 = (lanes)(values[j]) * LOAD(x + columns[j] * stride) + s0;
    sums sum;
    sum.vector = (s0 + s1) + (s2 + s3);
    return sum;
}

inline row_sums csr_sums(
    global const int *columns, global const real *values, global const real *x, int stride, int j, int split,
    int end)
{
    row_sums sum;
    sum.lower = csr_sum(columns, values, x, stride, j, split);
    sum.all.vector = csr_sum(columns, values, x, stride, split, end).vector + sum.lower.vector;
    return sum;
}

inline sums dense_sum(global const real *a, global const real *x, int stride, int j, int end)
{
    lanes s0 = 0, s1 = 0, s2 = 0, s3 = 0;
    for (; j + 4 <= end; j += 4) {
        s0 = (lanes)(a[j]) * LOAD(x + j * stride) + s0;
        s1 = (lanes)(a[j + 1]) * LOAD(x + (j + 1) * stride) + s1;
        s2 = (lanes)(a[j + 2]) * LOAD(x + (j + 2) * stride) + s2;
        s3 = (lanes)(a[j + 3]) * LOAD(x + (j + 3) * stride) + s3;
    }
    for (; j < end; ++j)
        s0 = (lanes)(a[j]) * LOAD(x + j * stride) + s0;
    sums sum;
    sum.vector = (s0 + s1) + (s2 + s3);
    return sum;
}

#endif

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
    const row_sums sum = csr_sums(
        columns, values, x + offset, stride, pointers[row], middle[row], pointers[row + 1]);
    const int i = (first + row) * stride + offset;
    for (int c = 0; c < K; ++c)
        RELAX_STORE(i + c, sum.lower.item[c], sum.all.item[c]);
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
