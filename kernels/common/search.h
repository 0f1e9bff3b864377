// SPDX-License-Identifier: BSD-3-Clause
// Binary search in a sparse row, whose columns ascend.

#ifndef LTCL_SEARCH_H
#define LTCL_SEARCH_H

// The first of the entries j .. end in `column` or a column after it; `end` where there is none.
static inline int entry_from(global const int *columns, int j, int end, int column)
{
    while (j < end) {
        const int half_way = j + (end - j) / 2;
        if (columns[half_way] < column)
            j = half_way + 1;
        else
            end = half_way;
    }
    return j;
}

#endif
