# SPDX-License-Identifier: BSD-3-Clause
"""A square T' of a T whose camera and projector have different pixels, as good as damages need.

The brightest entry of a row tells where the direct light of a camera pixel comes from. With at
least as many camera pixels as projector pixels, rows that share a brightest column are averaged;
with fewer, columns that share a brightest row are summed, as larger projector pixels would be.
`ltcl.align` is what bounces need; here an error of a pixel does not matter.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.transport.first_bounce import ENTRIES
from ltcl.transport.noise import Noise
from ltcl.transport.transport import Transport

# Share of the pixels of T' that have direct light, at least.
MIN_SEEN_SHARE = 0.5
# Median entry of a row, to its brightest one, from which on the row sees all patterns alike.
EVEN_SHARE = 0.5


def nearest_system(T: Transport) -> Transport | None:
    """T' of the channels of T (its diagonal blocks); None if T does not show a T' well enough."""
    if not all(isinstance(matrix, ENTRIES) for matrix in T.matrices):
        return None
    M, N = T.shape
    if T.camera_grid == T.grid:
        return Transport(T.matrices, T.grid, noise=T.noise)
    brightness = _without_even_rows(sum(T.matrices))
    if M >= N:
        group = _mean_rows(np.asarray(brightness.argmax(axis=1)).ravel(), N)
        matrices = [_dense(group @ matrix) for matrix in T.matrices]
        noise = _averaged_rows(T.noise, group)
        grid = T.grid
    else:
        group = _sum_columns(np.asarray(brightness.argmax(axis=0)).ravel(), M)
        matrices = [_dense(matrix @ group) for matrix in T.matrices]
        noise = _summed_columns(T.noise, group)
        grid = T.camera_grid
    is_seen = np.min([matrix.diagonal() for matrix in matrices], axis=0) > 0
    if is_seen.mean() < MIN_SEEN_SHARE:
        return None
    return Transport(matrices, grid, noise=noise)


def _without_even_rows(brightness: Any) -> Any:
    """The same, but 0 in rows that see all patterns alike, and so show no pixel."""
    if not isinstance(brightness, np.ndarray):
        # Most entries of a sparse row are 0.
        return brightness
    is_even = np.median(brightness, axis=1) > EVEN_SHARE * brightness.max(axis=1)
    return np.where(is_even[:, None], 0.0, brightness)


def _mean_rows(pixels: np.ndarray, N: int) -> scipy.sparse.csr_array:
    """Means (N, M) of the rows that belong to the same projector pixel."""
    counts = np.bincount(pixels, minlength=N)
    weights = 1.0 / counts[pixels]
    shape = (N, len(pixels))
    return scipy.sparse.csr_array((weights, (pixels, np.arange(len(pixels)))), shape)


def _sum_columns(pixels: np.ndarray, M: int) -> scipy.sparse.csr_array:
    """Sums (N, M) of the columns that belong to the same camera pixel."""
    shape = (len(pixels), M)
    ones = np.ones(len(pixels))
    return scipy.sparse.csr_array((ones, (np.arange(len(pixels)), pixels)), shape)


def _averaged_rows(noise: Noise, group: scipy.sparse.csr_array) -> Noise:
    rows = (group.power(2) @ noise.rows.T).T
    return replace(noise, rows=rows, white=np.full_like(rows, np.inf))


def _summed_columns(noise: Noise, group: scipy.sparse.csr_array) -> Noise:
    columns = (group.T @ noise.columns.T).T
    return replace(noise, columns=columns)


def _dense(matrix: Any) -> Any:
    if scipy.sparse.issparse(matrix):
        return scipy.sparse.csr_array(matrix)
    return np.ascontiguousarray(matrix)
