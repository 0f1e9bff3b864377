# SPDX-License-Identifier: BSD-3-Clause
"""A quad-tree of sums over the cells of all levels (`kernels/pyramid.cl`)."""

from __future__ import annotations

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.operators.bases import Basis, launch_grid, launch_group

SMALL_LEVEL_PIXELS = 4096  # cells of a level from which on one launch does all the rest


class Pyramid(Basis):
    """A quad-tree: sums over the cells of all levels, (M, N), the finest first (`kernels/pyramid.cl`).

    Level 0 is the pixels; a cell of each further level covers 2 x 2 of the one before, fewer at the
    edges, until one cell is left: the basis of transports that were scanned adaptively. Not
    orthonormal. `cells` holds (rows, columns) of each level, whose cells are row-major one behind
    the other.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Pyramid
    >>> W = Pyramid(ltcl.open_device(), (2, 3))
    >>> (W @ numpy.arange(6.0)).tolist()  # pixels, then 0 + 1 + 3 + 4 and 2 + 5, then all
    [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 8.0, 7.0, 15.0]
    """

    orthonormal = False
    isometric = False

    def __init__(self, device: Device, grid: tuple[int, int]) -> None:
        h, w = checks.grid("grid", grid)
        levels = range((max(h, w) - 1).bit_length() + 1)
        self.cells = tuple((-(-h // 2**level), -(-w // 2**level)) for level in levels)
        super().__init__(device, grid, "pyramid", sum(h * w for h, w in self.cells))

    def _transform(
        self, x: Array, out: Array, a: float, b: float, y: Array, transpose: bool
    ) -> None:
        k, levels = x.columns, len(self.cells)
        kernel, pieces = self._kernel("pyramid", "spread" if transpose else "gather", k)
        if transpose:
            launch_grid(kernel, pieces, *self.grid, *self.grid, levels, k, a, b, x, y, out)
            return
        sums = self.device.empty((self.shape[0] + levels) * k)  # a spare cell a level
        large = sum(h * w > SMALL_LEVEL_PIXELS for h, w in self.cells)
        for level in range(large):
            arguments = (*self.grid, level, level + 1, k, a, b, x, sums, y, out)
            launch_grid(kernel, pieces, *self.cells[level], *arguments)
        launch_group(kernel, pieces, *self.grid, large, levels, k, a, b, x, sums, y, out)
