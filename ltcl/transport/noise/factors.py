# SPDX-License-Identifier: BSD-3-Clause
"""Factors of the variance of rows, from the detail within each row; those of columns likewise.

Two halves of the windows tell a factor each. As far as these agree over the rows, they are not
chance.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ltcl.transport.noise.agreement import CHANCE_SIGMAS, MIN_BLOCKS, Agreement
from ltcl.transport.noise.blocks import MEDIAN_SQUARE, MIN_VARIANCE, has_unexplained_zeros
from ltcl.transport.noise.windows import Windows

# Median variance of single rows over that of blocks, at most, if it is noise.
MAX_EXCESS = 1.5
# Rows that are read at once.
ROWS_PER_STEP = 4096


def find_factors(
    read: Callable[[np.ndarray], np.ndarray], n: int, windows: Windows, agreement: Agreement
) -> np.ndarray:
    """Factors of n rows, whose mean is 1; `read` gives entries of rows in pixels of `windows`.

    1 if the detail of rows is more than the noise on which blocks agree.
    """
    if len(windows.pixels) < 2:
        return np.ones(n)
    halves = []
    for start in range(0, n, ROWS_PER_STEP):
        rows = np.arange(start, min(start + ROWS_PER_STEP, n))
        X = read(rows).reshape(len(rows), *windows.pixels.shape)
        halves.append(_half_variances(X, rows, windows, agreement.q))
    logs = np.log(np.maximum(np.concatenate(halves, axis=1), MIN_VARIANCE))
    is_known = np.isfinite(logs).all(axis=0)
    if is_known.sum() < MIN_BLOCKS or not logs[:, is_known].std(axis=1).all():
        return np.ones(n)
    typical = np.exp(np.median(logs[:, is_known])) / MEDIAN_SQUARE
    if typical > MAX_EXCESS * agreement.floor2:
        return np.ones(n)
    # Two halves of equal noise correlate by r; their mean has 2 r / (1 + r) of signal.
    r = float(np.corrcoef(logs[:, is_known])[0, 1])
    signal = 0.0
    if r > CHANCE_SIGMAS / n**0.5:
        signal = 2.0 * r / (1.0 + r)
    mean = np.where(is_known, logs.mean(axis=0), logs[:, is_known].mean())
    factors = np.exp((mean - mean.mean()) * signal)
    return factors / factors.mean()


def _half_variances(X: np.ndarray, rows: np.ndarray, windows: Windows, q: float) -> np.ndarray:
    """Median squares (2, rows) of detail in every second window; infinite if unknown."""
    d = np.einsum("iwp,kp->iwk", X, windows.detail)
    light = np.maximum(X.mean(axis=2), 0.0)
    z = d**2 / (1.0 + q * light)[:, :, None]
    zeros = np.mean(X == 0.0, axis=2)
    is_unknown = has_unexplained_zeros(zeros, light, np.median(d**2, axis=2) / MEDIAN_SQUARE)
    is_unknown |= (windows.pixels == rows[:, None, None]).any(axis=2)
    z[is_unknown] = np.nan
    has_empty_half = is_unknown[:, ::2].all(axis=1) | is_unknown[:, 1::2].all(axis=1)
    z[has_empty_half] = np.inf
    even = np.nanmedian(z[:, ::2], axis=(1, 2))
    odd = np.nanmedian(z[:, 1::2], axis=(1, 2))
    return np.stack([even, odd])
