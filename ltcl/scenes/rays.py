# SPDX-License-Identifier: BSD-3-Clause
"""Rays and lines of sight, past walls with a front and opaque black blocks.

A ray o + t d meets a wall where o + t d = corner + u right + v down with u and v in [0, 1]. Walls
stop light from both sides; from behind they are black, as blocks are from everywhere. All rays are
tried against all walls, which suits rooms of a few walls and millions of rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl.errors import InputError
from ltcl.scenes.patches import Patches, check_blocks
from ltcl.scenes.walls import Wall, point

# Tolerance as a part of the side of a wall or block: a ray that aims at a seam must not slip
# through it, and a ray that runs along a face of a block is not stopped by it. As a part of a ray's
# length: its start and its target may lie on a surface, and a wall is in front of the face of a
# block that it lies on.
RAY_TOLERANCE = 1e-9
# Points along a side of a patch that are tried for a line of sight.
SIGHT_POINTS = 4
# Part of a wall's side: a projector or camera this near lies on the wall.
ON_WALL_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class Hits:
    """The first surface that each ray meets, one entry per ray.

    `wall` is the number of the wall whose front was met; -1 where that was nothing, a block, or the
    back of a wall. `u` and `v` are the place on it, in [0, 1] along its right and down edges, or 0.
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
    """True where nothing stands between points (R, 3) and one place (3,) or a place (R, 3) each.

    The result has shape (R,). Walls, from either side, and blocks are as in `cast`. The points and
    the place may lie on them.

    >>> floor = Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))
    >>> clear([floor], np.array([[0.5, 0.5, 0], [0.5, 0.5, -1]]), np.array([0.5, 0.5, 1])).tolist()
    [True, False]
    """
    hits = cast(walls, origins, place - origins, blocks)
    return hits.distance >= 1 - RAY_TOLERANCE


@dataclass(frozen=True, eq=False)
class Sight:
    """View of patches from one point.

    `towards` (N, 3) are unit vectors from the middle of each patch to the point, in the patch's
    frame; `share` (N,) is the part of each patch that the point sees, of a lattice of 16 places, 0
    from behind.
    """

    towards: np.ndarray
    share: np.ndarray


def sight(
    name: str, stand: Any, walls: Sequence[Wall], patches: Patches, blocks: Any = ()
) -> Sight:
    """View of the patches of walls from a projector or camera that stands at `stand` (3,).

    InputError if that is no place, lies on a wall or in a block, or sees no patch from its front.

    >>> from ltcl.scenes import cut
    >>> floor = Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))
    >>> seen = sight("camera", (0.5, 0.5, 1), [floor], cut([floor], 1))
    >>> seen.towards.tolist(), seen.share.tolist()
    ([[0.0, 0.0, 1.0]], [1.0])
    """
    place = np.array(point(name, stand))
    boxes = check_blocks(blocks)
    coordinates = ", ".join(f"{value:g}" for value in place)
    position = f"{name} is at ({coordinates})"
    _check_position(position, place, walls, boxes)

    rays = place - patches.centre
    directions = rays / np.linalg.norm(rays, axis=1)[:, None]
    towards = np.einsum("nij,nj->ni", patches.frames, directions)
    step = (np.arange(SIGHT_POINTS) + 0.5) / SIGHT_POINTS - 0.5
    v, u = np.meshgrid(step, step, indexing="ij")
    u = u.reshape(-1, 1)
    v = v.reshape(-1, 1)
    right = u * patches.right[:, None]
    origins = patches.centre[:, None] + right + v * patches.down[:, None]
    is_free = clear(walls, origins.reshape(-1, 3), place, boxes)
    free_share = is_free.reshape(len(patches), -1).mean(axis=1)
    share = np.where(towards[:, 2] > 0, free_share, 0.0)
    if not share.any():
        raise InputError(
            f"{position}, where it faces none of {len(walls)} wall(s) in plain view; "
            "it must stand in front of one"
        )
    return Sight(towards, share)


def _check_position(
    position: str, place: np.ndarray, walls: Sequence[Wall], boxes: np.ndarray
) -> None:
    """Refuse a place on a wall or in a block."""
    for wall in walls:
        u, v, height = wall.coordinates(place - wall.corner)
        is_on_plane = abs(height) <= ON_WALL_TOLERANCE * np.linalg.norm(wall.right)
        if is_on_plane and 0 <= u <= 1 and 0 <= v <= 1:
            raise InputError(f"{position}, on the wall {wall.name!r}; it must stand off it")
    for low, high in boxes:
        if np.all((place >= low) & (place <= high)):
            raise InputError(f"{position}, in a block; it must stand outside")


def _meet_wall(
    hits: Hits, number: int, wall: Wall, origins: np.ndarray, directions: np.ndarray
) -> None:
    """Enter the rays that meet this wall before all surfaces so far."""
    # (R, 3): u, v, height
    start = wall.coordinates(origins - wall.corner)
    step = wall.coordinates(directions)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = -start[:, 2] / step[:, 2]
        place = start[:, :2] + distance[:, None] * step[:, :2]
        is_inside = (place >= -RAY_TOLERANCE) & (place <= 1 + RAY_TOLERANCE)
        is_nearest = (distance > RAY_TOLERANCE) & (distance < hits.distance)
        met = is_inside.all(axis=1) & is_nearest
    from_front = met & (step[:, 2] < 0)
    hits.distance[met] = distance[met]
    hits.wall[met] = -1
    hits.wall[from_front] = number
    inside = np.clip(place[met].T, 0, 1)
    hits.u[met], hits.v[met] = np.where(from_front[met], inside, 0.0)


def _meet_block(
    hits: Hits, low: np.ndarray, high: np.ndarray, origins: np.ndarray, directions: np.ndarray
) -> None:
    """Enter the rays that meet this block first: the method of slabs."""
    margin = RAY_TOLERANCE * (high - low)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_low = (low + margin - origins) / directions
        to_high = (high - margin - origins) / directions
    enter = np.minimum(to_low, to_high).max(axis=1)
    leave = np.maximum(to_low, to_high).min(axis=1)
    with np.errstate(invalid="ignore"):
        # Rays that run within a face give 0 / 0: they graze the block and pass.
        is_nearest = enter < hits.distance * (1 - RAY_TOLERANCE)
        met = (enter < leave) & (leave > RAY_TOLERANCE) & is_nearest
    hits.distance[met] = np.maximum(enter[met], 0.0)
    hits.wall[met] = -1
    hits.u[met] = 0.0
    hits.v[met] = 0.0
