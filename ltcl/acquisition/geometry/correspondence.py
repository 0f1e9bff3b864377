# SPDX-License-Identifier: BSD-3-Clause
"""Map from camera pixels to projector coordinates, from photographs of Gray code alone.

A pixel is valid if every bit of its coordinates is certain, or all but one, and if they fit those
of its neighbours. `subpixel` finds fractions of a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ltcl import checks
from ltcl.acquisition.geometry.graycode import GrayCode
from ltcl.acquisition.geometry.subpixel import refine
from ltcl.errors import InputError

# Side of the neighbourhood that a coordinate must fit.
NEIGHBOURHOOD = 5

# Valid neighbours that a pixel must have.
MIN_NEIGHBOURS = 3

# Beyond any coordinate.
FAR = np.float32(1e9)


@dataclass(frozen=True)
class Correspondence:
    """A map from camera pixels to projector coordinates.

    Parameters
    ----------
    x, y : (H, W) array_like
        Column and row of the projector, in pixels with centres at integers; kept as float32, NaN
        where not valid.
    valid : (H, W) bool
        Whether the coordinates of the pixel are known.
    grid : (int, int)
        Height and width of the projector.

    Raises
    ------
    InputError
        Sizes differ, or a valid coordinate is not finite.

    Examples
    --------
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
        """Map of a camera that is already on the projector's grid."""
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
    images: Sequence[Any],
    grid: tuple[int, int],
    *,
    subpixel: bool = True,
    levels: int | None = None,
) -> Correspondence:
    """Decode photographs of Gray code into the map from camera to projector.

    Parameters
    ----------
    images : sequence of (H, W) or (H, W, 3) arrays
        Photographs of `GrayCode(grid).patterns()`, in that order: linear or raw, all of one
        exposure.
    grid : (int, int)
        Height and width of the projector.
    subpixel : bool
        Find fractions of a pixel (error 0.03), by planes through the edges of stripes.
    levels : int, optional
        Number of codes of the camera if images are floats: a difference of one code may be noise.

    Returns
    -------
    Correspondence
        Pixels that are not fully known or do not fit their neighbours are not valid.

    Raises
    ------
    InputError
        The number of photographs is another, sizes are mixed, there is NaN, white is as dark as
        black, or no pixel is valid.

    Examples
    --------
    >>> decode(GrayCode((4, 6)).patterns(), (4, 6)).decoded
    1.0
    """
    code = GrayCode(checks.grid("grid", grid))
    x, y = code.decode(images, levels=levels, edges=checks.flag("subpixel", subpixel))
    is_known = (x.width <= 2.0) & (y.width <= 2.0)
    valid = is_known & _fits_neighbours(x.value, is_known) & _fits_neighbours(y.value, is_known)
    if not valid.any():
        raise InputError(
            "photographs: no pixel is decoded; patterns must be in view, sharp, above the noise"
        )
    if not subpixel:
        return Correspondence(x.value, y.value, valid, code.grid)
    h, w = code.grid
    return Correspondence(refine(x, valid, w), refine(y, valid, h), valid, code.grid)


def _fits_neighbours(value: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """True where valid coordinates (H, W) fit those of their neighbours.

    The centre of a plane is the median of its 5 x 5 neighbourhood. A pixel may deviate from that by
    one projector pixel and twice the median absolute deviation of the neighbours, which is large at
    folds and borders. It must have three valid neighbours (fewer only in a picture that is that
    small).
    """
    deviation = np.abs(value - _median_of_valid(value, valid, -FAR))
    # Invalid pixels count as half very near and half very far: they leave the median where it is.
    spread = np.minimum(_median_of_valid(deviation, valid, np.float32(0.0)), FAR / 4)
    count = cv2.boxFilter(
        valid.view(np.uint8),
        -1,
        (NEIGHBOURHOOD, NEIGHBOURHOOD),
        normalize=False,
        borderType=cv2.BORDER_CONSTANT,
    )
    has_neighbours = count > min(MIN_NEIGHBOURS, value.size - 1)
    return valid & has_neighbours & (deviation <= 1.0 + 2.0 * spread)


def _median_of_valid(value: np.ndarray, valid: np.ndarray, low: np.float32) -> np.ndarray:
    """Median of the valid neighbours, within one rank; invalid ones are `low` and far in turn."""
    filled = np.full(value.shape, FAR)
    filled[::2, 1::2] = low
    filled[1::2, ::2] = low
    np.copyto(filled, value, "same_kind", where=valid)
    return cv2.medianBlur(filled, NEIGHBOURHOOD)
