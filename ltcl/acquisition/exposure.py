# SPDX-License-Identifier: BSD-3-Clause
"""Exposures: which ones a camera has, one that is bright for white, a bracket, and those of a scan.

Under white the brightest pixels reach `WHITE` of the linear range. The longest exposure is `LONGER` times
that, or ends where ambient light takes `AMBIENT` of the range. A scan photographs each pattern at both: for
the pixels that a pattern lights, and for the weak light everywhere else. An automatic rig adds the geometric
mean: T p of 64 x 64 pixels then has a relative error of 0.40 % instead of 0.46 % (`bench/acquire.py`).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition import rig
from ltcl.acquisition.rig import LONGEST, SHORTEST, Shots
from ltcl.errors import AcquisitionError, InputError

WHITE = 0.7  # of the linear range, for the brightest pixels under white
LONGER = 64.0  # times the exposure of white: beyond, a photograph costs more time than its light is worth
LAST_CODE = 0.995  # of full scale: as good as the last code
ONE_EXPOSURE = "rig.exposures has one exposure, which determines no response; response= must be passed"
_FIRST = 1 / 60
_PROBES = 10
_DIM, _BRIGHT = 0.3, 0.95  # codes of the brightest pixels under white, outside of which another probe follows
AMBIENT = 0.3  # of the linear range
_BRIGHTEST = 0.999  # quantile of the pixels that is to be bright
_HOT = 0.1  # of the pixels: more at the last code under black, and the exposure is too long
_NOMINAL = 0.05  # relative difference of nominal exposures, 0.017 for 1/60, from exact ones


@contextlib.contextmanager
def acquisition_error(subject: str) -> Iterator[None]:
    """Raise an InputError about photographs as an AcquisitionError.

    >>> with acquisition_error("the response"):
    ...     raise InputError("images are black")
    Traceback (most recent call last):
    ltcl.errors.AcquisitionError: the response: images are black
    """
    try:
        yield
    except InputError as error:
        raise AcquisitionError(f"{subject}: {error}") from error


def nearest(exposures: Iterable[float] | None, seconds: float) -> float:
    """The exposure of a camera whose ratio to `seconds` is nearest to 1; None: it has any from 1e-4 to 30.

    >>> nearest((0.1, 1.0), 0.3), nearest((0.1, 1.0), 0.4), nearest(None, 50.0)
    (0.1, 1.0, 30.0)
    """
    if exposures is None:
        return float(min(max(seconds, SHORTEST), LONGEST))
    return rig.nearest(tuple(exposures), seconds)


def offered(shots: Shots, seconds: Iterable[float]) -> tuple[float, ...]:
    """The exposures of a camera nearest to `seconds`: ascending, each once."""
    return tuple(sorted({nearest(shots.exposures, t) for t in seconds}))


def check_offered(shots: Shots, seconds: Iterable[float]) -> None:
    """Refuse exposures that the camera does not have."""
    for t in seconds:
        closest = nearest(shots.exposures, t)
        if abs(closest - t) > (0.0 if shots.exposures is None else _NOMINAL * t):
            has = (
                f"{SHORTEST:g} to {LONGEST:g} s"
                if shots.exposures is None
                else f"{closest:g} s as the nearest"
            )
            raise InputError(f"exposures has {t:g} s; the rig has {has}")


def bracket(shortest: float, longest: float, count: int = 6) -> tuple[float, ...]:
    """Exposures for `calibrate`: `count` of them, ascending, whose ratios are not all powers of one number.

    >>> [round(t, 3) for t in bracket(0.01, 0.32, 4)]
    [0.01, 0.026, 0.123, 0.32]
    """
    checks.number("shortest", shortest, above=0.0)
    checks.number("longest", longest, above=shortest)
    checks.count("count", count, least=2)
    # Steps in the golden ratio, which no period divides.
    steps = np.where(np.arange(count - 1) % 2, (1 + 5**0.5) / 2, 1.0)
    place = np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()
    return tuple(float(t) for t in shortest * (longest / shortest) ** place)


def hot_pixels(black: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels at the last code in a photograph (H, W[, 3]) that should be dark: defects, lamps.

    They say nothing about exposure, response or noise, and must not determine them.

    >>> hot_pixels(np.array([[0.0] * 19 + [1.0]])).sum(), hot_pixels(np.ones((2, 2))).sum()
    (np.int64(1), np.int64(0))
    """
    hot = np.asarray((black.max(axis=-1) if black.ndim == 3 else black) >= LAST_CODE)
    return hot if hot.mean() <= _HOT else np.zeros_like(hot)


def fill_hot_pixels(image: np.ndarray, hot: np.ndarray) -> np.ndarray:
    """The photograph with the good pixel before, row by row, in place of each hot one.

    >>> fill_hot_pixels(np.array([[1.0, 9.0, 3.0]]), np.array([[False, True, False]])).tolist()
    [[1.0, 1.0, 3.0]]
    """
    if not hot.any():
        return image
    good = np.flatnonzero(~hot)
    donor = good[np.maximum(np.searchsorted(good, np.arange(hot.size), "right") - 1, 0)]
    return image.reshape(hot.size, -1)[donor].reshape(image.shape)


def brightness(image: np.ndarray, hot: np.ndarray) -> float:
    """What all but a thousandth of the pixels of a photograph reach at most, hot ones aside."""
    return float(np.quantile(fill_hot_pixels(image, hot), _BRIGHTEST, method="higher"))


def bright_white(shots: Any, grid: tuple[int, int]) -> float:
    """Seconds at which the brightest pixels under white have codes between 0.3 and 0.95 of full scale.

    `shots` has `photograph(codes, seconds)` with float photographs in [0, 1], and maybe `exposures`.

    >>> class Lamp:
    ...     def photograph(self, codes, seconds):
    ...         return np.minimum(codes * 4.0 * seconds, 1.0)
    >>> round(4 * bright_white(Lamp(), (4, 4)), 3)
    0.7
    """
    exposures = getattr(shots, "exposures", None)
    white, hot = np.ones(grid, np.float32), np.zeros((), bool)
    seconds = nearest(exposures, _FIRST)
    for _ in range(_PROBES):
        image = shots.photograph(white, seconds)
        if hot.ndim == 0:
            hot = np.zeros(image.shape[:2], bool)
        if brightness(image, hot) > _BRIGHT:
            hot = hot_pixels(shots.photograph(0 * white, seconds))
        level = brightness(image, hot)
        if _DIM <= level <= _BRIGHT:
            break
        change = 1 / 4 if level >= LAST_CODE else WHITE / max(level, WHITE / 16)
        following = nearest(exposures, seconds * change)
        if following == seconds:
            if image.min() >= LAST_CODE:
                raise AcquisitionError(
                    f"every pixel is saturated under white at the shortest exposure, {seconds:g} s; the "
                    "camera must get less light: a smaller aperture, a darker projector or room"
                )
            break
        seconds = following
    return seconds


def longest_exposure(white: float, ambient: float) -> float:
    """Seconds of the longest exposure, from those of white and the ambient radiance.

    >>> longest_exposure(1.0, 0.0), longest_exposure(1.0, 0.01)
    (64.0, 30.0)
    """
    return AMBIENT / ambient if ambient * LONGER * white > AMBIENT else LONGER * white


def for_scan(shots: Shots, white: float, longest: float) -> tuple[float, ...]:
    """The exposures of each pattern of a scan, ascending; two where a person takes the photographs."""
    by_hand = getattr(shots.rig, "keeps_photographs", False)
    return offered(shots, [white, longest] if by_hand else [white, math.sqrt(white * longest), longest])


def expected(shots: Shots, lit: float, ambient: float) -> tuple[float, ...]:
    """The exposures of a scan, from guesses of the radiance of white and of ambient light, for a plan."""
    white = WHITE / lit
    return for_scan(shots, white, longest_exposure(white, ambient))
