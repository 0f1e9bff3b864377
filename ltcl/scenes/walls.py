# SPDX-License-Identifier: BSD-3-Clause
"""Walls and blocks of a room: their places, their albedos, and that none cuts through another."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError, InputTypeError

Vector = tuple[float, float, float]

# Overlaps up to this part of the larger wall are rounding errors.
OVERLAP_TOLERANCE = 1e-9
# Names of a block's faces: the axis of the normal, and its sign.
FACES = {
    "+x": (0, 1),
    "-x": (0, -1),
    "+y": (1, 1),
    "-y": (1, -1),
    "top": (2, 1),
    "bottom": (2, -1),
}


@dataclass(frozen=True)
class Wall:
    """A parallelogram in space that carries part of a picture; z points up.

    Parameters
    ----------
    name : str
        Name for people: "left", "floor", ...
    corner, right, down : (3,) floats
        Place of the picture's top left corner, and the edges from there along its rows and columns.

    Raises
    ------
    InputError
        If the edges span no area.

    Examples
    --------
    >>> Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0)).normal
    array([0., 0., 1.])
    """

    name: str
    corner: Vector
    right: Vector
    down: Vector

    def __post_init__(self) -> None:
        if not np.any(np.cross(self.down, self.right)):
            raise InputError(
                f"wall {self.name!r} has edges {self.right} and {self.down}; they span no area"
            )

    @property
    def normal(self) -> np.ndarray:
        """Unit normal of the side that carries the picture, (3,): down x right."""
        normal = np.cross(self.down, self.right).astype(np.float64)
        return normal / np.linalg.norm(normal)

    @property
    def area(self) -> float:
        """Area of the parallelogram."""
        return float(np.linalg.norm(np.cross(self.down, self.right)))

    @property
    def outline(self) -> np.ndarray:
        """The corners (4, 3), around the front."""
        corner, right, down = np.array([self.corner, self.right, self.down], np.float64)
        return np.stack([corner, corner + down, corner + down + right, corner + right])

    def points(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Places (..., 3) at shares u of `right` and v of `down`, which broadcast."""
        corner, right, down = np.array([self.corner, self.right, self.down], np.float64)
        return corner + u[..., None] * right + v[..., None] * down

    def coordinates(self, vectors: np.ndarray) -> np.ndarray:
        """Vectors (..., 3) as parts of right, down and normal, (..., 3)."""
        edges = np.stack([self.right, self.down, self.normal], axis=1).astype(np.float64)
        return vectors @ np.linalg.inv(edges).T


@dataclass(frozen=True)
class Block:
    """An opaque box with sides along the axes: it casts shadows, and hides walls from the viewer.

    Parameters
    ----------
    corner, size : (3,) floats
        The corner nearest to the origin, and the lengths along x, y and z.
    albedo : float or (3,) floats, optional
        Albedo of all faces, one number or one colour: they become walls of the picture, lit and
        seen. Without it the block is black.

    Raises
    ------
    InputError
        If a number is not finite, a length is not above 0, or the albedo is outside [0, 1).

    Examples
    --------
    >>> block = Block(corner=(0.3, 0.4, 0), size=(0.2, 0.2, 0.5), albedo=0.6)
    >>> [wall.name for wall in block.faces()]
    ['block +x', 'block -x', 'block +y', 'block -y', 'block top', 'block bottom']
    """

    corner: Vector
    size: Vector
    albedo: Any = None

    def __post_init__(self) -> None:
        for name in ("corner", "size"):
            object.__setattr__(self, name, point(f"block {name}", getattr(self, name)))
        if min(self.size) <= 0:
            raise InputError(f"block size is {self.size}; all three lengths must be above 0")
        if self.albedo is not None:
            albedo = finite_floats("block albedo", self.albedo)
            check_albedo(checks.shape("block albedo", albedo, (), (3,)))

    @property
    def low(self) -> np.ndarray:
        """The corner nearest to the origin, (3,)."""
        return np.array(self.corner)

    @property
    def high(self) -> np.ndarray:
        """The corner farthest from the origin, (3,)."""
        return np.add(self.corner, self.size)

    def faces(self) -> tuple[Wall, ...]:
        """The six faces as walls that look outwards; side faces stand upright."""
        faces = []
        x_axis, y_axis, z_axis = np.eye(3)
        for name, (axis, sign) in FACES.items():
            normal = sign * np.eye(3)[axis]
            # Side faces hang from their upper edge; top and bottom lie as floor and ceiling do.
            if axis < 2:
                down_axis = -z_axis
            elif sign > 0:
                down_axis = x_axis
            else:
                down_axis = y_axis
            right = np.cross(normal, down_axis) * self.size
            down = down_axis * self.size
            corner = (self.low + self.high + normal * self.size - right - down) / 2
            faces.append(Wall(f"block {name}", vector(corner), vector(right), vector(down)))
        return tuple(faces)


def box_corners(blocks: Sequence[Block]) -> np.ndarray:
    """Low and high corner of each block, (B, 2, 3)."""
    corners = [(block.low, block.high) for block in blocks]
    return np.array(corners).reshape(-1, 2, 3)


def finite_floats(name: str, value: Any) -> np.ndarray:
    """Return `value` as float64; refuse other than finite real numbers."""
    return checks.finite(name, checks.real(name, value)).astype(np.float64)


def vector(array: np.ndarray) -> Vector:
    """Three floats of an array (3,)."""
    x, y, z = array.tolist()
    return float(x), float(y), float(z)


def point(name: str, value: Any) -> Vector:
    """Return `value` as three finite floats.

    >>> point("light", [1, 2, 3])
    (1.0, 2.0, 3.0)
    """
    try:
        array = checks.real(name, value)
    except InputTypeError as error:
        raise InputTypeError(f"{name} is {value!r}; it must be three numbers (x, y, z)") from error
    if array.shape != (3,) or not np.isfinite(array).all():
        raise InputError(f"{name} is {value!r}; it must be three finite numbers (x, y, z)")
    return vector(array)


def spread_albedo(albedo: Any, walls: int, n: int) -> np.ndarray:
    """Albedo of every patch, (channels, n * walls * n), of one number, or one per wall or colour.

    `albedo` is a scalar; (walls,), one per wall; (3,), one colour for all walls; or (walls, 3),
    (walls, 1) or (1, 3) in full. Three numbers for three walls could be either, and are refused.

    >>> spread_albedo([0.5, 0.2], walls=2, n=1)
    array([[0.5, 0.2]])
    """
    value = finite_floats("albedo", albedo)
    if value.shape == (walls,) == (3,):
        raise InputError(
            "albedo has shape (3,) for 3 walls: one per wall, or one colour? "
            "It must be (3, 1) for one per wall, (1, 3) for a colour"
        )
    checks.shape("albedo", value, (), (walls,), (3,), (walls, 1), (1, 3), (walls, 3))
    check_albedo(value)
    value = np.atleast_1d(value)
    if value.shape == (walls,):
        value = value[:, None]
    channels = value.shape[-1]
    wall_albedos = np.broadcast_to(value, (walls, channels)).T
    shape = (channels, n, walls, n)
    patches = np.broadcast_to(wall_albedos[:, None, :, None], shape)
    return patches.reshape(channels, -1)


def check_albedo(albedo: np.ndarray) -> None:
    """Refuse albedos outside [0, 1): a patch cannot give back all the light it gets, or more."""
    bad = ~((albedo >= 0) & (albedo < 1))
    if bad.any():
        count = np.count_nonzero(bad)
        first = albedo[bad].flat[0]
        raise InputError(
            f"albedo has {count} value(s) outside [0, 1), the first {first:g}; "
            "all must be at least 0 and below 1"
        )


def refuse_crossing(walls: Sequence[Wall]) -> None:
    """Refuse walls that cut through each other, or cover each other facing the same way.

    Light could not tell which side it is on. Walls may touch: along an edge, at a corner, or one
    with its edge in the middle of the other.
    """
    for first, second in itertools.combinations(walls, 2):
        problem = _crossing(first, second)
        if problem:
            raise InputError(
                f"walls {first.name!r} and {second.name!r} {problem}; move or shorten one"
            )


def _crossing(first: Wall, second: Wall) -> str:
    """Describe how two walls cross; the text is empty if they do not."""
    a = first.outline
    b = second.outline
    longest_edge = np.abs(np.diff([a, b], axis=1)).max()
    touch = OVERLAP_TOLERANCE * longest_edge
    # Heights of the corners of each wall above the plane of the other.
    heights_a = (a - b[0]) @ _normal(b)
    heights_b = (b - a[0]) @ _normal(a)
    faces_same_way = first.normal @ second.normal > 0
    is_same_plane = np.abs([heights_a, heights_b]).max() <= touch
    if faces_same_way and is_same_plane:
        return "lie on top of each other" if overlap(a, b, touch) else ""
    depths = (-heights_a.min(), heights_a.max(), -heights_b.min(), heights_b.max())
    if min(depths) <= touch:
        return ""
    # Both planes are cut. On their common line each wall fills an interval.
    line = np.cross(_normal(a), _normal(b))
    line /= np.linalg.norm(line)
    low, high = _span(a, heights_a, line)
    other_low, other_high = _span(b, heights_b, line)
    common = min(high, other_high) - max(low, other_low)
    return "cut through each other" if common > touch else ""


def overlap(first: np.ndarray, second: np.ndarray, touch: float) -> bool:
    """True if convex outlines (4, 3) in one plane overlap: no line along an edge separates them."""
    normal = _normal(first)
    for corners in (first, second):
        for edge in np.roll(corners, -1, axis=0) - corners:
            across = np.cross(normal, edge) / np.linalg.norm(edge)
            a = first @ across
            b = second @ across
            if min(a.max(), b.max()) - max(a.min(), b.min()) <= touch:
                return False
    return True


def _normal(corners: np.ndarray) -> np.ndarray:
    normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
    return normal / np.linalg.norm(normal)


def _span(corners: np.ndarray, height: np.ndarray, line: np.ndarray) -> tuple[float, float]:
    """Interval of a line that a wall fills.

    The line is where a plane, `height` below the corners, cuts the wall.
    """
    next_corners = np.roll(corners, -1, axis=0)
    next_height = np.roll(height, -1)
    is_crossing = (height < 0) != (next_height < 0)
    drop = (height - next_height)[is_crossing]
    share = height[is_crossing] / drop
    steps = (next_corners - corners)[is_crossing]
    along = (corners[is_crossing] + share[:, None] * steps) @ line
    return float(along.min()), float(along.max())
