# SPDX-License-Identifier: BSD-3-Clause
"""Whether photographs of a pattern show the same light, and those of one and its inverse add up to white.

What one photograph tells of another that was exposed s times as long is min(s x, 1), x linear. Pixels are
averaged over cells, so that it takes another pattern, exposure or set-up, and not noise, to make most of the
cells that tell anything differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np

from ltcl.acquisition.radiometry import NoiseModel, Response
from ltcl.errors import AcquisitionError

_CELLS = 64  # along a side
_FULL, _DIM = 0.98, 0.1  # codes, and light, that tell nothing
_OFF, _SIGMAS = 0.25, 1.5  # relative difference, beyond the noise: no camera exposes as exactly as it tells
_FEW, _SHARE = 3, 0.02  # of the cells: fewer may be hot pixels
ROUGH = NoiseModel(electrons=500.0, read=0.01)
"""Of a camera of which nothing is known yet: more than most have."""
_MUST = "photographs must be in their order, exposed as asked, of a set-up that stays as it was"


class _Seen(NamedTuple):
    """Linear light of cells, which of them have a pixel that is full, and the noise of the light."""

    light: np.ndarray
    full: np.ndarray
    noise: np.ndarray


def refuse_unlike(
    images: Sequence[np.ndarray],
    seconds: Sequence[float],
    numbers: Sequence[int],
    response: Response,
    noise: NoiseModel = ROUGH,
    offset: Any = 0.0,
) -> None:
    """Refuse photographs of one pattern that contradict each other.

    Parameters
    ----------
    images : (H, W) or (H, W, 3) each
        In [0, 1] of full scale.
    seconds, numbers : of each
    offset : float or (channels,)
        Linear value without light.

    Raises
    ------
    AcquisitionError
        It names two of them.

    Examples
    --------
    >>> dim, bright = np.full((4, 4), 0.2), np.full((4, 4), 0.4)
    >>> refuse_unlike([dim, bright], (1, 2), (6, 7), Response.identity())
    >>> refuse_unlike([dim, dim], (1, 2), (6, 7), Response.identity())  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ltcl.errors.AcquisitionError: photographs 6 (1 s) and 7 (2 s) are of one pattern, but show ...
    """
    order = sorted(range(len(images)), key=lambda k: seconds[k])
    seen = [_seen(images[k], response, noise, offset) for k in order]
    for (i, a), (j, b) in pairwise(zip(order, seen, strict=True)):
        if _differ(a, b, seconds[j] / seconds[i]):
            one, other = (f"{numbers[k]} ({seconds[k]:.3g} s)" for k in sorted((i, j)))
            raise AcquisitionError(
                f"photographs {one} and {other} are of one pattern, but show other light; {_MUST}"
            )


class Complements:
    """Linear photographs of patterns, some with their inverses behind them: light that adds up to the same.

    Examples
    --------
    >>> told = Complements()
    >>> for n, (x, light) in enumerate([(0, 0.2), (1, 0.6), (0.2, 0.3), (0.8, 0.5), (0, 0.5), (1, 0.6)]):
    ...     told.add(np.full((4, 4), x), np.full((4, 4), light), n)
    >>> told.refuse()  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ltcl.errors.AcquisitionError: photographs 4 and 5 are of a pattern and its inverse, but do ...
    """

    def __init__(self) -> None:
        self._before: tuple[np.ndarray, np.ndarray] | None = None
        self._sums: list[tuple[int, np.ndarray]] = []

    def add(self, codes: np.ndarray, light: np.ndarray, number: int) -> None:
        """A photograph, its pattern and its number."""
        small = _cells(light)
        if self._before is not None and np.all(np.abs(self._before[0] + codes - 1.0) < 1e-3):
            self._sums.append((number, self._before[1] + small))
        self._before = codes, small

    def refuse(self) -> None:
        """Refuse the first two that add up to something else than most."""
        if not self._sums:
            return
        white = np.median([light for _, light in self._sums], axis=0)
        lit = white > max(_DIM, 0.25 * float(white.max()))
        for number, light in self._sums:
            if lit.any() and np.median(np.abs(light - white)[lit] / white[lit]) > _OFF:
                raise AcquisitionError(
                    f"photographs {number - 1} and {number} are of a pattern and its inverse, but do not add "
                    f"up to white; {_MUST}"
                )


def _seen(image: np.ndarray, response: Response, noise: NoiseModel, offset: Any) -> _Seen:
    light, full = _cells(response.linear(image)) - offset, _cells(np.asarray(image >= _FULL, np.float32)) > 0
    each = max(1.0, image.shape[0] * image.shape[1] / (light.shape[0] * light.shape[1]))
    return _Seen(light, full, np.sqrt(noise.variance(light) / each))


def _cells(image: np.ndarray) -> np.ndarray:
    """Means over cells, (a, b, channels)."""
    size = tuple(min(n, _CELLS) for n in image.shape[1::-1])
    small = cv2.resize(np.asarray(image, np.float32), size, interpolation=cv2.INTER_AREA)
    return small.reshape(*size[::-1], -1)


def _differ(a: _Seen, b: _Seen, longer: float) -> bool:
    """Whether most cells of which one of two tells the other differ; b is `longer` times as long as a."""
    bright = (a.light > _DIM) | (b.light > _DIM)
    up = _beyond(np.minimum(a.light * longer, 1.0), b, a.noise * longer)
    down = _beyond(b.light / longer, a, b.noise / longer)
    told = np.concatenate([up[bright & ~a.full], down[bright & ~b.full]])
    return told.size >= max(_FEW, _SHARE * bright.size) and bool(np.median(told) > 1.0)


def _beyond(expected: np.ndarray, found: _Seen, noise: np.ndarray) -> np.ndarray:
    """How far cells are off what is expected, 1 for what is allowed; full ones show that light at least."""
    off = found.light - expected
    size = np.maximum(np.maximum(expected, found.light), _DIM)
    allowed = _OFF * size + _SIGMAS * np.hypot(noise, found.noise)
    return np.where(found.full, np.maximum(off, 0.0), np.abs(off)) / allowed
