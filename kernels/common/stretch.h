// SPDX-License-Identifier: BSD-3-Clause
// LANES neighbouring values that one work-item handles together: 8 on CPUs, 1 on GPUs, where neighbours are
// the business of neighbouring items.

#include "common/real.h"

#ifndef LANES
#error "stretch.h needs -DLANES=<neighbouring values of one work-item: 1 or 8>"
#endif

// flags: what comparing two stretches gives. TOTAL: the sum of the lanes.
#if LANES == 8
typedef real8 stretch;
typedef int8 flags;
#define LOAD_STRETCH(a) LOAD8(a)
#define ANY(flags) any(flags)
#define TOTAL(v) sum8(v)
#else
typedef real stretch;
typedef int flags;
#define LOAD_STRETCH(a) (*(a))
#define ANY(flags) (flags)
#define TOTAL(v) (v)
#endif

typedef union {
    stretch vector;
    real item[LANES];
} stretch_items;

// PoCL compiles fabs() of eight lanes to a call.
INLINE stretch magnitude(stretch v)
{
    return v < 0 ? -v : v;
}
