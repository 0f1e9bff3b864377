# SPDX-License-Identifier: BSD-3-Clause
"""What rays meet first, and what a point sees of patches: walls with a front, and opaque black blocks.

Walls stop light from both sides; from behind they are black, as blocks are from everywhere. With o
+ t d on the plane of a wall at o + t d = corner + u right + v down, the wall is met where u and v
are in [0, 1]. All rays are tried against all walls, which suits rooms of a few walls and millions
of rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl.errors import InputError
from ltcl.scenes.patches import Patches, check_blocks
from ltcl.scenes.walls import Wall, point

_HAIR = 1e-9
"""Of a wall's or block's side: rays that aim at a seam must not slip through it, and what runs along a face
of a block is not stopped by it. Of a ray's length: where it starts and what it aims at may lie on a surface,
and walls are in front of the face of a block that they lie on."""

_SIGHT_POINTS = 4  # along a patch
_NEAR = 1e-6  # of a wall's side: a projector or camera this near lies on the wall


@dataclass(frozen=True, eq=False)
class Hits:
    """What rays met first, one entry per ray.

    `wall` is the number of the wall whose front was met; -1 where that was nothing, a block, or a
    wall's back. `u`, `v` say where on it, in [0, 1] along its right and down edges, or 0.
    `distance` counts lengths of the ray's direction; it is infinite where nothing was met.
    """

    wall: np.ndarray
    u: np.ndarray
    v: np.ndarray
    distance: np.ndarray


def cast(
    walls: Sequence[Wall], origins: np.ndarray, directions: np.ndarray, blocks: Any = ()
) -> Hits:
    """Follow rays, origins and directions (R, 3), to the nearest wall or block.

    Blocks (B, 2, 3) are opaque boxes along the axes, lowest and highest corner; walls on their
    faces reflect.

    >>> floor = Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))
    >>> start, down = np.array([[0.25, 0.5, 2.0]]), np.array([[0.0, 0.0, -1.0]])
    >>> hits = cast([floor], start, down)
    >>> int(hits.wall[0]), float(hits.u[0]), float(hits.v[0]), float(hits.distance[0])
    (0, 0.5, 0.25, 2.0)
    >>> int(cast([floor], start, down, [[(0, 0, 1), (1, 1, 1.5)]]).wall[0])
    -1
    """
    rays = len(origins)
    hits = Hits(np.full(rays, -1), np.zeros(rays), np.zeros(rays), np.full(rays, np.inf))
    for number, wall in enumerate(walls):
        _meet_wall(hits, number, wall, origins, directions)
    for low, high in check_blocks(blocks):
        _meet_block(hits, low, high, origins, directions)
    return hits


def clear(
    walls: Sequence[Wall], origins: np.ndarray, place: np.ndarray, blocks: Any = ()
) -> np.ndarray:
    """Whether nothing stands between points (R, 3) and a place (3,), or a place (R, 3) each; (R,) bool.

    Walls, from either side, and blocks are as in `cast`. The points and the place may lie on them.

    >>> floor = Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))
    >>> clear([floor], np.array([[0.5, 0.5, 0], [0.5, 0.5, -1]]), np.array([0.5, 0.5, 1])).tolist()
    [True, False]
    """
    return cast(walls, origins, place - origins, blocks).distance >= 1 - _HAIR


@dataclass(frozen=True, eq=False)
class Sight:
    """What a point sees of patches.

    `towards` (N, 3) are unit vectors from the middle of each patch to the point, in the patch's
    frame; `share` (N,) is the part of each patch that the point sees, of a lattice of 16 places, 0
    from behind.
    """

    towards: np.ndarray
    share: np.ndarray


def sight(
    name: str, stand: Any, walls: Sequence[Wall], patches: Patches, blocks: Any = ()
) -> Sight:
    """What a projector or camera that stands at `stand` (3,) sees of the patches of walls.

    InputError: it is no place, lies on a wall or in a block, or sees no patch from its front.

    >>> from ltcl.scenes import cut
    >>> floor = Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))
    >>> seen = sight("camera", (0.5, 0.5, 1), [floor], cut([floor], 1))
    >>> seen.towards.tolist(), seen.share.tolist()
    ([[0.0, 0.0, 1.0]], [1.0])
    """
    place, boxes = np.array(point(name, stand)), check_blocks(blocks)
    here = f"{name} is at ({', '.join(f'{value:g}' for value in place)})"
    for wall in walls:
        u, v, height = wall.coordinates(place - wall.corner)
        if abs(height) <= _NEAR * np.linalg.norm(wall.right) and 0 <= u <= 1 and 0 <= v <= 1:
            raise InputError(f"{here}, on the wall {wall.name!r}; it must stand off it")
    if any(((place >= low) & (place <= high)).all() for low, high in boxes):
        raise InputError(f"{here}, in a block; it must stand outside")
    towards = place - patches.centre
    towards = np.einsum(
        "nij,nj->ni", patches.frames, towards / np.linalg.norm(towards, axis=1)[:, None]
    )
    step = (np.arange(_SIGHT_POINTS) + 0.5) / _SIGHT_POINTS - 0.5
    v, u = (coordinate.ravel()[:, None] for coordinate in np.meshgrid(step, step, indexing="ij"))
    origins = patches.centre[:, None] + u * patches.right[:, None] + v * patches.down[:, None]
    free = clear(walls, origins.reshape(-1, 3), place, boxes).reshape(len(patches), -1)
    share = np.where(towards[:, 2] > 0, free.mean(axis=1), 0.0)
    if not share.any():
        raise InputError(
            f"{here}, where it faces none of {len(walls)} wall(s) in plain view; "
            "it must stand in front of one"
        )
    return Sight(towards, share)


def _meet_wall(
    hits: Hits, number: int, wall: Wall, origins: np.ndarray, directions: np.ndarray
) -> None:
    """Enter the rays that meet this wall before all that was met so far."""
    start, step = (
        wall.coordinates(origins - wall.corner),
        wall.coordinates(directions),
    )  # (R, 3): u, v, height
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = -start[:, 2] / step[:, 2]
        place = start[:, :2] + distance[:, None] * step[:, :2]
        inside = ((place >= -_HAIR) & (place <= 1 + _HAIR)).all(axis=1)
        met = inside & (distance > _HAIR) & (distance < hits.distance)
    front = met & (step[:, 2] < 0)
    hits.distance[met] = distance[met]
    hits.wall[met] = -1
    hits.wall[front] = number
    hits.u[met], hits.v[met] = np.where(front[met], np.clip(place[met].T, 0, 1), 0.0)


def _meet_block(
    hits: Hits, low: np.ndarray, high: np.ndarray, origins: np.ndarray, directions: np.ndarray
) -> None:
    """Enter the rays that meet this block first: the method of slabs."""
    hair = _HAIR * (high - low)
    low, high = low + hair, high - hair
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(low - origins) / directions, (high - origins) / directions])
    enter, leave = np.min(ends, axis=0).max(axis=1), np.max(ends, axis=0).min(axis=1)
    with np.errstate(invalid="ignore"):
        # Rays that run within a face give 0 / 0: they graze the block and pass.
        met = (enter < leave) & (leave > _HAIR) & (enter < hits.distance * (1 - _HAIR))
    hits.distance[met] = np.maximum(enter[met], 0.0)
    hits.wall[met] = -1
    hits.u[met], hits.v[met] = 0.0, 0.0
