# SPDX-License-Identifier: BSD-3-Clause
"""`Axis`: a projector coordinate of every camera pixel, in five bytes a pixel.

A camera has up to a hundred million pixels, so that whole coordinates are kept as uint16, and
fractions of the distance of two pixels in 254 steps. Values as floats are made of the rows that are
worked on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# What is known of a coordinate.
UNKNOWN = np.uint8(0)
CERTAIN = np.uint8(1)
# One bit is undecided: the pixel is on the edge between its place and the one before, or after.
EDGE_BEFORE = np.uint8(2)
EDGE_AFTER = np.uint8(3)
# The pixel is lit, but more than one bit is within the noise: its neighbours must confirm it.
FAINT = np.uint8(4)

# Length of the interval that is known, and its middle from the whole coordinate, by the above.
WIDTHS = np.array([np.inf, 1.0, 2.0, 2.0, np.inf], np.float32)
SHIFTS = np.array([0.0, 0.0, -0.5, 0.5, 0.0], np.float32)

# Steps of a fraction, and the number that stands for no edge.
FRACTION_STEPS = 254
NO_EDGE = np.uint8(255)


@dataclass(frozen=True, kw_only=True)
class Axis:
    """A projector coordinate of every camera pixel, arrays (H, W).

    Attributes
    ----------
    place : uint16
        The whole coordinate that the brighter pictures give, however faintly.
    state : uint8
        `UNKNOWN`, `CERTAIN`, `EDGE_BEFORE`, `EDGE_AFTER` or `FAINT`.
    right_steps, below_steps : uint8
        Fractions of the distance to the next pixel, in steps, or `NO_EDGE`.
    """

    place: np.ndarray
    state: np.ndarray
    right_steps: np.ndarray
    below_steps: np.ndarray

    @classmethod
    def unknown(cls, shape: tuple[int, ...]) -> Axis:
        """Coordinates that are not known anywhere."""
        return cls(
            place=np.zeros(shape, np.uint16),
            state=np.full(shape, UNKNOWN),
            right_steps=np.full(shape, NO_EDGE),
            below_steps=np.full(shape, NO_EDGE),
        )

    def rows(self, rows: slice) -> Axis:
        """The coordinates of some rows."""
        return Axis(
            place=self.place[rows],
            state=self.state[rows],
            right_steps=self.right_steps[rows],
            below_steps=self.below_steps[rows],
        )

    @property
    def value(self) -> np.ndarray:
        """Middle of the interval that is known, in projector pixels with centres at integers."""
        return self.place + SHIFTS.take(self.state)

    @property
    def width(self) -> np.ndarray:
        """Length of the interval: 1 if every bit is certain, 2 on an edge, else infinite."""
        return WIDTHS.take(self.state)

    @property
    def known(self) -> np.ndarray:
        """True where every bit is certain, or all but one on an edge."""
        return (self.state >= CERTAIN) & (self.state <= EDGE_AFTER)

    @property
    def right(self) -> np.ndarray:
        """Fraction in [0, 1] of the distance to the next pixel at which `place` changes by 1.

        NaN if it does not.
        """
        return _fractions(self.right_steps)

    @property
    def below(self) -> np.ndarray:
        """The same fraction of the distance to the pixel below."""
        return _fractions(self.below_steps)


FRACTIONS = np.arange(256, dtype=np.float32) / FRACTION_STEPS
FRACTIONS[NO_EDGE] = np.nan


def _fractions(steps: np.ndarray) -> np.ndarray:
    return FRACTIONS.take(steps)
