# SPDX-License-Identifier: BSD-3-Clause
"""How sharp a camera sees the projector's pixels, from the stripes that give their places.

With b = 1 and -1 where a pattern of stripes is on and off, and D the photograph of it less that of
its inverse, on the projector's grid, light from elsewhere is in both and cancels. What is left of
pixel n is

    D_n = l_n ((1 - q) b_n + q (b_n-1 + b_n+1) / 2)

along an axis: l its direct light, and q the part of what comes out at it that is its neighbours',
for camera pixels are too large for the grid, or out of focus. Least squares over the finest
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

from ltcl.acquisition.geometry.correspondence import Correspondence
from ltcl.acquisition.geometry.graycode import FINE, GrayCode
from ltcl.acquisition.geometry.resample import SEPARABLE, Footprints, Resampling
from ltcl.errors import AcquisitionError

logger = logging.getLogger(__name__)
BAD, HOPELESS = (
    0.035,
    0.3,
)  # blur from which there is a warning (a sharp camera has 1 to 2 %), and a refusal
OF_MAP = (
    0.07  # q of errors of the map, of camera pixels as wide as the projector's: measured, above
)
OF_MEANS = (
    13 / 32
)  # q of means by a tent: E |a + b + c|, even in [-1/2, 1/2] (footprint: a, tent: b + c)
_LEAST = 3  # patterns that determine l and q


@dataclass(frozen=True)
class Sharpness:
    """How well a camera separates pixels: `leak`, q along y and x; `width` of its own in the projector's.

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
        cls, mapping: Correspondence, R: Resampling, light: Sequence[np.ndarray] = ()
    ) -> Sharpness:
        """By photographs (H, W[, c]) of Gray code, linear in light; without and of small grids by the map."""
        width = Footprints.of(mapping).width
        by_map = min(OF_MEANS * width, 1.0) if width >= SEPARABLE else 0.0
        y, x = (_leak(R, light, axis) for axis in (0, 1))
        return cls((by_map, by_map) if y is None or x is None else (y, x), width)

    def of_blocks(self, side: int) -> Sharpness:
        """Of blocks of `side` x `side` pixels: less of their light crosses a border."""
        y, x = self.leak
        return Sharpness((y / side, x / side), self.width / side)

    @property
    def own(self) -> float:
        """The part of what comes out at a pixel that is its own light."""
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
        """q along y and x, or what is as bad as errors of the map, where that is more."""
        least = OF_MAP * min(self.width, 1.0) ** 2
        return max(self.leak[0], least), max(self.leak[1], least)

    def check(self, side: int = 1) -> None:
        """Warn of a camera that hardly separates blocks of `side` x `side` pixels; refuse one that does not.

        >>> Sharpness((0.4, 0.4), 0.9).check()  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ltcl.errors.AcquisitionError: the camera does not separate the projector's pixels: ...
        """
        here = self.of_blocks(side)
        if not here.blur > BAD:
            return
        text = (
            f"camera pixels are {self.width:.2g} projector pixels wide, and {here.own:.0%} of what comes out "
            f"at a pixel is its own light: pictures of fine detail have an error of {here.blur:.1%}; "
            "move the camera closer, focus it and the projector, use a longer lens or a projector_grid of "
            f"fewer pixels, or scan with strategy='block' and block={2 * side}"
        )
        if here.blur > HOPELESS:
            text += "; or photographs of the finest stripes are exchanged"
            raise AcquisitionError(f"the camera does not separate the projector's pixels: {text}")
        logger.warning("%s", text)


def _leak(R: Resampling, light: Sequence[np.ndarray], axis: int) -> float | None:
    """q along y (axis 0) or x, in [0, 1], of pixels with two neighbours; None where patterns are too few."""
    if R.grid[axis] == 1:
        return 0.0
    code, seen = GrayCode(R.grid), np.moveaxis(R.seen, axis, -1)[:, 1:-1]
    first, last = (2 * code.bits[0] * (1 - axis), 2 * sum(code.bits[: 2 - axis]))
    fine = range(max(first, last - 2 * FINE), last, 2)
    if len(fine) < _LEAST or len(light) < last or not seen.any():
        return None
    patterns = code.patterns()
    b = np.stack(
        [2.0 * patterns[k].take(0, 1 - axis) - 1.0 for k in fine], axis=-1
    )  # (n, patterns)
    A = np.stack([b[1:-1], (b[:-2] + b[2:]) / 2], axis=-1)
    D = np.stack(
        [R.apply(light[k] - light[k + 1]).reshape(*R.grid, -1).mean(axis=-1) for k in fine]
    )
    D = np.moveaxis(D, 1 + axis, -1)[..., 1:-1]  # (patterns, lines, n - 2)
    z = np.einsum("nik,kjn->ijn", np.linalg.pinv(A), D)[:, seen]  # l (1 - q), l q
    l = z.sum(axis=0)
    lit = l > 0
    return float(np.clip(np.median(z[1, lit] / l[lit]), 0.0, 1.0)) if lit.any() else None
