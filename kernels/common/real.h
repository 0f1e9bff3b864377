// SPDX-License-Identifier: BSD-3-Clause
// The number type of every kernel, and wide loads and stores.
//
// Products are written a * b + c, never fma(): PoCL compiles fma() on vectors to a library call,
// which made the CSR product with 8 right-hand sides 1.7 times slower. Compilers contract a * b + c
// where the device has the instruction.

#ifndef LTCL_REAL_H
#define LTCL_REAL_H

typedef float real;
typedef float4 real4;
typedef float8 real8;

// Wide loads and stores at any address that is aligned to one real. PoCL 3.0 compiles vload8 to a call, twice as
// slow as the unaligned load instruction that Clang makes of a vector type with its alignment lowered.
#ifdef __clang__
typedef float2 real2_packed __attribute__((aligned(4)));
typedef real4 real4_packed __attribute__((aligned(4)));
typedef real8 real8_packed __attribute__((aligned(4)));
#define LOAD2(p) (*(global const real2_packed *)(p))
#define LOAD4(p) (*(global const real4_packed *)(p))
#define LOAD8(p) (*(global const real8_packed *)(p))
#define STORE2(v, p) (*(global real2_packed *)(p) = (v))
#define STORE4(v, p) (*(global real4_packed *)(p) = (v))
#define STORE8(v, p) (*(global real8_packed *)(p) = (v))
#else
#define LOAD2(p) vload2(0, p)
#define LOAD4(p) vload4(0, p)
#define LOAD8(p) vload8(0, p)
#define STORE2(v, p) vstore2(v, 0, p)
#define STORE4(v, p) vstore4(v, 0, p)
#define STORE8(v, p) vstore8(v, 0, p)
#endif

// What works on several values at once must be inlined: a call passes each of them through memory.
#ifdef __clang__
#define INLINE static inline __attribute__((always_inline))
#else
#define INLINE static inline
#endif

// The epilogue of a product, value by value: out = a sum + b y + c x; y is not read where b is 0, nor x where c is.
static inline void finish(
    int i, real sum, real a, real b, real c, global const real *x, global const real *y, global real *out)
{
    real value = a * sum;
    if (b != 0)
        value += b * y[i];
    if (c != 0)
        value += c * x[i];
    out[i] = value;
}

static inline real sum8(real8 v)
{
    real4 h = v.lo + v.hi;
    return (h.s0 + h.s1) + (h.s2 + h.s3);
}

#endif
