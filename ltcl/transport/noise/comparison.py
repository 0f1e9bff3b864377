# SPDX-License-Identifier: BSD-3-Clause
"""Comparison of two measurements T_1 and T_2 (M, N) of one scene, some rows at a time.

(T_1 - T_2)^2 / 2 has the variance of either, if both are equally noisy.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.transport.noise.neighbours import cancellation

# Entries that are compared at once.
ENTRIES_PER_STEP = 1 << 22


def shows_rows(T: Any) -> bool:
    """True if rows of T can be read: an array, a sparse matrix, or rows of a store."""
    return hasattr(T, "rows") or isinstance(T, np.ndarray) or scipy.sparse.issparse(T)


def differences(first: Any, second: Any) -> Iterator[tuple[np.ndarray, ...]]:
    """Rows, columns, light and half of the squared difference of entries, unless both are 0."""
    for start, A, B in _row_blocks(first, second):
        i, j = np.nonzero((A != 0) | (B != 0))
        a = A[i, j]
        b = B[i, j]
        yield i + start, j, (a + b) / 2, (a - b) ** 2 / 2


def compare(first: Any, second: Any) -> tuple[float, float]:
    """Compare two measurements: errors of a row, and exposures.

    Returns the share of neighbours that errors off the diagonal lack, and how many times as bright
    `second` is as `first`.
    """
    sum_ratios: list[float] = []
    exposures: list[float] = []
    is_square = first.shape[0] == first.shape[1]
    for start, A, B in _row_blocks(first, second):
        norms_A = np.linalg.norm(A, axis=1)
        norms_B = np.linalg.norm(B, axis=1)
        is_lit = (norms_A != 0) & (norms_B != 0)
        exposures.extend(norms_B[is_lit] / norms_A[is_lit])
        E = A - B
        if is_square:
            np.fill_diagonal(E[:, start:], 0.0)
        noisy = E[E.any(axis=1)]
        sum_ratios.extend(np.sum(noisy, axis=1) ** 2 / np.sum(noisy**2, axis=1))
    neighbours = 0.0
    if sum_ratios:
        # Each ratio is the square of a normal value.
        scatter = (2.0 / len(sum_ratios)) ** 0.5
        neighbours = cancellation(float(np.mean(sum_ratios)), scatter)
    exposure = float(np.median(exposures)) if exposures else 1.0
    return neighbours, exposure


def _row_blocks(first: Any, second: Any) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """The first row and the rows of both, float64, some at a time."""
    M, N = first.shape
    step = max(1, ENTRIES_PER_STEP // N)
    for start in range(0, M, step):
        stop = min(start + step, M)
        yield start, _dense_rows(first, start, stop), _dense_rows(second, start, stop)


def _dense_rows(T: Any, start: int, stop: int) -> np.ndarray:
    rows = T.rows(start, stop) if hasattr(T, "rows") else T[start:stop]
    if scipy.sparse.issparse(rows):
        rows = rows.toarray()
    return np.asarray(rows, np.float64)
