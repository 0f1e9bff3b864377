# SPDX-License-Identifier: BSD-3-Clause
"""Columns of T, batch by batch, into a store: what is committed is never photographed again.

A batch is a block of columns of the store: pixels that follow each other. Its photographs depend on nothing
but the calibration, so that a scan which was stopped goes on with the next block.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import scipy.sparse

from ltcl.acquisition.scanning import thresholds
from ltcl.acquisition.scanning.codes import Code
from ltcl.acquisition.scanning.pictures import UNKNOWN, Pictures
from ltcl.store import BlockStore


def scan(
    pictures: Pictures, code: Code, store: BlockStore, sigmas: float, tell: Callable[[int], None]
) -> None:
    """Photograph, decode and commit every block of columns that is not in the store.

    Parameters
    ----------
    sigmas : float
        Of `thresholds.keep`; 0 keeps every entry.
    tell : function of an int
        Told the patterns that were photographed: first those of an earlier run, 0 of none, then each one.
    """
    missing = sorted({block for _, block in store.missing("columns")})
    lit = {block: _count(code, store, block) for block in range(store.layout.blocks("columns"))}
    tell(sum(count for block, count in lit.items() if block not in missing))
    pictures.announce(
        (p for block in missing for p in _lit(pictures.grid, code, store, block)), code.count(code.size)
    )
    for block in missing:
        _batch(pictures, code, store, block, sigmas, lambda: tell(1))


def _count(code: Code, store: BlockStore, block: int) -> int:
    start, stop = store.layout.span(block, "columns")
    return code.count(stop - start)


def _batch(
    pictures: Pictures,
    code: Code,
    store: BlockStore,
    block: int,
    sigmas: float,
    tell: Callable[[], None],
) -> None:
    start, stop = store.layout.span(block, "columns")
    taken = pictures.take(_lit(pictures.grid, code, store, block), tell)
    for c in range(pictures.channels):
        value, variance = (np.stack([part[k][c] for part in taken]) for k in (0, 1))
        x, v = (part[: stop - start] for part in code.decode(value, variance, pictures.ambient[c]))
        store.write(c, block, *_sparse(x, v, pictures, sigmas))


def _lit(grid: tuple[int, int], code: Code, store: BlockStore, block: int) -> Iterator[np.ndarray]:
    """The patterns (h, w) of a block."""
    start, stop = store.layout.span(block, "columns")
    for on in code.patterns(stop - start):
        pattern = np.zeros(grid, np.float32)
        pattern.flat[start + np.flatnonzero(on)] = 1.0
        yield pattern


def _sparse(
    x: np.ndarray, v: np.ndarray, pictures: Pictures, sigmas: float
) -> tuple[scipy.sparse.csr_array, np.ndarray]:
    """What of columns (k, M) is kept, and its variance; 0, and NaN, where nothing told it."""
    kept = thresholds.keep(x, v, pictures.grid, sigmas) & pictures.seen
    ends = np.concatenate([[0], np.cumsum(np.count_nonzero(kept, axis=1))])
    variance = v[kept]
    known = variance < 1e-3 * UNKNOWN
    values = np.where(known, x[kept], 0.0).astype(np.float32)
    matrix = scipy.sparse.csr_array((values, np.nonzero(kept)[1].astype(np.int32), ends), shape=x.shape)
    return matrix, np.where(known, variance, np.nan)
