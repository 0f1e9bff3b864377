# SPDX-License-Identifier: BSD-3-Clause
"""How many numbers of a matrix are how large, in bins of less than a percent, found without sorting them.

A bin is all float32 numbers with the same exponent and first seven bits behind it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

_SHIFT = 16  # bits of a float32 that a bin leaves open
_PIECE = 1 << 22  # numbers handled at once


@dataclass(frozen=True)
class Magnitudes:
    """Numbers in each bin, and their sum of squares, (bins,), bins ascending."""

    counts: np.ndarray
    squares: np.ndarray

    @classmethod
    def of(cls, values: np.ndarray) -> Magnitudes:
        """Those of a float32 array.

        >>> m = Magnitudes.of(np.array([3.0, -4.0, 12.0], np.float32))
        >>> m.threshold(5.0), m.kept(m.threshold(5.0)), m.threshold(4.9)
        (12.0, 1, 4.0)
        """
        bins = 1 << (32 - _SHIFT - 1)
        counts, squares = np.zeros(bins, np.int64), np.zeros(bins)
        flat = np.ravel(values)
        for start in range(0, flat.size, _PIECE):
            piece = np.abs(flat[start : start + _PIECE])
            keys = piece.view(np.int32) >> _SHIFT
            counts += np.bincount(keys, minlength=bins)
            squares += np.bincount(keys, np.square(piece, dtype=np.float64), minlength=bins)
        return cls(counts, squares)

    def threshold(self, frobenius: float) -> float:
        """The largest below which all numbers together have at most this Frobenius norm."""
        sums = np.cumsum(self.squares)
        bins = int(np.searchsorted(sums, frobenius**2 * (1 + 1e-12), side="right"))
        return _edge(min(bins, int(np.flatnonzero(self.counts)[-1]) + 1 if self.counts.any() else 0))

    def at_most(self, count: int) -> float:
        """The smallest threshold that keeps at most `count` numbers."""
        above = np.cumsum(self.counts[::-1])[::-1]  # numbers in this bin and beyond
        return _edge(int(np.searchsorted(-above, -count, side="left")))

    def kept(self, threshold: float) -> int:
        """How many are at least `threshold`, an edge."""
        return int(self.counts[_key(threshold) :].sum())

    def dropped(self, threshold: float) -> float:
        """Frobenius norm of what is below `threshold`, an edge."""
        return math.sqrt(float(self.squares[: _key(threshold)].sum()))


def _edge(key: int) -> float:
    return float(np.int32(key << _SHIFT).view(np.float32))


def _key(threshold: float) -> int:
    return int(np.float32(threshold).view(np.int32)) >> _SHIFT
