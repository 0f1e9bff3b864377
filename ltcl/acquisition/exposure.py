# SPDX-License-Identifier: BSD-3-Clause
"""Exposures: one that is bright for white, a bracket for the response of the camera, and those of a scan.

Under white the brightest pixels reach `WHITE` of the linear range. The longest exposure is `LONGER` times
that, or ends where ambient light takes `AMBIENT` of the range. A scan photographs each pattern at both: for
the pixels that a pattern lights, and for the weak light everywhere else. An automatic rig adds the geometric
mean: T p of 64 x 64 pixels then has a relative error of 0.40 % instead of 0.46 % (`bench/acquire.py`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from ltcl.acquisition.rig import Shots, nearest
from ltcl.acquisition.session import CaptureSession
from ltcl.errors import AcquisitionError

WHITE = 0.7  # of the linear range, for the brightest pixels under white
LONGER = 64.0  # times the exposure of white: beyond, a photograph costs more time than its light is worth
AMBIENT = 0.3  # of the linear range
LAST_CODE = 0.995  # of full scale: as good as the last code
_FIRST = 1 / 60
_PROBES = 10
DIM, BRIGHT = 0.3, 0.95  # codes of the brightest pixels under white, outside of which another probe follows
_BRIGHTEST = 0.999  # quantile of the pixels that is to be bright
_HOT = 0.1  # of the pixels: more at the last code under black, and the exposure is too long


def offered(exposures: Iterable[float] | None, seconds: Iterable[float]) -> tuple[float, ...]:
    """The exposures of a camera nearest to `seconds`: ascending, each once."""
    return tuple(sorted({nearest(exposures, t) for t in seconds}))


def bracket(shortest: float, longest: float, count: int) -> tuple[float, ...]:
    """`count` exposures, ascending, in steps of which every second is longer by the golden ratio.

    No period divides them: powers of one number do not determine a response (`radiometry.response`).

    >>> [round(t, 3) for t in bracket(0.01, 0.32, 4)]
    [0.01, 0.026, 0.123, 0.32]
    """
    steps = np.where(np.arange(count - 1) % 2, (1 + 5**0.5) / 2, 1.0)
    powers = np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()
    return tuple((shortest * (longest / shortest) ** powers).tolist())


def hot_pixels(black: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels at the last code in a photograph (H, W[, 3]) that should be dark: defects, lamps.

    They must not determine exposure, response or noise.
    """
    hot = np.asarray((black.max(axis=-1) if black.ndim == 3 else black) >= LAST_CODE)
    return hot if hot.mean() <= _HOT else np.zeros_like(hot)


def fill_hot_pixels(image: np.ndarray, hot: np.ndarray) -> np.ndarray:
    """The photograph with the good pixel before, row by row, in place of each hot one."""
    if not hot.any():
        return image
    good = np.flatnonzero(~hot)
    donor = good[np.maximum(np.searchsorted(good, np.arange(hot.size), "right") - 1, 0)]
    return image.reshape(hot.size, -1)[donor].reshape(image.shape)


def brightness(image: np.ndarray, hot: np.ndarray) -> float:
    """What all but a thousandth of the pixels of a photograph reach at most, without hot ones."""
    return float(np.quantile(fill_hot_pixels(image, hot), _BRIGHTEST, method="higher"))


def bright_white(session: CaptureSession) -> float:
    """Seconds at which the brightest pixels under white have codes between 0.3 and 0.95 of full scale.

    AcquisitionError where every pixel is saturated at the shortest, or at a code of fewer bits.
    """
    shots, hot = session.shots, np.zeros(1, bool)
    white = np.ones(shots.grid, np.float32)
    seconds, before = nearest(shots.exposures, _FIRST), 0.0
    for _ in range(_PROBES):
        image = session.photograph(white, seconds)
        level = brightness(image, hot)
        if level > BRIGHT:
            hot = hot_pixels(session.photograph(0 * white, seconds))
            level = brightness(image, hot)
        if DIM <= level <= BRIGHT:
            break
        last = (shots.levels or 1) - 1
        code = round(level * last)
        bits = code.bit_length()
        if level == before and bits > 8 and code + 1 == 1 << bits and level < LAST_CODE:
            raise AcquisitionError(
                f"white is saturated at code {code} of {last}; bits of the rig (camera_bits of a folder) "
                f"must be {bits}"
            )
        change = 1 / 4 if level >= LAST_CODE else WHITE / max(level, WHITE / 16)
        following = nearest(shots.exposures, seconds * change)
        if following == seconds:
            if image.min() < LAST_CODE:
                break
            raise AcquisitionError(
                f"every pixel is saturated under white at the shortest exposure, {seconds:g} s; the camera "
                "must get less light: a smaller aperture, a darker projector or room"
            )
        seconds, before = following, level
    return seconds


def longest_exposure(white: float, ambient: float) -> float:
    """Seconds of the longest exposure, from those of white and the ambient radiance."""
    return AMBIENT / ambient if ambient * LONGER * white > AMBIENT else LONGER * white


def for_scan(shots: Shots, white: float, longest: float) -> tuple[float, ...]:
    """The exposures of each pattern of a scan, ascending; two where a person takes the photographs."""
    by_hand = getattr(shots.rig, "keeps_photographs", False)
    seconds = [white, longest] if by_hand else [white, math.sqrt(white * longest), longest]
    return offered(shots.exposures, seconds)


def expected(shots: Shots, lit: float, ambient: float) -> tuple[float, ...]:
    """The exposures of a scan, from guesses of the radiance of white and of ambient light, for a plan."""
    return for_scan(shots, WHITE / lit, longest_exposure(WHITE / lit, ambient))
