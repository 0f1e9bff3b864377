# SPDX-License-Identifier: BSD-3-Clause
"""The change of bounces by pixels of twice the size: light that is uneven within a pixel.

A pixel of T has one value for all its places. Where light changes within pixels, as beside a fold,
at a grazing angle, or at the border of a shadow, products of T are not those of the light, and
bounces are wrong though T is right. The error is about proportional to the size of a pixel, so that
it is as large as the change by pixels of 2 x 2: of that T, (M, N) -> (M / 4, N / 4),

    T'[I, J] = mean over i in I of the sum over j in J of T[i, j]

which is what a camera and a projector of such pixels would measure.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse

from ltcl.transport.first_bounce import ENTRIES

# Pixels along a side of a large pixel.
FACTOR = 2
# Large pixels whose T is inverted.
MAX_LARGE_PIXELS = 2048
# Numbers of T that are read at once.
CHUNK_NUMBERS = 1 << 22


def resolution_spread(
    T: Any, F: np.ndarray, bounces: np.ndarray, grid: tuple[int, int], is_exact: bool
) -> np.ndarray:
    """Relative change of bounces 1, 2, ... under white by pixels of twice the size.

    `bounces` (k + 1, N) are those of T (N, N), from direct light on, with its diagonal as first
    bounce, or if `is_exact` 1 / diag(T^-1). F, (N,), is 0 at masked pixels. NaN if T is too large,
    or shows no entries.

    Examples
    --------
    >>> T = np.eye(4) + 0.1
    >>> F = T.diagonal()
    >>> white = T.sum(axis=1)
    >>> direct = F * np.linalg.solve(T, white)
    >>> first = F * np.linalg.solve(T, white - direct)
    >>> resolution_spread(T, F, np.stack([direct, first]), (1, 4), False).round(2)
    array([0.27])
    """
    unknown = np.full(len(bounces) - 1, np.nan)
    average = _average(grid, F > 0)
    pixels, _ = average.shape
    if not isinstance(T, ENTRIES) or not 1 < pixels <= min(MAX_LARGE_PIXELS, len(F) - 1):
        return unknown
    # Of ones where `average` is not 0.
    add = average.T.sign()
    large = _large_pixels(T, average, add)
    try:
        inverse = np.linalg.inv(large)
    except np.linalg.LinAlgError:
        return unknown
    first_bounce = 1.0 / inverse.diagonal() if is_exact else large.diagonal()
    remaining = large.sum(axis=1)
    remaining -= first_bounce * (inverse @ remaining)
    spread = unknown
    for number, bounce in enumerate(bounces[1:]):
        of_large = first_bounce * (inverse @ remaining)
        remaining -= of_large
        expected = average @ bounce
        size = max(float(np.linalg.norm(expected)), 1e-300)
        spread[number] = np.linalg.norm(of_large - expected) / size
    return spread


def _large_pixels(T: Any, average: Any, add: Any) -> np.ndarray:
    """T of large pixels, float64; of a dense T, which may lie on the disk, some rows at a time."""
    if not isinstance(T, np.ndarray):
        return np.asarray((average @ T @ add).toarray(), np.float64)
    pixels, _ = average.shape
    large = np.zeros((pixels, pixels))
    step = max(CHUNK_NUMBERS // T.shape[1], 1)
    for start in range(0, T.shape[0], step):
        rows = slice(start, start + step)
        large += average[:, rows] @ (T[rows] @ add)
    return large


def _average(grid: tuple[int, int], is_lit: np.ndarray) -> Any:
    """Means over the lit pixels of each large pixel that has some, (large pixels, N) sparse."""
    height, width = grid
    rows = np.arange(height) // FACTOR
    columns = np.arange(width) // FACTOR
    number = (rows[:, None] * (columns[-1] + 1) + columns).ravel()
    lit = np.flatnonzero(is_lit)
    _, large_pixel, counts = np.unique(number[lit], return_inverse=True, return_counts=True)
    weights = 1.0 / counts[large_pixel]
    shape = (len(counts), len(is_lit))
    return scipy.sparse.csr_array((weights, (large_pixel, lit)), shape=shape)
