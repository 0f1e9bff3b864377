# SPDX-License-Identifier: BSD-3-Clause
"""Whether the photographs of a batch show their patterns, before anything of it is kept.

In units of the noise (`agreement`), photographs are compared with what is known of them:

    exposures     of one pattern show the same light
    patterns      no picture of a batch shows the pattern of another (all that one exposure allows)
    anchor        after each batch, the pattern of blocks shows what it showed in the calibration
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from ltcl.acquisition import agreement
from ltcl.acquisition.agreement import ADVICE, Deviation, Sensor, find_deviation
from ltcl.acquisition.anchor import first_moved, shift_of
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.radiometry import Radiance, merge
from ltcl.errors import AcquisitionError

_KNOWN = 0.25  # standard deviation, relative to white, of a pixel that counts
_RATIO, _SIGMAS = 4.0, 6.0
_MODEL, _SAME = 0.02, 2.5  # relative systematic error; mean z^2 of pictures that are the same


class Shot(NamedTuple):
    """The photographs of a pattern: its codes (h, w), exposures in order, numbers."""

    codes: np.ndarray
    images: list[np.ndarray]
    numbers: range


class Checks:
    """Compares the photographs of batches with a calibration.

    Parameters
    ----------
    calibration : Calibration
    name : function of a number
        What a photograph is called.
    """

    def __init__(self, calibration: Calibration, name: Callable[[int], str]) -> None:
        self._calibration, self._name = calibration, name
        self._sensor = Sensor(calibration.response, calibration.noise, calibration.offset)

    def deviation(self, shot: Shot, seconds: Sequence[float] = ()) -> Deviation | None:
        """Whether exposures of a pattern deviate, where it is lit or at all pixels that see the projector."""
        weights = self._calibration.resampling.weights
        lit = np.flatnonzero(shot.codes if shot.codes.ndim == 2 else shot.codes.any(axis=2))
        places = [np.unique(weights.indices), np.unique(weights[lit].indices)]
        pixels = [agreement.spread(part) for part in places if len(part)]
        return find_deviation(
            shot.images, seconds or self._calibration.exposures, self._sensor, pixels=pixels
        )

    def refuse(self, deviations: Sequence[tuple[Shot, Deviation]], following: Shot | None = None) -> None:
        """Refuse a batch of which exposures of some patterns deviate; `following`: the shot behind the first.

        Raises
        ------
        AcquisitionError
            It names the first two.
        """
        if not deviations:
            return
        text = None
        if len(deviations) > 1:
            text = self._missing(deviations[0][0], following) or self._exchanged(
                *(d[0] for d in deviations[:2])
            )
        if text is None:
            text = "; ".join(found.describe(shot.numbers, self._name) for shot, found in deviations[:2])
        raise AcquisitionError(f"{text}; {ADVICE}")

    def _exchanged(self, a: Shot, b: Shot) -> str | None:
        """Which two photographs of two patterns may belong in each other's place."""
        pairs = []
        for i, j in product(range(len(a.images)), range(len(b.images))):
            first, second = list(a.images), list(b.images)
            first[i], second[j] = second[j], first[i]
            if not (self.deviation(a._replace(images=first)) or self.deviation(b._replace(images=second))):
                pairs.append(f"{self._name(a.numbers[i])} and {self._name(b.numbers[j])}")
        return f"{', or '.join(pairs[:2])} are exchanged" if pairs else None

    def _missing(self, first: Shot, second: Shot | None) -> str | None:
        """Whether a photograph of a shot is missing, and those behind it have moved up by one place."""
        if second is None or self.deviation(second._replace(images=[first.images[-1], *second.images[:-1]])):
            return None
        t = self._calibration.exposures
        fit = [
            self._name(first.numbers[k])
            for k in range(len(t))
            if self.deviation(first._replace(images=first.images[:-1]), (*t[:k], *t[k + 1 :])) is None
        ]
        return f"{' or '.join(fit)} is missing, and those behind it have moved up by one" if fit else None

    def refuse_misplaced(
        self, lit: np.ndarray, value: np.ndarray, variance: np.ndarray, numbers: Sequence[range]
    ) -> None:
        """Refuse pictures that show the pattern of another one of their batch.

        Parameters
        ----------
        lit : (k, N) bool
            Patterns.
        value, variance : (k, N)
            Light relative to white.
        numbers : of the photographs of each picture

        Raises
        ------
        AcquisitionError
            It names two pictures.
        """
        pair = misplaced(lit, value, variance)
        if pair is not None:
            a, b = (
                self._name(part[0]) if len(part) == 1 else f"photographs {part[0]} to {part[-1]}"
                for part in (numbers[pair[0]], numbers[pair[1]])
            )
            raise AcquisitionError(f"{a} show the pattern of {b}; {ADVICE}")

    def refuse_moved(self, blocks: Shot, pictures: Sequence[tuple[Shot, Radiance]]) -> None:
        """Refuse a batch after which the pattern of blocks is not what it was in the calibration.

        Raises
        ------
        AcquisitionError
            It names the photographs from which on it was not: those that show it first, and those before.
        """
        told = self._calibration
        seconds = told.exposures[0]
        if told.anchor is None or told.anchor.deviation(blocks.images[0], seconds, self._sensor) is None:
            return
        now = merge(blocks.images, [seconds], told.response, told.noise, black=told.offset)
        taken = [*pictures, (blocks, now)]
        *shifts, last = (
            shift_of(shot.codes, picture, told.white, told.ambient, told.resampling)
            for shot, picture in taken
        )
        moved = last - told.anchor.shift
        first = first_moved(shifts, moved)
        start, stop = taken[max(first - 1, 0)][0].numbers[0], taken[first][0].numbers[-1]
        raise AcquisitionError(
            f"{self._name(blocks.numbers[0])}, of the pattern of blocks, is not what the calibration showed: "
            f"from one of photographs {start} to {stop} on, the camera, the projector, the scene or the "
            f"light changed (moved by {np.hypot(*moved):.2g} projector pixels); {ADVICE}"
        )


def misplaced(lit: np.ndarray, value: np.ndarray, variance: np.ndarray) -> tuple[int, int] | None:
    """The first of k pictures that shows the pattern of another, and that; None where all are right.

    Picture a shows pattern b if it is four times as bright where b alone is lit as where a alone is, beyond
    the noise. One such picture may show a mirror: b must show another pattern too, or the same light as a.

    >>> lit = np.eye(4, dtype=bool)
    >>> misplaced(lit, 0.9 * lit[[0, 2, 1, 3]], np.full((4, 4), 1e-4))
    (1, 2)
    """
    known = variance < _KNOWN**2
    on, off = known * lit, known * ~lit
    pixels = (
        np.maximum(off @ lit.T, 1e-9),
        np.maximum(on @ ~lit.T, 1e-9),
    )  # of b alone; of a alone, known in a
    there, here = (off * value) @ lit.T / pixels[0], (on * value) @ ~lit.T / pixels[1]
    noise = (off * variance) @ lit.T / pixels[0] ** 2 + (on * variance) @ ~lit.T / pixels[1] ** 2
    shows = (
        (pixels[0] >= 1)
        & (pixels[1] >= 1)
        & (there > _RATIO * here)
        & (there - here > _SIGMAS * np.sqrt(noise))
    )
    for a, b in np.argwhere(shows):
        both = known[a] & known[b]
        z2 = (value[a] - value[b]) ** 2 / (variance[a] + variance[b] + (_MODEL * value[b]) ** 2)
        if shows[b].any() or (both.any() and np.mean(z2[both]) < _SAME):
            return int(a), int(b)
    return None
