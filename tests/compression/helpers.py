# SPDX-License-Identifier: BSD-3-Clause
"""Bases and transports that the tests of compression share, made without ltcl."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
import pywt

Transform = Callable[[np.ndarray], np.ndarray]


def wavelets(grid: tuple[int, int], name: str) -> Transform:
    """Orthonormal 2-D wavelets of each column of (N, k), by PyWavelets; `grid` of powers of two."""

    def transform(x: np.ndarray) -> np.ndarray:
        images = x.reshape(*grid, -1)
        levels = int(np.log2(min(grid)))
        with warnings.catch_warnings():  # filters longer than the coarsest picture wrap around it
            warnings.simplefilter("ignore", UserWarning)
            parts = pywt.wavedec2(images, name, mode="periodization", level=levels, axes=(0, 1))
        return pywt.coeffs_to_array(parts, axes=(0, 1))[0].reshape(x.shape).astype(np.float32)

    return transform


def matrix_of(transform: Transform, n: int) -> np.ndarray:
    """The (N, N) matrix of a transform, float64."""
    return transform(np.eye(n, dtype=np.float32)).astype(np.float64)


def smooth(grid: tuple[int, int], seed: int = 0) -> np.ndarray:
    """A smooth R with a few sharp entries, (N, N) float32."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: grid[0], : grid[1]].reshape(2, -1)
    distance = (y[:, None] - y) ** 2 / grid[0] ** 2 + (x[:, None] - x) ** 2 / grid[1] ** 2
    R = np.exp(-3 * distance) / len(x)
    R[rng.integers(0, len(x), 5), rng.integers(0, len(x), 5)] += 0.2
    return R.astype(np.float32)
