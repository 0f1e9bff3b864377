# SPDX-License-Identifier: BSD-3-Clause
"""Many pixels at once: batches of n = 2^k - 1 pixels under the n patterns of an S-matrix.

Of the Sylvester matrix H of order n + 1, whose first row and column are 1, S = (1 - H) / 2 without these has
(n + 1) / 2 pixels on in every row, and S^-1 = 2 / (n + 1) (2 S^T - 1). Each of the n columns is told by all n
photographs:

    variance of a column = 4 / (n + 1)^2 sum_k v_k

which is about 4 / n of that of one photograph: better than a pixel at a time where noise does not depend on
the light (reading, rounding, ambient light), worse where photons of the light itself make it, of which there
are more. Light that is subtracted in all photographs, and is wrong by e, leaves 2 e / (n + 1) in each column.
A batch of fewer pixels takes the smallest such matrix that has as many columns, and leaves out the rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from ltcl import checks
from ltcl.errors import InputError


@dataclass(frozen=True)
class Hadamard:
    """Batches of `size` = 2^k - 1 pixels.

    Raises
    ------
    InputError
        Another size.

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
        """Patterns for a batch of so many pixels."""
        return (1 << pixels.bit_length()) - 1

    def patterns(self, pixels: int) -> np.ndarray:
        """(patterns, pixels) bool: which pixels of a batch are on."""
        return _matrix(self.count(pixels))[:, :pixels]

    def decode(
        self, value: np.ndarray, variance: np.ndarray, ambient: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Columns of T and their variance, (patterns, M); of more pixels than there are the rest is 0.

        Parameters
        ----------
        value, variance : (patterns, M)
        ambient : (M,)
            Variance of the ambient light that was subtracted.
        """
        n = len(value)
        x = 2.0 / (n + 1) * ((2.0 * _matrix(n) - 1.0).T @ value)
        v = 4.0 / (n + 1) ** 2 * (variance.sum(axis=0, dtype=np.float64) + ambient)
        return x, np.broadcast_to(v, x.shape)


def _matrix(n: int) -> np.ndarray:
    return scipy.linalg.hadamard(n + 1)[1:, 1:] < 0
