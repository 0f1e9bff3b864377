# SPDX-License-Identifier: BSD-3-Clause
"""Walls cut into flat patches: the geometry that form factors, rays and visibility are computed from.

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
from ltcl.scenes.walls import Wall

_HAIR = 1e-5  # of the scene's size: above the rounding of coordinates, far below a patch


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

    InputError: there is no wall, or n is not a whole number of at least 1.

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
    centre = np.stack(
        [wall.points(place, place[:, None]) for wall in walls], axis=1
    )  # (n, walls, n, 3)
    edges = (
        np.broadcast_to(
            np.array([getattr(wall, name) for wall in walls], np.float64)[:, None] / n, centre.shape
        )
        for name in ("right", "down")
    )
    return Patches(centre.reshape(-1, 3), *(edge.reshape(-1, 3) for edge in edges))


def squared_size(patches: Patches) -> np.ndarray:
    """(|right|^2 + |down|^2) / 4 of every patch, (N,); the size of a pair is the root of the sum of both."""
    return (np.square(patches.right).sum(axis=1) + np.square(patches.down).sum(axis=1)) / 4


def check_patches(patches: Any) -> Patches:
    """Return `patches` if they are some, finite and each with an area."""
    if not isinstance(patches, Patches):
        raise InputTypeError(
            f"patches is a {type(patches).__name__}; it must be ltcl.scenes.Patches, see ltcl.scenes.cut"
        )
    count = len(patches)
    if count < 1:
        raise InputError("patches are 0; there must be at least 1")
    for name in ("centre", "right", "down"):
        value = checks.real(f"patches.{name}", getattr(patches, name))
        checks.finite(f"patches.{name}", checks.shape(f"patches.{name}", value, (count, 3)))
    flat = np.flatnonzero(patches.area == 0)
    if len(flat):
        raise InputError(
            f"patches has {len(flat)} without area, the first at {flat[0]}; edges must span one"
        )
    return patches


def check_blocks(blocks: Any) -> np.ndarray:
    """Return `blocks` as (B, 2, 3) float64, low and high corners of boxes; None is no box."""
    value = checks.finite("blocks", checks.real("blocks", () if blocks is None else blocks)).astype(
        np.float64
    )
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
    """The same patches in the units of kernels; boxes (B, 2, 3) as centre and half sides, shrunk by a hair.

    Where there are no boxes, one row that is not used.
    """
    half = (np.abs(patches.right) + np.abs(patches.down)) / 2
    low, high = (patches.centre - half).min(axis=0), (patches.centre + half).max(axis=0)
    middle, size = (low + high) / 2, float((high - low).max())
    placed = Patches((patches.centre - middle) / size, patches.right / size, patches.down / size)
    low, high = ((blocks[:, end] - middle) / size for end in (0, 1))
    half = (high - low) / 2
    rows = np.concatenate([(low + high) / 2, half - np.minimum(_HAIR, half / 2)], axis=1)
    return placed, device.upload(rows if len(rows) else np.zeros((1, 6)))


def lanes(device: Device) -> int:
    """Neighbouring patches that one work-item handles together."""
    return 8 if device.is_cpu else 1


def padded(device: Device, rows: np.ndarray) -> Array:
    """Rows (m, N) on the device, with zeros behind each up to whole stretches of lanes."""
    more = -rows.shape[1] % lanes(device)
    return device.upload(np.pad(rows, ((0, 0), (0, more))))
