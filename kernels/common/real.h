// SPDX-License-Identifier: BSD-3-Clause
// The number type of every kernel, wide loads and stores, the epilogue of a product, sums.
//
// Products are written a * b + c, which compilers contract, never fma(): PoCL compiles that to a
// call on vectors (1.7 times slower). It compiles vload8 to a call, too: twice as slow as a load of
// a vector type whose alignment is lowered.

#ifndef LTCL_REAL_H
#define LTCL_REAL_H

typedef float real, real1;
typedef float2 real2;
typedef float4 real4;
typedef float8 real8;

// The member of a family for n values: OF(real, 8) is real8.
#define PASTE(name, n) name##n
#define OF(name, n) PASTE(name, n)

// Loads and stores of n neighbouring values at any address of a real.
// INLINE is for all functions: a call would pass several values through memory, and llvmpipe crashes
// where that memory lives across a barrier.
#ifdef __clang__
typedef real2 real2_packed __attribute__((aligned(4)));
typedef real4 real4_packed __attribute__((aligned(4)));
typedef real8 real8_packed __attribute__((aligned(4)));
#define LOAD_WIDE(n, p) (*(global const real##n##_packed *)(p))
#define STORE_WIDE(n, v, p) (*(global real##n##_packed *)(p) = (v))
#define INLINE static inline __attribute__((always_inline))
#else
#define LOAD_WIDE(n, p) vload##n(0, p)
#define STORE_WIDE(n, v, p) vstore##n(v, 0, p)
#define INLINE static inline
#endif
#define LOAD1(p) (*(p))
#define LOAD2(p) LOAD_WIDE(2, p)
#define LOAD4(p) LOAD_WIDE(4, p)
#define LOAD8(p) LOAD_WIDE(8, p)
#define STORE1(v, p) (*(p) = (v))
#define STORE2(v, p) STORE_WIDE(2, v, p)
#define STORE4(v, p) STORE_WIDE(4, v, p)
#define STORE8(v, p) STORE_WIDE(8, v, p)

// out = a sum + b y + c x, one value; y is not read where b is 0, nor x where c is.
INLINE void finish(
    int i, real sum, real a, real b, real c, global const real *x, global const real *y,
    global real *out)
{
    out[i] = a * sum + (b == 0 ? 0 : b * y[i]) + (c == 0 ? 0 : c * x[i]);
}

INLINE real sum8(real8 v)
{
    const real4 h = v.lo + v.hi;
    return (h.s0 + h.s1) + (h.s2 + h.s3);
}

// values[j], j < stride, becomes the sum of values[j], values[j + stride], ...; see fold.
INLINE void fold_step(local real *values, int count, int stride, int period, int largest)
{
    for (int j = get_local_id(0); j < min(stride, count); j += get_local_size(0)) {
        real sum = values[j];
        for (int i = j + stride; i < count; i += stride)
            sum = j % period < largest ? sum + values[i] : fmax(sum, values[i]);
        values[j] = sum;
    }
}

// Sums, or maxima, over a work-group, in two steps of about the root of their terms each: the same
// order every time. All items call it. A tree would take a barrier in a loop, of which PoCL compiles
// many copies.
//   values   values[j], j < period, becomes the sum of values[j], values[j + period], ...
//   count    number of values
//   period   number of results
//   largest  from this result on, the largest value in place of the sum
INLINE void fold(local real *values, int count, int period, int largest)
{
    const int rows = (count + period - 1) / period;
    int parts = 1;
    while (parts * parts < rows)
        parts++;
    barrier(CLK_LOCAL_MEM_FENCE);
    fold_step(values, count, parts * period, period, largest);
    barrier(CLK_LOCAL_MEM_FENCE);
    fold_step(values, min(count, parts * period), period, period, largest);
    barrier(CLK_LOCAL_MEM_FENCE);
}

#endif
