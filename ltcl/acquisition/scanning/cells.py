# SPDX-License-Identifier: BSD-3-Clause
"""Blocks of projector pixels; the quad-tree of cells over them; which cells may be lit together."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ltcl import checks


@dataclass(frozen=True)
class Blocks:
    """The pixels (h, w) of a projector in blocks of side x side, fewer at the right and lower rim.

    Lit together, they give a transport of 1 / side^2 as many columns: entry (i, j) is the mean light in block
    i for unit light from every pixel of block j.

    Attributes
    ----------
    pixels : (h, w)
        Of the projector.
    side : int
        Of a block; 1 leaves all as it is.

    Examples
    --------
    >>> blocks = Blocks((2, 3), 2)
    >>> blocks.grid
    (1, 2)
    >>> blocks.enlarged(np.array([[0.0, 1.0]])).tolist()
    [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]
    >>> blocks.sum(np.array([[1.0, 2.0, 5.0], [3.0, 4.0, 7.0]])).tolist()
    [[10.0, 12.0]]
    """

    pixels: tuple[int, int]
    side: int

    def __post_init__(self) -> None:
        h, w = checks.grid("pixels", self.pixels)
        checks.count("block", self.side, most=max(h, w))

    @property
    def grid(self) -> tuple[int, int]:
        """(h, w) of the blocks."""
        return -(-self.pixels[0] // self.side), -(-self.pixels[1] // self.side)

    def enlarged(self, pattern: np.ndarray) -> np.ndarray:
        """The pattern on the projector's pixels, (h, w)."""
        if self.side == 1:
            return pattern
        h, w = self.pixels
        return np.repeat(np.repeat(pattern, self.side, axis=0)[:h], self.side, axis=1)[:, :w]

    def sum(self, picture: np.ndarray) -> np.ndarray:
        """Sum over every block of a picture (h, w[, c])."""
        if self.side == 1:
            return picture
        for axis in (0, 1):
            starts = np.arange(0, self.pixels[axis], self.side)
            picture = np.add.reduceat(picture, starts, axis=axis)
        return picture


@dataclass(frozen=True, eq=False)
class Cells:
    """The cells of all levels, numbered as by `ltcl.operators.Pyramid`.

    Level 0 is the pixels; a cell of each further level covers 2 x 2 of the one before, fewer at the right and
    lower rim, until one is left; row-major, the finest level first.

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


def colour(starts: np.ndarray, pixels: np.ndarray, count: int) -> np.ndarray:
    """A colour of each of n cells, so that no camera pixel is active in two of one colour (Sen et al. 2005).

    Greedy, the cells with most active pixels first, each into the first colour that has room.

    Parameters
    ----------
    starts : (n + 1,), pixels : (entries,)
        Cell k is active at the camera pixels ``pixels[starts[k]:starts[k + 1]]``.
    count : int
        Of camera pixels.

    Returns
    -------
    (n,) int
        From 0; at least as many as the pixel with most active cells has, which no colouring goes below.

    Examples
    --------
    Cells 0 and 1 share pixel 2, cells 1 and 2 pixel 0:

    >>> colour(np.array([0, 1, 3, 4]), np.array([2, 2, 0, 0]), 3).tolist()
    [1, 0, 1]
    """
    n = len(starts) - 1
    found = np.zeros(n, np.int64)
    taken = np.zeros((0, count), bool)
    used = 0
    for cell in np.argsort(-np.diff(starts), kind="stable"):
        own = pixels[starts[cell] : starts[cell + 1]]
        free = np.flatnonzero(~taken[:used, own].any(axis=1))
        if len(free) == 0 and used == len(taken):
            taken = np.concatenate([taken, np.zeros((max(8, used), count), bool)])
        place = int(free[0]) if len(free) else used
        used = max(used, place + 1)
        taken[place, own] = True
        found[cell] = place
    return found
