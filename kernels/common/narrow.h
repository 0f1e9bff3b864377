// SPDX-License-Identifier: BSD-3-Clause
// Numbers stored in fewer bits than those of x, one at a time or eight neighbours. VALUES tells their type:
// 0 float32, 1 bfloat16 (the upper half of a float32), 2 float16, 3 int8.

#ifndef LTCL_NARROW_H
#define LTCL_NARROW_H

#include "common/real.h"

#ifndef VALUES
#error "narrow.h needs -DVALUES=<type of the numbers: 0 float32, 1 bfloat16, 2 float16, 3 int8>"
#endif

// Wide loads from any address that holds a number; see LOAD8 in common/real.h.
#ifdef __clang__
typedef ushort8 ushort8_packed __attribute__((aligned(2)));
typedef char8 char8_packed __attribute__((aligned(1)));
#define LOAD8_USHORT(p) (*(global const ushort8_packed *)(p))
#define LOAD8_CHAR(p) (*(global const char8_packed *)(p))
#define LOAD8_UCHAR(p) as_uchar8(LOAD8_CHAR(p))
#else
#define LOAD8_USHORT(p) vload8(0, p)
#define LOAD8_CHAR(p) vload8(0, p)
#define LOAD8_UCHAR(p) vload8(0, p)
#endif

#if VALUES == 0
typedef real narrow;
#define WIDEN(p) (*(p))
#define WIDEN8(p) LOAD8(p)
#elif VALUES == 1
typedef ushort narrow;
#define WIDEN(p) as_float((uint)*(p) << 16)
#define WIDEN8(p) as_float8(convert_uint8(LOAD8_USHORT(p)) << 16)
#elif VALUES == 2
// Sign, exponent and fraction move to their places in a float32, whose exponents count from 112 lower. No stored
// number is subnormal. PoCL compiles vload_half() to a call.
typedef ushort narrow;
#define WIDEN(p) (as_float(((int)((uint)*(p) << 16) >> 3) & (int)0x8fffffff) * 0x1p112f)
#define WIDEN8(p) \
    (as_float8((as_int8(convert_uint8(LOAD8_USHORT(p)) << 16) >> 3) & (int)0x8fffffff) * 0x1p112f)
#elif VALUES == 3
typedef char narrow;
#define WIDEN(p) ((real)*(p))
#define WIDEN8(p) convert_float8(LOAD8_CHAR(p))
#else
#error "VALUES must be 0, 1, 2 or 3"
#endif

#endif
