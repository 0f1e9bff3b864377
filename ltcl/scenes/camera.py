# SPDX-License-Identifier: BSD-3-Clause
"""A pinhole camera that looks at walls: it draws pictures on them, and reads images off them.

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

# Pixels along an image that OpenCV can still address.
MAX_IMAGE_SIDE = 32766
# Part of the larger side that is left free around the walls.
MARGIN = 0.03
# Output rows drawn at a time, so that supersampling stays small in memory.
ROWS_AT_ONCE = 32
# Points this far beside a wall, as a part of it, count as on it; else seams would show as cracks.
EDGE_TOLERANCE = 1e-9
# Homogeneous corners (u, v, 1) of a wall, around it.
CORNERS = np.array([(0, 0, 1), (0, 1, 1), (1, 1, 1), (1, 0, 1)], np.float64)
# A point this much nearer, as a part, does not hide another: where walls meet, rounding decides.
DEPTH_TOLERANCE = 1e-6
# Channels that OpenCV interpolates fast.
CHANNELS_AT_ONCE = 4
# Points along a patch: 256 points give a mean good to a fraction of a percent.
MAX_POINTS = 16


@dataclass(frozen=True)
class SceneCamera:
    """A pinhole eye at `eye` that looks at `target`, upright (z is up).

    InputError if it looks straight up or down, where upright means nothing.

    >>> floor = Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))
    >>> SceneCamera(eye=(2, 2, 1), target=(0, 0, 0)).sees(floor)
    True
    """

    eye: Vector
    target: Vector

    def __post_init__(self) -> None:
        if self.eye[:2] == self.target[:2]:
            raise InputError(
                f"viewer looks from {self.eye} at {self.target}, straight up or down; "
                "it must look sideways"
            )

    def sees(self, wall: Wall) -> bool:
        """True if the wall turns its picture to the camera."""
        towards = np.subtract(self.eye, wall.corner)
        return bool(towards @ wall.normal > 0)

    def homography(self, wall: Wall) -> np.ndarray:
        """H (3, 3) from (u, v, 1) on the wall to homogeneous image coordinates, x right, y down."""
        forward = np.subtract(self.target, self.eye).astype(np.float64)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        axes = np.stack([right, np.cross(forward, right), forward])
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        corner = np.subtract(wall.corner, self.eye)
        return axes @ np.stack([wall.right, wall.down, corner], axis=1)


@dataclass(frozen=True)
class ViewFrame:
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


def frame(camera: SceneCamera, walls: Sequence[Wall]) -> ViewFrame:
    """Smallest upright frame with a small margin around the walls that the camera sees.

    InputError where it sees none, or one of them is not in front of it.
    """
    seen = [wall for wall in walls if camera.sees(wall)]
    points = np.zeros((1, 3))
    if seen:
        points = np.concatenate([CORNERS @ camera.homography(wall).T for wall in seen])
    if points[:, 2].min() <= 0:
        raise InputError(
            f"viewer at {camera.eye} sees {len(seen)} of {len(walls)} walls; "
            "at least one must face the viewer, and those that do must lie in front"
        )
    places = points[:, :2] / points[:, 2:]
    low = places.min(axis=0)
    high = places.max(axis=0)
    margin = MARGIN * (high - low).max()
    return ViewFrame(centre=(low + high) / 2, size=high - low + 2 * margin)


def draw(
    camera: SceneCamera,
    walls: Sequence[Wall],
    picture: Any,
    size: int,
    supersample: int,
    screens: Sequence[Wall] = (),
) -> np.ndarray:
    """Image (H, W[, c]) float32 of a picture (h, w[, c]) on the walls, 0 on screens and beside."""
    visible = frame(camera, (*walls, *screens))
    height, width = visible.pixels(size)
    scale = supersample * visible.scale(height, width)
    painted = _painted_walls(camera, walls, picture, screens)
    x = _sample_places(width * supersample, scale, visible.centre[0])
    y = _sample_places(height * supersample, scale, visible.centre[1])
    channels = picture.shape[2:]
    image = np.zeros((height, width, *channels), dtype=np.float32)
    for row in range(0, height, ROWS_AT_ONCE):
        rows = y[row * supersample : (row + ROWS_AT_ONCE) * supersample]
        points = _lattice(x, rows)
        values = np.zeros((*points.shape[:2], *channels), dtype=np.float32)
        nearest = np.zeros(points.shape[:2])
        for homography, painting in painted:
            place, nearness = _hit(homography, points)
            is_shown = nearness > nearest
            columns = np.flatnonzero(is_shown.any(axis=0))
            if len(columns):
                # A wall covers a part of the image.
                part = (slice(None), slice(columns[0], columns[-1] + 1))
                is_painted = is_shown[part]
                nearest[part][is_painted] = nearness[part][is_painted]
                pixels = place[part] * painting.shape[1::-1] - 0.5
                values[part][is_painted] = _interpolate(painting, pixels)[is_painted]
        image[row : row + ROWS_AT_ONCE] = _shrink(values, supersample)
    return image


def _painted_walls(
    camera: SceneCamera, walls: Sequence[Wall], picture: Any, screens: Sequence[Wall]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Homography and part of the picture of each wall and black screen that the camera sees."""
    paintings = np.split(np.asarray(picture, dtype=np.float32), len(walls), axis=1)
    black = np.zeros_like(paintings[0][:1, :1])
    paintings += [black] * len(screens)
    painted = []
    for wall, painting in zip((*walls, *screens), paintings, strict=True):
        if camera.sees(wall):
            painted.append((camera.homography(wall), painting))
    return painted


def _sample_places(count: int, scale: float, centre: float) -> np.ndarray:
    """Coordinates in the image plane of the samples along one side of an image, (count,)."""
    return (np.arange(count) + 0.5 - count / 2) / scale + centre


def read(
    camera: SceneCamera,
    walls: Sequence[Wall],
    image: Any,
    grid: tuple[int, int],
    screens: Sequence[Wall] = (),
) -> np.ndarray:
    """Picture (h, w[, 3]) float32 on the walls' grid: means of an image (H, W[, 3]) by patches.

    The image just covers the frame, centred. The mean of a patch that is partly hidden is over what
    shows; patches that are hidden or seen from behind are 0.
    """
    visible = frame(camera, (*walls, *screens))
    height, width = image.shape[:2]
    scale = visible.scale(height, width)
    # From the image plane to OpenCV's pixel coordinates, whose origin is the first pixel's centre.
    shift = np.array([width - 1, height - 1]) / 2 - scale * visible.centre
    to_pixels = np.array([[scale, 0, shift[0]], [0, scale, shift[1]], [0, 0, 1]])
    patches = (grid[0], grid[1] // len(walls))
    image = np.asarray(image, dtype=np.float32)
    homographies = {}
    outlines = {}
    for number, wall in enumerate((*walls, *screens)):
        if camera.sees(wall):
            homography = camera.homography(wall)
            homographies[number] = homography
            outline = _apply(homography, CORNERS)
            outlines[number] = np.pad(outline, ((0, 0), (0, 1)))

    paintings = []
    for number in range(len(walls)):
        if number not in homographies:
            hidden = np.zeros((*patches, *image.shape[2:]), dtype=np.float32)
            paintings.append(hidden)
            continue
        hiding = []
        for screen, outline in outlines.items():
            is_same = screen == number
            if not is_same and overlap(outlines[number], outline, EDGE_TOLERANCE):
                hiding.append(homographies[screen])
        homography = homographies[number]
        painting = _read_wall(homography, to_pixels, image, patches, hiding)
        paintings.append(painting)
    return np.concatenate(paintings, axis=1)


def _apply(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Map homogeneous points (..., 3) to places (..., 2)."""
    # Not by matmul: of finite numbers some BLAS report a division by zero (numpy issue 29820).
    mapped = np.einsum("...j,ij->...i", points, homography)
    return mapped[..., :2] / mapped[..., 2:]


def _lattice(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Homogeneous points (len(y), len(x), 3)."""
    columns, rows = np.meshgrid(x, y)
    return np.stack([columns, rows, np.ones_like(columns)], axis=-1)


def _hit(homography: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (..., 2) on a wall of image points (..., 3), and 1 / depth there; 0 beside it."""
    mapped = points @ np.linalg.inv(homography).T
    nearness = mapped[..., 2]
    # The wall's plane may lie edge-on.
    with np.errstate(divide="ignore", invalid="ignore"):
        place = mapped[..., :2] / nearness[..., None]
    is_inside = (place >= -EDGE_TOLERANCE) & (place <= 1 + EDGE_TOLERANCE)
    return place, np.where(is_inside.all(axis=-1), nearness, 0)


def _read_wall(
    homography: np.ndarray,
    to_pixels: np.ndarray,
    image: np.ndarray,
    patches: tuple[int, int],
    hiding: Sequence[np.ndarray],
) -> np.ndarray:
    """Mean of the image over the footprint of each patch, where walls `hiding` leave it open."""
    h, w = patches
    border_lattice = _lattice(np.linspace(0, 1, w + 1), np.linspace(0, 1, h + 1))
    borders = _apply(to_pixels @ homography, border_lattice)
    longest_height = np.linalg.norm(np.diff(borders, axis=0), axis=-1).max()
    longest_width = np.linalg.norm(np.diff(borders, axis=1), axis=-1).max()
    pixels = np.ceil(max(longest_height, longest_width))
    points = int(np.clip(pixels, 2, MAX_POINTS))
    u = (np.arange(w * points) + 0.5) / (w * points)
    v = (np.arange(h * points) + 0.5) / (h * points)
    projected = _lattice(u, v) @ homography.T
    values = _interpolate(image, _apply(to_pixels, projected))
    if not hiding:
        return _shrink(values, points)

    nearness = 1 / projected[..., 2]
    places = projected * nearness[..., None]
    is_shown = np.ones(nearness.shape, bool)
    for screen in hiding:
        _, screen_nearness = _hit(screen, places)
        is_shown &= screen_nearness <= nearness * (1 + DEPTH_TOLERANCE)
    shown = is_shown.astype(np.float32)
    weight = _shrink(shown, points)
    if values.ndim == 3:
        shown = shown[..., None]
        weight = weight[..., None]
    least_weight = 1 / (2 * points**2)
    return _shrink(values * shown, points) / np.maximum(weight, least_weight)


def _interpolate(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Values at pixel coordinates (..., 2), x first; the border pixel goes on outside the image."""
    x, y = np.ascontiguousarray(np.moveaxis(places, -1, 0), dtype=np.float32)
    if image.ndim == 2 or image.shape[2] <= CHANNELS_AT_ONCE:
        return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    values = []
    for first in range(0, image.shape[2], CHANNELS_AT_ONCE):
        channels = image[..., first : first + CHANNELS_AT_ONCE]
        values.append(np.atleast_3d(_interpolate(channels, places)))
    return np.concatenate(values, axis=-1)


def _shrink(image: np.ndarray, factor: int) -> np.ndarray:
    """Mean over factor x factor squares."""
    h = image.shape[0] // factor
    w = image.shape[1] // factor
    return image.reshape(h, factor, w, factor, *image.shape[2:]).mean(axis=(1, 3))
