# SPDX-License-Identifier: BSD-3-Clause
"""Sums of pixels at all scales: over cells of a quad-tree, or under hat functions.

Kernels: `kernels/pyramid.cl`, `kernels/hats.cl`, which take the same arguments.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.device.kernels import Queued, in_order
from ltcl.operators import bases
from ltcl.operators.bases import Basis, bind_grid, bind_group
from ltcl.operators.epilogue import Epilogue

PYRAMID = "pyramid"
HATS = "hats"


class MultiscaleSums(Basis):
    """Sums of pixels at all scales, (M, N), the finest first; level 0 is the pixels.

    Subclasses set `file`, whose kernels make them.

    Attributes
    ----------
    levels : tuple of (rows, columns)
        Sums of each level, row-major, one level behind the other.
    """

    file: ClassVar[str]
    orthonormal = False
    isometric = False

    def __init__(
        self, device: Device, grid: tuple[int, int], levels: Sequence[tuple[int, int]]
    ) -> None:
        self.levels = tuple(levels)
        self._sizes = [rows * columns for rows, columns in levels]
        super().__init__(device, grid, self.file, sum(self._sizes))

    def _bind_transform(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> Queued:
        return self.bind_levels(x, out, epilogue, transpose, self.scratch(x.columns))

    def scratch(self, columns: int) -> Array:
        """Room for the sums of all levels; wide loads reach a spare one behind each level."""
        return self.device.empty((sum(self._sizes) + len(self.levels), columns))

    def bind_levels(
        self,
        x: Array,
        out: Array,
        epilogue: Epilogue,
        transpose: bool,
        sums: Array,
        first_level: int = 0,
    ) -> Queued:
        """The launches of all levels from one on: large ones one by one, the others in one.

        Sums are gathered from the finest level on, and spread from the coarsest on. `out` then has
        the sums of these levels alone; what is spread to the finest of them is in `sums`, which
        has those of level l behind l spare ones.
        """
        name = "spread" if transpose else "gather"
        kernel, pieces = self._kernel(self.file, name, x.columns)
        height, width = self.grid
        count = len(self.levels)
        arguments: dict[str, Any] = {
            "height": height,
            "width": width,
            "k": x.columns,
            "a": epilogue.a,
            "b": epilogue.b,
            "x": x,
            "sums": sums,
            "y": epilogue.operand(x),
            "out": out,
        }
        if transpose:
            arguments["levels"] = count
        small = bases.small_level_pixels(self.device)
        large = max(first_level, sum(size > small for size in self._sizes))
        launches: list[Queued] = []
        for level in range(first_level, large):
            levels = {"first_level": level, "end_level": level + 1}
            launches.append(bind_grid(kernel, pieces, self.levels[level], **levels, **arguments))
        if large < count:
            rest = {"first_level": large, "end_level": count}
            launches.append(bind_group(kernel, pieces, **rest, **arguments))
        if transpose:
            launches.reverse()
        return in_order(launches)


class Pyramid(MultiscaleSums):
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
    levels : tuple of (rows, columns)
        Cells of each level, row-major, one level behind the other.

    Examples
    --------
    Pixels, then the sums 0 + 1 + 3 + 4 and 2 + 5, then all:

    >>> import ltcl, numpy
    >>> from ltcl.operators import Pyramid
    >>> W = Pyramid(ltcl.open_device(), (2, 3))
    >>> (W @ numpy.arange(6.0)).tolist()
    [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 8.0, 7.0, 15.0]
    """

    file = PYRAMID

    def __init__(self, device: Device, grid: tuple[int, int]) -> None:
        h, w = checks.grid("grid", grid)
        cells = []
        for level in range((max(h, w) - 1).bit_length() + 1):
            size = 2**level
            cells.append((-(-h // size), -(-w // size)))
        super().__init__(device, (h, w), cells)


class Hats(MultiscaleSums):
    """Sums under the hat functions of all levels, (M, N), the finest first.

    Node (i, j) of level l stands at pixel (i s, j s), s = 2^l, and its hat is bilinear:
    ``max(0, 1 - |row / s - i|) max(0, 1 - |column / s - j|)``. Level 0 is the pixels; on the last,
    no side has more than two nodes. Sums of hats of one level are all pictures that are bilinear
    between its nodes: the basis of transports that are estimated from pictures (`ltcl.fit`). Not
    orthonormal.

    Parameters
    ----------
    device : Device
    grid : (h, w)

    Attributes
    ----------
    levels : tuple of (rows, columns)
        Nodes of each level, row-major, one level behind the other.

    Examples
    --------
    Pixels, then hats of width 2 at pixel 0, with half of pixel 1, and at pixel 2:

    >>> import ltcl, numpy
    >>> from ltcl.operators import Hats
    >>> W = Hats(ltcl.open_device(), (1, 3))
    >>> (W @ numpy.array([1.0, 4.0, 10.0])).tolist()
    [1.0, 4.0, 10.0, 3.0, 12.0]
    """

    file = HATS

    def __init__(self, device: Device, grid: tuple[int, int]) -> None:
        h, w = checks.grid("grid", grid)
        super().__init__(device, (h, w), hat_levels((h, w)))


def hat_levels(grid: tuple[int, int]) -> list[tuple[int, int]]:
    """Nodes (rows, columns) of the hats of each level over a grid.

    >>> hat_levels((4, 9))
    [(4, 9), (3, 5), (2, 3), (2, 2)]
    """
    h, w = grid
    levels = [(h, w)]
    while max(h, w) > 2:
        h = h // 2 + 1
        w = w // 2 + 1
        levels.append((h, w))
    return levels
