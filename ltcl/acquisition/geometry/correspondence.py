# SPDX-License-Identifier: BSD-3-Clause
"""Map from camera pixels to projector coordinates, from photographs of Gray code alone.

A pixel is valid if every bit of its coordinates is certain, or all but one, and if they fit those
of its neighbours. Where more bits are within the noise, the brighter pictures still give a
coordinate; if it fits those of valid neighbours, it is right but once in thousands, and counts too.
`subpixel` finds fractions of a pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ltcl import checks
from ltcl.acquisition.geometry.axis import UNKNOWN, Axis
from ltcl.acquisition.geometry.graycode import GrayCode
from ltcl.acquisition.geometry.photographs import PhotographFile
from ltcl.acquisition.geometry.subpixel import refine
from ltcl.acquisition.radiometry.strips import in_strips
from ltcl.errors import InputError

# Side of the neighbourhood that a coordinate must fit.
NEIGHBOURHOOD = 5

# Valid neighbours that a pixel must have, and a faint one.
MIN_NEIGHBOURS = 3
MIN_FAINT_NEIGHBOURS = 5

# Times that faint pixels next to valid ones are compared with these.
GROWTH_STEPS = 3

# A test of coordinates (H, W) by those of valid pixels.
NeighbourTest = Callable[[np.ndarray, np.ndarray], np.ndarray]

# Rows around a strip that its comparison reads: a median of deviations from a median.
COMPARED_REACH = 2 * (NEIGHBOURHOOD // 2)

# Pixels of a strip of rows: its medians stay in the cache.
STRIP_PIXELS = 1 << 16

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
    images: Sequence[Any] | PhotographFile,
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
        exposure. Or those of `GrayCode(grid, has_few_inverses=True)`, or without the inverses,
        which is less sure: of every other pattern, then white and black.
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
    checks.flag("subpixel", subpixel)
    x, y = code.decode(images, levels=levels, edges=subpixel)
    valid = _confirm(x, y)
    if not valid.any():
        raise InputError(
            "photographs: no pixel is decoded; patterns must be in view, sharp, above the noise"
        )
    h, w = code.grid
    if not subpixel:
        return Correspondence(x.value, y.value, valid, code.grid)
    # Bits and edges of an axis are not needed any more: 5 bytes a camera pixel.
    fine_x = refine(x, valid, w)
    del x
    fine_y = refine(y, valid, h)
    del y
    valid &= np.isfinite(fine_x) & np.isfinite(fine_y)
    return Correspondence(fine_x, fine_y, valid, code.grid)


def _confirm(x: Axis, y: Axis) -> np.ndarray:
    """Pixels (H, W) whose coordinates are known, or faint, and fit those of their neighbours.

    Known pixels are compared with known ones first; then the others next to valid pixels with
    these, and again those next to what this adds.
    """
    known = x.known & y.known
    valid = known & _compare(x, y, known, known, _fits_plane)
    readable = (x.state != UNKNOWN) & (y.state != UNKNOWN)
    for _ in range(GROWTH_STEPS):
        others = readable & ~valid
        valid |= others & _compare(x, y, others, valid, _fits_median)
    return valid


def _compare(
    x: Axis, y: Axis, compared: np.ndarray, neighbours: np.ndarray, test: NeighbourTest
) -> np.ndarray:
    """True (H, W) where both coordinates pass a test; compared are rows with such pixels."""
    passed = np.zeros(neighbours.shape, bool)

    def compare_rows(rows: slice) -> None:
        if not compared[rows].any():
            return
        top = max(rows.start - COMPARED_REACH, 0)
        window = slice(top, rows.stop + COMPARED_REACH)
        inside = slice(rows.start - top, rows.stop - top)
        near = neighbours[window]
        both = test(x.rows(window).value, near) & test(y.rows(window).value, near)
        passed[rows] = both[inside]

    height, width = neighbours.shape
    in_strips(height, STRIP_PIXELS // width, compare_rows)
    return passed


def _fits_plane(value: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """True where valid coordinates (H, W) fit those of their neighbours.

    The centre of a plane is the median of its 5 x 5 neighbourhood. A pixel may deviate from that by
    one projector pixel and twice the median absolute deviation of the neighbours, which is large at
    folds and borders. It must have three valid neighbours (fewer only in a picture that is that
    small).
    """
    deviation = np.abs(value - _median_of_valid(value, valid, -FAR))
    # Invalid pixels count as half very near and half very far: they leave the median where it is.
    spread = np.minimum(_median_of_valid(deviation, valid, np.float32(0.0)), FAR / 4)
    has_neighbours = _count_valid(valid) > min(MIN_NEIGHBOURS, value.size - 1)
    return has_neighbours & (deviation <= 1.0 + 2.0 * spread)


def _fits_median(value: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """True where coordinates (H, W) deviate by one projector pixel from those of valid neighbours.

    There must be five: a faint pixel is less sure.
    """
    deviation = np.abs(value - _median_of_valid(value, valid, -FAR))
    return (_count_valid(valid) >= MIN_FAINT_NEIGHBOURS) & (deviation <= 1.0)


def _count_valid(valid: np.ndarray) -> np.ndarray:
    """Number of valid pixels in the neighbourhood of each, itself included."""
    return cv2.boxFilter(
        valid.view(np.uint8),
        -1,
        (NEIGHBOURHOOD, NEIGHBOURHOOD),
        normalize=False,
        borderType=cv2.BORDER_CONSTANT,
    )


def _median_of_valid(value: np.ndarray, valid: np.ndarray, low: np.float32) -> np.ndarray:
    """Median of the valid neighbours, within one rank; invalid ones are `low` and far in turn."""
    filled = np.full(value.shape, FAR)
    filled[::2, 1::2] = low
    filled[1::2, ::2] = low
    np.copyto(filled, value, "same_kind", where=valid)
    return cv2.medianBlur(filled, NEIGHBOURHOOD)
