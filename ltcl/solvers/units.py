# SPDX-License-Identifier: BSD-3-Clause
"""Right-hand sides in units of their own, so that squares of any light stay inside float32."""

from __future__ import annotations

import numpy as np


def of(b: np.ndarray) -> np.ndarray:
    """A power of two for each column, near its largest value: in such units norms stay inside float32."""
    largest = np.max(np.abs(b, dtype=np.float64), axis=0)
    return np.exp2(np.floor(np.log2(np.where(largest > 0.0, largest, 1.0))))


def restored(x: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """x times its unit in float32, or in float64 where it is beyond float32."""
    wide = x * unit
    return wide if np.any(np.abs(wide) > np.finfo(np.float32).max) else wide.astype(np.float32)
