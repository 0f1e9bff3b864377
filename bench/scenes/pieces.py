# SPDX-License-Identifier: BSD-3-Clause
"""Surfaces of a scene cut into the pieces that the pixels of a pinhole see.

A wall is cut along the edges of pixels, beyond the frame into larger cells. Where a block stands on
a piece, its other parts are kept alone. Surfaces that face away are cut into a few cells.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from scenes.tracing import Cuboid

# Numbers in the place of a wall's, of surfaces that no pixel sees, and of the faces of blocks.
UNSEEN = -1
OF_BLOCK = -2
# Pixels along the side of pieces beyond the frame.
CELL_BEYOND_FRAME = 4
# Parts along each side of a piece that a block stands on.
PARTS_OF_COVERED = 3
# Distance before a surface at which a block covers it.
COVER_DISTANCE = 1e-5
# Pieces along each side of surfaces that face away from the pinhole.
CELLS_OF_HIDDEN_FACES = 8
# Area of a piece, relative to a pixel, from which on it is one.
LEAST_PART = 1e-6
# Rays along each side of a pixel that tell which surface it sees.
RAYS_OF_PIXEL = 8


@dataclass(kw_only=True)
class Pieces:
    """Flat convex pieces of surfaces, P of them.

    Attributes
    ----------
    corners : list of (k, 3)
        Around each piece, k at most `MAX_CORNERS`.
    surface : list of int
        Number of its surface.
    pixel : list of int
        Pixel whose frame it is in, -1 for none.
    part : list of float
        Part of the pixel that it fills, seen or hidden.
    """

    corners: list[np.ndarray] = field(default_factory=list)
    surface: list[int] = field(default_factory=list)
    pixel: list[int] = field(default_factory=list)
    part: list[float] = field(default_factory=list)

    def add(self, corners: np.ndarray, surface: int, pixel: int, part: float) -> None:
        """Add a piece."""
        self.corners.append(corners)
        self.surface.append(surface)
        self.pixel.append(pixel)
        self.part.append(part)

    def __len__(self) -> int:
        return len(self.corners)


@dataclass(frozen=True)
class Surface:
    """A flat surface: corner (3,), both edges, the side that reflects is right x up; its wall."""

    start: np.ndarray
    right: np.ndarray
    up: np.ndarray
    wall: int

    @property
    def normal(self) -> np.ndarray:
        """Unit normal, (3,)."""
        normal = np.cross(self.right, self.up)
        return normal / np.linalg.norm(normal)

    @property
    def outline(self) -> np.ndarray:
        """Its four corners, (4, 3)."""
        end = self.start + self.right
        return np.array([self.start, end, end + self.up, self.start + self.up])

    def cells(self, across: int, up: int) -> list[np.ndarray]:
        """Cut into across x up parallelograms."""
        right = self.right / across
        upwards = self.up / up
        cells = []
        for i in range(across):
            for j in range(up):
                start = self.start + i * right + j * upwards
                cells.append(Surface(start, right, upwards, self.wall).outline)
        return cells


def axes_of(block: Cuboid) -> np.ndarray:
    """Unit vectors along the sides of a block, (3, 3)."""
    angle = math.radians(block.degrees)
    return np.array(
        [
            [math.cos(angle), 0.0, -math.sin(angle)],
            [0.0, 1.0, 0.0],
            [math.sin(angle), 0.0, math.cos(angle)],
        ]
    )


def faces_of(block: Cuboid) -> list[Surface]:
    """The faces of a block but that on the floor."""
    frame = axes_of(block)
    middle = np.array(block.middle)
    half = np.array(block.half)
    faces = []
    for axis in range(3):
        for sign in (1, -1):
            if axis == 1 and sign == -1:
                continue
            first = half[(axis + 1) % 3] * frame[(axis + 1) % 3]
            second = half[(axis + 2) % 3] * frame[(axis + 2) % 3]
            if sign < 0:
                first, second = second, first
            start = middle + sign * half[axis] * frame[axis] - first - second
            faces.append(Surface(start, 2 * first, 2 * second, OF_BLOCK))
    return faces


class View:
    """The pinhole at `eye` on the z axis: places (u, v) in pixels from the upper left corner.

    `tangent` is that of half the width of the frame.
    """

    def __init__(self, eye: float, tangent: float, grid: tuple[int, int]) -> None:
        self.grid = grid
        self.eye = np.array([0.0, 0.0, eye])
        self.tangent = tangent

    def project(self, points: np.ndarray) -> np.ndarray:
        """Places (n, 2) of points (n, 3)."""
        height, width = self.grid
        from_eye = points - self.eye
        scale = -from_eye[:, 2] * self.tangent
        u = (0.5 + 0.5 * from_eye[:, 0] / scale) * width
        v = (0.5 - 0.5 * from_eye[:, 1] / scale) * height
        return np.stack([u, v], axis=1)

    def rays(self, places: np.ndarray) -> np.ndarray:
        """Directions (n, 3) through places, of depth 1."""
        height, width = self.grid
        x = (2.0 * places[:, 0] / width - 1.0) * self.tangent
        y = (1.0 - 2.0 * places[:, 1] / height) * self.tangent
        return np.stack([x, y, np.full(len(x), -1.0)], axis=1)

    def onto(self, surface: Surface, places: np.ndarray) -> np.ndarray:
        """The points (n, 3) of the plane of a surface at places."""
        rays = self.rays(places)
        distance = (surface.start - self.eye) @ surface.normal / (rays @ surface.normal)
        return self.eye + distance[:, None] * rays

    def faces(self, surface: Surface) -> bool:
        """True if the pinhole is before the surface."""
        return float((self.eye - surface.start) @ surface.normal) > 1e-9


def cut(view: View, surfaces: Sequence[Surface], blocks: Sequence[Cuboid]) -> Pieces:
    """Cut surfaces along the edges of pixels, those that are not seen into cells."""
    pieces = Pieces()
    for number, surface in enumerate(surfaces):
        if surface.wall == UNSEEN or not view.faces(surface):
            for cell in _cells_of_hidden(view, surface):
                pieces.add(cell, number, -1, 0.0)
            continue
        covering = () if surface.wall == OF_BLOCK else blocks
        for place, pixel in _places(view, surface):
            for part in _uncovered(view, surface, place, covering):
                pieces.add(view.onto(surface, part), number, pixel, _area(part))
    return pieces


def _cells_of_hidden(view: View, surface: Surface) -> list[np.ndarray]:
    """Cells of a surface that no pixel sees; as many as pixels are wide in a closed box."""
    if surface.wall != UNSEEN:
        return surface.cells(CELLS_OF_HIDDEN_FACES, CELLS_OF_HIDDEN_FACES)
    size = CELL_BEYOND_FRAME / max(view.grid)
    across = max(1, math.ceil(np.linalg.norm(surface.right) / size))
    up = max(1, math.ceil(np.linalg.norm(surface.up) / size))
    return surface.cells(across, up)


def _places(view: View, surface: Surface) -> Iterator[tuple[np.ndarray, int]]:
    """The parts of pixels and of larger cells that a surface fills, (k, 2), and their pixels."""
    height, width = view.grid
    outline = view.project(surface.outline)
    low = outline.min(axis=0)
    high = outline.max(axis=0)
    for v in _edges(low[1], high[1], height):
        row = _clip(_clip(outline, 1, v[0], 1.0), 1, v[1], -1.0)
        if len(row) < 3:
            continue
        for u in _edges(row[:, 0].min(), row[:, 0].max(), width):
            place = _clip(_clip(row, 0, u[0], 1.0), 0, u[1], -1.0)
            if _area(place) < LEAST_PART:
                continue
            is_inside = v[0] >= 0 and v[1] <= height and u[0] >= 0 and u[1] <= width
            pixel = v[0] * width + u[0] if is_inside else -1
            yield place, pixel


def _uncovered(
    view: View, surface: Surface, place: np.ndarray, blocks: Sequence[Cuboid]
) -> list[np.ndarray]:
    """A place, or those of its parts on which no block stands."""
    if not blocks:
        return [place]
    corners = np.concatenate([place, place.mean(axis=0)[None]])
    is_covered = _covered(view, surface, corners, blocks)
    if not is_covered.any():
        return [place]
    parts = []
    low = place.min(axis=0)
    size = (place.max(axis=0) - low) / PARTS_OF_COVERED
    for i in range(PARTS_OF_COVERED):
        for j in range(PARTS_OF_COVERED):
            start = low + size * (i, j)
            part = place
            for axis in range(2):
                part = _clip(part, axis, start[axis], 1.0)
                part = _clip(part, axis, start[axis] + size[axis], -1.0)
            if _area(part) < LEAST_PART:
                continue
            if not _covered(view, surface, part.mean(axis=0)[None], blocks).any():
                parts.append(part)
    return parts


def _covered(
    view: View, surface: Surface, places: np.ndarray, blocks: Sequence[Cuboid]
) -> np.ndarray:
    """True where a block stands on a surface, (n,)."""
    points = view.onto(surface, places) + COVER_DISTANCE * surface.normal
    is_covered = np.zeros(len(points), bool)
    for block in blocks:
        inside = np.abs((points - np.array(block.middle)) @ axes_of(block).T) < block.half
        is_covered |= inside.all(axis=1)
    return is_covered


def _edges(low: float, high: float, pixels: int) -> list[tuple[int, int]]:
    """First and last edge of each pixel from low to high, and of larger cells beyond the frame."""
    edges = []
    start = math.floor(max(low, 0.0))
    stop = math.ceil(min(high, pixels))
    edges += [(k, k + 1) for k in range(start, stop)]
    step = CELL_BEYOND_FRAME
    if low < 0:
        edges += [(k - step, k) for k in range(0, math.floor(low), -step)]
    if high > pixels:
        edges += [(k, k + step) for k in range(pixels, math.ceil(high), step)]
    return edges


def _clip(polygon: np.ndarray, axis: int, level: float, sign: float) -> np.ndarray:
    """The part of a convex polygon (k, 2) on one side of a line across an axis."""
    if len(polygon) == 0:
        return polygon
    height = sign * (polygon[:, axis] - level)
    corners = []
    for k in range(len(polygon)):
        following = (k + 1) % len(polygon)
        if height[k] >= 0:
            corners.append(polygon[k])
        if (height[k] > 0 > height[following]) or (height[k] < 0 < height[following]):
            share = height[k] / (height[k] - height[following])
            corners.append(polygon[k] + share * (polygon[following] - polygon[k]))
    return np.array(corners).reshape(-1, 2)


def _area(polygon: np.ndarray) -> float:
    """Area of a polygon (k, 2)."""
    if len(polygon) < 3:
        return 0.0
    x, y = polygon.T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def seen_parts(
    view: View, surfaces: Sequence[Surface], pieces: Pieces, blocks: Sequence[Cuboid]
) -> np.ndarray:
    """Parts of pixels that pieces fill before all others, by rays."""
    height, width = view.grid
    count = RAYS_OF_PIXEL
    v, u = (np.indices((height * count, width * count)) + 0.5) / count
    places = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = view.rays(places)
    nearest = np.full(len(rays), np.inf)
    found = np.full(len(rays), -1)
    for number, surface in enumerate(surfaces):
        if not view.faces(surface):
            continue
        facing = rays @ surface.normal
        distance = (surface.start - view.eye) @ surface.normal / facing
        point = view.eye + distance[:, None] * rays - surface.start
        edges = np.stack([surface.right, surface.up], axis=1)
        within = point @ np.linalg.pinv(edges).T
        is_on = ((within >= 0) & (within <= 1)).all(axis=1) & (facing < 0) & (distance > 0)
        is_nearer = is_on & (distance < nearest)
        nearest[is_nearer] = distance[is_nearer]
        found[is_nearer] = number
    row = places[:, 1].astype(int)
    pixel = row * width + places[:, 0].astype(int)
    hits = np.zeros((height * width, len(surfaces)))
    is_found = found >= 0
    np.add.at(hits, (pixel[is_found], found[is_found]), 1.0 / count**2)
    surface = np.array(pieces.surface)
    of_pixel = np.array(pieces.pixel)
    in_frame = np.flatnonzero(of_pixel >= 0)
    place = of_pixel[in_frame], surface[in_frame]
    part = np.array(pieces.part)[in_frame]
    total = np.zeros(hits.shape)
    np.add.at(total, place, part)
    seen = np.zeros(len(pieces))
    seen[in_frame] = hits[place] * part / total[place]
    # Blocks may stand on all of a place that a ray at their edge meets.
    filled = np.bincount(of_pixel[in_frame], seen[in_frame], height * width)
    seen[in_frame] /= filled[of_pixel[in_frame]]
    return seen
