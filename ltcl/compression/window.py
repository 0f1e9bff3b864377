# SPDX-License-Identifier: BSD-3-Clause
"""A part of the picture on which bases are tried, where the whole is too large for all of them."""

from __future__ import annotations

import numpy as np

from ltcl.compression.fit import Problem
from ltcl.compression.sources import at_once, cut, source
from ltcl.operators import Dense

SIDE = 64


def pixels(grid: tuple[int, int], side: int | None = None) -> tuple[np.ndarray, tuple[int, int]]:
    """Pixels (n,) of the middle `side` x `side` of a grid, 64 x 64 when not given, and the grid of these.

    >>> pixels((3, 5), 2)[0].tolist()
    [1, 2, 6, 7]
    """
    h, w = (min(size, SIDE if side is None else side) for size in grid)
    top, left = (grid[0] - h) // 2, (grid[1] - w) // 2
    rows, columns = np.arange(top, top + h), np.arange(left, left + w)
    return np.add.outer(rows * grid[1], columns).ravel(), (h, w)


def window(problem: Problem, side: int | None = None) -> Problem:
    """R between the pixels of a window; `problem` itself where that is all of them."""
    chosen, grid = pixels(problem.grid, side)
    if len(chosen) == problem.pixels:
        return problem
    R = np.empty((len(chosen), len(chosen)), np.float32)
    for row in range(grid[0]):  # neighbours in a row of the picture
        for start, stop in cut(grid[1], at_once(problem.pixels, problem.memory)):
            place, first = row * grid[1], int(chosen[row * grid[1]])
            R[place + start : place + stop] = problem.R.rows(first + start, first + stop)[:, chosen]
    return Problem(source("R", R), Dense(problem.device, R), grid, problem.memory, problem.pixels)
