# SPDX-License-Identifier: BSD-3-Clause
"""Weights corrected to first order: what they average lies in the middle of the projector pixel.

A row of weights `w_nm` that sums to one puts the light of projector pixel n `mean = sum_m w_nm d_m` from its
middle, d_m = n - x_m. Weights `w_nm (1 + b . (d_m - mean))` with `b = -C^-1 mean`, C the spread of d, still
sum to one and put it on n, so that constant and linear pictures come out exactly; but only as far as no
weight changes its sign, at the rim for instance.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse

from ltcl.acquisition.geometry.correspondence import Correspondence

STEEP = 1e-4  # smallest spread of the samples, in squared projector pixels, that tells a slope


def centred(
    weights: scipy.sparse.csr_array, found: Correspondence, fixed: scipy.sparse.csr_array | None = None
) -> scipy.sparse.csr_array:
    """`weights` (N, M) with the centres of `weights + fixed` on their pixels; empty rows stay.

    >>> one = np.ones((1, 3))
    >>> line = Correspondence(np.array([[-0.5, 0.0, 0.25]]), 0 * one, one, one > 0, (1, 1))
    >>> row = centred(scipy.sparse.csr_array(np.full((1, 3), 1 / 3)), line).toarray()
    >>> bool(abs(row @ [-0.5, 0.0, 0.25]) < 1e-3), round(float(row.sum()), 6)
    (True, 1.0)
    """
    n, dx, dy = _places(weights, found)
    starts = np.asarray(weights.indptr)
    total = np.bincount(n, weights.data, len(starts) - 1)
    data = weights.data / np.where(total != 0, total, 1.0)[n]
    mx, my = (np.bincount(n, data * d, len(total)) for d in (dx, dy))
    xx, xy, yy = (np.bincount(n, data * p, len(total)) for p in (dx * dx, dx * dy, dy * dy))
    xx, xy, yy = xx - mx * mx + STEEP, xy - mx * my, yy - my * my + STEEP
    det = np.maximum(xx * yy - xy * xy, STEEP**2)
    # Where `fixed` pulls the centre by some way, these weights are to have theirs as far on the other side.
    ax, ay = (m + pull for m, pull in zip((mx, my), _pull(fixed, found, total), strict=True))
    bx, by = -(yy * ax - xy * ay) / det, -(xx * ay - xy * ax) / det
    change = bx[n] * (dx - mx[n]) + by[n] * (dy - my[n])
    worst, some = np.zeros(len(total)), np.flatnonzero(np.diff(starts))
    worst[some] = np.minimum.reduceat(change, starts[some]) if len(some) else 0.0
    data = weights.data * (1 + change / np.maximum(1.0, -worst)[n])
    return scipy.sparse.csr_array((data, weights.indices, weights.indptr), shape=weights.shape)


def _places(
    weights: scipy.sparse.csr_array, found: Correspondence
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row of each entry, and n - x_m in both axes."""
    count = np.diff(np.asarray(weights.indptr))
    n = np.repeat(np.arange(len(count)), count)
    x, y = (part.ravel()[weights.indices].astype(np.float64) for part in (found.x, found.y))
    return n, n % found.grid[1] - x, n // found.grid[1] - y


def _pull(
    fixed: scipy.sparse.csr_array | None, found: Correspondence, total: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | tuple[float, float]:
    if fixed is None:
        return 0.0, 0.0
    n, dx, dy = _places(fixed, found)
    part = np.where(total != 0, total, np.inf)
    x, y = (np.bincount(n, fixed.data * d, len(total)) / part for d in (dx, dy))
    return x, y
