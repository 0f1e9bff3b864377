# SPDX-License-Identifier: BSD-3-Clause
"""What a point sees of patches: from which direction, and how much of each is not hidden."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl.errors import InputError
from ltcl.scenes.blocks import point
from ltcl.scenes.exchange.geometry import check_blocks
from ltcl.scenes.patches import Patches
from ltcl.scenes.rays import clear
from ltcl.scenes.walls import Wall

_POINTS = 4  # along a patch
_NEAR = 1e-6  # of a wall's side: a projector or camera this near lies on the wall


@dataclass(frozen=True, eq=False)
class Sight:
    """Of a point.

    Attributes
    ----------
    towards : ndarray, (N, 3)
        Unit vectors from the middle of each patch to the point, in the patch's frame.
    share : ndarray, (N,)
        Part of each patch that the point sees, of a lattice of 16 places; 0 from behind.
    """

    towards: np.ndarray
    share: np.ndarray


def sight(name: str, stand: Any, walls: Sequence[Wall], patches: Patches, blocks: Any = ()) -> Sight:
    """What a projector or camera that stands at `stand` (3,) sees of the patches of walls.

    Raises
    ------
    InputError
        If the point is no place, lies on a wall or in a block, or sees no patch from its front; `name`
        says who stands there.

    Examples
    --------
    >>> from ltcl.scenes.patches import cut
    >>> floor = Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))
    >>> seen = sight("camera", (0.5, 0.5, 1), [floor], cut([floor], 1))
    >>> seen.towards.tolist(), seen.share.tolist()
    ([[0.0, 0.0, 1.0]], [1.0])
    """
    place, boxes = np.array(point(name, stand)), check_blocks(blocks)
    _refuse_inside(name, place, walls, boxes)
    towards = place - patches.centre
    towards = np.einsum("nij,nj->ni", patches.frames, towards / np.linalg.norm(towards, axis=1)[:, None])
    step = (np.arange(_POINTS) + 0.5) / _POINTS - 0.5
    v, u = (part.ravel()[:, None] for part in np.meshgrid(step, step, indexing="ij"))
    origins = patches.centre[:, None] + u * patches.right[:, None] + v * patches.down[:, None]
    origins = origins.reshape(-1, 3)
    free = clear(walls, origins, place, boxes)
    share = np.where(towards[:, 2] > 0, free.reshape(len(patches), -1).mean(axis=1), 0.0)
    if not share.any():
        raise InputError(
            f"{name} is at {_text(place)}, where it faces none of {len(walls)} wall(s) in plain view; "
            "it must stand in front of one"
        )
    return Sight(towards, share)


def _refuse_inside(name: str, place: np.ndarray, walls: Sequence[Wall], blocks: np.ndarray) -> None:
    for wall in walls:
        edges = np.stack([wall.right, wall.down, wall.normal], axis=1).astype(np.float64)
        u, v, height = np.linalg.solve(edges, place - wall.corner)
        if abs(height) <= _NEAR * np.linalg.norm(wall.right) and 0 <= u <= 1 and 0 <= v <= 1:
            raise InputError(f"{name} is at {_text(place)}, on the wall {wall.name!r}; it must stand off it")
    for low, high in blocks:
        if ((place >= low) & (place <= high)).all():
            raise InputError(f"{name} is at {_text(place)}, in a block; it must stand outside")


def _text(place: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:g}" for value in place) + ")"
