# SPDX-License-Identifier: BSD-3-Clause
"""Small matrices that have broken kernels, in float32, so device and reference start alike.

Whole light transports with known answers are in `tests/problems.py`.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse


def signed(rows: int, columns: int, seed: int = 0) -> np.ndarray:
    """(rows, columns) values in -1..1."""
    return np.random.default_rng(seed).uniform(-1, 1, (rows, columns)).astype(np.float32)


def vectors(n: int, k: int | None, seed: int = 1) -> np.ndarray:
    """(n,) values in -1..1 where k is None, else (n, k)."""
    return signed(n, 1 if k is None else k, seed).reshape((n,) if k is None else (n, k))


def sparse(rows: int, columns: int, density: float = 0.3, seed: int = 0) -> scipy.sparse.csr_array:
    """(rows, columns) with signed values in random places."""
    keep = np.random.default_rng(seed + 1000).random((rows, columns)) < density
    return scipy.sparse.csr_array(np.where(keep, signed(rows, columns, seed), 0))


def bounces(n: int, rho: float, seed: int = 0) -> np.ndarray:
    """Nonnegative R (n, n) with spectral radius `rho`."""
    R = np.random.default_rng(seed).random((n, n))
    return (R * (rho / np.abs(np.linalg.eigvals(R)).max())).astype(np.float32)


def _stretches() -> scipy.sparse.csr_array:
    """Runs of neighbours around 16 and 32 long, at odd starts, whole and with one pixel missing."""
    A = np.zeros((24, 97), np.float32)
    for row, (start, length) in enumerate(
        (start, length) for start in (0, 1, 60) for length in (8, 15, 16, 17, 31, 32, 33, 37)
    ):
        A[row, start : start + length] = signed(1, length, row)[0]
        if row % 3 == 0:
            A[row, start + length // 2] = 0
    return scipy.sparse.csr_array(A)


def _strong_rows() -> scipy.sparse.csr_array:
    """Two rows that are full among others that hold one value: work is spread unevenly."""
    A = np.diag(signed(1, 300)[0])
    A[[7, 299]] = signed(2, 300, 1)
    return scipy.sparse.csr_array(A)


def _some_empty() -> scipy.sparse.csr_array:
    A = signed(65, 40)
    A[[0, 1, 30, 64]] = 0
    A[:, [0, 39]] = 0
    return scipy.sparse.csr_array(A)


SPARSE = {
    "1x1": scipy.sparse.csr_array(np.array([[0.5]], np.float32)),
    "53x7": sparse(53, 7),
    "7x53": sparse(7, 53),
    "129x129": sparse(129, 129, 0.1),
    "some empty": _some_empty(),
    "all empty": scipy.sparse.csr_array((5, 3), dtype=np.float32),
    "stretches": _stretches(),
    "strong rows": _strong_rows(),
}

_SHAPES = ((53, 7), (7, 53), (1, 300), (300, 1), (32, 32), (65, 129), (9, 63))
DENSE = {f"{rows}x{columns}": signed(rows, columns) for rows, columns in _SHAPES}
DENSE |= {"1x1": np.array([[0.5]], np.float32), "zeros": np.zeros((17, 9), np.float32)}
