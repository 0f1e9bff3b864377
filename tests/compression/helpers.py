# SPDX-License-Identifier: BSD-3-Clause
"""Transports that the tests of compression share, and what they are judged by in float64."""

from __future__ import annotations

import numpy as np
import scipy.sparse

import ltcl
from tests import gallery


def smooth(grid: tuple[int, int], seed: int = 0) -> np.ndarray:
    """A smooth R with a few sharp entries, (N, N) float32."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: grid[0], : grid[1]].reshape(2, -1)
    distance = (y[:, None] - y) ** 2 / grid[0] ** 2 + (x[:, None] - x) ** 2 / grid[1] ** 2
    R = np.exp(-3 * distance) / len(x)
    R[rng.integers(0, len(x), 5), rng.integers(0, len(x), 5)] += 0.2
    return R.astype(np.float32)


def sparse(h: int, w: int) -> ltcl.Transport:
    """A few strong links between pixels, and F between 0.5 and 1."""
    n = h * w
    R = 0.3 * np.abs(gallery.sparse(n, n, 0.02).toarray())
    T = scipy.sparse.csr_array((np.eye(n) + R) * np.random.default_rng(2).uniform(0.5, 1, n))
    return ltcl.Transport(T, (h, w))


def dense_systems(T: ltcl.Transport) -> list[np.ndarray]:
    """S = T F^-1 of every channel in float64, by NumPy."""
    return [
        (matrix.toarray() if scipy.sparse.issparse(matrix) else np.asarray(matrix, np.float64)) / F
        for matrix, F in zip(T.matrices, np.atleast_2d(T.first_bounce), strict=True)
    ]


def worst_error(S: np.ndarray, approximate: np.ndarray) -> float:
    """The largest ||x~ - x|| / ||x|| over all right-hand sides: ||S~^-1 E||."""
    return float(np.linalg.norm(np.linalg.solve(approximate, approximate - S), 2))
