# SPDX-License-Identifier: BSD-3-Clause
"""Pixels of a projector in square blocks, which a scan lights as one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ltcl import checks


@dataclass(frozen=True)
class Blocks:
    """Pixels (h, w) of a projector in blocks of side x side, cut at the right and lower rim.

    >>> Blocks((2, 3), 2).sum(np.array([[1.0, 2.0, 5.0], [3.0, 4.0, 7.0]])).tolist()
    [[10.0, 12.0]]
    """

    pixels: tuple[int, int]
    side: int

    def __post_init__(self) -> None:
        checks.count("block", self.side, most=max(checks.grid("pixels", self.pixels)))

    @cached_property
    def grid(self) -> tuple[int, int]:
        """(h, w) of the blocks."""
        h, w = self.pixels
        return -(-h // self.side), -(-w // self.side)

    def enlarged(self, pattern: np.ndarray) -> np.ndarray:
        """The pattern of blocks on the projector's pixels, (h, w)."""
        h, w = self.pixels
        rows = np.repeat(pattern, self.side, axis=0)[:h]
        return np.repeat(rows, self.side, axis=1)[:, :w]

    def sum(self, picture: np.ndarray) -> np.ndarray:
        """Sum over every block of a picture (h, w[, c])."""
        if self.side == 1:
            return picture
        for axis in (0, 1):
            starts = np.arange(0, self.pixels[axis], self.side)
            picture = np.add.reduceat(picture, starts, axis=axis)
        return picture
