# SPDX-License-Identifier: BSD-3-Clause
"""Places of camera pixels on a projector's grid, and photographs of Gray code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ltcl.acquisition import camera_map
from ltcl.acquisition.geometry import GrayCode

Grid = tuple[int, int]
Place = Callable[[Any, Any], tuple[Any, Any]]


def homography(camera: Grid, grid: Grid) -> Place:
    """A plane seen askance; every camera pixel lies on the projector's grid."""
    H, W = camera
    h, w = grid

    def place(u: Any, v: Any) -> tuple[Any, Any]:
        a = u / max(W - 1, 1)
        b = v / max(H - 1, 1)
        d = 1 + 0.08 * a + 0.05 * b
        x = (w - 1) * (0.03 + 0.85 * a + 0.07 * b) / d
        y = (h - 1) * (0.02 + 0.9 * b + 0.05 * a) / d
        return x, y

    return place


def turned(
    grid: Grid, size: float, turn: float, shift: tuple[float, float] = (0, 0), wide: float = 1.25
):
    """Places of a turned camera of `size` pixels to one of the projector's; its grid."""
    h, w = grid
    H = int(wide * size * h)
    W = int(wide * size * w)

    def place(u: Any, v: Any) -> tuple[Any, Any]:
        a = (u - W / 2) / size
        b = (v - H / 2) / size
        x = a + turn * b + (w - 1) / 2 + shift[0]
        y = b - turn * a + (h - 1) / 2 + shift[1]
        return x, y

    return place, (H, W)


def places(place: Place, camera: Grid) -> tuple[np.ndarray, np.ndarray]:
    """x and y of the middle of every camera pixel."""
    v, u = np.mgrid[: camera[0], : camera[1]].astype(float)
    return place(u, v)


def photographs(
    place: Place, camera: Grid, grid: Grid, noise: float, random: Any, indirect: float = 0.0
):
    """Photographs of Gray code: albedo 0.6, an even part `indirect` of all light, and noise."""
    C = camera_map(place, camera, grid, points=6)
    for codes in GrayCode(grid).patterns():
        image = 0.6 * (C @ codes.ravel()).reshape(camera) + indirect * codes.mean()
        yield np.maximum(image + noise * random.standard_normal(camera), 0.0).astype(np.float32)
