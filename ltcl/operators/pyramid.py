# SPDX-License-Identifier: BSD-3-Clause
"""A quad-tree over the grid: the basis of transports that were scanned adaptively (`kernels/pyramid.cl`).

Where all pixels of a cell give nearly the same light, it is measured once, with the cell lit as a whole. With
what was measured (for one pixel of it) as columns of a core C, T = C W: W sums the pattern in every cell.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.operators.base import MOST, group_of, lanes_of
from ltcl.operators.bases import Basis


class Pyramid(Basis):
    """Sums over the cells of all levels, (M, N), the finest first; the transpose spreads cells over pixels.

    Level 0 is the pixels; a cell of each further level covers 2 x 2 of the one before, fewer at the edges,
    until one cell is left. Not orthonormal: each pixel is in one cell of every level.

    Parameters
    ----------
    device : Device
    grid : (h, w)

    Attributes
    ----------
    cells : tuple of (rows, columns)
        Of each level, ceil(h / 2^level) x ceil(w / 2^level).
    offsets : (levels,) int64
        The coefficient at which each level begins; cells are row-major within it.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Pyramid
    >>> W = Pyramid(ltcl.open_device(), (2, 3))
    >>> W.cells
    ((2, 3), (1, 2), (1, 1))
    >>> (W @ numpy.arange(6.0))[W.index(1, 0, [0, 1])].tolist()  # 0 + 1 + 3 + 4 and 2 + 5
    [8.0, 7.0]
    """

    orthonormal = False
    isometric = False

    def __init__(self, device: Device, grid: tuple[int, int]) -> None:
        self.cells = _cells(checks.grid("grid", grid))
        super().__init__(device, grid, "pyramid", sum(h * w for h, w in self.cells))
        self.offsets = np.cumsum([0] + [h * w for h, w in self.cells[:-1]])
        self._sums = device.empty(0)
        self._lock = threading.Lock()  # a product must have the sums to itself while it is queued

    def index(self, level: int, row: Any, column: Any) -> Any:
        """The coefficient of cell (row, column) of a level; of many where these are arrays."""
        return self.offsets[level] + np.asarray(row) * self.cells[level][1] + np.asarray(column)

    @property
    def nbytes(self) -> int:
        """Bytes of the scratch."""
        return self._sums.nbytes

    def diagonal(self) -> np.ndarray:
        """1 of every pixel, (N,) float64: the finest level comes first."""
        return np.ones(self.shape[1])

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        if x.columns == 0:
            return
        levels = range(len(self.cells))
        name, levels = ("spread", reversed(levels)) if transpose else ("gather", levels)
        with self._lock:
            needed = (self.shape[0] + len(self.cells)) * x.columns  # a spare cell a level
            if self._sums.size < needed:
                self._sums = self.device.empty(needed)
            for level in levels:
                self._launch(name, level, scale, int(add is not None), x, self._sums, add or out, out)

    def _launch(self, name: str, level: int, *arguments: Any) -> None:
        (h, w), k = self.cells[level], arguments[-1].columns
        lanes = lanes_of(k)
        kernel = self.device.kernel("pyramid", f"pyramid_{name}", K=lanes)
        pieces = -(-k // lanes)
        if self.device.is_cpu:
            size, group = (1, min(w, -(-64 // h)), min(h, MOST)), (1, 1, 1)
        else:
            size, group = (pieces, min(w, MOST), min(h, MOST)), (*group_of(pieces), 1)
        kernel(size, group, *self.grid, level, len(self.cells), k, *arguments)


def _cells(grid: tuple[int, int]) -> tuple[tuple[int, int], ...]:
    levels = (max(grid) - 1).bit_length() + 1
    return tuple((-(-grid[0] // 2**level), -(-grid[1] // 2**level)) for level in range(levels))
