# SPDX-License-Identifier: BSD-3-Clause
"""Sharpness of a camera on the projector's pixels, from photographs of Gray code stripes.

With b = 1 and -1 where a pattern of stripes is on and off, and D the photograph of it less that of
its inverse, on the projector's grid, light from elsewhere is in both and cancels. The rest of pixel
n is

    D_n = l_n ((1 - q) b_n + q (b_n-1 + b_n+1) / 2)

along an axis: l its direct light, and q the part of the light seen at it that is its neighbours',
because camera pixels are too large for the grid, or out of focus. Least squares over the finest
patterns of the axis give q; the median of the pixels counts. Blocks of k x k pixels share a k-th of
it. The relative error of a picture of noise, even in [0, 1], is

    blur = sqrt(a_y a_x - 2 (1 - q_y) (1 - q_x) + 1) / 2,    a = (1 - q)^2 + q^2 / 2

Errors of the map blur as a q of 0.07 times the square of a camera pixel's width does (measured: 0.5
% with a width of 0.27, 3.9 % with 0.72); the larger counts. Known limit: uneven light passes for a
q of up to 0.02.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltcl.acquisition.geometry.bits import FINE_BITS
from ltcl.acquisition.geometry.correspondence import Correspondence
from ltcl.acquisition.geometry.footprints import Footprints
from ltcl.acquisition.geometry.graycode import GrayCode
from ltcl.acquisition.geometry.photographs import PhotographFile
from ltcl.acquisition.geometry.resample import SEPARABLE_WIDTH, Resampling
from ltcl.errors import AcquisitionError

logger = logging.getLogger(__name__)

# Blur from which there is a warning (a sharp camera has 1 to 2 %), and a refusal.
WARNING_BLUR = 0.035
MAX_BLUR = 0.3

# q of errors of the map, for camera pixels as wide as the projector's: measured, above.
MAP_ERROR_LEAK = 0.07

# q of means by a tent: E |a + b + c|, even in [-1/2, 1/2] (footprint: a, tent: b + c).
TENT_LEAK = 13 / 32

# Camera pixels that are narrower, in projector pixels, are fine enough.
FINE_WIDTH = 0.5

# Patterns that determine l and q.
MIN_PATTERNS = 3


@dataclass(frozen=True)
class Sharpness:
    """Sharpness of a camera: to what extent it separates the projector's pixels.

    Parameters
    ----------
    leak : (float, float)
        q along y and x: part of the light seen at a pixel that is its neighbours'.
    width : float
        Width of a camera pixel, in projector pixels.

    Examples
    --------
    >>> sharpness = Sharpness((0.2, 0.5), 0.25)
    >>> sharpness.own, sharpness.of_blocks(2).own
    (0.4, 0.675)
    >>> round(Sharpness((0.2, 0.0), 0.0).blur, 3)  # sqrt(3 / 8) of 0.2
    0.122
    """

    leak: tuple[float, float]
    width: float

    @classmethod
    def of(
        cls,
        mapping: Correspondence,
        R: Resampling,
        light: Sequence[np.ndarray] | PhotographFile = (),
    ) -> Sharpness:
        """Sharpness of a camera.

        Parameters
        ----------
        mapping : Correspondence
            Map from the camera to the projector.
        R : Resampling
            Resampling of photographs by this map.
        light : sequence of (H, W) or (H, W, c) arrays, or PhotographFile
            Photographs of Gray code, linear in light. Without them, and on small grids, the size of
            camera pixels decides.

        Returns
        -------
        Sharpness
        """
        width = Footprints.from_map(mapping).width
        leak_y = _measure_leak(R, light, 0)
        leak_x = _measure_leak(R, light, 1)
        if leak_y is not None and leak_x is not None:
            return cls((leak_y, leak_x), width)
        leak = 0.0
        if width >= SEPARABLE_WIDTH:
            leak = min(TENT_LEAK * width, 1.0)
        return cls((leak, leak), width)

    def of_blocks(self, side: int) -> Sharpness:
        """Sharpness for blocks of `side` x `side` pixels: less of their light crosses a border."""
        y, x = self.leak
        return Sharpness((y / side, x / side), self.width / side)

    @property
    def own(self) -> float:
        """Part of the light seen at a pixel that is its own."""
        y, x = self.leak
        return round((1 - y) * (1 - x), 12)

    @property
    def blur(self) -> float:
        """Relative error of pictures of noise."""
        y, x = self.errors
        a = ((1 - y) ** 2 + y**2 / 2) * ((1 - x) ** 2 + x**2 / 2)
        return float(np.sqrt(max(a - 2 * (1 - y) * (1 - x) + 1, 0.0)) / 2)

    @property
    def errors(self) -> tuple[float, float]:
        """q along y and x, or the q that is as bad as errors of the map if that is larger."""
        y, x = self.leak
        least = MAP_ERROR_LEAK * min(self.width, 1.0) ** 2
        return max(y, least), max(x, least)

    def check(self, side: int = 1) -> None:
        """Warn if a camera hardly separates blocks of `side` x `side` pixels, or refuse it.

        >>> Sharpness((0.4, 0.4), 0.9).check()  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ltcl.errors.AcquisitionError: the camera does not separate the projector's pixels: ...
        """
        sharpness = self.of_blocks(side)
        if not sharpness.blur > WARNING_BLUR:
            return
        text = (
            f"camera pixels are {self.width:.2g} projector pixels wide, and {sharpness.own:.0%} of "
            "the light seen at a pixel is its own: pictures of fine detail have an error of "
            f"{sharpness.blur:.1%}; {self._advice()}use a projector_grid of fewer pixels, "
            f"or scan with strategy='block' and block={2 * side}"
        )
        if sharpness.blur > MAX_BLUR:
            text += "; or photographs of the finest stripes are exchanged"
            raise AcquisitionError(f"the camera does not separate the projector's pixels: {text}")
        logger.warning("%s", text)

    def _advice(self) -> str:
        """Advice by the width of camera pixels: finer ones do not sharpen a blur."""
        advice = ""
        if self.width > FINE_WIDTH:
            advice += "move the camera closer or use a longer lens, "
        if max(self.leak) > TENT_LEAK * self.width:
            advice += "focus the camera and the projector, "
        return advice


def _measure_leak(
    R: Resampling, light: Sequence[np.ndarray] | PhotographFile, axis: int
) -> float | None:
    """q along y (axis 0) or x, in [0, 1], at pixels with two neighbours.

    None for too few patterns or no light.
    """
    if R.grid[axis] == 1:
        return 0.0
    is_seen = np.moveaxis(R.seen, axis, -1)[:, 1:-1]
    if not len(light) or not is_seen.any():
        return None
    code = GrayCode(R.grid)
    has_few_inverses = len(light) != code.count
    code = GrayCode(R.grid, has_few_inverses)
    numbers = code.layout.pairs_of_axis(axis)[-FINE_BITS:].tolist()
    if len(numbers) < MIN_PATTERNS or len(light) != code.count:
        return None

    # A (n - 2, patterns, 2) has the columns b_n and (b_n-1 + b_n+1) / 2.
    patterns = code.patterns()
    stripes = [2.0 * patterns[k].take(0, 1 - axis) - 1.0 for k in numbers]
    b = np.stack(stripes, axis=-1)
    A = np.stack([b[1:-1], (b[:-2] + b[2:]) / 2], axis=-1)

    # D (patterns, lines, n - 2)
    differences = []
    for k in numbers:
        difference = R.apply(light[k] - light[k + 1])
        differences.append(difference.reshape(*R.grid, -1).mean(axis=-1))
    D = np.moveaxis(np.stack(differences), 1 + axis, -1)[..., 1:-1]

    own, neighbours = np.einsum("nik,kjn->ijn", np.linalg.pinv(A), D)[:, is_seen]
    direct = own + neighbours  # l (1 - q) + l q
    is_lit = direct > 0
    if not is_lit.any():
        return None
    q = np.median(neighbours[is_lit] / direct[is_lit])
    return float(np.clip(q, 0.0, 1.0))
