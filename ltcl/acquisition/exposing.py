# SPDX-License-Identifier: BSD-3-Clause
"""The seconds that a set-up is photographed for, from a few probes of it.

White: bright, but not saturated. Deep: as long as tells more, which ends where the light that is there
without the projector takes a third of the range. Scanning: some of those between, for the pixels that a
pattern lights and for the weak light everywhere else at once.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from ltcl.acquisition.radiometry import NoiseModel, Response, choose
from ltcl.acquisition.rig import LONGEST, SHORTEST, Shots
from ltcl.errors import AcquisitionError, InputError

DEEPEST = 64.0  # times the exposure of white: further in one photograph costs more than it tells
_AMBIENT = 0.3  # of full scale that light without the projector may take
_SNR = 10.0  # of the weak light, wanted in one picture; the sum over a picture has far more
_FINE = 1 << 10  # levels from which two exposures span the range; fewer take three


@contextlib.contextmanager
def telling(what: str) -> Iterator[None]:
    """What photographs do not tell is a failed acquisition, not a bad argument.

    >>> with telling("the response"):
    ...     raise InputError("images are black")
    Traceback (most recent call last):
    ltcl.errors.AcquisitionError: the response: images are black
    """
    try:
        yield
    except InputError as error:
        raise AcquisitionError(f"{what}: {error}") from error


def offered(shots: Shots, seconds: Iterable[float]) -> tuple[float, ...]:
    """`seconds` as the camera has them: the nearest ones, ascending, each once.

    >>> from ltcl.acquisition import VirtualRig
    >>> offered(Shots(VirtualRig(np.eye(1), (1, 1), exposures=[0.1, 0.2])), [0.11, 0.12, 50.0])
    (0.1, 0.2)
    """
    if shots.exposures is None:
        return tuple(sorted({float(min(max(t, SHORTEST), LONGEST)) for t in seconds}))
    have = shots.exposures
    return tuple(sorted({min(have, key=lambda given: abs(math.log(given / t))) for t in seconds}))


def deepest(shots: Shots, white: float, response: Response) -> float:
    """The longest exposure that is of use, from one photograph under a black projector."""
    (probe,) = offered(shots, [8.0 * white])
    black = np.zeros(shots.grid, np.float32)
    shots.prepare([(black, probe)])
    light = float(np.quantile(response.linear(shots.photograph(black, probe)), 0.99)) / probe
    most = DEEPEST * white
    return offered(shots, [min(most, _AMBIENT / light) if light * most > _AMBIENT else most])[0]


def for_scan(
    shots: Shots, pixel: np.ndarray, white: float, deep: float, response: Response, noise: NoiseModel
) -> tuple[float, ...]:
    """The longest exposure, and one or, of a camera of few levels, two shorter ones, as `choose` has them.

    The longest is there for light that is too weak to stand out of one picture, but not out of many.

    Parameters
    ----------
    pixel : (h, w)
        Codes that light one pixel: of its picture the dark is told, of a white one the bright.
    white, deep : float
        Seconds for white; the longest.
    """
    seconds = offered(shots, [white, deep])
    lit = [np.ones(shots.grid, np.float32), pixel]
    shots.prepare([(codes, t) for t in seconds for codes in lit])
    probes = [np.hstack([shots.photograph(codes, t) for codes in lit]) for t in seconds]
    if len(seconds) == 1:
        return seconds
    have: Sequence[float] = shots.exposures or offered(shots, deep * 2.0 ** (-np.arange(0, 24) / 2))
    usable = [t for t in have if t <= deep * 1.001]
    most = 3 if 0 < noise.levels < _FINE else 2
    levels = noise.levels or None
    with telling("the exposures"):
        found = choose(probes, seconds, response, noise, snr=_SNR, most=most, exposures=usable, levels=levels)
    return offered(shots, [*(found[:-1] or found), deep])
