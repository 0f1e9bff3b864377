# SPDX-License-Identifier: BSD-3-Clause
"""A quad-tree over the pixels, on the host: cells, their children, sums over them.

Numbered as by `ltcl.operators.Pyramid`: level 0 is the pixels, a cell of each further level covers 2 x 2 of
the one before, fewer at the right and lower rim, until one is left; row-major, the finest level first.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ltcl import checks
from ltcl.acquisition.scanning.block import Blocks


@dataclass(frozen=True, eq=False)
class Cells:
    """The cells of all levels.

    Attributes
    ----------
    grid : (h, w)
    sizes : tuple of (rows, columns)
        Of each level.
    offsets : tuple of int
        The number of the first cell of each level; and of all cells at the end.

    Examples
    --------
    >>> cells = Cells((2, 3))
    >>> cells.sizes, cells.offsets
    (((2, 3), (1, 2), (1, 1)), (0, 6, 8, 9))
    >>> cells.sums(np.arange(6.0))[6:].tolist()
    [8.0, 7.0, 15.0]
    >>> cells.children(1, np.array([0, 1])).tolist()  # of cell 0 four, of the one at the rim two
    [[0, 2], [1, -1], [3, 5], [4, -1]]
    """

    grid: tuple[int, int]
    sizes: tuple[tuple[int, int], ...] = field(init=False)
    offsets: tuple[int, ...] = field(init=False)

    def __post_init__(self) -> None:
        h, w = checks.grid("grid", self.grid)
        levels = (max(h, w) - 1).bit_length() + 1
        sizes = tuple((-(-h // 2**level), -(-w // 2**level)) for level in range(levels))
        ends = np.cumsum([rows * columns for rows, columns in sizes])
        object.__setattr__(self, "sizes", sizes)
        object.__setattr__(self, "offsets", (0, *(int(end) for end in ends)))

    @property
    def top(self) -> int:
        """The level of the one cell that is everything."""
        return len(self.sizes) - 1

    def areas(self, level: int) -> np.ndarray:
        """Pixels of each cell of a level."""
        return self._blocks(level).sum(np.ones(self.grid)).ravel()

    def sums(self, x: np.ndarray) -> np.ndarray:
        """Sums of (N,) over the cells of all levels."""
        parts = [np.asarray(x, np.float64).reshape(self.grid)]
        for size in self.sizes[:-1]:
            parts.append(Blocks(size, 2).sum(parts[-1]))
        return np.concatenate([part.ravel() for part in parts])

    def children(self, level: int, cells: np.ndarray) -> np.ndarray:
        """(4, n) cells of `level` - 1: upper left, upper right, lower left, lower right; or -1."""
        (_, columns), (h, w) = self.sizes[level], self.sizes[level - 1]
        row, column = np.divmod(cells, columns)
        found = []
        for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
            r, c = 2 * row + down, 2 * column + right
            found.append(np.where((r < h) & (c < w), r * w + c, -1))
        return np.stack(found)

    def pattern(self, level: int, cells: np.ndarray) -> np.ndarray:
        """(h, w) float32, 1 on the pixels of some cells of a level."""
        lit = np.zeros(self.sizes[level], np.float32)
        lit.flat[cells] = 1.0
        return self._blocks(level).enlarged(lit)

    def of_pixels(self, level: int) -> np.ndarray:
        """(N,) the cell of a level that each pixel is in, counted over all levels."""
        rows, columns = (np.arange(n) >> level for n in self.grid)
        return self.offsets[level] + (rows[:, None] * self.sizes[level][1] + columns).ravel()

    def _blocks(self, level: int) -> Blocks:
        return Blocks(self.grid, min(1 << level, max(self.grid)))
