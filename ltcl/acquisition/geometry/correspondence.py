# SPDX-License-Identifier: BSD-3-Clause
"""Which projector coordinates each camera pixel sees, from photographs of Gray code."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.geometry.graycode import GrayCode, consistent
from ltcl.acquisition.geometry.subpixel import refine
from ltcl.errors import InputError

_DARK, _STEPS = 2e-3, 1.5  # least difference that counts, of the brightest pixel and of the camera's codes


@dataclass(frozen=True)
class Correspondence:
    """A map from camera pixels to projector coordinates.

    `x`, `y` (H, W) float32: column and row of the projector's `grid` (h, w), in pixels with centres at
    integers; NaN where not `valid` (H, W) bool. InputError for sizes that differ, and where a valid
    coordinate is not finite.

    >>> Correspondence.aligned((2, 3)).x
    array([[0., 1., 2.],
           [0., 1., 2.]], dtype=float32)
    """

    x: np.ndarray
    y: np.ndarray
    valid: np.ndarray
    grid: tuple[int, int]

    def __post_init__(self) -> None:
        checks.grid("grid", self.grid)
        valid = np.asarray(self.valid, bool)
        if valid.ndim != 2 or valid.size == 0:
            raise InputError(f"valid has shape {valid.shape}; it must be (H, W)")
        object.__setattr__(self, "valid", valid)
        for name in ("x", "y"):
            array = checks.shape(name, checks.real(name, getattr(self, name)), valid.shape)
            checks.finite(f"{name}[valid]", array[valid])
            object.__setattr__(self, name, np.where(valid, array, np.nan).astype(np.float32))

    @classmethod
    def aligned(cls, grid: tuple[int, int]) -> Correspondence:
        """The camera already on the projector's grid."""
        h, w = checks.grid("grid", grid)
        y, x = np.mgrid[:h, :w]
        return cls(x, y, np.ones(grid, bool), (h, w))

    @property
    def camera_grid(self) -> tuple[int, int]:
        """(H, W) of the camera."""
        return self.valid.shape[0], self.valid.shape[1]

    @property
    def decoded(self) -> float:
        """Fraction of the camera's pixels that are valid."""
        return float(self.valid.mean())


def decode(
    images: Sequence[Any], grid: tuple[int, int], *, subpixel: bool = True, levels: int | None = None
) -> Correspondence:
    """The map from photographs (H, W) or (H, W, 3) of `GrayCode(grid).patterns()`, in that order.

    They are linear or raw, all of one exposure. `subpixel`: fractions of a pixel (error 0.03) by planes
    through the edges of stripes. Pixels that are not fully known or do not fit their neighbours are not
    valid. `levels`: codes of the camera where images are floats; a difference of one code may be noise.

    InputError for another number of photographs, mixed sizes, NaN; white as dark as black; no valid pixel.

    >>> decode(GrayCode((4, 6)).patterns(), (4, 6)).decoded
    1.0
    """
    code = GrayCode(checks.grid("grid", grid))
    dark = max(_DARK, _STEPS / (levels - 1)) if levels else _DARK
    x, y = code.decode(images, dark=dark, edges=checks.flag("subpixel", subpixel))
    valid = (x.width <= 2.0) & (y.width <= 2.0)
    valid &= consistent(x.value, valid) & consistent(y.value, valid)
    if not valid.any():
        raise InputError("photographs: no pixel is decoded; patterns must be in view, sharp, above the noise")
    columns, rows = (refine(x, valid, grid[1]), refine(y, valid, grid[0])) if subpixel else (x.value, y.value)
    return Correspondence(columns, rows, valid, code.grid)
