# SPDX-License-Identifier: BSD-3-Clause
"""Cut a matrix into slabs of whole rows, each below the device's largest buffer."""

from __future__ import annotations

import numpy as np

from ltcl import checks
from ltcl.device import Device
from ltcl.device.device import SPARE_BYTES
from ltcl.errors import MemoryLimitError


def cut(row_bytes: np.ndarray, limit: int, what: str) -> list[tuple[int, int]]:
    """Row ranges (start, stop), each of at most `limit` bytes, as few as possible.

    Parameters
    ----------
    row_bytes : (M,) integers
        Bytes of each row in the largest of the slab's buffers.
    limit : int
        Bytes of the largest buffer.
    what : str
        Names the matrix in the refusal of a single row beyond the limit.

    >>> cut(np.array([4, 4, 4, 4, 4]), 8, "A")
    [(0, 2), (2, 4), (4, 5)]
    """
    ends = np.concatenate([[0], np.cumsum(row_bytes, dtype=np.int64)])
    pieces, start = [], 0
    while start < len(row_bytes):
        stop = int(np.searchsorted(ends, ends[start] + limit, side="right")) - 1
        if stop == start:
            raise MemoryLimitError(
                f"row {start} of {what} has {checks.size(int(row_bytes[start]))}, "
                f"the largest buffer of this device {checks.size(limit)}"
            )
        pieces.append((start, stop))
        start = stop
    return pieces or [(0, 0)]


def largest(device: Device) -> int:
    """Bytes of the largest buffer, and never so many that a 32-bit count of values overflows.

    Kernels count on beyond the end of a row by a work-group or a stretch: room is left for that.
    """
    return min(device.max_allocation - SPARE_BYTES, 4 * ((1 << 31) - 4096))
