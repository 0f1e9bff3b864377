# SPDX-License-Identifier: BSD-3-Clause
"""Phase shift: sinusoids moved in steps, whose phase tells the projector coordinate to a fraction of a pixel.

Photograph k of an axis shows `a + b cos(phi - 2 pi k / K)`, with `phi = 2 pi x / P` for period P; least
squares over the K steps gives phi, b and, from what is left over, the noise. A fine period is the precise
one, and even light between walls does not move its phase; which of its periods a pixel is in, a coarser
coordinate tells: Gray code, or a longer period, up to one that spans the whole grid. K steps are blind to
harmonics below K - 1, so six of them bear a projector that is not linear.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.geometry.decoded import Axis, photographs
from ltcl.errors import InputError

SYSTEMATIC = 0.05  # of a period: what a phase may be off besides noise
WEIGHT = 0.2  # of a phase beside an edge: where a camera resolves projector pixels, they are flat
FINER = 0.29  # deviation of a number that may be anywhere in an interval of length 1: what a phase must beat


@dataclass(frozen=True)
class PhaseShift:
    """Sinusoids for a projector grid, and the decoding of their photographs.

    Parameters
    ----------
    grid : (h, w)
        A side of 1 needs no patterns.
    periods : sequence of float
        Projector pixels, at least 3 each, falling. Without Gray code the first spans the longer side, and
        each next is finer by as much as noise allows: 4 to 10 times.
    steps : int
        Photographs of a period, at least 3; 4 and more tell the noise.

    Examples
    --------
    >>> shift = PhaseShift((1, 40), periods=(40, 8))
    >>> x, y = shift.decode(shift.patterns())
    >>> bool(np.abs(x.value[0] - np.arange(40)).max() < 1e-4)
    True
    """

    grid: tuple[int, int]
    periods: tuple[float, ...] = (16.0,)
    steps: int = 6

    def __post_init__(self) -> None:
        checks.grid("grid", self.grid)
        checks.count("steps", self.steps, least=3)
        object.__setattr__(self, "periods", tuple(self.periods))
        for number, period in enumerate(self.periods):
            checks.number(f"periods[{number}]", period, least=3.0)
        if not self.periods or any(b >= a for a, b in zip(self.periods, self.periods[1:], strict=False)):
            raise InputError(f"periods are {self.periods}; they must fall, and be one at least")

    @property
    def count(self) -> int:
        """How many photographs there are."""
        return self.steps * len(self.periods) * sum(n > 1 for n in self.grid)

    def patterns(self) -> list[np.ndarray]:
        """Codes (h, w) in [0, 1], float32: of x, then of y; each period's steps in turn."""
        h, w = self.grid
        columns = [np.broadcast_to(line, (h, w)) for line in self._lines(w)]
        rows = [np.broadcast_to(line[:, None], (h, w)) for line in self._lines(h)]
        return [np.ascontiguousarray(line, np.float32) for line in columns + rows]

    def decode(
        self,
        images: Sequence[Any],
        coarse: tuple[Axis, Axis] | None = None,
        *,
        sigmas: float = 3.0,
        dark: float = 2e-3,
    ) -> tuple[Axis, Axis]:
        """x and y of every camera pixel.

        Parameters
        ----------
        images : sequence of (H, W) or (H, W, 3)
            The photographs of `patterns()`, in that order, linear.
        coarse : pair of Axis, optional
            What Gray code tells. Its intervals need to be shorter than a period, no better. Where the phase
            lies outside the interval nothing is known; where noise hides the phase, the interval stays.
        sigmas, dark : float
            How far an amplitude must stand out of its noise, and the part of the largest that counts.

        Raises
        ------
        InputError
            Another number of photographs, mixed sizes, NaN; or no `coarse`, and no period spans the grid.
        """
        if coarse is None and self.periods[0] < max(self.grid):
            raise InputError(
                f"periods[0] is {self.periods[0]:g}; without coarse it must span the {max(self.grid)} pixels"
            )
        if not self.count:
            raise InputError(f"grid is {self.grid}; phase shift has nothing to tell in a single pixel")
        pictures = photographs("photographs", images, self.count)
        known = list(coarse) if coarse else [_whole(n, pictures[0].shape) for n in self.grid[::-1]]
        start = 0
        for axis, n in enumerate(self.grid[::-1]):
            for period in self._fitting(n):
                stack = pictures[start : start + self.steps]
                known[axis] = _unwrap(known[axis], _phase(stack, sigmas, dark), period, n)
                start += self.steps
        return known[0], known[1]

    def _fitting(self, n: int) -> list[float]:
        """The periods of a side of n pixels, a little longer so that whole ones fill it.

        Every step then lights as much of the grid, and light from elsewhere is the same in all of them.
        """
        return [n / (n // P) if n >= P else P for P in self.periods] if n > 1 else []

    def _lines(self, n: int) -> list[np.ndarray]:
        place = np.arange(n) if n > 1 else np.zeros(0)
        turns = [(place / P - k / self.steps) for P in self._fitting(n) for k in range(self.steps)]
        return [0.5 + 0.5 * np.cos(2 * np.pi * turn) for turn in turns]


@dataclass(frozen=True)
class _Wave:
    """Phase in turns in [0, 1), its standard deviation, and whether it can be believed."""

    turn: np.ndarray
    deviation: np.ndarray
    seen: np.ndarray


def _phase(stack: list[np.ndarray], sigmas: float, dark: float) -> _Wave:
    """Least squares of `a + b cos + c sin` over the steps; what is left over is noise."""
    K = len(stack)
    angle = 2 * np.pi * np.arange(K) / K
    mean = np.zeros(stack[0].shape, np.float32)
    cosine, sine, square = np.zeros_like(mean), np.zeros_like(mean), np.zeros_like(mean)
    for picture in stack:
        mean += picture / np.float32(K)
    for picture, t in zip(stack, angle, strict=True):
        off = picture - mean
        cosine += off * np.float32(2 * np.cos(t) / K)
        sine += off * np.float32(2 * np.sin(t) / K)
        square += off * off
    amplitude = np.hypot(cosine, sine)
    left = np.maximum(square - K / 2 * amplitude**2, 0.0) / max(K - 3, 1)
    noise = np.sqrt(left * np.float32(2 / K))  # of the amplitude, and of the phase times the amplitude
    step = 1.0 if stack[0].dtype.kind in "ui" else 0.0
    least = np.maximum(
        sigmas * noise, max(dark * float(np.quantile(amplitude, 0.999)), step * np.sqrt(2 / K))
    )
    turn = (np.arctan2(sine, cosine) / np.float32(2 * np.pi)) % 1.0
    deviation = noise / np.maximum(amplitude, np.finfo(np.float32).tiny) / np.float32(2 * np.pi)
    return _Wave(turn, deviation, amplitude > np.maximum(least, np.finfo(np.float32).tiny))


def _whole(n: int, shape: tuple[int, ...]) -> Axis:
    """Nothing is known but that it is somewhere on the grid."""
    middle, width, none = (np.full(shape, value, np.float32) for value in ((n - 1) / 2, n, 0.0))
    return Axis(middle, width, none)


def _unwrap(coarse: Axis, wave: _Wave, period: float, size: int) -> Axis:
    """The place of that phase nearest to the coarse coordinate, where only one lies in its interval.

    At the border of a period the phase may turn over a little before or after the coarse coordinate does;
    the nearest place is right all the same. A pixel whose phase lies outside its interval knows nothing.
    """
    P = np.float32(period)
    value = (wave.turn + np.round(coarse.value / P - wave.turn)) * P
    deviation = wave.deviation * P
    # The interval, widened by what either may be off, but not so far that two places of the phase lie in it.
    reach = np.minimum(coarse.width / 2 + 1.0 + 4.0 * deviation, P / 2)
    told = wave.seen & (coarse.width <= P) & (deviation < FINER * coarse.width)
    inside = (np.abs(value - coarse.value) <= reach * 1.00001) & (value > -1.0) & (value < size)
    width = np.where(inside, np.minimum(8.0 * deviation + SYSTEMATIC * P, coarse.width), np.inf)
    certain = np.clip(1.0 - 12.0 * wave.deviation, 0.0, 1.0)
    new = (value, width, certain)
    old = (coarse.value, coarse.width, coarse.confidence)
    v, w, c = [np.where(told, a, b).astype(np.float32) for a, b in zip(new, old, strict=True)]
    return Axis(v, w, c, coarse.edges, WEIGHT)
