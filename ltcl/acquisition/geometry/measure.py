# SPDX-License-Identifier: BSD-3-Clause
"""Drive a projector and a camera through the patterns that tell which pixel sees which."""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np

from ltcl import checks
from ltcl.acquisition.geometry.correspondence import Correspondence
from ltcl.acquisition.geometry.decoded import Axis, photographs
from ltcl.acquisition.geometry.gray import GrayCode
from ltcl.acquisition.geometry.phase import PhaseShift
from ltcl.acquisition.geometry.unmixing import FINE
from ltcl.acquisition.stuck import healed, stuck
from ltcl.errors import AcquisitionError

SMALL = 128  # sides up to here take narrow stripes in every pattern: the wide ones would be whole walls
PROBES = 8
STEPS = 1.5  # of the camera's codes: the least difference that counts
BRIGHT, DIM = 0.95, 0.3  # of full scale, at the brightest pixels


class Shots(Protocol):
    """What takes the photographs; `photograph` gives float images in [0, 1] of full scale."""

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        """Photograph the scene under `codes` (h, w)."""
        ...


def measure(
    shots: Shots,
    grid: tuple[int, int],
    *,
    phase: bool | None = None,
    seconds: float | None = None,
    high_frequency: bool | None = None,
    period: float | None = None,
    steps: int = 6,
    sigmas: float = 3.0,
    dark: float = 2e-3,
) -> Correspondence:
    """Measure which projector coordinate each camera pixel sees.

    Parameters
    ----------
    shots : object with ``photograph(codes, seconds)``
        Used where it has them: `exposures`, the seconds to choose from; `levels`, how many codes an integer
        camera has; `prepare`, told of all (codes, seconds) that come next.
    grid : (h, w)
        Of the projector; a side of 1 takes no patterns.
    phase : bool, optional
        Add phase shift to Gray code. Planes through the edges of stripes give fractions of a pixel without
        it, and better ones where the camera resolves the projector's pixels, in which a phase is flat; so,
        left out, only where it does not.
    seconds : float, optional
        Exposure of every photograph; left out, a few photographs of white find one that is bright but not
        saturated.
    high_frequency : bool, optional
        Narrow stripes in every pattern; left out, where both sides of the grid are 128 at most.
    period, steps : float, int
        Of the phase shift; the period is 16 projector pixels, 8 on small grids, when left out.
    sigmas, dark : float
        As in `GrayCode.decode`.

    Returns
    -------
    Correspondence

    Raises
    ------
    InputError
        Bad arguments, or photographs of mixed sizes.
    AcquisitionError
        No pixel could be decoded.

    Examples
    --------
    A camera that sees the projector's own pixels:

    >>> class Mirror:
    ...     def photograph(self, codes, seconds):
    ...         return codes * min(seconds, 1.0)
    >>> measure(Mirror(), (8, 12), seconds=0.5).decoded
    1.0
    """
    grid = checks.grid("grid", grid)
    small = max(grid) <= SMALL
    narrow = small if high_frequency is None else checks.flag("high_frequency", high_frequency)
    code = GrayCode(grid, narrow)
    if phase is not None:
        checks.flag("phase", phase)
    small_period = period or (8.0 if small else 16.0)
    shift = PhaseShift(grid, (small_period,), steps) if max(grid) > 1 and phase is not False else None
    if seconds is None:
        seconds = exposure(shots, grid)
    checks.number("seconds", seconds, above=0.0)
    # A difference of one step of the camera tells nothing.
    dark = max(dark, STEPS / ((getattr(shots, "levels", None) or np.inf) - 1))
    known = code.decode(_take(shots, code.patterns(), seconds), sigmas=sigmas, dark=dark, edges=True)
    if shift is not None and (phase or not _resolved(*known, grid)):
        known = shift.decode(_take(shots, shift.patterns(), seconds), known, sigmas=sigmas, dark=dark)
    found = Correspondence.of(*known, grid)
    if not found.valid.any():
        raise AcquisitionError(
            "shots: no camera pixel could be decoded; the patterns must be in view, sharp and above the noise"
        )
    return found


def _resolved(x: Axis, y: Axis, grid: tuple[int, int]) -> bool:
    """Whether camera pixels are so much smaller than the projector's that many see one alone."""
    valid = (x.width <= 2.0) & (y.width <= 2.0)
    places = np.rint(y.value[valid]) * grid[1] + np.rint(x.value[valid])
    return valid.sum() * FINE**2 > len(np.unique(places))


def _take(shots: Shots, patterns: list[np.ndarray], seconds: float) -> list[np.ndarray]:
    tell = getattr(shots, "prepare", None)
    if tell is not None:
        tell((pattern, seconds) for pattern in patterns)
    return [np.asarray(shots.photograph(pattern, seconds)) for pattern in patterns]


def exposure(shots: Shots, grid: tuple[int, int], seconds: float = 1 / 60) -> float:
    """Seconds at which white is bright but not saturated, but for a thousandth of the pixels.

    Pixels that are saturated under black as well do not count.

    >>> class Lamp:
    ...     def photograph(self, codes, seconds):
    ...         return np.minimum(codes * 4.0 * seconds, 1.0)
    >>> round(4 * exposure(Lamp(), (4, 4)), 3)
    0.7
    """
    white, allowed = np.ones(grid, np.float32), getattr(shots, "exposures", None)
    bad = np.zeros((), bool)
    for _ in range(PROBES):
        seconds = nearest(seconds, allowed)
        (image,) = photographs("photographs", [shots.photograph(white, seconds)], 1)
        if np.quantile(healed(image, bad), 0.999, method="higher") > BRIGHT:
            bad = stuck(np.asarray(shots.photograph(0 * white, seconds)))
        level = float(np.quantile(healed(image, bad), 0.999))
        change = 1 / 2 if level > BRIGHT else 0.7 / max(level, 0.7 / 16) if level < DIM else 1.0
        if change == 1.0 or nearest(seconds * change, allowed) == seconds:
            break
        seconds *= change
    return nearest(seconds, allowed)


def nearest(seconds: float, allowed: Any) -> float:
    """The exposure that a camera has, of `allowed` or of any, nearest to some seconds."""
    if not allowed:
        return min(max(seconds, 1e-4), 30.0)
    return min(allowed, key=lambda given: abs(math.log(given / seconds)))
