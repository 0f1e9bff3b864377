# SPDX-License-Identifier: BSD-3-Clause
"""Columns of T, batch by batch, into a store: what is committed is never photographed again.

A batch is a block of columns of the store: pixels that follow each other. Its photographs depend on nothing
but the calibration, so that a scan which was stopped goes on with the next block.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np
import scipy.sparse

from ltcl.acquisition.scanning import thresholds
from ltcl.acquisition.scanning.hadamard import Hadamard
from ltcl.acquisition.scanning.pictures import UNKNOWN, Pictures
from ltcl.acquisition.scanning.pixel import Pixels
from ltcl.store import BlockStore


class Code(Protocol):
    """How the pixels of a batch are lit, and its columns found: `Pixels`, `Hadamard`."""

    @property
    def size(self) -> int:
        """Pixels of a batch."""
        ...

    def count(self, pixels: int) -> int:
        """Patterns for a batch of so many pixels."""
        ...

    def patterns(self, pixels: int) -> np.ndarray:
        """(patterns, pixels) bool."""
        ...

    def decode(
        self, value: np.ndarray, variance: np.ndarray, ambient: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Columns (pixels or more, M) and their variance."""
        ...


def code_of(strategy: str, grid: tuple[int, int], order: int) -> Code:
    """The code of a strategy: `Hadamard` of "hadamard", else `Pixels`.

    Two batches at least, so that no pattern is white, which the calibration has photographed already.

    >>> code_of("hadamard", (64, 64), 63), code_of("pixel", (4, 4), 63)
    (Hadamard(size=63), Pixels(size=8))
    """
    half = max(1, grid[0] * grid[1] // 2)
    if strategy == "hadamard":
        return Hadamard(min(order, max(1, (1 << (half.bit_length() - 1)) - 1)))
    return Pixels(min(Pixels().size, half))


def patterns(code: Code, n: int) -> int:
    """Patterns for n pixels.

    >>> patterns(Pixels(4), 10)
    13
    """
    whole, rest = divmod(n, code.size)
    return whole * code.count(code.size) + (code.count(rest) if rest else 0)


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
    pictures.announce(p for block in missing for p in _lit(pictures.grid, code, store, block))
    for block in missing:
        _batch(pictures, code, store, block, sigmas, lambda: tell(1))


def _count(code: Code, store: BlockStore, block: int) -> int:
    start, stop = store.layout.span(block, "columns")
    return code.count(stop - start)


def _batch(
    pictures: Pictures, code: Code, store: BlockStore, block: int, sigmas: float, tell: Callable[[], None]
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
