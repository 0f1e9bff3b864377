# SPDX-License-Identifier: BSD-3-Clause
"""Right-hand sides in units of their own, so that squares of any light stay inside float32."""

from __future__ import annotations

import numpy as np

_FLOAT32 = np.finfo(np.float32)


def largest(b: np.ndarray) -> np.ndarray:
    """The largest size of each column, float64, NaN where it holds one; of both ends, without a copy of b."""
    most, least = np.max(b, axis=0), np.min(b, axis=0)
    return np.maximum(most.astype(np.float64), -least.astype(np.float64))


def of(b: np.ndarray) -> np.ndarray:
    """A power of two for each column, near its largest value: in such units norms stay inside float32."""
    sizes = largest(b)
    return np.exp2(np.floor(np.log2(np.where(sizes > 0.0, sizes, 1.0))))


def scaled(b: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """b in its units, in float32 where it is so already: powers of two change no digit."""
    return b / (unit.astype(np.float32) if _in_float32(b, unit) else unit)


def restored(x: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """x times its unit in float32, or in float64 where it is beyond float32."""
    if _in_float32(x, unit) and np.all(largest(x) * unit <= _FLOAT32.max):
        return x * unit.astype(np.float32)
    wide = x * unit
    return wide if np.any(np.abs(wide) > _FLOAT32.max) else wide.astype(np.float32)


def _in_float32(x: np.ndarray, unit: np.ndarray) -> bool:
    """Whether x is float32, and the units are normal numbers of it."""
    return x.dtype == np.float32 and bool(np.all(unit >= _FLOAT32.tiny))
