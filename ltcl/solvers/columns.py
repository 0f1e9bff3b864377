# SPDX-License-Identifier: BSD-3-Clause
"""Steps that differ between right-hand sides: coefficients (k,) on the host, 0 where a column rests."""

from __future__ import annotations

import numpy as np


def ratio(numerator: np.ndarray, denominator: np.ndarray, where: np.ndarray) -> np.ndarray:
    """numerator / denominator in the columns `where` a step is taken, 0 in those that rest.

    A denominator beyond float32 gives NaN, not a step of 0 that would be repeated for ever.

    >>> ratio(np.array([1.0, 0.0]), np.array([2.0, 0.0]), np.array([True, False])).tolist()
    [0.5, 0.0]
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # the monitor sees what comes of it
        return np.where(where, numerator / np.where(np.isfinite(denominator), denominator, np.nan), 0.0)
