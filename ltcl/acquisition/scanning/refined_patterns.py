# SPDX-License-Identifier: BSD-3-Clause
"""Patterns of a round of a sketch, which are fine where light is unknown at fine scales.

Each is a quad-tree of squares: from large ones on, a square is divided in four by chance, as often
as the light that is unknown in it is unknown at finer scales, and what is left whole is lit or not.
So creases, contacts and edges get fine squares, and walls large ones; no two patterns are alike.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np


def refined_patterns(unknown: np.ndarray, count: int, seed: tuple[int, int]) -> list[np.ndarray]:
    """Patterns (h, w) of 0 and 1, given the light that is `unknown`, (levels, h, w).

    Level l is that of squares of 2^l pixels.

    >>> patterns = refined_patterns(np.ones((4, 8, 16)), 5, seed=(0, 1))
    >>> len(patterns), patterns[0].shape, np.unique(patterns).tolist()
    (5, (8, 16), [0.0, 1.0])
    """
    random = np.random.default_rng(seed)
    up_to = np.cumsum(unknown, axis=0)
    return [_quad_tree(up_to, random) for _ in range(count)]


def _quad_tree(up_to: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """A pattern, given the light that is unknown up to each level."""
    grid = up_to.shape[1:]
    pattern = np.zeros(grid, np.float32)
    is_divided = np.ones(grid, bool)
    for level, square, squares in _squares(grid, _coarsest(up_to), random):
        is_left_whole = np.ones(squares, bool)
        if level > 0:
            finer = np.bincount(square.ravel(), up_to[level - 1].ravel(), squares)
            here = np.bincount(square.ravel(), up_to[level].ravel(), squares)
            is_left_whole = random.random(squares) * here >= finer
        is_lit = random.random(squares) < 0.5
        ends = is_divided & is_left_whole[square]
        pattern[ends] = is_lit[square][ends]
        is_divided &= ~ends
    return pattern


def _coarsest(up_to: np.ndarray) -> int:
    """The level of the largest squares, of which a side has two at least."""
    levels, height, width = up_to.shape
    return max(min(levels, (min(height, width) - 1).bit_length()) - 1, 0)


def _squares(
    grid: tuple[int, ...], coarsest: int, random: np.random.Generator
) -> Iterator[tuple[int, np.ndarray, int]]:
    """Levels from the coarsest on, the number of each pixel's square, (h, w), and their count.

    Squares are nested, and begin at a place by chance.
    """
    row, column = np.indices(grid, np.int32)
    row += random.integers(0, 1 << coarsest, dtype=np.int32)
    column += random.integers(0, 1 << coarsest, dtype=np.int32)
    for level in reversed(range(coarsest + 1)):
        across = (column[0, -1] >> level) + 1
        square = (row >> level) * across + (column >> level)
        yield level, square, int(square[-1, -1]) + 1
