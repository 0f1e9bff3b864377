# SPDX-License-Identifier: BSD-3-Clause
"""The functions in which a row of T is written: its own pixel, and hats that widen with distance.

Light between two places varies with their distance: what a camera pixel sees of its neighbours
changes from pixel to pixel, what it sees of the far side of the scene is smooth. So its row is a
sum of hat functions (`ltcl.operators.Hats`), of each level only those around the pixel:

    level 0    pixels, up to REACH away
    level l    hats of width 2^l, up to REACH of them away
    the last   the whole picture
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks

# Hats to each side of a pixel, of each level.
REACH = 2
# Hats of the next coarser stage to each side, where T is refined.
COARSE_REACH = 1
# Pixels up to which all rows are estimated whole.
MAX_WHOLE_PIXELS = 1 << 13
# Bytes of a function of a row while it is learned: mean, variance, node, and what is made of them.
ROW_BYTES = 40
# Bytes of a channel of a pixel while T is refined, but for its pictures.
PIXEL_BYTES = 1000


def hat_levels(grid: tuple[int, int]) -> list[tuple[int, int]]:
    """Nodes (rows, columns) of each level over a grid, as `ltcl.operators.Hats` has them.

    It stands here once more, as acquisition needs no device, and operators do.

    >>> hat_levels((4, 9))
    [(4, 9), (3, 5), (2, 3), (2, 2)]
    """
    height, width = grid
    levels = [(height, width)]
    while max(height, width) > 2:
        height = height // 2 + 1
        width = width // 2 + 1
        levels.append((height, width))
    return levels


def functions_of_row(grid: tuple[int, int]) -> int:
    """Number of functions in the window of a pixel.

    >>> functions_of_row((4, 9)), functions_of_row((64, 64))
    (40, 125)
    """
    count = 0
    for rows, columns in hat_levels(grid):
        if max(rows, columns) <= 2 * REACH + 1:
            return count + rows * columns
        count += (2 * REACH + 1) ** 2
    return count


def check_memory(grid: tuple[int, int], channels: int) -> None:
    """Refuse a grid whose rows do not fit the memory of the host."""
    height, width = grid
    pixels = height * width
    if pixels > MAX_WHOLE_PIXELS:
        needed = pixels * channels * PIXEL_BYTES
    else:
        needed = pixels * functions_of_row(grid) * (channels + 1) * ROW_BYTES
    checks.fits_host(f"estimating T of {height} x {width} pixels", needed)


def numbers_of_row(grid: tuple[int, int]) -> int:
    """Numbers that the transport keeps of each row, about.

    >>> numbers_of_row((64, 64)), numbers_of_row((256, 512))
    (125, 34)
    """
    if grid[0] * grid[1] > MAX_WHOLE_PIXELS:
        return (2 * REACH + 1) ** 2 + (2 * COARSE_REACH + 1) ** 2
    return functions_of_row(grid)


def hat_matrix(grid: tuple[int, int]) -> scipy.sparse.csr_array:
    """W (nodes, N) of `ltcl.operators.Hats`: the hats of all levels on the pixels."""
    levels = []
    for level, (height, width) in enumerate(hat_levels(grid)):
        down = hats_of_side(grid[0], height, 2**level)
        across = hats_of_side(grid[1], width, 2**level)
        levels.append(scipy.sparse.kron(down, across, format="csr"))
    return scipy.sparse.csr_array(scipy.sparse.vstack(levels, format="csr"))


def hats_of_side(pixels: int, nodes: int, width: int) -> scipy.sparse.csr_array:
    """Hats along one side, (nodes, pixels)."""
    distance = np.abs(np.arange(pixels) / width - np.arange(nodes)[:, None])
    return scipy.sparse.csr_array(np.maximum(1.0 - distance, 0.0))


@dataclass(frozen=True, eq=False, kw_only=True)
class Windows:
    """The hats of each pixel's row, q of them, in groups of the same level and distance.

    Attributes
    ----------
    grid : (h, w)
    nodes : (N, q) int32
        Their numbers among all nodes; `absent` where there is none, beyond the rim.
    absent : int
        Number of all nodes.
    group : (q,)
        Group of each function; group 0 is the pixel itself.
    area : (groups,)
        Pixels under a hat of the group.
    """

    grid: tuple[int, int]
    nodes: np.ndarray
    absent: int
    group: np.ndarray
    area: np.ndarray

    @classmethod
    def of(cls, grid: tuple[int, int]) -> Windows:
        """The windows of all pixels of a grid."""
        levels = hat_levels(grid)
        builder = _Builder(grid)
        for level, size in enumerate(levels):
            if max(size) <= 2 * REACH + 1:
                builder.add_all(level, size)
                break
            builder.add_window(level, size)
        hats = sum(rows * columns for rows, columns in levels)
        return builder.windows(hats)

    @property
    def groups(self) -> int:
        """Number of groups."""
        return len(self.area)

    def every(self, step: int) -> tuple[Windows, np.ndarray]:
        """The windows of every `step`-th pixel along both sides, and their numbers."""
        height, width = self.grid
        numbers = np.arange(height * width).reshape(self.grid)[::step, ::step]
        chosen = numbers.ravel()
        return replace(self, grid=numbers.shape, nodes=self.nodes[chosen]), chosen


class _Builder:
    """Collects the functions of all levels."""

    def __init__(self, grid: tuple[int, int]) -> None:
        self.grid = grid
        self.row, self.column = np.indices(grid).reshape(2, -1)
        # Nodes of the levels before.
        self.first = 0
        self.nodes: list[np.ndarray] = []
        self.group: list[int] = []
        self.area: list[float] = []

    def add_window(self, level: int, size: tuple[int, int]) -> None:
        """Add the hats of a level around each pixel."""
        first_group = len(self.area)
        rings = range(REACH + 1)
        self.area += [4.0**level for _ in rings]
        height, width = size
        middle_row = nearest(self.row, level)
        middle_column = nearest(self.column, level)
        for down in range(-REACH, REACH + 1):
            for across in range(-REACH, REACH + 1):
                row = middle_row + down
                column = middle_column + across
                is_there = (row >= 0) & (row < height) & (column >= 0) & (column < width)
                node = self.first + row * width + column
                self.nodes.append(np.where(is_there, node, -1))
                self.group.append(first_group + max(abs(down), abs(across)))
        self.first += height * width

    def add_all(self, level: int, size: tuple[int, int]) -> None:
        """Add all hats of a level; those of level 0 but the pixel itself, which is a group."""
        count = size[0] * size[1]
        pixels = len(self.row)
        if level == 0:
            # A picture of a few pixels: each is a hat, and the pixel itself comes first.
            self.area += [1.0, 1.0]
            own = np.arange(pixels)
            for step in range(count):
                self.nodes.append((own + step) % count)
                self.group.append(min(step, 1))
        else:
            group = len(self.area)
            self.area.append(4.0**level)
            for node in range(count):
                self.nodes.append(np.full(pixels, self.first + node))
                self.group.append(group)
        self.first += count

    def windows(self, absent: int) -> Windows:
        """The windows, `absent` being the number of all nodes."""
        nodes = np.stack(self.nodes, axis=1)
        nodes = np.where(nodes < 0, absent, nodes).astype(np.int32)
        return Windows(
            grid=self.grid,
            nodes=nodes,
            absent=absent,
            group=np.array(self.group),
            area=np.array(self.area),
        )


def nearest(pixel: np.ndarray, level: int) -> np.ndarray:
    """The number of the node of a level that is nearest to a pixel, along one side."""
    half = (1 << level) >> 1
    return (pixel + half) >> level


def sums_under_hats(W: Any, patterns: Sequence[np.ndarray]) -> np.ndarray:
    """Sums of patterns (N,) under all hats, (nodes + 1, patterns), the last of them 0: `absent`."""
    sums = np.zeros((W.shape[0] + 1, len(patterns)))
    sums[:-1] = W @ np.stack(patterns, axis=1)
    return sums
