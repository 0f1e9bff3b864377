# SPDX-License-Identifier: BSD-3-Clause
"""A quad-tree of sums over the cells of all levels (`kernels/pyramid.cl`)."""

from __future__ import annotations

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.operators.bases import Basis, launch_grid, launch_group

# Cells of a level up to which one launch does all the levels from it on.
PYRAMID = "pyramid"
SMALL_LEVEL_PIXELS = 4096


class Pyramid(Basis):
    """A quad-tree: sums over the cells of all levels, (M, N), the finest first.

    Level 0 is the pixels; a cell of each further level covers 2 x 2 of the one before, fewer at the
    edges, until one cell is left: the basis of transports that were scanned adaptively. Not
    orthonormal.

    Parameters
    ----------
    device : Device
    grid : (h, w)

    Attributes
    ----------
    cells : tuple of (rows, columns)
        Of each level, whose cells are row-major one behind the other.

    Examples
    --------
    Pixels, then the sums 0 + 1 + 3 + 4 and 2 + 5, then all:

    >>> import ltcl, numpy
    >>> from ltcl.operators import Pyramid
    >>> W = Pyramid(ltcl.open_device(), (2, 3))
    >>> (W @ numpy.arange(6.0)).tolist()
    [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 8.0, 7.0, 15.0]
    """

    orthonormal = False
    isometric = False

    def __init__(self, device: Device, grid: tuple[int, int]) -> None:
        h, w = checks.grid("grid", grid)
        levels = (max(h, w) - 1).bit_length() + 1
        cells = []
        for level in range(levels):
            size = 2**level
            cells.append((-(-h // size), -(-w // size)))
        self.cells = tuple(cells)
        self._sizes = [rows * columns for rows, columns in cells]
        super().__init__(device, grid, PYRAMID, sum(self._sizes))

    def _transform(
        self, x: Array, out: Array, a: float, b: float, y: Array, transpose: bool
    ) -> None:
        if transpose:
            self._spread(x, out, a, b, y)
        else:
            self._gather(x, out, a, b, y)

    def _spread(self, x: Array, out: Array, a: float, b: float, y: Array) -> None:
        """Queue the transpose: of each pixel, the sum of the cells that it lies in."""
        kernel, pieces = self._kernel("pyramid", "spread", x.columns)
        height, width = self.grid
        launch_grid(
            kernel,
            pieces,
            self.grid,
            height=height,
            width=width,
            levels=len(self.cells),
            k=x.columns,
            a=a,
            b=b,
            x=x,
            y=y,
            out=out,
        )

    def _gather(self, x: Array, out: Array, a: float, b: float, y: Array) -> None:
        """Queue the sums of all cells: large levels one by one, then the others in one launch."""
        kernel, pieces = self._kernel("pyramid", "gather", x.columns)
        height, width = self.grid
        levels = len(self.cells)
        arguments = {
            "height": height,
            "width": width,
            "k": x.columns,
            "a": a,
            "b": b,
            "x": x,
            # Wide loads reach a spare cell behind each level.
            "sums": self.device.empty((self.shape[0] + levels) * x.columns),
            "y": y,
            "out": out,
        }
        large = sum(size > SMALL_LEVEL_PIXELS for size in self._sizes)
        for level in range(large):
            cells = self.cells[level]
            launch_grid(kernel, pieces, cells, first_level=level, end_level=level + 1, **arguments)
        launch_group(kernel, pieces, first_level=large, end_level=levels, **arguments)
