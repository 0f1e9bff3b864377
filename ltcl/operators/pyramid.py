# SPDX-License-Identifier: BSD-3-Clause
"""A quad-tree over the grid: the basis of transports that were scanned adaptively (`kernels/pyramid.cl`).

Where all pixels of a cell give nearly the same light, it is measured once, with the cell lit as a whole. With
what was measured (for one pixel of it) as columns of a core C, T = C W: W sums the pattern in every cell.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.operators.bases import Basis, launch_grid, launch_group

_SMALL = 4096  # cells of a level from which on one launch does all the rest


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
        h, w = checks.grid("grid", grid)
        levels = range((max(h, w) - 1).bit_length() + 1)
        self.cells = tuple((-(-h // 2**level), -(-w // 2**level)) for level in levels)
        super().__init__(device, grid, "pyramid", sum(h * w for h, w in self.cells))
        self.offsets = np.cumsum([0] + [h * w for h, w in self.cells[:-1]])

    def index(self, level: int, row: Any, column: Any) -> Any:
        """The coefficient of cell (row, column) of a level; of many where these are arrays."""
        return self.offsets[level] + np.asarray(row) * self.cells[level][1] + np.asarray(column)

    def diagonal(self) -> np.ndarray:
        """1 of every pixel, (N,) float64: the finest level comes first."""
        return np.ones(self.shape[1])

    def _transform(self, x: Array, out: Array, a: float, b: float, y: Array, transpose: bool) -> None:
        k, levels = x.columns, len(self.cells)
        kernel, pieces = self._kernel("pyramid", "spread" if transpose else "gather", k)
        if transpose:
            launch_grid(kernel, pieces, *self.grid, *self.grid, levels, k, a, b, x, y, out)
            return
        sums = self.device.empty((self.shape[0] + levels) * k)  # a spare cell a level
        large = sum(h * w > _SMALL for h, w in self.cells)
        for level in range(large):
            arguments = (*self.grid, level, level + 1, k, a, b, x, sums, y, out)
            launch_grid(kernel, pieces, *self.cells[level], *arguments)
        launch_group(kernel, pieces, *self.grid, large, levels, k, a, b, x, sums, y, out)
