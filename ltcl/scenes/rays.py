# SPDX-License-Identifier: BSD-3-Clause
"""The first thing a ray meets: walls, which are parallelograms with a front, and opaque black blocks.

Walls stop light from both sides; from behind they are black, as blocks are from everywhere. With o + t d
on the plane of a wall at o + t d = corner + u right + v down, the wall is met where u and v are in [0, 1].
All rays are tried against all walls, which suits rooms of a few walls and millions of rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltcl.scenes.walls import Wall

_EDGE = 1e-9  # of a wall's side: rays that aim at a seam must not slip through it
_START = 1e-9  # of a ray's length: a ray does not meet the surface it starts from
_HAIR = 1e-9  # of a block's side: what runs along a face is not stopped by it
_END = 1e-9  # of a ray's length: the place that it aims at may lie on a surface
_FACE = 1e-9  # of a ray's length: walls are in front of the face of a block that they lie on


@dataclass(frozen=True, eq=False)
class Hits:
    """What rays met first, one entry per ray.

    Attributes
    ----------
    wall : ndarray of int
        Number of the wall whose front was met; -1 where that was nothing, a block, or a wall's back.
    u, v : ndarray
        Where on the wall, in [0, 1] along its right and down edges; 0 where wall is -1.
    distance : ndarray
        How far, in lengths of the ray's direction; infinite where nothing was met.
    """

    wall: np.ndarray
    u: np.ndarray
    v: np.ndarray
    distance: np.ndarray


def cast(
    walls: Sequence[Wall],
    origins: np.ndarray,
    directions: np.ndarray,
    blocks: Sequence[np.ndarray] | np.ndarray = (),
) -> Hits:
    """Follow rays to the nearest wall or block.

    Parameters
    ----------
    walls : sequence of Wall
    origins, directions : ndarray, (R, 3)
        Directions need not be unit vectors.
    blocks : ndarray, (B, 2, 3)
        Opaque boxes along the axes, lowest and highest corner, as
        `ltcl.scenes.exchange.geometry.check_blocks` returns them. Walls on their faces reflect.

    Examples
    --------
    >>> floor = Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))
    >>> down = np.array([[0.0, 0.0, -1.0]])
    >>> hits = cast([floor], np.array([[0.25, 0.5, 2.0]]), down)
    >>> int(hits.wall[0]), float(hits.u[0]), float(hits.v[0]), float(hits.distance[0])
    (0, 0.5, 0.25, 2.0)
    >>> block = np.array([[(0, 0, 1), (1, 1, 1.5)]])
    >>> int(cast([floor], np.array([[0.25, 0.5, 2.0]]), down, block).wall[0])
    -1
    """
    rays = len(origins)
    found = Hits(np.full(rays, -1), np.zeros(rays), np.zeros(rays), np.full(rays, np.inf))
    for number, wall in enumerate(walls):
        _meet_wall(found, number, wall, origins, directions)
    for low, high in blocks:
        _meet_block(found, low, high, origins, directions)
    return found


def clear(
    walls: Sequence[Wall],
    origins: np.ndarray,
    place: np.ndarray,
    blocks: Sequence[np.ndarray] | np.ndarray = (),
) -> np.ndarray:
    """Whether nothing stands between points (R, 3) and a place (3,), or a place (R, 3) each; (R,) bool.

    Walls, from either side, and blocks are as in `cast`. The points and the place may lie on them.

    Examples
    --------
    >>> floor = Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))
    >>> clear([floor], np.array([[0.5, 0.5, 0], [0.5, 0.5, -1]]), np.array([0.5, 0.5, 1])).tolist()
    [True, False]
    """
    return cast(walls, origins, place - origins, blocks).distance >= 1 - _END


def _meet_wall(found: Hits, number: int, wall: Wall, origins: np.ndarray, directions: np.ndarray) -> None:
    """Enter the rays that meet this wall before all that was met so far."""
    # Rows that give u, v and the height over the wall of a point from its corner.
    edges = np.stack([wall.right, wall.down, wall.normal], axis=1).astype(np.float64)
    inverse = np.linalg.inv(edges)
    start, step = (origins - wall.corner) @ inverse.T, directions @ inverse.T  # (R, 3) each
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = -start[:, 2] / step[:, 2]
        place = start[:, :2] + distance[:, None] * step[:, :2]
        inside = ((place >= -_EDGE) & (place <= 1 + _EDGE)).all(axis=1)
        met = inside & (distance > _START) & (distance < found.distance)
    front = met & (step[:, 2] < 0)
    found.distance[met] = distance[met]
    found.wall[met] = -1
    found.wall[front] = number
    found.u[met], found.v[met] = np.where(front[met], np.clip(place[met].T, 0, 1), 0.0)


def _meet_block(
    found: Hits, low: np.ndarray, high: np.ndarray, origins: np.ndarray, directions: np.ndarray
) -> None:
    """Enter the rays that meet this block first: the method of slabs."""
    hair = _HAIR * (high - low)
    low, high = low + hair, high - hair
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(low - origins) / directions, (high - origins) / directions])
    enter, leave = np.min(ends, axis=0).max(axis=1), np.max(ends, axis=0).min(axis=1)
    with np.errstate(invalid="ignore"):
        # Rays that run within a face give 0 / 0: they graze the block and pass.
        met = (enter < leave) & (leave > _START) & (enter < found.distance * (1 - _FACE))
    found.distance[met] = np.maximum(enter[met], 0.0)
    found.wall[met] = -1
    found.u[met], found.v[met] = 0.0, 0.0
