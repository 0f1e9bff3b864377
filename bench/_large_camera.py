# SPDX-License-Identifier: BSD-3-Clause
"""A colour camera of any size before a scene of many pixels, whose photographs are made in strips.

The camera looks from where the projector stands, with a margin around its picture: each of its
pixels sees the part of the picture that it covers. A photograph is the only picture of the camera's
size in memory.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse

import ltcl

# Linear camera: electrons at full scale, read noise and code without light relative to full scale.
BITS = 12
ELECTRONS = 10000.0
READ_NOISE = 0.001
BLACK = 0.004
AMBIENT = 0.01
# Part of each side of a photograph around the projector's picture.
MARGIN = 0.03
ROWS_AT_ONCE = 64
NOISE_VALUES = 1 << 22


class LargeCameraRig:
    """A projector before a scene of known T, and a linear colour camera of 12 bits.

    `count` is the number of its photographs.
    """

    channels = 3
    bits = BITS

    def __init__(self, truth: ltcl.Transport, megapixels: float) -> None:
        self.projector_grid: tuple[int, int] = truth.grid
        height = round(np.sqrt(1e6 * megapixels * 3 / 4))
        self.camera_grid = (height, 4 * height // 3)
        self.count = 0
        self._matrices = truth.matrices
        self._down = _covered(self.camera_grid[0], truth.grid[0])
        self._across = _covered(self.camera_grid[1], truth.grid[1])
        self._random = np.random.default_rng(2)
        strip = ROWS_AT_ONCE * self.camera_grid[1] * 3
        self._noise = self._random.standard_normal(NOISE_VALUES + strip, np.float32)

    def describe(self) -> dict[str, object]:
        """The rig as plain JSON."""
        return {"kind": "large camera", "camera_grid": self.camera_grid}

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        """A photograph of 12 bits, (H, W, 3) uint16, of linear codes."""
        self.count += 1
        radiance = self._radiance(np.asarray(codes, np.float32))
        image = np.empty((*self.camera_grid, 3), np.uint16)
        for top in range(0, len(image), ROWS_AT_ONCE):
            strip = image[top : top + ROWS_AT_ONCE]
            strip[:] = self._codes(seconds * self._seen(radiance, top, len(strip)))
        return image

    def _radiance(self, codes: np.ndarray) -> np.ndarray:
        """T p + ambient light in the projector's pixels, (h, w, 3)."""
        if codes.ndim == 2:
            codes = np.repeat(codes[..., None], 3, axis=2)
        radiance = np.empty((*self.projector_grid, 3), np.float32)
        for channel, A in enumerate(self._matrices):
            light = A @ codes[..., channel].ravel()
            radiance[..., channel] = light.reshape(self.projector_grid)
        return radiance + np.float32(AMBIENT)

    def _seen(self, radiance: np.ndarray, top: int, rows: int) -> np.ndarray:
        """The radiance that some rows of the camera see, (rows, W, 3)."""
        height, width, _ = radiance.shape
        down = self._down[top : top + rows] @ radiance.reshape(height, -1)
        by_column = down.reshape(rows, width, 3).transpose(1, 0, 2).reshape(width, -1)
        seen = self._across @ by_column
        return seen.reshape(-1, rows, 3).transpose(1, 0, 2)

    def _codes(self, value: np.ndarray) -> np.ndarray:
        """Codes of linear values, with the noise of photons and of reading."""
        start = self._random.integers(len(self._noise) - value.size)
        noise = self._noise[start : start + value.size].reshape(value.shape)
        value = value + noise * np.sqrt(value / ELECTRONS + READ_NOISE**2)
        full_scale = 2**BITS - 1
        return np.clip(full_scale * (BLACK + (1.0 - BLACK) * value) + 0.5, 0, full_scale)


def _covered(camera_side: int, side: int) -> Any:
    """Parts of a side's pixels that each camera pixel covers, (camera_side, side) sparse."""
    edges = (np.arange(camera_side + 1) / camera_side - MARGIN) / (1.0 - 2.0 * MARGIN) * side
    first = np.floor(edges[:-1]).astype(int)
    rows = []
    columns = []
    parts = []
    for step in range(int(np.ceil(edges[1] - edges[0])) + 1):
        column = first + step
        overlap = np.minimum(edges[1:], column + 1) - np.maximum(edges[:-1], column)
        is_there = (overlap > 0) & (column >= 0) & (column < side)
        rows.append(np.flatnonzero(is_there))
        columns.append(column[is_there])
        parts.append(overlap[is_there] / (edges[1] - edges[0]))
    places = np.concatenate(rows), np.concatenate(columns)
    shape = camera_side, side
    return scipy.sparse.csr_array((np.concatenate(parts).astype(np.float32), places), shape=shape)
