# SPDX-License-Identifier: BSD-3-Clause
"""Walls of a room: where they stand, how their patches see each other, how bright they are.

A picture on the walls has grid (n, walls * n): one n x n square per wall, side by side, row-major.
The matrix of form factors follows that order, so patch (r, c) of wall w is row r * walls * n + w * n + c.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError
from ltcl.scenes.exchange.cube_tables import parallel, perpendicular

Vector = tuple[float, float, float]


def vector(array: np.ndarray) -> Vector:
    """Three floats of an array (3,)."""
    x, y, z = (float(v) for v in array)
    return x, y, z


@dataclass(frozen=True)
class Wall:
    """A parallelogram in space that carries part of a picture; z points up.

    Parameters
    ----------
    name : str
        What people call it: "left", "floor", ...
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
            raise InputError(f"wall {self.name!r} has edges {self.right} and {self.down}; they span no area")

    @property
    def normal(self) -> np.ndarray:
        """Unit normal of the side that carries the picture, (3,): down x right."""
        normal = np.cross(self.down, self.right).astype(np.float64)
        return normal / np.linalg.norm(normal)

    @property
    def area(self) -> float:
        """Area of the parallelogram."""
        return float(np.linalg.norm(np.cross(self.down, self.right)))


def form_factors(walls: Sequence[Wall], n: int) -> np.ndarray:
    """Form factors of all patches of some faces of the unit cube, (N, N) float64, N = n * n * len(walls).

    Parameters
    ----------
    walls : sequence of Wall
        Different faces of the unit cube, seen from inside.
    n : int
        Patches along each side of a wall.

    Returns
    -------
    ndarray, (N, N), float64
        Entry [i, j] is the share of the light leaving patch i that meets patch j; symmetric.

    Raises
    ------
    MemoryLimitError
        If the matrix does not fit in the memory of the host.

    Examples
    --------
    >>> from ltcl.scenes.box import WALLS
    >>> float(form_factors(WALLS, 2).sum(axis=1).round(9).min())  # a closed room loses no light
    1.0
    """
    size = n * n * len(walls)
    checks.fits_host(f"a {size} x {size} matrix of form factors", 8 * size**2)
    matrix = np.zeros((size, size))
    if len(walls) == 1:
        return matrix
    meeting, facing = perpendicular(n), parallel(n, gap=n)
    axis = [_axis(wall) for wall in walls]
    places = [_doubled_places(wall, n) for wall in walls]
    for i, j in itertools.combinations(range(len(walls)), 2):
        table = facing if axis[i] == axis[j] else meeting
        # The tables count along the shared directions first; their other two offsets may be swapped.
        order = [k for k in range(3) if k not in (axis[i], axis[j])]
        order += [axis[i], axis[j]] if len(order) == 1 else []
        _gather(matrix, table, (i, places[i][:, :, order]), (j, places[j][:, :, order]))
    return matrix


def spread_albedo(albedo: Any, walls: int, n: int) -> np.ndarray:
    """Albedo of every patch, (channels, N) float64, from one number, one per wall, per colour or both.

    Parameters
    ----------
    albedo : array_like in [0, 1)
        A scalar; (walls,), one per wall; (3,), one colour for all walls; (walls, 3) or (walls, 1) or
        (1, 3) to say it in full. Three numbers for three walls could be either, and are refused.
    walls, n : int
        Number of walls, and patches along each side of one.

    Returns
    -------
    ndarray, (channels, n * walls * n), float64
        One channel, or three where colours were given.

    Raises
    ------
    InputError
        If the shape is none of the above, or could mean two things, or a value is outside [0, 1).

    Examples
    --------
    >>> spread_albedo([0.5, 0.2], walls=2, n=1)
    array([[0.5, 0.2]])
    """
    value = checks.finite("albedo", checks.real("albedo", albedo)).astype(np.float64)
    if value.shape == (walls,) == (3,):
        raise InputError(
            "albedo has shape (3,) for 3 walls: one per wall, or one colour? "
            "It must be (3, 1) for one per wall, (1, 3) for a colour"
        )
    checks.shape("albedo", value, (), (walls,), (3,), (walls, 1), (1, 3), (walls, 3))
    if value.ndim == 1:
        value = value[:, None] if len(value) == walls else value[None, :]
    check_albedo(value)
    value = np.broadcast_to(value, (walls, value.shape[-1] if value.ndim else 1))
    patches = np.broadcast_to(value.T[:, None, :, None], (value.shape[1], n, walls, n))
    return patches.reshape(value.shape[1], -1)


def check_albedo(albedo: np.ndarray) -> None:
    """Refuse albedos outside [0, 1): a patch cannot give back all the light it gets, let alone more."""
    bad = ~((albedo >= 0) & (albedo < 1))
    if bad.any():
        raise InputError(
            f"albedo has {np.count_nonzero(bad)} value(s) outside [0, 1), the first {albedo[bad].flat[0]:g}; "
            "all must be at least 0 and below 1"
        )


def _axis(wall: Wall) -> int:
    """The coordinate axis a wall is perpendicular to."""
    return int(np.argmax(np.abs(wall.normal)))


def _doubled_places(wall: Wall, n: int) -> np.ndarray:
    """Centres of the patches in half patch sides, (n, n, 3) integers: odd along the wall, even across."""
    along = np.arange(1, 2 * n, 2)
    corner, right, down = (np.asarray(v, dtype=np.int64) for v in (wall.corner, wall.right, wall.down))
    return 2 * n * corner + along[:, None, None] * down + along[None, :, None] * right


def _gather(
    matrix: np.ndarray, table: np.ndarray, first: tuple[int, np.ndarray], second: tuple[int, np.ndarray]
) -> None:
    """Write the form factors between two walls, given as (index, places), in both triangles.

    Row by row of the first wall, so that temporary arrays stay n times smaller than the block.
    """
    (i, from_places), (j, to_places) = first, second
    n = len(from_places)
    walls = round(len(matrix) / n**2)
    blocks = matrix.reshape(n, walls, n, n, walls, n)
    for r in range(n):
        # Half of a doubled difference is the offset in patches; across the wall, where it is odd,
        # rounding down gives the number of patches between patch and wall.
        offset = np.abs(from_places[r][:, None, None, :] - to_places) // 2  # (n, n, n, axes)
        block = table[tuple(np.moveaxis(offset, -1, 0))]
        blocks[r, i, :, :, j, :] = block
        blocks[:, j, :, r, i, :] = block.transpose(1, 2, 0)
