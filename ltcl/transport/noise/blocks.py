# SPDX-License-Identifier: BSD-3-Clause
"""Blocks of T between a window of the camera and one of the projector, and their noise.

The detail d of a block, orthogonal to smooth light along each of its four axes, is noise if the
scene has no edge, gloss lobe or first bounce there, and more if it has. So v = median(d^2) / 0.455
is an upper bound on the variance of its entries.

An entry of 0 may be noise: a path tracer leaves entries that no path met, a share exp(-L^2 / v) of
those of mean light L. Blocks with more zeros have dead or clipped entries, and tell nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import scipy.sparse

from ltcl.transport.noise.windows import Windows, distances

# Types of matrices whose entries are read.
ARRAYS = (np.ndarray, scipy.sparse.csr_array)
# Median of the squares of standard normal values.
MEDIAN_SQUARE = 0.4549
# Least variance, so that logarithms exist.
MIN_VARIANCE = 1e-60
# Part of the exponent L^2 / v that zeros may have, as both are estimates.
ZEROS_EXPONENT = 0.5
# Pixels by which a blurred first bounce may reach beyond its own.
BLUR_REACH = 2


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """Variances v and mean light L of blocks, (camera windows, projector windows).

    `entries` are those of T, (camera windows, pixels, projector windows, pixels). v is NaN if it is unknown. A block is `near` if its windows are so close that a blurred first
    bounce reaches it.
    """

    camera: Windows
    projector: Windows
    entries: np.ndarray
    variance: np.ndarray
    light: np.ndarray
    is_near: np.ndarray

    @classmethod
    def read(cls, T: Any, camera: Windows, projector: Windows) -> Self:
        """The blocks of T (M, N) between two sets of windows."""
        shape = (*camera.pixels.shape, *projector.pixels.shape)
        X = read_entries(T, camera.pixels.ravel(), projector.pixels.ravel())
        X = X.reshape(shape)
        variance = detail_variance(X, camera, projector)
        light = np.maximum(X.mean(axis=(1, 3)), 0.0)
        is_unknown = has_unexplained_zeros(np.mean(X == 0.0, axis=(1, 3)), light, variance)
        distance = distances(camera, projector)
        # A block with direct light is not smooth.
        is_unknown |= distance <= 0
        return cls(
            camera=camera,
            projector=projector,
            entries=X,
            variance=np.where(is_unknown, np.nan, variance),
            light=light,
            is_near=distance <= BLUR_REACH,
        )

    @property
    def is_known(self) -> np.ndarray:
        """True where the variance is known."""
        return np.isfinite(self.variance)

    def log_floors(self, q: float) -> np.ndarray:
        """log of v / (1 + q L)."""
        variance = np.maximum(self.variance, MIN_VARIANCE)
        return np.log(variance / (1.0 + q * self.light))

    def without_factors(self, rows: np.ndarray, columns: np.ndarray) -> Self:
        """The blocks with variances over factors of rows (M,) and columns (N,)."""
        row_factors = rows[self.camera.pixels].mean(axis=1)
        column_factors = columns[self.projector.pixels].mean(axis=1)
        variance = self.variance / (row_factors[:, None] * column_factors)
        return replace(self, variance=variance)

    def far_count(self) -> int:
        """Number of known blocks that no blurred first bounce reaches."""
        return int(np.count_nonzero(self.is_known & ~self.is_near))


def detail_variance(
    X: np.ndarray, camera: Windows | None = None, projector: Windows | None = None
) -> np.ndarray:
    """Median square of the detail of blocks X (a, p, b, q), over that of normal values, (a, b).

    Without windows of the camera, or of the projector, it is detail along the others alone.
    """
    d = X
    if projector is not None:
        d = np.einsum("apbq,jq->apbj", d * projector.weight, projector.detail, optimize=True)
        d /= projector.gain
    if camera is not None:
        d = d * camera.weight[:, :, None, None]
        d = np.einsum("ip,apbj->aibj", camera.detail, d, optimize=True)
        d /= camera.gain[:, :, None, None]
    return np.median(d**2, axis=(1, 3)) / MEDIAN_SQUARE


def has_unexplained_zeros(zeros: np.ndarray, light: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """True if noise of a `variance` leaves fewer entries of mean `light` at 0 than `zeros`."""
    exponent = np.full(light.shape, np.inf)
    np.divide(light**2, variance, out=exponent, where=variance > 0.0)
    explained = np.exp(-ZEROS_EXPONENT * exponent)
    return (zeros == 1.0) | (zeros > explained)


def read_entries(T: Any, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """T[rows][:, columns], float64."""
    if not isinstance(T, ARRAYS):
        # A store reads rows in ascending order.
        ascending, order = np.unique(rows, return_inverse=True)
        return np.asarray(T.between(ascending, columns), np.float64)[order]
    # The smaller selection first.
    if len(rows) < len(columns):
        entries: Any = T[rows][:, columns]
    else:
        entries = T[:, columns][rows]
    if scipy.sparse.issparse(entries):
        entries = entries.toarray()
    return np.asarray(entries, np.float64)
