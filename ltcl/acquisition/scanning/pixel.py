# SPDX-License-Identifier: BSD-3-Clause
"""One pixel at a time, and after each batch of them all of the batch at once.

Of B pixels the photographs x_j, and their sum G, all of them less the same ambient light: with variances v_j
and g of their own and a of the ambient light, which is in all alike, the rest r = sum_j x_j - G has the
variance R = sum_j v_j + g + (B - 1)^2 a, and the best columns are

    x_j - (v_j + (B - 1) a) r / R,    of variance v_j + a - (v_j + (B - 1) a)^2 / R

G is brighter than each x_j, so that weak light, of which an error in black or response is a large part, adds
up as it should: an error in a is B times smaller in a sum of all columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltcl import checks


@dataclass(frozen=True)
class Pixels:
    """Batches of `size` pixels, each on its own.

    Examples
    --------
    >>> Pixels(2).patterns(2).tolist()
    [[True, False], [False, True], [True, True]]
    >>> x, v = Pixels(2).decode(np.array([[1.0], [2.0], [3.6]]), np.ones((3, 1)), np.zeros(1))
    >>> x.round(3).tolist(), v.round(3).tolist()
    ([[1.2], [2.2]], [[0.667], [0.667]])
    """

    size: int = 64

    def __post_init__(self) -> None:
        checks.count("size", self.size)

    def count(self, pixels: int) -> int:
        """Patterns for a batch of so many pixels."""
        return pixels + (pixels > 1)

    def patterns(self, pixels: int) -> np.ndarray:
        """(patterns, pixels) bool: which pixels of a batch are on."""
        one = np.eye(pixels, dtype=bool)
        return np.concatenate([one, np.ones((1, pixels), bool)]) if pixels > 1 else one

    def decode(
        self, value: np.ndarray, variance: np.ndarray, ambient: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Columns of T and their variance, (pixels, M).

        Parameters
        ----------
        value, variance : (patterns, M)
        ambient : (M,)
            Variance of the ambient light that was subtracted.
        """
        if len(value) == 1:
            return value, variance + ambient
        x, v, B = value[:-1].astype(np.float64), variance[:-1].astype(np.float64), len(value) - 1
        shared = (B - 1) * ambient
        rest = x.sum(axis=0) - value[-1]
        others = all_but_one(v) + variance[-1] + (B - 1) * shared  # R = v_j + others
        R = np.maximum(v + others, 1e-300)
        spread = v / R * (others + ambient - 2 * shared) + (ambient * others - shared**2) / R
        return x - (v + shared) / R * rest, np.maximum(spread, 0.0)


def all_but_one(v: np.ndarray) -> np.ndarray:
    """Sums over the first axis without the entry itself, exact where that is larger than all others.

    >>> all_but_one(np.array([1.0, 1e12, 2.0])).tolist()
    [1000000000002.0, 3.0, 1000000000001.0]
    """
    none = np.zeros_like(v[:1])
    before = np.cumsum(np.concatenate([none, v[:-1]]), axis=0)
    behind = np.cumsum(np.concatenate([none, v[:0:-1]]), axis=0)[::-1]
    return before + behind
