# SPDX-License-Identifier: BSD-3-Clause
"""How the rows of a sparse product are cut, so that memory stays bounded whatever its rows hold."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

FILL = 1 << 22  # numbers in the product of one block, at most


def cuts(C: Any) -> Iterator[tuple[int, int]]:
    """Blocks of rows (start, stop) whose product C C has no more than `FILL` numbers, or a single row."""
    n = C.shape[0]
    lengths = np.diff(C.indptr)
    through = np.concatenate([[0], np.cumsum(lengths[C.indices], dtype=np.int64)])
    fill = np.minimum(np.diff(through[C.indptr]), n)
    ends = np.concatenate([[0], np.cumsum(fill)])
    start = 0
    while start < n:
        stop = int(np.searchsorted(ends, ends[start] + FILL, side="right")) - 1
        stop = min(max(stop, start + 1), n)
        yield start, stop
        start = stop
