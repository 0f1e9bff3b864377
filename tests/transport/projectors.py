# SPDX-License-Identifier: BSD-3-Clause
"""Virtual projectors on a small corner, made without ltcl's transports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

import ltcl

ALBEDO = 0.5
ROWS = 8
CAMERA = (ROWS, 2 * ROWS)


@dataclass(frozen=True, kw_only=True)
class Projector:
    """A projector of `grid` pixels on the columns from left to right of the camera's picture."""

    grid: tuple[int, int]
    left: float = -0.1
    right: float = 1.1
    gain: float = 1.0
    blur: float = 0.5

    def direct(self) -> np.ndarray:
        """F_k, (M, N_k)."""
        rows = blurred(CAMERA[0], (-0.1, 1.1), self.grid[0], self.blur)
        columns = blurred(CAMERA[1], (self.left, self.right), self.grid[1], self.blur)
        return ALBEDO * self.gain * np.kron(rows, columns)


LEFT = Projector(grid=(10, 13), right=0.65)
RIGHT = Projector(grid=(12, 14), left=0.3, gain=1.3)


def blurred(camera: int, span: tuple[float, float], pixels: int, blur: float) -> np.ndarray:
    """Weights (camera pixels, projector pixels) along an axis."""
    place = (np.arange(camera) + 0.5) / camera
    at = (place - span[0]) / (span[1] - span[0]) * pixels - 0.5
    everywhere = np.arange(-3 * pixels, 4 * pixels)
    weights = np.exp(-0.5 * np.square((at[:, None] - everywhere) / blur))
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)
    inside = weights[:, 3 * pixels : 4 * pixels]
    return np.where(inside > 1e-3, inside, 0.0)


def corner() -> np.ndarray:
    """S between camera pixels, float64."""
    return ltcl.scenes.dihedral(ROWS, albedo=ALBEDO).transport().to_numpy() / ALBEDO


def transports(device: Any, S: np.ndarray, **options: Any) -> list[ltcl.Transport]:
    """T_k of the left and the right projector, in grey."""
    members = []
    for projector in (LEFT, RIGHT):
        matrix = (S @ projector.direct()).astype(np.float32)
        members.append(
            ltcl.Transport(matrix, projector.grid, camera_grid=CAMERA, device=device, **options)
        )
    return members
