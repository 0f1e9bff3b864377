# SPDX-License-Identifier: BSD-3-Clause
"""Where the tiles of a sparse matrix lie: `width` neighbouring columns of a row under one place.

Tiles of a row are laid greedily from left to right, each beginning at the first nonzero that none before has
covered: no cover has fewer. Places take 16 bits: where there are more columns, tiles begin at multiples of a
`granule`, and rows are cut in `pages` of 65536 granules. Only where pointers of so many pages weighed more
than longer places, these have 32 bits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl.errors import InputError

WIDTHS = (1, 8, 16)
PLACES = 1 << 16  # in a page
_PIECE = 1 << 22  # nonzeros handled at once


@dataclass(frozen=True)
class Layout:
    """How places are counted in (M, N): tile columns are min((page * PLACES + place) * granule, last)."""

    width: int
    granule: int
    pages: int
    long: bool

    def last(self, columns: int) -> int:
        """The last column at which a tile may begin, so that it ends within the matrix."""
        return max(columns - self.width, 0)

    @property
    def place(self) -> type[np.generic]:
        """The type of places."""
        return np.int32 if self.long else np.uint16

    def nbytes(self, rows: int, tiles: int) -> int:
        """Bytes of pointers and places."""
        return 4 * (rows * self.pages + 1) + (4 if self.long else 2) * tiles


@dataclass(frozen=True)
class Cover:
    """Tiles that hold all nonzeros: rows and first columns, (tiles,), and the tile of each nonzero (nnz,)."""

    shape: tuple[int, int]
    layout: Layout
    rows: np.ndarray
    columns: np.ndarray
    tile: np.ndarray

    def nbytes(self, itemsize: int) -> int:
        """Bytes of pointers, places and numbers of `itemsize` bytes, without scales of rows."""
        tiles = len(self.rows)
        return self.layout.nbytes(self.shape[0], tiles) + tiles * self.layout.width * itemsize


def cover(matrix: Any, width: int) -> Cover:
    """The fewest tiles that hold the nonzeros of a checked `csr_array`, in the layout of fewest bytes.

    A matrix of fewer than `width` columns gets narrower tiles, for none may reach beyond its end.

    >>> import scipy.sparse
    >>> found = cover(scipy.sparse.csr_array([[0] * 3 + [1] * 9 + [0] * 8]), 8)
    >>> found.columns.tolist(), found.tile.tolist()
    ([3, 11], [0, 0, 0, 0, 0, 0, 0, 0, 1])
    """
    if width not in WIDTHS:
        raise InputError(f"width is {width!r}; it must be one of {', '.join(map(str, WIDTHS))}")
    rows, columns = matrix.shape
    width = max(w for w in WIDTHS if w <= max(min(width, columns), 1))
    short = _short(columns, width)
    found = _cover(matrix, short)
    long = Layout(width, 1, 1, long=True)
    tiles = len(found.rows)
    # Finer granules never need more tiles, so this is a fair guess of what longer places would take.
    if short.nbytes(rows, tiles) > long.nbytes(rows, tiles):
        return _cover(matrix, long)
    return found


def _short(columns: int, width: int) -> Layout:
    granule = 1
    while granule < width and granule * PLACES < columns:
        granule *= 2
    return Layout(width, granule, max(-(-columns // (granule * PLACES)), 1), long=False)


def _cover(matrix: Any, layout: Layout) -> Cover:
    counts = np.diff(matrix.indptr)
    row = np.repeat(np.arange(matrix.shape[0]), counts)
    columns = matrix.indices.astype(np.int64)
    begins = np.minimum(columns // layout.granule * layout.granule, layout.last(matrix.shape[1]))
    leads = np.ones(len(columns), bool) if layout.width == 1 else _leads(matrix, begins, layout.width)
    return Cover(matrix.shape, layout, row[leads], begins[leads], np.cumsum(leads) - 1)


def _leads(matrix: Any, begins: np.ndarray, width: int) -> np.ndarray:
    """Which nonzeros open a tile, (nnz,), when the tile that a nonzero opens begins at `begins`."""
    leads = np.zeros(len(begins), bool)
    pointers, start = matrix.indptr.astype(np.int64), 0
    while start < matrix.shape[0]:
        stop = max(int(np.searchsorted(pointers, pointers[start] + _PIECE, side="right")) - 1, start + 1)
        piece = slice(pointers[start], pointers[stop])
        _lead(
            leads[piece],
            pointers[start : stop + 1] - pointers[start],
            matrix.indices[piece],
            begins[piece] + width,
        )
        start = stop
    return leads


def _lead(leads: np.ndarray, pointers: np.ndarray, columns: np.ndarray, ends: np.ndarray) -> None:
    """The same for some rows; `ends` is the first column behind the tile that a nonzero opens."""
    row = np.repeat(np.arange(len(pointers) - 1), np.diff(pointers))
    line = int(ends.max(initial=0)) + 1  # rows one behind the other, further apart than any tile reaches
    behind = np.searchsorted(
        row * line + columns, row * line + ends
    )  # the first nonzero that it does not hold
    filled = np.diff(pointers) > 0
    at, stop = pointers[:-1][filled], pointers[1:][filled]
    while at.size:  # a tile further in all rows
        leads[at] = True
        at = behind[at]
        left = at < stop
        at, stop = at[left], stop[left]
