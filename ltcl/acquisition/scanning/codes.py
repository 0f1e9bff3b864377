# SPDX-License-Identifier: BSD-3-Clause
"""How the pixels of a batch are lit, and its columns of T estimated from the pictures.

One pixel at a time, and all of the batch at once: of B pixels the pictures x_j, and their sum G, all less the
same ambient light. With variances v_j and g of their own and a of the ambient light, which is in all alike,
the rest r = sum_j x_j - G has the variance R = sum_j v_j + g + (B - 1)^2 a, and the best columns are

    x_j - (v_j + (B - 1) a) r / R,    of variance v_j + a - (v_j + (B - 1) a)^2 / R

G is brighter than each x_j, so that weak light, in which an error of black or response is large, adds up.

Many at once: n = 2^k - 1 pixels under the n patterns of an S-matrix. With H the Sylvester matrix of order
n + 1, S = (1 - H) / 2 without the first row and column has (n + 1) / 2 pixels on in every row; its inverse is
2 / (n + 1) (2 S^T - 1). Each column then has the variance 4 / (n + 1)^2 sum_k v_k: about 4 / n of that of one
picture, better where noise does not depend on the light, worse where it is that of photons. Light that is
subtracted in all and is wrong by e leaves 2 e / (n + 1) in each column.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from ltcl import checks
from ltcl.errors import InputError


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
        """Columns of T and their variance, (pixels, M), from pictures (patterns, M).

        `ambient` (M,) is the variance of the ambient light that was subtracted.
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


@dataclass(frozen=True)
class Hadamard:
    """Batches of `size` = 2^k - 1 pixels, under S-matrices; InputError of another size.

    Examples
    --------
    >>> Hadamard(3).patterns(3).astype(int).tolist()
    [[1, 0, 1], [0, 1, 1], [1, 1, 0]]
    >>> T = np.array([[0.5], [0.1], [0.2]])
    >>> x, v = Hadamard(3).decode(Hadamard(3).patterns(3) @ T, np.ones((3, 1)), np.zeros(1))
    >>> x.round(9).ravel().tolist(), v.ravel().tolist()
    ([0.5, 0.1, 0.2], [0.75, 0.75, 0.75])
    """

    size: int = 63

    def __post_init__(self) -> None:
        checks.count("size", self.size)
        if self.size & (self.size + 1):
            raise InputError(f"size is {self.size}; it must be 2^k - 1: 1, 3, 7, 15, ...")

    def count(self, pixels: int) -> int:
        """As of `Pixels`."""
        return (1 << pixels.bit_length()) - 1

    def patterns(self, pixels: int) -> np.ndarray:
        """As of `Pixels`; of fewer pixels the smallest matrix with as many columns, without the rest."""
        return _matrix(self.count(pixels))[:, :pixels]

    def decode(
        self, value: np.ndarray, variance: np.ndarray, ambient: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """As of `Pixels`; (patterns, M), 0 for pixels beyond those of the batch."""
        n = len(value)
        x = 2.0 / (n + 1) * ((2.0 * _matrix(n) - 1.0).T @ value)
        v = 4.0 / (n + 1) ** 2 * (variance.sum(axis=0, dtype=np.float64) + ambient)
        return x, np.broadcast_to(v, x.shape)


def _matrix(n: int) -> np.ndarray:
    return scipy.linalg.hadamard(n + 1)[1:, 1:] < 0


Code = Pixels | Hadamard


def code_of(strategy: str, grid: tuple[int, int], order: int) -> Code:
    """The code of a strategy: `Hadamard` of "hadamard", else `Pixels`.

    Two batches at least, so that no pattern is white, which the calibration has photographed already.

    >>> code_of("hadamard", (64, 64), 63), code_of("pixel", (4, 4), 63)
    (Hadamard(size=63), Pixels(size=8))
    """
    half = max(1, grid[0] * grid[1] // 2)
    if strategy == "hadamard":
        return Hadamard(min(order, max(1, (1 << (half.bit_length() - 1)) - 1)))
    return Pixels(min(Pixels().size, half))


def patterns(code: Code, n: int) -> int:
    """Patterns for n pixels.

    >>> patterns(Pixels(4), 10)
    13
    """
    whole, rest = divmod(n, code.size)
    return whole * code.count(code.size) + (code.count(rest) if rest else 0)
