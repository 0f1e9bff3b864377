# SPDX-License-Identifier: BSD-3-Clause
"""Hat functions of many pixels, level by level: sums under them, means by them, and between them.

Node (i, j) of level l stands at pixel (i s, j s), s = 2^l, as `ltcl.operators.Hats` has them. Hats
of a level are products of hats along both sides and add up to 1 at each pixel.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.acquisition.estimation.windows import hat_levels, hats_of_side, nearest


class HatLevels:
    """The hats of all levels over a grid (h, w).

    Attributes
    ----------
    grid : (h, w)
    sizes : list of (rows, columns)
        Nodes of each level.
    first : list of int
        The number of the first node of each level, among those of all, which come last.
    """

    def __init__(self, grid: tuple[int, int]) -> None:
        self.grid = grid
        self.sizes = hat_levels(grid)
        self.first = [0]
        for rows, columns in self.sizes:
            self.first.append(self.first[-1] + rows * columns)

    @property
    def nodes(self) -> int:
        """Number of the nodes of all levels."""
        return self.first[-1]

    def nodes_of(self, level: int) -> int:
        """Number of the nodes of a level."""
        rows, columns = self.sizes[level]
        return rows * columns

    def sums(self, level: int, picture: np.ndarray, power: int = 1) -> np.ndarray:
        """Sums of a picture (h, w) under the hats of a level, or under a power of them."""
        if level == 0:
            return picture
        down, across = self._sides(level)
        if power != 1:
            down = down.power(power)
            across = across.power(power)
        return down @ (across @ picture.T).T

    def sums_from(
        self, level: int, pictures: np.ndarray, power: int = 1, dtype: Any = np.float64
    ) -> np.ndarray:
        """Sums of pictures (frames, h, w) under all hats from a level on, (nodes, frames)."""
        first = self.first[level]
        sums = np.empty((self.nodes - first, len(pictures)), dtype)
        for coarser in range(level, len(self.sizes)):
            nodes = slice(self.first[coarser] - first, self.first[coarser + 1] - first)
            for number, picture in enumerate(pictures):
                sums[nodes, number] = self.sums(coarser, picture, power).ravel()
        return sums

    def between(self, level: int, fine: int, numbers: np.ndarray) -> scipy.sparse.csr_array:
        """Hats of a level at nodes of a finer one, (len(numbers), nodes of the level).

        Values at the nodes of the level are interpolated by it.
        """
        row, column = np.divmod(numbers, self.sizes[fine][1])
        rows, columns = self.sizes[level]
        corners = []
        for node_row, down in _corners(row, level - fine, rows):
            for node_column, across in _corners(column, level - fine, columns):
                corners.append((node_row * columns + node_column, down * across))
        nodes = np.stack([node for node, _ in corners], axis=1)
        shares = np.stack([share for _, share in corners], axis=1)
        places = np.arange(0, nodes.size + 1, len(corners))
        shape = (len(numbers), rows * columns)
        hats = scipy.sparse.csr_array((shares.ravel(), nodes.ravel(), places), shape=shape)
        hats.sum_duplicates()
        return hats

    def at_pixels(self, pixels: np.ndarray) -> scipy.sparse.csr_array:
        """The hats of all levels at some pixels, (len(pixels), nodes)."""
        levels = [self.between(level, 0, pixels) for level in range(len(self.sizes))]
        return scipy.sparse.csr_array(scipy.sparse.hstack(levels, format="csr"))

    def by_scale(self, values: np.ndarray) -> np.ndarray:
        """Values of all nodes, (nodes,), at the pixels: that of the nearest node of each level.

        The result is (levels, h, w) float32.
        """
        planes = np.empty((len(self.sizes), *self.grid), np.float32)
        for level, (rows, columns) in enumerate(self.sizes):
            of_level = values[self.first[level] : self.first[level + 1]].reshape(rows, columns)
            down = nearest(np.arange(self.grid[0]), level)
            across = nearest(np.arange(self.grid[1]), level)
            planes[level] = of_level[np.ix_(down, across)]
        return planes

    def _sides(self, level: int) -> tuple[Any, Any]:
        return self._all_sides[level]

    @cached_property
    def _all_sides(self) -> list[tuple[Any, Any]]:
        sides = []
        for level, (rows, columns) in enumerate(self.sizes):
            down = hats_of_side(self.grid[0], rows, 2**level)
            across = hats_of_side(self.grid[1], columns, 2**level)
            sides.append((down, across))
        return sides


def light_of_scales(hats: HatLevels, variance: np.ndarray) -> np.ndarray:
    """Variances of light at pixels, (levels, h, w), by those of the coefficients of all nodes.

    A hat of level l has 4^l pixels: its light is its coefficient times that, if all are lit.
    """
    planes = hats.by_scale(variance)
    for level, plane in enumerate(planes):
        plane *= 4.0**level
    return planes


def _corners(place: np.ndarray, levels: int, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """The two nodes around places along one side, `levels` coarser, and the share of each."""
    before = place >> levels
    share = (place - (before << levels)) / 2.0**levels
    after = np.minimum(before + 1, count - 1)
    return [(before, 1.0 - share), (after, share)]
