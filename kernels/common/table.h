// SPDX-License-Identifier: BSD-3-Clause
// Alias tables of rows, which alias.cl writes and walk.cl reads.
//
// A row has a record (x, y: place of its first table entry, low word first; z: entries, 0 where there is
// nothing to draw; w: its sum |R_i|, the bits of a real). A table entry is 64 bits, one load:
//   threshold 18 | own column 22, sign 1 | alias column 22, sign 1

#ifndef LTCL_TABLE_H
#define LTCL_TABLE_H

#define THRESHOLD_BITS 18
#define TARGET_BITS 23  // a column and its sign
#define TARGET_MASK ((1u << TARGET_BITS) - 1)

#endif
