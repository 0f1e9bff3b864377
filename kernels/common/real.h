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
