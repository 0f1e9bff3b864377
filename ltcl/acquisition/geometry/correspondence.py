# SPDX-License-Identifier: BSD-3-Clause
"""Which projector coordinates each camera pixel sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.geometry.graycode import Axis, GrayCode, consistent
from ltcl.acquisition.geometry.subpixel import refine
from ltcl.errors import InputError


@dataclass(frozen=True)
class Correspondence:
    """A map from camera pixels to projector coordinates.

    Attributes
    ----------
    x, y : (H, W) float32
        Column and row of the projector, in pixels, with pixel centres at integers; NaN where not valid.
    confidence : (H, W) float32
        In [0, 1]; 0 where not valid.
    valid : (H, W) bool
    grid : (h, w)
        Of the projector.

    Raises
    ------
    InputError
        Sizes that differ, or a valid coordinate that is not finite.

    Examples
    --------
    >>> Correspondence.aligned((2, 3)).x
    array([[0., 1., 2.],
           [0., 1., 2.]], dtype=float32)
    """

    x: np.ndarray
    y: np.ndarray
    confidence: np.ndarray
    valid: np.ndarray
    grid: tuple[int, int]

    def __post_init__(self) -> None:
        checks.grid("grid", self.grid)
        valid = np.asarray(self.valid, bool)
        if valid.ndim != 2 or valid.size == 0:
            raise InputError(f"valid has shape {valid.shape}; it must be (H, W)")
        object.__setattr__(self, "valid", valid)
        for name in ("x", "y", "confidence"):
            array = checks.shape(name, checks.real(name, getattr(self, name)), valid.shape)
            checks.finite(f"{name}[valid]", array[valid])
            other = 0.0 if name == "confidence" else np.nan
            object.__setattr__(self, name, np.where(valid, array, other).astype(np.float32))

    @classmethod
    def aligned(cls, grid: tuple[int, int]) -> Correspondence:
        """The camera already on the projector's grid."""
        h, w = checks.grid("grid", grid)
        y, x = np.mgrid[:h, :w]
        return cls(x, y, np.ones(grid), np.ones(grid, bool), (h, w))

    @classmethod
    def of(cls, x: Axis, y: Axis, grid: tuple[int, int]) -> Correspondence:
        """Decoded coordinates, without those that are not fully known or do not fit their neighbours."""
        valid = (x.width <= 2.0) & (y.width <= 2.0)
        valid &= consistent(x.value, valid) & consistent(y.value, valid)
        (column, fits), (row, also) = refine(x, valid, grid[1]), refine(y, valid, grid[0])
        return cls(column, row, np.minimum(x.confidence, y.confidence), fits & also, grid)

    @property
    def camera_grid(self) -> tuple[int, int]:
        """(H, W) of the camera."""
        return self.valid.shape[0], self.valid.shape[1]

    @property
    def decoded(self) -> float:
        """Part of the camera's pixels that are valid."""
        return float(self.valid.mean())


def decode(
    images: Sequence[Any],
    grid: tuple[int, int],
    *,
    high_frequency: bool = False,
    subpixel: bool = True,
) -> Correspondence:
    """The map from photographs of Gray code, without a rig.

    Parameters
    ----------
    images : sequence of (H, W) or (H, W, 3)
        Of `GrayCode(grid, high_frequency).patterns()`, in that order.
    grid : (h, w)
        Of the projector.
    high_frequency : bool
        As in `GrayCode`.
    subpixel : bool
        Fit planes through the edges of stripes; else coordinates are whole, or halves on edges.

    Raises
    ------
    InputError
        Another number of photographs, mixed sizes, NaN; or white shows nothing that black does not.

    Examples
    --------
    >>> decode(GrayCode((4, 6)).patterns(), (4, 6)).decoded
    1.0
    """
    code = GrayCode(checks.grid("grid", grid), high_frequency)
    x, y = code.decode(images, edges=checks.flag("subpixel", subpixel))
    return Correspondence.of(x, y, code.grid)
