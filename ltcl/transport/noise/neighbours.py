# SPDX-License-Identifier: BSD-3-Clause
"""Errors of a row that lack a share of their neighbours, as those of a path tracer do.

Paths that miss a column of T meet its neighbours. Errors of a row are then

    e (1 - c G) / ||1 - c G||

with independent errors e, the binomial mean G over 3 x 3 columns, and the share c from 0 to 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy  # its subpackage ndimage is loaded at the first use

# G along one axis of the grid.
BINOMIAL = [0.25, 0.5, 0.25]
# G_00 and ||G||^2 of both axes: (1/2)^2, and ((1/4)^2 + (1/2)^2 + (1/4)^2)^2.
CENTRE = 0.25
SQUARED_NORM = 0.375**2
# Standard deviations of a mean of squares that may be chance.
CHANCE_SIGMAS = 3.0


def filter_pictures(pictures: np.ndarray, grid: tuple[int, int], c: float) -> np.ndarray:
    """(1 - c G) a / ||1 - c G|| of pictures a, (N, ...) or (3 N, ...)."""
    mean = pictures.reshape(-1, *grid, *pictures.shape[1:])
    for axis in (1, 2):
        mean = scipy.ndimage.correlate1d(mean, BINOMIAL, axis=axis, mode="nearest")
    return (pictures - c * mean.reshape(pictures.shape)) / squared_norm(c) ** 0.5


def filtered_variance(bases: Sequence[np.ndarray], c: float) -> np.ndarray:
    """Squared norms (N,) float32 of filtered products of orthonormal `bases` (h, h), (w, w)."""
    overlaps = []
    norms = []
    for basis in bases:
        mean = scipy.ndimage.correlate1d(basis, BINOMIAL, axis=1, mode="nearest")
        overlaps.append(np.sum(basis * mean, axis=1))
        norms.append(np.sum(mean**2, axis=1))
    variance = 1.0 - 2.0 * c * np.kron(*overlaps) + c**2 * np.kron(*norms)
    return (variance / squared_norm(c)).astype(np.float32)


def squared_norm(c: float) -> float:
    """||1 - c G||^2."""
    return 1.0 - 2.0 * CENTRE * c + SQUARED_NORM * c**2


def cancellation(ratio: float, scatter: float) -> float:
    """The share c for which (1 - c)^2 / ||1 - c G||^2 is `ratio`.

    The ratio is the variance of sums of a row over that of independent errors, with this relative
    standard deviation. 0 if it may be below 1 by chance.
    """
    # Written so that NaN is chance, too.
    if not ratio * (1.0 + CHANCE_SIGMAS * scatter) < 1.0:
        return 0.0
    # The lower root of a c^2 - 2 b c + 1 - ratio = 0.
    a = 1.0 - SQUARED_NORM * ratio
    b = 1.0 - CENTRE * ratio
    return (b - (b * b - a * (1.0 - ratio)) ** 0.5) / a
