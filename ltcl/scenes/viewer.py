# SPDX-License-Identifier: BSD-3-Clause
"""A pinhole viewer who looks at walls: draws pictures on them, and reads images off them.

A point u right + v down of a wall, (u, v) in [0, 1]^2, appears at H (u, v, 1) in the image plane,
so each wall has one homography H (3 x 3), which also tells its depth there: the last coordinate. Of
walls that overlap in the image the nearest shows, point by point. Walls seen from behind are left
out, and screens, which are walls without a picture, show black. All values are linear and pass
unclipped.

Drawing interpolates linearly between patch centres and averages supersample^2 points per pixel;
reading averages a lattice of points per patch, about one per pixel of its footprint, 16 x 16 at
most, without those that are hidden.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ltcl.errors import InputError
from ltcl.scenes.walls import Vector, Wall, overlap

LONGEST = 32766  # pixels along an image that OpenCV can still address
_MARGIN = 0.03  # of the larger side, left free around the walls
_BAND = 32  # output rows drawn at a time, so that supersampling stays small in memory
_EDGE = 1e-9  # of a wall: points so far beside it count as on it, lest seams show as cracks
_AT_ONCE = 4  # channels that OpenCV interpolates fast
_MOST_POINTS = 16  # along a patch: 256 points give a mean good to a fraction of a percent


@dataclass(frozen=True)
class Viewer:
    """A pinhole eye at `eye` that looks at `target`, upright (z is up).

    InputError: it looks straight up or down, where upright means nothing.

    >>> floor = Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))
    >>> Viewer(eye=(2, 2, 1), target=(0, 0, 0)).sees(floor)
    True
    """

    eye: Vector
    target: Vector

    def __post_init__(self) -> None:
        if self.eye[:2] == self.target[:2]:
            raise InputError(
                f"viewer looks from {self.eye} at {self.target}, straight up or down; it must look sideways"
            )

    def sees(self, wall: Wall) -> bool:
        """Whether the wall turns its picture to the viewer."""
        return bool(np.subtract(self.eye, wall.corner) @ wall.normal > 0)

    def homography(self, wall: Wall) -> np.ndarray:
        """H (3, 3) from (u, v, 1) on the wall to homogeneous image plane coordinates, x right, y down."""
        forward = np.subtract(self.target, self.eye).astype(np.float64)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        axes = np.stack([right, np.cross(forward, right), forward])
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        return axes @ np.stack([wall.right, wall.down, np.subtract(wall.corner, self.eye)], axis=1)


@dataclass(frozen=True)
class Frame:
    """The part of the image plane that holds all visible walls: centre (x, y) and size (x, y)."""

    centre: np.ndarray
    size: np.ndarray

    def pixels(self, longer: int) -> tuple[int, int]:
        """(height, width) of an image of the frame, `longer` pixels along its longer side."""
        # Rounding up keeps the scale that `scale` finds for this image exactly longer / max(size).
        width, height = np.ceil(longer * self.size / self.size.max() - 1e-9).astype(int)
        return int(height), int(width)

    def scale(self, height: int, width: int) -> float:
        """Pixels per unit of the image plane at which an image just covers the frame."""
        return float(np.min([width, height] / self.size))


def frame(viewer: Viewer, walls: Sequence[Wall]) -> Frame:
    """Smallest upright frame with a small margin around the walls the viewer sees, in front, one at least."""
    corners = np.array([(0, 0, 1), (0, 1, 1), (1, 0, 1), (1, 1, 1)], dtype=np.float64)
    seen = [corners @ viewer.homography(wall).T for wall in walls if viewer.sees(wall)]
    points = np.concatenate(seen) if seen else np.zeros((1, 3))
    if points[:, 2].min() <= 0:
        raise InputError(
            f"viewer at {viewer.eye} sees {len(seen)} of {len(walls)} walls; "
            "at least one must face the viewer, and those that do must lie in front"
        )
    places = points[:, :2] / points[:, 2:]
    low, high = places.min(axis=0), places.max(axis=0)
    return Frame((low + high) / 2, high - low + 2 * _MARGIN * (high - low).max())


def draw(
    viewer: Viewer,
    walls: Sequence[Wall],
    picture: Any,
    size: int,
    supersample: int,
    screens: Sequence[Wall] = (),
) -> np.ndarray:
    """Image (H, W[, c]) float32 of a picture (h, w[, c]) on the walls; 0 on screens and beside all."""
    visible = frame(viewer, (*walls, *screens))
    height, width = visible.pixels(size)
    scale = supersample * visible.scale(height, width)
    parts = np.split(np.asarray(picture, dtype=np.float32), len(walls), axis=1)
    black = np.zeros_like(parts[0][:1, :1])
    pictured = [*zip(walls, parts, strict=True), *((screen, black) for screen in screens)]
    seen = [(viewer.homography(wall), painting) for wall, painting in pictured if viewer.sees(wall)]
    image = np.zeros((height, width, *picture.shape[2:]), dtype=np.float32)
    x = (np.arange(width * supersample) + 0.5 - width * supersample / 2) / scale + visible.centre[0]
    y = (np.arange(height * supersample) + 0.5 - height * supersample / 2) / scale + visible.centre[
        1
    ]
    for row in range(0, height, _BAND):
        rows = y[row * supersample : (row + _BAND) * supersample]
        points = _lattice(x, rows)
        values = np.zeros((*points.shape[:2], *picture.shape[2:]), dtype=np.float32)
        nearest = np.zeros(points.shape[:2])
        for homography, painting in seen:
            place, nearness = _hit(homography, points)
            shown = nearness > nearest
            if shown.any():
                nearest[shown] = nearness[shown]
                values[shown] = _interpolate(painting, place * painting.shape[1::-1] - 0.5)[shown]
        image[row : row + _BAND] = _shrink(values, supersample)
    return image


def read(
    viewer: Viewer,
    walls: Sequence[Wall],
    image: Any,
    grid: tuple[int, int],
    screens: Sequence[Wall] = (),
) -> np.ndarray:
    """Picture (h, w[, 3]) float32 on the walls' grid: means of an image (H, W[, 3]) over the patches.

    The image just covers the frame, centred. Of patches partly hidden the mean is over what shows;
    those hidden or seen from behind are 0.
    """
    visible = frame(viewer, (*walls, *screens))
    height, width = image.shape[:2]
    scale = visible.scale(height, width)
    # From the image plane to OpenCV's pixel coordinates, whose origin is the first pixel's centre.
    shift = np.array([width - 1, height - 1]) / 2 - scale * visible.centre
    to_pixels = np.array([[scale, 0, shift[0]], [0, scale, shift[1]], [0, 0, 1]])
    patches = (grid[0], grid[1] // len(walls))
    image = np.asarray(image, dtype=np.float32)
    seen = {
        i: viewer.homography(wall) for i, wall in enumerate((*walls, *screens)) if viewer.sees(wall)
    }
    corners = np.array([(0, 0, 1), (0, 1, 1), (1, 1, 1), (1, 0, 1)], dtype=np.float64)
    outlines = {
        i: np.pad(_apply(homography, corners), ((0, 0), (0, 1))) for i, homography in seen.items()
    }
    parts = []
    for i in range(len(walls)):
        if i in seen:
            others = [j for j in seen if j != i and overlap(outlines[i], outlines[j], touch=1e-9)]
            hiding = [seen[j] for j in others]
            parts.append(_read_wall(seen[i], to_pixels, image, patches, hiding))
        else:
            parts.append(np.zeros((*patches, *image.shape[2:]), dtype=np.float32))
    return np.concatenate(parts, axis=1)


def _apply(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(..., 2) from homogeneous (..., 3)."""
    # Not by matmul: of finite numbers some BLAS report a division by zero (numpy issue 29820).
    mapped = np.einsum("...j,ij->...i", points, homography)
    return mapped[..., :2] / mapped[..., 2:]


def _lattice(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Homogeneous points (len(y), len(x), 3)."""
    return np.stack([*np.meshgrid(x, y), np.ones((len(y), len(x)))], axis=-1)


def _hit(homography: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where on a wall points of the image plane (..., 3) lie, (..., 2), and 1 / depth there; 0 beside it."""
    place = points @ np.linalg.inv(homography).T
    nearness = place[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):  # where the wall's plane lies edge-on
        place = place[..., :2] / nearness[..., None]
    inside = np.all((place >= -_EDGE) & (place <= 1 + _EDGE), axis=-1)
    return place, np.where(inside, nearness, 0)


def _read_wall(
    homography: np.ndarray,
    to_pixels: np.ndarray,
    image: np.ndarray,
    patches: tuple[int, int],
    hiding: Sequence[np.ndarray],
) -> np.ndarray:
    """Mean of the image over the footprint of each patch of one wall, where walls `hiding` leave it open."""
    h, w = patches
    borders = _apply(
        to_pixels @ homography, _lattice(np.linspace(0, 1, w + 1), np.linspace(0, 1, h + 1))
    )
    sides = [np.linalg.norm(np.diff(borders, axis=axis), axis=-1).max() for axis in (0, 1)]
    points = int(np.clip(np.ceil(max(sides)), 2, _MOST_POINTS))
    u = (np.arange(w * points) + 0.5) / (w * points)
    v = (np.arange(h * points) + 0.5) / (h * points)
    projected = _lattice(u, v) @ homography.T
    values = _interpolate(image, _apply(to_pixels, projected))
    if not hiding:
        return _shrink(values, points)
    nearness = 1 / projected[..., 2]
    places = projected * nearness[..., None]
    # A little nearer does not hide: where walls meet, rounding decides.
    shown = np.all([_hit(other, places)[1] <= nearness * (1 + 1e-6) for other in hiding], axis=0)
    shown = shown.astype(np.float32)
    weight = _shrink(shown, points)
    shown = shown.reshape(*shown.shape, *[1] * (values.ndim - 2))
    weight = weight.reshape(*weight.shape, *[1] * (values.ndim - 2))
    return _shrink(values * shown, points) / np.maximum(weight, 1 / (2 * points**2))


def _interpolate(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Values at pixel coordinates (..., 2), x first; the border pixel goes on outside the image."""
    x, y = np.ascontiguousarray(np.moveaxis(places, -1, 0), dtype=np.float32)
    if image.ndim == 2 or image.shape[2] <= _AT_ONCE:
        return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    parts = [image[..., k : k + _AT_ONCE] for k in range(0, image.shape[2], _AT_ONCE)]
    return np.concatenate([np.atleast_3d(_interpolate(part, places)) for part in parts], axis=-1)


def _shrink(image: np.ndarray, factor: int) -> np.ndarray:
    """Mean over factor x factor squares."""
    h, w = image.shape[0] // factor, image.shape[1] // factor
    return image.reshape(h, factor, w, factor, *image.shape[2:]).mean(axis=(1, 3))
