# SPDX-License-Identifier: BSD-3-Clause
"""Whether the photographs of a batch show their patterns, before anything of it is kept.

In units of the noise (`agreement`), photographs are compared with what is known of them:

    exposures     of one pattern show the same light
    patterns      no picture of a batch shows the pattern of another (all that one exposure allows)
    anchor        after each batch, the pattern of blocks shows what it showed in the calibration
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from ltcl.acquisition.agreement import ADVICE, Deviation, Sensor, find_deviation, sample, spread
from ltcl.acquisition.anchor import first_moved, shift_of
from ltcl.acquisition.calibration import Calibration
from ltcl.errors import AcquisitionError

_CLEAR = 5.0  # standard deviations of white that count
_KNOWN = 0.25  # standard deviation, relative to white, of a pixel that counts
_RATIO, _SIGMAS = 4.0, 6.0
_MODEL, _SAME = 0.02, 2.5  # relative systematic error; mean z^2 of pictures that are the same


class Shot(NamedTuple):
    """The photographs of a pattern: its codes (h, w), images, their seconds and numbers."""

    codes: np.ndarray
    images: Sequence[np.ndarray]
    seconds: Sequence[float]
    numbers: Sequence[int]


class Checks:
    """Compares the photographs of batches with a calibration and its white picture of the scan.

    `name` says what a photograph is called.
    """

    def __init__(
        self, calibration: Calibration, white: tuple[np.ndarray, np.ndarray], name: Callable[[int], str]
    ) -> None:
        self._calibration, self._white, self._name = calibration, white, name
        self._sensor = Sensor(calibration.response, calibration.noise, calibration.offset)
        self._seen = spread(np.unique(calibration.resampling.weights.indices))

    def deviation(self, shot: Shot) -> Deviation | None:
        """Which exposures of a pattern deviate, at pixels that see the projector or where it is lit."""
        lit = np.flatnonzero(shot.codes if shot.codes.ndim == 2 else shot.codes.any(axis=2))
        of_lit = np.unique(self._calibration.resampling.weights[lit].indices)
        for pixels in (self._seen, spread(of_lit)):
            samples = [sample(image, pixels) for image in shot.images]
            deviation = find_deviation(samples, shot.seconds, self._sensor) if len(samples) > 1 else None
            if deviation is not None:
                return deviation
        return None

    def refuse(self, shots: Sequence[Shot]) -> None:
        """Raise AcquisitionError about a shot whose exposures deviate, and the one behind it."""
        deviations = [(shot, self.deviation(shot)) for shot in shots]
        described = [d.describe(shot.numbers, self._name) for shot, d in deviations if d is not None]
        text = self._rearranged(shots) if len(described) == 2 else None
        raise AcquisitionError(f"{text or '; '.join(described)}; {ADVICE}")

    def _rearranged(self, shots: Sequence[Shot]) -> str | None:
        """Which photographs are exchanged, or which is missing, if that makes all of two patterns agree."""
        images = [image for shot in shots for image in shot.images]

        def agree(order: Sequence[int | None]) -> bool:
            """Whether photographs agree in another order; None: there is none."""
            rest = iter(order)
            for shot in shots:
                pairs = [(images[k], t) for t in shot.seconds if (k := next(rest)) is not None]
                if self.deviation(shot._replace(images=[x for x, _ in pairs], seconds=[t for _, t in pairs])):
                    return False
            return True

        every, names = list(range(len(images))), [self._name(n) for shot in shots for n in shot.numbers]
        missing = [names[k] for k in every[: len(every) // 2] if agree([*every[:k], None, *every[k:-1]])]
        if missing:
            return f"{' or '.join(missing)} is missing, and those behind it have moved up by one"
        orders = ((a, b, [{a: b, b: a}.get(k, k) for k in every]) for a, b in combinations(every, 2))
        pairs = [f"{names[a]} and {names[b]}" for a, b, order in orders if agree(order)]
        return f"{', or '.join(pairs[:2])} are exchanged" if pairs else None

    def refuse_misplaced(
        self, patterns: Sequence[np.ndarray], pictures: Sequence[Any], shots: Sequence[Shot]
    ) -> None:
        """Raise AcquisitionError about a picture that shows the pattern of another one of its batch.

        Relative to white, picture a shows pattern b if it is four times as bright where b alone is lit as
        where a alone is, beyond the noise. One such picture may show a mirror: b must show another pattern
        too, or the same light as a.
        """
        w, noise = (x.sum(axis=0) for x in self._white)
        clear = w > _CLEAR * np.sqrt(noise)
        sums = np.stack([[x.sum(axis=0)[clear] for x in picture] for picture in pictures], axis=1)
        value, variance = sums[0] / w[clear], sums[1] / w[clear] ** 2
        lit = np.stack(patterns).reshape(len(patterns), -1)[:, clear] > 0
        known = variance < _KNOWN**2
        on, dark = known * lit, known * ~lit
        there, here = (
            np.maximum(pixels, 1e-9) for pixels in (dark @ lit.T, on @ ~lit.T)
        )  # pixels of b, of a
        light = (dark * value) @ lit.T / there, (on * value) @ ~lit.T / here
        noise = (dark * variance) @ lit.T / there**2 + (on * variance) @ ~lit.T / here**2
        shows = (there >= 1) & (here >= 1) & (light[0] > _RATIO * light[1])
        shows &= light[0] - light[1] > _SIGMAS * np.sqrt(noise)
        for a, b in np.argwhere(shows):
            both = known[a] & known[b]
            z2 = (value[a] - value[b]) ** 2 / (variance[a] + variance[b] + (_MODEL * value[b]) ** 2)
            if shows[b].any() or (both.any() and np.mean(z2[both]) < _SAME):
                first, other = (" or ".join(map(self._name, shots[k].numbers)) for k in (a, b))
                raise AcquisitionError(f"{first} shows the pattern of {other}; {ADVICE}")

    def refuse_moved(self, blocks: Shot, shots: Sequence[Shot]) -> None:
        """Raise AcquisitionError if the pattern of blocks is not what it was in the calibration.

        It names the photographs from which on it was not: those that show it first, and those before. The
        image of each of `shots`, `blocks` behind them, is its picture (`anchor.compact`).
        """
        known, (image,), (seconds,) = self._calibration, blocks.images, blocks.seconds
        if known.anchor is None or known.anchor.deviation(image, seconds, self._sensor) is None:
            return
        *shifts, moved = (
            shift_of(shot.codes, shot.images[0], known.white, known.ambient, known.resampling)
            for shot in shots
        )
        first = first_moved(shifts, moved)
        start, stop = shots[max(first - 1, 0)].numbers[0], shots[first].numbers[-1]
        raise AcquisitionError(
            f"{self._name(blocks.numbers[0])}, of the pattern of blocks, is not what the calibration showed: "
            f"from one of photographs {start} to {stop} on, the camera, the projector, the scene or the "
            f"light changed (moved by {np.hypot(*moved):.2g} camera pixels); {ADVICE}"
        )
