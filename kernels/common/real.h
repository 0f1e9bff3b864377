// SPDX-License-Identifier: BSD-3-Clause
// The number type of every kernel, and how a product leaves one.
//
// Products are written a * b + c, never fma(): PoCL compiles fma() on vectors to a library call,
// which made the CSR product with 8 right-hand sides 1.7 times slower. Compilers contract a * b + c
// where the device has the instruction.

#ifndef LTCL_REAL_H
#define LTCL_REAL_H

typedef float real;
typedef float4 real4;
typedef float8 real8;

// Wide loads from any address that is aligned to one real. PoCL 3.0 compiles vload8 to a call, twice as
// slow as the unaligned load instruction that Clang makes of a vector type with its alignment lowered.
#ifdef __clang__
typedef float2 real2_packed __attribute__((aligned(4)));
typedef real4 real4_packed __attribute__((aligned(4)));
typedef real8 real8_packed __attribute__((aligned(4)));
#define LOAD2(p) (*(global const real2_packed *)(p))
#define LOAD4(p) (*(global const real4_packed *)(p))
#define LOAD8(p) (*(global const real8_packed *)(p))
#else
#define LOAD2(p) vload2(0, p)
#define LOAD4(p) vload4(0, p)
#define LOAD8(p) vload8(0, p)
#endif

// Every product ends in out = scale * sum + add, so that one launch makes a residual or an iteration.
// `adds` says whether `add` is an operand; where it is 0, `add` is any valid buffer and is not read.
#define LTCL_STORE(out, i, sum, scale, adds, add) \
    ((out)[i] = (adds) ? (scale) * (sum) + (add)[i] : (scale) * (sum))

inline real sum8(real8 v)
{
    real4 h = v.lo + v.hi;
    return (h.s0 + h.s1) + (h.s2 + h.s3);
}

#endif
