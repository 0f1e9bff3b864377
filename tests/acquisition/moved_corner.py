# SPDX-License-Identifier: BSD-3-Clause
"""A corner that a projector lights from two places, whose transports are known in both.

The corner is larger than the picture, so that the projector still lights it after it has moved, and
camera pixels are smaller than the projector's. Light that bounced comes from exact form factors of
its patches, direct light from areas: nothing of it is interpolated between projector pixels.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

import ltcl
from ltcl.acquisition import VirtualRig

GRID = (16, 16)
# Rows of patches; there are as many columns on each of two walls.
PATCHES = 36
# Rows and columns of patches to a pixel of the projector.
PIXEL = (1.5, 3.0)
# Camera pixels to a side of a projector pixel, and along each side.
CAMERA_PIXELS = 3.1
CAMERA = (66, 66)
AMBIENT = 0.01


def shares(wholes: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """Share of each interval that lies in each of others; both are given by ascending edges."""
    start = np.maximum(wholes[:-1, None], parts[:-1])
    end = np.minimum(wholes[1:, None], parts[1:])
    return np.maximum(end - start, 0.0) / np.diff(wholes)[:, None]


@cache
def bounced(albedo: float) -> np.ndarray:
    """Light of patches that bounced at least once, for that which they get from the projector."""
    T = np.asarray(ltcl.scenes.dihedral(PATCHES, albedo=albedo).transport().matrices[0], np.float64)
    return T - albedo * np.eye(len(T))


@cache
def camera_transport(
    rows: float = 0.0, columns: float = 0.0, albedo: float = 0.6, spread: float = 0.0
) -> np.ndarray:
    """T (camera pixels, projector pixels) after the picture has moved by rows and columns.

    `spread` enlarges the picture by that part of its size, from its middle.
    """
    patches = []
    direct = []
    indirect = []
    for axis, shift in enumerate((rows, columns)):
        size = PATCHES * (1 + axis)
        pixel = PIXEL[axis] * (1.0 + spread)
        middle = size / 2.0 + PIXEL[axis] * shift
        lit = middle + pixel * (np.arange(GRID[axis] + 1) - GRID[axis] / 2.0)
        edges = np.arange(size + 1.0)
        camera_pixel = PIXEL[axis] / CAMERA_PIXELS
        seen = size / 2.0 + camera_pixel * (np.arange(CAMERA[axis] + 1) - CAMERA[axis] / 2.0)
        patches.append(shares(edges, lit))
        direct.append(shares(seen, lit))
        indirect.append(shares(seen, edges))
    lit_patches = np.kron(patches[0], patches[1])
    return albedo * np.kron(*direct) + np.kron(*indirect) @ (bounced(albedo) @ lit_patches)


def rig(T: np.ndarray | None = None, **options: Any) -> VirtualRig:
    """The camera before a transport, by default that of the scan."""
    matrix = camera_transport() if T is None else T
    settings: dict[str, Any] = {"bits": 12, "ambient": AMBIENT, "camera_grid": CAMERA}
    return VirtualRig(matrix.astype(np.float32), GRID, **{**settings, **options})
