# SPDX-License-Identifier: BSD-3-Clause
"""Maps from a camera to a projector, a camera whose direct light is known, and photographs of Gray code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse
from scipy.special import ndtr

from ltcl.acquisition.geometry import GrayCode

Map = tuple[np.ndarray, np.ndarray]


def homography(camera: tuple[int, int], grid: tuple[int, int]) -> Map:
    """A plane seen askance; every camera pixel lies on the projector's grid."""
    (H, W), (h, w) = camera, grid
    v, u = (c / max(n - 1, 1) for c, n in zip(np.mgrid[:H, :W], (H, W), strict=True))
    d = 1 + 0.08 * u + 0.05 * v
    return (w - 1) * (0.03 + 0.85 * u + 0.07 * v) / d, (h - 1) * (0.02 + 0.9 * v + 0.05 * u) / d


def folded(camera: tuple[int, int], grid: tuple[int, int]) -> Map:
    """Two walls that meet at an edge: the map is continuous, its slope is not."""
    x, y = homography(camera, grid)
    bend = np.maximum(np.linspace(-1, 1, camera[1]), 0.0)
    return x - 0.3 * bend * (grid[1] - 1) / 2, y + 0.08 * bend * (grid[0] - 1)


MAPS = {"homography": homography, "fold": folded}


def light_transport(x: np.ndarray, y: np.ndarray, grid: tuple[int, int], blur: float = 0.35):
    """Direct light (M, N): projector pixels are squares blurred by `blur`; camera pixels average."""
    slopes = [np.gradient(a, axis=k) if a.shape[k] > 1 else 0 * a for a in (x, y) for k in (0, 1)]
    total = scipy.sparse.csr_array((x.size, grid[0] * grid[1]))
    rows = np.arange(x.size)
    wide = []
    for c, n, (a, b) in ((x, grid[1], slopes[:2]), (y, grid[0], slopes[2:])):
        centre, s = c.ravel(), np.sqrt(blur**2 + (a**2 + b**2) / 6).ravel()
        reach = int(np.ceil(4 * s.max())) + 1
        places = [np.round(centre).astype(int) + k for k in range(-reach, reach + 1)]
        wide.append([(p, ndtr((p + 0.5 - centre) / s) - ndtr((p - 0.5 - centre) / s), n) for p in places])
    for column, weight_x, w in wide[0]:
        for row, weight_y, h in wide[1]:
            seen = (column >= 0) & (column < w) & (row >= 0) & (row < h)
            entries = ((weight_x * weight_y)[seen], (rows[seen], (row * w + column)[seen]))
            total = total + scipy.sparse.csr_array(entries, shape=total.shape)
    return total


def photographs(x: np.ndarray, y: np.ndarray, grid: tuple[int, int], noise: float, random: Any, **light: Any):
    """Of Gray code: albedo 0.6, an even part `indirect` of all light, and noise."""
    T, indirect = light_transport(x, y, grid), light.get("indirect", 0.0)
    for codes in GrayCode(grid).patterns():
        image = 0.6 * (T @ codes.ravel()).reshape(x.shape) + indirect * codes.mean()
        yield np.maximum(image + noise * random.standard_normal(x.shape), 0.0).astype(np.float32)


Place = Callable[[Any, Any], tuple[Any, Any]]


def turned(grid: tuple[int, int], size: float, turn: float, shift: tuple[float, float] = (0, 0), wide=1.25):
    """Places of a camera of `size` pixels to one of the projector's, turned and shifted; its grid."""
    (h, w), (H, W) = grid, (int(wide * size * n) for n in grid)

    def place(u: Any, v: Any) -> tuple[Any, Any]:
        a, b = (u - W / 2) / size, (v - H / 2) / size
        return a + turn * b + (w - 1) / 2 + shift[0], b - turn * a + (h - 1) / 2 + shift[1]

    return place, (H, W)


def places(place: Place, camera: tuple[int, int]) -> Map:
    """x and y of the middle of every camera pixel."""
    v, u = np.mgrid[: camera[0], : camera[1]].astype(float)
    return place(u, v)
