// SPDX-License-Identifier: BSD-3-Clause
// Alias tables, written by alias.cl, read by walk.cl. A row has a record (x, y: place of its first entry, low word
// first; z: entries, 0 where there is nothing to draw; w: its sum |R_i|, the bits of a real). An entry is one load of
// 64 bits:
//   threshold 18 | own column 22, sign 1 | alias column 22, sign 1

#define THRESHOLD_BITS 18
#define TARGET_BITS 23  // a column and its sign
#define TARGET_MASK ((1u << TARGET_BITS) - 1)
