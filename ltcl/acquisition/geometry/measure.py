# SPDX-License-Identifier: BSD-3-Clause
"""Drive a projector and a camera through the patterns that tell which pixel sees which."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ltcl import checks
from ltcl.acquisition.exposure import bright_white
from ltcl.acquisition.geometry.correspondence import Correspondence
from ltcl.acquisition.geometry.graycode import GrayCode
from ltcl.errors import AcquisitionError

SMALL = 128  # sides up to here take narrow stripes in every pattern: the wide ones would be whole walls
STEPS, DARK = 1.5, 2e-3  # least difference that counts, of the camera's codes and of the brightest pixel


class Shots(Protocol):
    """What takes the photographs; `photograph` gives float images in [0, 1] of full scale."""

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        """Photograph the scene under `codes` (h, w)."""
        ...


def measure(
    shots: Shots, grid: tuple[int, int], *, seconds: float | None = None, high_frequency: bool | None = None
) -> Correspondence:
    """Measure which projector coordinate each camera pixel sees, by Gray code.

    Planes through the edges of its stripes give fractions of a pixel: 0.03 projector pixels with camera
    pixels up to twice as large as the projector's, 0.06 camera pixels with ones up to four times as large, of
    smooth surfaces (phase shift in addition, measured on the same maps, gives 0.03 and 0.05).

    Parameters
    ----------
    shots : object with ``photograph(codes, seconds)``
        Used where it has them: `exposures`, the seconds to choose from; `levels`, how many codes an integer
        camera has; `prepare`, which gets all (codes, seconds) that come next.
    grid : (h, w)
        Of the projector; a side of 1 takes no patterns.
    seconds : float, optional
        Exposure of every photograph; None: a few photographs of white find one that is bright but not
        saturated.
    high_frequency : bool, optional
        Narrow stripes in every pattern; None: where both sides of the grid are 128 at most.

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
    if high_frequency is None:
        high_frequency = max(grid) <= SMALL
    code = GrayCode(grid, high_frequency)
    if seconds is None:
        seconds = bright_white(shots, grid)
    checks.number("seconds", seconds, above=0.0)
    patterns = code.patterns()
    prepare = getattr(shots, "prepare", None)
    if prepare is not None:
        prepare((pattern, seconds) for pattern in patterns)
    images = [np.asarray(shots.photograph(pattern, seconds)) for pattern in patterns]
    # A difference of one step of the camera may be noise alone.
    dark = max(DARK, STEPS / ((getattr(shots, "levels", None) or np.inf) - 1))
    correspondence = Correspondence.of(*code.decode(images, dark=dark, edges=True), grid)
    if not correspondence.valid.any():
        raise AcquisitionError(
            "shots: no camera pixel could be decoded; the patterns must be in view, sharp and above the noise"
        )
    return correspondence
