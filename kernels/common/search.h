// SPDX-License-Identifier: BSD-3-Clause

// The first of the entries j .. end of a sparse row, whose columns ascend, in `column` or after it; else `end`.
static inline int entry_from(global const int *columns, int j, int end, int column)
{
    while (j < end) {
        const int middle = j + (end - j) / 2;
        if (columns[middle] < column)
            j = middle + 1;
        else
            end = middle;
    }
    return j;
}
