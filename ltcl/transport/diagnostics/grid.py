# SPDX-License-Identifier: BSD-3-Clause
"""The grid that the rows of T fit.

Rows of T are alike for neighbouring pixels, and jump where a row of pixels ends. On the right grid,
of width w, rows i and i + w are more alike than under any other width at whose ends they jump.

Measured: 1 - cosine of the best other width is 0.05 to 0.6 times that of a wrong grid, and at least
0.96 times that of a right one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse

# Pairs of rows to compare.
PAIRS = 32
# Light of rows that are compared, to that of the median one: others are dead, unlit or hot.
MIN_LIGHT = 0.1
MAX_LIGHT = 10.0
# Sums of columns that are compared: noise averages out.
COLUMN_BINS = 64
# Difference of rows at the ends of a width, to that within, from which on they jump.
JUMP_RATIO = 2.0
# Difference of rows on another grid, to that on the given one, below which it is better.
BETTER_RATIO = 0.7
# Difference that is rounding of float32.
ROUNDING = 1e-6


def other_grid(T: Any, grid: tuple[int, int]) -> tuple[int, int] | None:
    """A grid of as many pixels that fits T (array or csr_array) clearly better, or None.

    Examples
    --------
    >>> from ltcl.scenes import dihedral
    >>> T = dihedral(8).transport().matrices[0]
    >>> other_grid(T, (8, 16)), other_grid(T, (16, 8))
    (None, (8, 16))
    """
    if not isinstance(T, (np.ndarray, scipy.sparse.csr_array)):
        return None
    n = grid[0] * grid[1]
    rows = _RowPairs(T, n)
    limit = BETTER_RATIO * (rows.difference_below(grid[1]) - ROUNDING)
    candidates = []
    for width in range(2, n):
        if n % width == 0 and width != grid[1]:
            candidates.append((rows.difference_below(width), width))
    for difference, width in sorted(candidates):
        if difference < limit and rows.jump_at_ends(width):
            return n // width, width
    return None


class _RowPairs:
    """Differences of a random sample of pairs of rows of T (n, N), 1 - cosine."""

    def __init__(self, T: Any, n: int) -> None:
        self.T = T
        self.n = n
        self.random = np.random.default_rng(0)
        self.pixels = self.random.permutation(n)[:PAIRS]
        bin_size = -(-n // COLUMN_BINS)
        self.bin_starts = np.arange(0, n, bin_size)
        with np.errstate(over="ignore", invalid="ignore"):
            light = T @ np.ones(n, np.float32)
        typical = float(np.median(light[light > 0])) if np.any(light > 0) else 0.0
        self.is_usual = (light > MIN_LIGHT * typical) & (light < MAX_LIGHT * typical)

    def difference_below(self, width: int) -> float:
        """Mean difference of rows one row of the grid apart; of random rows for a single row."""
        i = self.pixels
        if 2 * width <= self.n:
            j = np.where(i + width < self.n, i + width, i - width)
        else:
            j = self.random.permutation(self.n)[: len(i)]
        is_usual = self.is_usual[i] & self.is_usual[j]
        if not is_usual.any():
            return 1.0
        return float(self._difference(i[is_usual], j[is_usual]).mean())

    def jump_at_ends(self, width: int) -> bool:
        """True if rows differ more over the ends of a width than within."""
        pixels = self.random.permutation(self.n - 1)
        is_last = pixels % width == width - 1
        last = pixels[is_last][:PAIRS]
        inner = pixels[~is_last][:PAIRS]
        usual = np.median(self._difference(inner, inner + 1))
        jumps = self._difference(last, last + 1)
        return bool(np.quantile(jumps, 0.25) > JUMP_RATIO * usual)

    def _difference(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """1 - cosine of rows i and j, without the direct light of either pixel."""
        first = self._binned(i, i, j)
        second = self._binned(j, i, j)
        return 1.0 - np.sum(first * second, axis=1)

    def _binned(self, pixels: np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Sums over bins of columns, unit vectors."""
        if isinstance(self.T, np.ndarray):
            rows = self.T[pixels]
        else:
            rows = self.T[pixels].toarray()
        index = np.arange(len(pixels))
        rows[index, i] = 0.0
        rows[index, j] = 0.0
        sums = np.add.reduceat(rows, self.bin_starts, axis=1, dtype=np.float64)
        return sums / (np.linalg.norm(sums, axis=1, keepdims=True) + 1e-300)
