// SPDX-License-Identifier: BSD-3-Clause
// Tables from which a walk draws the entries of a row: what alias.cl writes and walk.cl reads.
//
// A row has a record (x, y: place of its first table entry, low word first; z: entries, 0 where there is
// nothing to draw; w: its sum |R_i|, the bits of a real). A table entry is 64 bits, one load:
//   TABLE_ALIAS    threshold 18 | own column 22, sign 1 | alias column 22, sign 1
//   TABLE_CDF      sum of |R_ij| up to and with the entry, as an integer, 41 | column 22, sign 1
//   TABLE_UNIFORM  value 32 | column 32
//
// Required define: TABLE, one of these.

#ifndef LTCL_TABLE_H
#define LTCL_TABLE_H

#define TABLE_ALIAS 0
#define TABLE_CDF 1
#define TABLE_UNIFORM 2

#ifndef TABLE
#error "table.h needs -DTABLE=<0 alias, 1 cdf, 2 uniform>"
#endif

#define THRESHOLD_BITS 18
#define TARGET_BITS 23  // a column and its sign
#define TARGET_MASK ((1u << TARGET_BITS) - 1)

#endif
