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


def spilled(n: int, spill: float) -> ltcl.Transport:
    """A corner whose pixels light up to `spill` of their own light on each of their neighbours."""
    scene = ltcl.scenes.dihedral(n, albedo=0.8)
    (T,) = scene.matrices()
    index, rng = np.arange(len(T)).reshape(scene.grid), np.random.default_rng(0)
    for shift in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        near = np.roll(index, shift, (0, 1)).ravel()
        T[near, index.ravel()] += spill * scene.first_bounce * rng.random(len(T))
    return ltcl.Transport(T, scene.grid, first_bounce=scene.first_bounce)


def sharp(n: int) -> ltcl.Transport:
    """A corner, where a few pixels also light up one another."""
    scene = ltcl.scenes.dihedral(n, albedo=0.6)
    (T,) = scene.matrices()
    rng = np.random.default_rng(0)
    linked = rng.random(T.shape) < 0.005
    T += 0.05 * linked * rng.random(T.shape) * scene.first_bounce
    return ltcl.Transport(T, scene.grid, first_bounce=scene.first_bounce)


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


def worst_error(S: np.ndarray, found: np.ndarray) -> float:
    """The largest ||x~ - x|| / ||x|| over all right-hand sides: ||S~^-1 E||."""
    return float(np.linalg.norm(np.linalg.solve(found, found - S), 2))


def core_arrays(C: ltcl.Transport) -> list[np.ndarray]:
    """Everything that a file would hold of a compressed transport."""
    from ltcl.transport import to_arrays

    arrays = to_arrays(C)
    return [arrays[name] for name in sorted(arrays)]
