# SPDX-License-Identifier: BSD-3-Clause
"""Blocks of side x side projector pixels as the pixels of a coarser scan.

Lit together, they give a transport of 1 / side^2 as many columns: entry (i, j) is the mean light in block i
for unit light from every pixel of block j. At the right and lower rim blocks have fewer pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltcl import checks


@dataclass(frozen=True)
class Blocks:
    """The pixels (h, w) of a projector in blocks.

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
    >>> blocks.mean(np.array([[1.0, 2.0, 5.0], [3.0, 4.0, 7.0]])).tolist()
    [[2.5, 6.0]]
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

    def mean(self, picture: np.ndarray) -> np.ndarray:
        """Mean over every block of a picture (h, w)."""
        return self.sum(picture) / self.sum(np.ones(self.pixels))
