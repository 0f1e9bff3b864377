# SPDX-License-Identifier: BSD-3-Clause
"""Where a sparse matrix is cut for blocked forward substitution: at the diagonal, and into blocks of rows.

The entries below the diagonal within a block are the sequential part of a sweep. They are copied out once,
since a work-item that walks through them finds them close together then.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ltcl.device import Array
from ltcl.operators.csr import CSR
from ltcl.operators.dense import Dense
from ltcl.operators.rows import Slab

_SAMPLE = 2048  # rows looked at to choose a block
_PIECE = 1 << 22  # entries handled at once on the host
_SIZES = tuple(1 << power for power in range(5, 14))
_LAUNCHES = 12e-6  # seconds of the two launches of a block
_ENTRY = {"csr": 1e-9, "dense": 0.3e-9}  # seconds of one entry of a triangle on a CPU
_SLOWER = 50.0  # times that takes longer in a single work-item of a GPU


def best_block(M: CSR | Dense) -> int:
    """Rows of a block so that launches and triangles together take least time: fewer, but larger ones."""
    entry = _ENTRY[M.file] * (1.0 if M.device.is_cpu else _SLOWER)

    def seconds(block: int) -> float:
        return _LAUNCHES * M.shape[0] / block + entry * _inside(M, block)

    return min(_SIZES, key=seconds)


def split(M: CSR, slab: Slab, block: int, scale: float) -> tuple[Array, tuple[Array, Array, Array]]:
    """Cut the rows of a slab.

    Returns
    -------
    middle : Array, (rows,) int32
        First entry of each row right of the diagonal, counted from 0 within the slab.
    inside : tuple of Array
        Pointers (rows + 1,), columns and values of what lies below the diagonal within a block, in `scale`.
    """
    pointers = M.pattern.indptr[slab.first : slab.first + slab.rows + 1]
    middle, counts = pointers[:-1].copy(), np.zeros(slab.rows + 1, np.int64)
    columns: list[np.ndarray] = [np.empty(0, np.int32)]
    values: list[np.ndarray] = [np.empty(0, np.float32)]
    for start, stop in _pieces(pointers):
        row = np.repeat(np.arange(start, stop), np.diff(pointers[start : stop + 1]))
        here = slice(pointers[start], pointers[stop])
        column = M.pattern.indices[here] - slab.first  # so that the diagonal is where column == row
        middle[start:stop] += np.bincount((row - start)[column <= row], minlength=stop - start)
        kept = (column < row) & (column >= row - row % block)
        counts[start + 1 : stop + 1] = np.bincount((row - start)[kept], minlength=stop - start)
        columns.append(M.pattern.indices[here][kept])
        values.append(scale * M.data[here][kept])
    upload = M.device.upload
    inside = (
        upload(np.cumsum(counts), np.int32),
        upload(np.concatenate(columns), np.int32),
        upload(np.concatenate(values)),
    )
    return upload(middle - pointers[0], np.int32), inside


def _pieces(pointers: np.ndarray) -> Iterator[tuple[int, int]]:
    """Ranges of rows with about `_PIECE` entries each, at least one row."""
    start, last = 0, len(pointers) - 1
    while start < last:
        stop = int(np.searchsorted(pointers, pointers[start] + _PIECE, side="right")) - 1
        yield start, (start := min(max(stop, start + 1), last))


def _inside(M: CSR | Dense, block: int) -> float:
    """About how many entries lie below the diagonal within blocks; counted in a sample of sparse rows."""
    n = M.shape[0]
    if isinstance(M, Dense):
        return n * min(block, n) / 2
    step = -(-n // _SAMPLE)
    found = 0
    for row in range(0, n, step):
        columns = M.pattern.indices[M.pattern.indptr[row] : M.pattern.indptr[row + 1]]
        found += int(np.diff(np.searchsorted(columns, (row - row % block, row)))[0])
    return found * step
