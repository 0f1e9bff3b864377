# SPDX-License-Identifier: BSD-3-Clause
"""Walls cut into flat patches: the geometry that form factors, rays and visibility are computed from.

A picture on the walls has grid (n, walls * n), row-major: patch (r, c) of wall w is number
r * walls * n + w * n + c.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltcl import checks
from ltcl.errors import InputError
from ltcl.scenes.walls import Wall


@dataclass(frozen=True, eq=False)
class Patches:
    """Parallelograms in space, N of them.

    Attributes
    ----------
    centre, right, down : ndarray, (N, 3) float64
        Middle of each patch, and its edges along the rows and columns of the picture.
    """

    centre: np.ndarray
    right: np.ndarray
    down: np.ndarray

    def __len__(self) -> int:
        return len(self.centre)

    @property
    def normal(self) -> np.ndarray:
        """Unit normals of the sides that carry the picture, (N, 3): down x right."""
        normal = np.cross(self.down, self.right)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    @property
    def frames(self) -> np.ndarray:
        """Rows x (along `right`), y, z (the normal) of each patch's own axes, (N, 3, 3)."""
        x = self.right / np.linalg.norm(self.right, axis=1, keepdims=True)
        z = self.normal
        return np.stack([x, np.cross(z, x), z], axis=1)

    @property
    def area(self) -> np.ndarray:
        """Areas, (N,)."""
        return np.linalg.norm(np.cross(self.down, self.right), axis=1)


def cut(walls: Sequence[Wall], n: int) -> Patches:
    """The n x n patches of each wall, in the order of the picture.

    Raises
    ------
    InputError
        If there is no wall, or n is not a whole number of at least 1.

    Examples
    --------
    >>> floor = Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))
    >>> patches = cut([floor], 2)
    >>> patches.centre[:2].tolist(), patches.area.tolist()
    ([[0.25, 0.25, 0.0], [0.25, 0.75, 0.0]], [0.25, 0.25, 0.25, 0.25])
    """
    n = checks.count("n", n)
    if not walls:
        raise InputError("walls is empty; there must be at least one wall to cut")
    place = (np.arange(n) + 0.5) / n
    corner, right, down = (
        np.array([getattr(wall, name) for wall in walls], np.float64) for name in ("corner", "right", "down")
    )  # (walls, 3) each
    shape = (n, len(walls), n, 3)
    along = place[None, None, :, None] * right[None, :, None, :]
    across = place[:, None, None, None] * down[None, :, None, :]
    centre = corner[None, :, None, :] + along + across
    edges = (np.broadcast_to(edge[None, :, None, :] / n, shape).reshape(-1, 3) for edge in (right, down))
    return Patches(centre.reshape(-1, 3), *edges)
