# SPDX-License-Identifier: BSD-3-Clause
"""Light from a point: how bright it falls on each patch, with the shadows of blocks and walls.

    E = mean over points of the patch of  cos(t) / r^2,  0 where something stands in between

Each patch is the mean of 8 x 8 points in the middle of as many equal parts, so the edge of a shadow is
good to 1/64 of a patch's light or so.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ltcl.errors import InputError
from ltcl.scenes.blocks import Block, point
from ltcl.scenes.rays import clear
from ltcl.scenes.walls import Vector, Wall

_POINTS = 8


def irradiance(
    walls: Sequence[Wall], grid: tuple[int, int], light: Vector, blocks: Sequence[Block] = ()
) -> np.ndarray:
    """Light that falls on each patch from a point that shines alike in all directions, largest value 1.

    Parameters
    ----------
    walls : sequence of Wall
        Opaque, their backs as well.
    grid : (h, w)
        Patches of the picture, the walls side by side.
    light : (3,) floats
        Where the light stands.
    blocks : sequence of Block
        What casts shadows besides the walls.

    Returns
    -------
    ndarray, (h, w) float32

    Raises
    ------
    InputError
        If the light is not three finite numbers, stands inside a block, or reaches no patch.

    Examples
    --------
    >>> floor = Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))
    >>> int(irradiance([floor], (3, 3), light=(0.5, 0.5, 0.2)).argmax())
    4
    """
    where = np.array(point("light", light))
    if any(block.covers(where) for block in blocks):
        raise InputError(f"light is {light}, inside a block; move it out")
    shape = (grid[0], grid[1] // len(walls))
    parts = [_on_wall(walls, i, shape, where, blocks) for i in range(len(walls))]
    picture = np.concatenate(parts, axis=1)
    if picture.max() <= 0:
        raise InputError(f"light is {light}, from where it reaches no patch; move it in front of a wall")
    return (picture / picture.max()).astype(np.float32)


def _on_wall(
    walls: Sequence[Wall], number: int, shape: tuple[int, int], light: np.ndarray, blocks: Sequence[Block]
) -> np.ndarray:
    wall = walls[number]
    h, w = shape
    u = (np.arange(w * _POINTS) + 0.5)[:, None] / (w * _POINTS)
    v = (np.arange(h * _POINTS) + 0.5)[:, None, None] / (h * _POINTS)
    points = np.asarray(wall.corner) + u * np.asarray(wall.right) + v * np.asarray(wall.down)
    ways = light - points
    arrives = np.maximum(ways @ wall.normal, 0) / np.linalg.norm(ways, axis=-1) ** 3
    boxes = np.array([(block.low, block.high) for block in blocks]).reshape(-1, 2, 3)
    arrives *= clear(walls, points.reshape(-1, 3), light, boxes).reshape(arrives.shape)
    return arrives.reshape(h, _POINTS, w, _POINTS).mean(axis=(1, 3))
