# SPDX-License-Identifier: BSD-3-Clause
"""A projector and a camera with a known map between them, and maps to choose from."""

from __future__ import annotations

import numpy as np
import scipy.sparse
from scipy.special import ndtr

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


def distorted(camera: tuple[int, int], grid: tuple[int, int]) -> Map:
    """Radial distortion of a lens, five per cent at the corners."""
    x, y = homography(camera, grid)
    cx, cy = (grid[1] - 1) / 2, (grid[0] - 1) / 2
    r2 = ((x - cx) ** 2 + (y - cy) ** 2) / (cx**2 + cy**2)
    return cx + (x - cx) * (1 - 0.05 * r2), cy + (y - cy) * (1 - 0.05 * r2)


MAPS = {"homography": homography, "fold": folded, "distortion": distorted}


def light_transport(x: np.ndarray, y: np.ndarray, grid: tuple[int, int], blur: float = 0.35):
    """Direct light (M, N): projector pixels are squares blurred by `blur`; camera pixels average."""
    slopes = [np.gradient(a, axis=k) if a.shape[k] > 1 else 0 * a for a in (x, y) for k in (0, 1)]
    sx = np.sqrt(blur**2 + (slopes[0] ** 2 + slopes[1] ** 2) / 6).ravel()
    sy = np.sqrt(blur**2 + (slopes[2] ** 2 + slopes[3] ** 2) / 6).ravel()
    wide = [list(_weights(c.ravel(), s, n)) for c, s, n in ((x, sx, grid[1]), (y, sy, grid[0]))]
    total = scipy.sparse.csr_array((x.size, grid[0] * grid[1]))
    rows = np.arange(x.size)
    for a, wa, ina in wide[0]:
        for b, wb, inb in wide[1]:
            seen = ina & inb
            entries = ((wa * wb)[seen], (rows[seen], (b * grid[1] + a)[seen]))
            total = total + scipy.sparse.csr_array(entries, shape=total.shape)
    return total


def _weights(centre: np.ndarray, s: np.ndarray, n: int):
    reach = int(np.ceil(4 * s.max())) + 1
    for k in range(-reach, reach + 1):
        place = np.round(centre).astype(int) + k
        weight = ndtr((place + 0.5 - centre) / s) - ndtr((place - 0.5 - centre) / s)
        yield place, weight, (place >= 0) & (place < n)


class Rig:
    """Photographs of a scene: direct light, an even share of all light, noise, 8 bits or none."""

    def __init__(
        self, x, y, grid, *, noise=0.005, indirect=0.0, gamma=1.0, bits=None, albedo=0.6, full=1 / 60, seed=1
    ) -> None:
        self.T = light_transport(x, y, grid)
        self.shape, self.noise, self.indirect, self.gamma = x.shape, noise, indirect, gamma
        self.bits, self.albedo, self.full = bits, albedo, full
        self.rng, self.count = np.random.default_rng(seed), 0

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        """The scene under `codes`; `full` seconds give the albedo its own value."""
        self.count += 1
        light = codes.astype(np.float64) ** self.gamma
        image = self.albedo * (self.T @ light.ravel()).reshape(self.shape) + self.indirect * light.mean()
        image = image * seconds / self.full + self.noise * self.rng.standard_normal(self.shape)
        image = np.clip(image, 0.0, 1.0)
        if self.bits:
            image = np.round(image * (2**self.bits - 1)) / (2**self.bits - 1)
        return image.astype(np.float32)
