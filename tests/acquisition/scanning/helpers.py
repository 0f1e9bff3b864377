# SPDX-License-Identifier: BSD-3-Clause
"""Corners whose transport is known, rigs that photograph them, and errors of scans of them."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

import ltcl
from ltcl.acquisition import VirtualRig

CLEAN: dict[str, Any] = {
    "gain": None,
    "read": 0.0,
    "bits": "float",
    "response": "linear",
    "black": 0.0,
}
"""Options of a camera without noise."""


@cache
def corner(n: int = 8, albedo: float = 0.6) -> np.ndarray:
    """T of a dihedral, grid (n, 2n), float64."""
    return np.asarray(ltcl.scenes.dihedral(n, albedo=albedo).transport().matrices[0], np.float64)


def rig(n: int = 8, **options: Any) -> VirtualRig:
    """A camera on the projector's pixels, by default with 12 bits."""
    return VirtualRig(corner(n), (n, 2 * n), **{"bits": 12, "ambient": 0.01, **options})


def dense(T: ltcl.Transport) -> np.ndarray:
    """All of T, by products with every pixel."""
    n = T.grid[0] * T.grid[1]
    pixels = np.eye(n).reshape(n, *T.grid)
    return (T @ pixels).reshape(n, n).T.astype(np.float64)


def unseen_patterns(grid: tuple[int, int]) -> np.ndarray:
    """Patterns that no scan has seen: three smooth ones, three of noise; (N, 6)."""
    y, x = np.mgrid[: grid[0], : grid[1]] / max(grid)
    smooth = [0.5 + 0.5 * np.sin(9 * x + k + 5 * y) for k in range(3)]
    noise = np.random.default_rng(11).random((3, *grid))
    return np.stack([*smooth, *noise]).reshape(6, -1).T


def unit(measured: np.ndarray, truth: np.ndarray) -> float:
    """The camera's unit of light, which only its last code fixes: least squares of row sums."""
    sums = measured.sum(axis=1)
    return float(sums @ truth.sum(axis=1) / (sums @ sums))


def relative_error(measured: np.ndarray, truth: np.ndarray, grid: tuple[int, int]) -> float:
    """The largest relative error of T p over unseen patterns p, in the camera's unit."""
    P = unseen_patterns(grid)
    pictures = unit(measured, truth) * (measured @ P)
    expected = truth @ P
    errors = np.linalg.norm(pictures - expected, axis=0) / np.linalg.norm(expected, axis=0)
    return float(errors.max())
