# SPDX-License-Identifier: BSD-3-Clause
"""Walls cut into flat patches: the geometry of form factors, rays and visibility.

A picture on the walls has grid (n, walls * n), row-major: patch (r, c) of wall w is number
r * walls * n + w * n + c. Kernels compute in float32, so for them lengths are counted from the
middle of the scene in parts of its size, and boxes are shrunk by a hair: light that leaves a face
of a box, or runs along it, is not blocked by that very box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.errors import InputError, InputTypeError
from ltcl.scenes.walls import Wall, finite_floats

# Boxes are shrunk by this part of the scene's size: above the rounding of coordinates, far below a
# patch.
BOX_SHRINKAGE = 1e-5
LANES_OF_CPU = 8


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

    InputError if there is no wall, or n is not a whole number of at least 1.

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
    centres = [wall.points(place, place[:, None]) for wall in walls]
    centre = np.stack(centres, axis=1)  # (n, walls, n, 3)
    right = np.array([wall.right for wall in walls], np.float64) / n
    down = np.array([wall.down for wall in walls], np.float64) / n
    return Patches(
        centre=centre.reshape(-1, 3),
        right=np.broadcast_to(right[:, None], centre.shape).reshape(-1, 3),
        down=np.broadcast_to(down[:, None], centre.shape).reshape(-1, 3),
    )


def squared_size(patches: Patches) -> np.ndarray:
    """(|right|^2 + |down|^2) / 4 of every patch, (N,).

    The size of a pair of patches is the root of the sum of both.
    """
    right = np.square(patches.right).sum(axis=1)
    down = np.square(patches.down).sum(axis=1)
    return (right + down) / 4


def check_patches(patches: Any) -> Patches:
    """Return `patches` if there is at least one, and all are finite and have an area."""
    if not isinstance(patches, Patches):
        kind = type(patches).__name__
        raise InputTypeError(
            f"patches is a {kind}; it must be ltcl.scenes.Patches, see ltcl.scenes.cut"
        )
    count = len(patches)
    if count < 1:
        raise InputError("patches are 0; there must be at least 1")
    for name in ("centre", "right", "down"):
        place = f"patches.{name}"
        value = checks.real(place, getattr(patches, name))
        checks.shape(place, value, (count, 3))
        checks.finite(place, value)
    flat = np.flatnonzero(patches.area == 0)
    if len(flat):
        raise InputError(
            f"patches has {len(flat)} without area, the first at {flat[0]}; edges must span one"
        )
    return patches


def check_blocks(blocks: Any) -> np.ndarray:
    """Return `blocks` as (B, 2, 3) float64, low and high corners of boxes; None is no box."""
    if blocks is None:
        return np.zeros((0, 2, 3))
    value = finite_floats("blocks", blocks)
    if value.size == 0:
        return np.zeros((0, 2, 3))
    if value.ndim != 3 or value.shape[1:] != (2, 3):
        raise InputError(
            f"blocks has shape {value.shape}; it must be (B, 2, 3), two corners of each box"
        )
    bad = np.flatnonzero((value[:, 0] >= value[:, 1]).any(axis=1))
    if len(bad):
        low, high = value[bad[0]]
        raise InputError(f"blocks has a box from {low} to {high}; the first must be below")
    return value


def scaled(device: Device, patches: Patches, blocks: np.ndarray) -> tuple[Patches, Array]:
    """Patches in units of kernels, and boxes (B, 2, 3) as centre and half sides, a little smaller.

    Where there are no boxes, the array has one row that is not used.
    """
    half_extent = (np.abs(patches.right) + np.abs(patches.down)) / 2
    scene_low = (patches.centre - half_extent).min(axis=0)
    scene_high = (patches.centre + half_extent).max(axis=0)
    middle = (scene_low + scene_high) / 2
    size = float((scene_high - scene_low).max())
    placed = Patches(
        centre=(patches.centre - middle) / size,
        right=patches.right / size,
        down=patches.down / size,
    )
    if not len(blocks):
        return placed, device.upload(np.zeros((1, 6)))
    low = (blocks[:, 0] - middle) / size
    high = (blocks[:, 1] - middle) / size
    half_sides = (high - low) / 2
    shrinkage = np.minimum(BOX_SHRINKAGE, half_sides / 2)
    rows = np.concatenate([(low + high) / 2, half_sides - shrinkage], axis=1)
    return placed, device.upload(rows)


def lanes(device: Device) -> int:
    """Number of neighbouring patches that one work-item handles together."""
    return LANES_OF_CPU if device.is_cpu else 1


def padded(device: Device, rows: np.ndarray) -> Array:
    """Rows (m, N) on the device, each followed by zeros up to whole stretches of lanes."""
    missing = -rows.shape[1] % lanes(device)
    return device.upload(np.pad(rows, ((0, 0), (0, missing))))
