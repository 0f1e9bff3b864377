# SPDX-License-Identifier: BSD-3-Clause
"""`Warp`: patterns on squares of camera pixels, shown by the projector pixels that are seen there.

A projector pixel takes the code of the square in which the camera sees its centre, by the camera
pixel that sees the nearest place. So patterns of 0 and 1 stay such, and the light of a pattern is
linear in it, whatever the squares are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import KDTree

from ltcl import checks
from ltcl.acquisition.geometry import Correspondence
from ltcl.errors import InputError

# Pixels of T, about, if the file does not say how large they are: T of all is made in memory.
DEFAULT_PIXELS = 4096
# Camera pixels along a side of a pixel of T, at least: with fewer, neighbours are not told apart.
MIN_SIDE = 3
# Projector pixels in a pixel of T: with fewer, it has no light of its own.
MIN_PROJECTOR_PIXELS = 2.0
# Distance, in projector pixels and in those between neighbouring camera pixels, up to which a
# projector pixel is seen by the camera pixel that is nearest to it.
SEEN_DISTANCE = 1.5
NO_PIXEL = -1


def default_side(camera_grid: tuple[int, int]) -> int:
    """Camera pixels along a side of a pixel of T, for about `DEFAULT_PIXELS` of them.

    >>> default_side((1080, 1920)), default_side((96, 192))
    (23, 3)
    """
    height, width = camera_grid
    return max(math.ceil(math.sqrt(height * width / DEFAULT_PIXELS)), MIN_SIDE)


def scene_grid(camera_grid: tuple[int, int], side: int) -> tuple[int, int]:
    """Height and width of T: whole squares of camera pixels.

    >>> scene_grid((1080, 1920), 23)
    (46, 83)
    """
    height, width = camera_grid
    if min(height, width) < side:
        raise InputError(
            f"side is {side}; photographs have {height} x {width} pixels, which must be at least "
            "as many"
        )
    return height // side, width // side


def camera_geometry(camera_grid: tuple[int, int], side: int) -> Correspondence:
    """The pixel of T that each camera pixel sees, for `ltcl.acquire`.

    >>> camera_geometry((4, 8), 4).x[0].tolist()
    [-0.375, -0.125, 0.125, 0.375, 0.625, 0.875, 1.125, 1.375]
    """
    height, width = scene_grid(camera_grid, side)
    row, column = np.indices(camera_grid)
    is_inside = (row < height * side) & (column < width * side)
    x = (column + 0.5) / side - 0.5
    y = (row + 0.5) / side - 0.5
    return Correspondence(x, y, is_inside, (height, width))


def is_of_squares(mapping: Correspondence) -> bool:
    """True if a map is that of `camera_geometry`, of one of several projectors.

    >>> is_of_squares(camera_geometry((9, 12), 3)), is_of_squares(Correspondence.aligned((9, 12)))
    (True, False)
    """
    step = float(np.nan_to_num(np.diff(mapping.x[0, :2])).max(initial=0.0))
    side = round(1.0 / step) if step > 0.0 else 0
    if side < MIN_SIDE or min(mapping.camera_grid) < side:
        return False
    squares = camera_geometry(mapping.camera_grid, side)
    is_same_column = np.array_equal(mapping.x, squares.x, equal_nan=True)
    return is_same_column and np.array_equal(mapping.y, squares.y, equal_nan=True)


@dataclass(frozen=True, eq=False)
class Warp:
    """The map from the pixels of T to those of a projector.

    Attributes
    ----------
    places : (h, w) int32
        The pixel of T, row by row, whose code each projector pixel shows; -1 for black.
    grid : (int, int)
        Height and width of T.

    Examples
    --------
    >>> warp = Warp(np.array([[0, 0, 1], [0, 0, -1]]), (1, 2))
    >>> warp.enlarged(np.array([[0.5, 0.8]])).tolist()
    [[0.5, 0.5, 0.8], [0.5, 0.5, 0.0]]
    """

    places: np.ndarray
    grid: tuple[int, int]

    @classmethod
    def of(cls, mapping: Correspondence, side: int) -> Warp:
        """The warp of a projector that the camera sees by `mapping`, to squares of `side`.

        InputError if squares have too few projector pixels.
        """
        grid = scene_grid(mapping.camera_grid, side)
        h, w = mapping.grid
        is_known = mapping.valid[: grid[0] * side, : grid[1] * side]
        rows, columns = np.nonzero(is_known)
        if not len(rows):
            raise InputError("the camera sees no pixel of the projector")
        places = np.stack([mapping.y[rows, columns], mapping.x[rows, columns]], axis=1)
        centres = np.indices((h, w)).reshape(2, -1).T
        distance, nearest = KDTree(places).query(centres)
        squares = (rows // side) * grid[1] + columns // side
        is_seen = distance <= _largest_distance(mapping)
        of_pixels = np.where(is_seen, squares[nearest], NO_PIXEL)
        _check_squares(of_pixels, squares, side)
        return cls(of_pixels.reshape(h, w).astype(np.int32), grid)

    @property
    def pixels(self) -> tuple[int, int]:
        """Height and width of the projector."""
        height, width = self.places.shape
        return height, width

    @cached_property
    def lit(self) -> np.ndarray:
        """Pixels of T that some projector pixel shows, (h, w) bool."""
        is_lit = np.zeros(self.grid[0] * self.grid[1], bool)
        is_lit[self.places[self.places >= 0]] = True
        return is_lit.reshape(self.grid)

    def enlarged(self, pattern: np.ndarray) -> np.ndarray:
        """The pattern (h, w[, 3]) of pixels of T on the pixels of the projector."""
        checks.shape("pattern", pattern, self.grid, (*self.grid, 3))
        flat = pattern.reshape(-1, *pattern.shape[2:])
        shown = flat[np.maximum(self.places, 0)]
        shown[self.places < 0] = 0
        return shown

    def reduced(self, picture: np.ndarray) -> np.ndarray:
        """Means of a picture (h, w[, 3]) of the projector over each pixel of T; 0 without any."""
        is_shown = self.places >= 0
        shape = (self.grid[0] * self.grid[1], *picture.shape[2:])
        total = np.zeros(shape, np.float64)
        np.add.at(total, self.places[is_shown], picture[is_shown])
        counts = np.bincount(self.places[is_shown], minlength=shape[0])
        means = total.T / np.maximum(counts, 1)
        return means.T.reshape(*self.grid, *shape[1:]).astype(np.float32)


def _largest_distance(mapping: Correspondence) -> float:
    """Distance in projector pixels from which on a place is not seen by a camera pixel."""
    steps = [np.abs(np.diff(mapping.x, axis=1)), np.abs(np.diff(mapping.y, axis=0))]
    known = np.concatenate([step[np.isfinite(step)] for step in steps])
    typical = float(np.median(known)) if len(known) else 1.0
    return SEEN_DISTANCE * max(typical, 1.0)


def _check_squares(of_pixels: np.ndarray, squares: np.ndarray, side: int) -> None:
    """Refuse squares that are smaller than projector pixels."""
    seen = np.unique(squares)
    shown = np.count_nonzero(of_pixels >= 0)
    pixels = shown / len(seen)
    if pixels < MIN_PROJECTOR_PIXELS:
        needed = math.ceil(side * math.sqrt(MIN_PROJECTOR_PIXELS / max(pixels, 1e-3)))
        raise InputError(
            f"side is {side} camera pixels, where a pixel of T has {pixels:.2g} projector pixels; "
            f"it must be {needed} or more, or the grid of the projector finer"
        )
