# SPDX-License-Identifier: BSD-3-Clause
"""Whether the exposures of a pattern show one pattern, where it lights the scene.

Linear values x_k above black of the photographs with t_k seconds, the shortest first, are in contradiction at
a pixel where

    |p - q| > max(p, q) / 2,    p = min(x_k t_{k+1} / t_k, s),    q = min(x_{k+1}, s)

for neighbours of them, s being saturation, by 6 standard deviations of noise and what a black that is wrong
by 0.003 makes. A pattern is refused where that is so at half of the pixels that could tell it: 4 of them, or
fewer in two patterns of a batch; in one it is logged.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ltcl.acquisition.calibration import Calibration
from ltcl.errors import AcquisitionError

logger = logging.getLogger(__name__)
_SIGMAS, _BLACK, _PART = 6.0, 0.003, 0.5
_FEW = 4  # pixels, fewer of which may be faults of the sensor
_MOST = 1 << 12  # pixels that are looked at


class Contradiction(NamedTuple):
    """Pixels at which exposures contradict each other, of those that could tell it."""

    pixels: int
    told: int


def contradiction(images: Sequence[np.ndarray], told: Calibration, lit: np.ndarray) -> Contradiction:
    """That of the photographs (H, W[, 3]) of a pattern, in the order of `told.exposures`.

    Parameters
    ----------
    lit : (h, w)
        Not 0 where the projector is on.
    """
    places = np.unique(told.resampling.weights[np.flatnonzero(lit)].indices)
    places = places[:: -(-max(len(places), 1) // _MOST)]
    codes = np.stack([image.reshape(-1, len(told.offset))[places] for image in images])
    light = told.response.linear(codes) - told.offset
    slope, most = told.response.derivative(codes), told.noise.saturation - told.offset
    ratio = np.array(told.exposures[1:]) / np.array(told.exposures[:-1])
    ratio = ratio[:, None, None]
    short, q = np.minimum(light[:-1], most / ratio), np.minimum(light[1:], most)
    p = ratio * short
    variance = ratio**2 * told.noise.variance(short, slope[:-1]) + told.noise.variance(q, slope[1:])
    doubt = _SIGMAS * np.sqrt(variance) + ratio * _BLACK
    more = np.maximum(p, q)
    off = np.abs(p - q) > np.maximum(_PART * more, doubt)
    return Contradiction(*(int(np.count_nonzero(part.any(axis=(0, 2)))) for part in (off, more > doubt)))


def check(found: Sequence[Contradiction], name: Callable[[int], str]) -> None:
    """Refuse patterns of a batch whose exposures are of several; log what may be a fault of the sensor.

    Examples
    --------
    >>> check([Contradiction(0, 9), Contradiction(9, 9)], "{}".format)  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ltcl.errors.AcquisitionError: 1: light does not rise as the seconds do; photographs must be in ...
    """
    wrong = [a for a, (pixels, told) in enumerate(found) if pixels > 0 and pixels >= _PART * told]
    if not wrong:
        return
    more = f", nor in {len(wrong) - 1} more of this batch" if len(wrong) > 1 else ""
    text = f"{name(wrong[0])}: light does not rise as the seconds do{more}"
    if len(wrong) == 1 and found[wrong[0]].told < _FEW:
        logger.warning("%s: are they in their places?", text)
        return
    raise AcquisitionError(
        f"{text}; photographs must be in the order of their patterns and exposures: put that right"
    )
