# SPDX-License-Identifier: BSD-3-Clause
"""The seconds that a set-up is photographed for, from a few probes of it.

White: bright, but not saturated. Deep: as long as tells more, which ends where the light that is there
without the projector takes a third of the range. Scanning: some of those between, for the pixels that a
pattern lights and for the weak light everywhere else at once.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator

import numpy as np

from ltcl.acquisition.radiometry import NoiseModel, Response
from ltcl.acquisition.rig import LONGEST, SHORTEST, Shots
from ltcl.acquisition.stuck import healed
from ltcl.errors import AcquisitionError, InputError

DEEPEST = 64.0  # times the exposure of white: further in one photograph costs more than it tells
_AMBIENT = 0.3  # of full scale that light without the projector may take
WHITE = 0.7  # of the range, for the brightest pixels under white
_SNR, _MOST = 100.0, 3  # of these, and photographs at most to reach it
ONE = "rig.exposures has one exposure, which tells no response; give response="
_ABOUT = 0.05  # relative difference of seconds that are written down shortly: 0.017 for 1/60
_FINE = 1 << 10  # levels from which two exposures span the range; fewer take one in between


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


def refuse_absent(shots: Shots, seconds: Iterable[float]) -> None:
    """Refuse exposures that the camera does not have.

    >>> from ltcl.acquisition import VirtualRig
    >>> refuse_absent(Shots(VirtualRig(np.eye(1), (1, 1))), [0.5, 40.0])
    Traceback (most recent call last):
    ltcl.errors.InputError: exposures has 40 s; the rig takes 0.0001 to 30 s
    """
    have = shots.exposures
    for t in seconds:
        (nearest,) = offered(shots, [t])
        if abs(nearest - t) > (0.0 if have is None else _ABOUT * t):
            takes = f"{SHORTEST:g} to {LONGEST:g} s" if have is None else f"{nearest:g} s at the nearest"
            raise InputError(f"exposures has {t:g} s; the rig takes {takes}")


def deepest(shots: Shots, white: float, response: Response, bad: np.ndarray) -> float:
    """The longest exposure that is of use, from one photograph under a black projector; `bad` are stuck."""
    (probe,) = offered(shots, [8.0 * white])
    black = np.zeros(shots.grid, np.float32)
    shots.prepare([(black, probe)])
    image = healed(shots.photograph(black, probe), bad)
    light = float(np.quantile(response.linear(image), 0.99)) / probe
    most = DEEPEST * white
    return offered(shots, [min(most, _AMBIENT / light) if light * most > _AMBIENT else most])[0]


def for_scan(shots: Shots, white: float, deep: float, noise: NoiseModel) -> tuple[float, ...]:
    """The exposures of every pattern: that of white, again where one has too much noise; the longest.

    A camera of few levels takes one in between. The longest is there for light that is too weak to stand out
    of one picture, but not out of many.

    Parameters
    ----------
    white, deep : float
        Seconds at which white fills `WHITE` of the range; the longest.

    Examples
    --------
    >>> from ltcl.acquisition import VirtualRig
    >>> rig = VirtualRig(np.eye(1), (1, 1))
    >>> for_scan(Shots(rig), 0.5, 8.0, NoiseModel(electrons=10000.0, levels=256))
    (0.5, 0.5, 2.0, 8.0)
    """
    again = math.ceil(_SNR**2 * float(noise.variance(WHITE)) / WHITE**2)
    between = [math.sqrt(white * deep)] if 0 < noise.levels < _FINE else []
    short, *longer = offered(shots, [white, *between, deep])
    return (*[short] * min(again, _MOST), *longer)


def guess(lit: float, ambient: float) -> tuple[float, float]:
    """Seconds for white and the longest, where nothing but these two radiances is known.

    >>> guess(0.7, 0.01)
    (1.0, 30.0)
    """
    white = WHITE / lit
    most = DEEPEST * white
    return white, min(most, _AMBIENT / ambient) if ambient > 0 else most
