# SPDX-License-Identifier: BSD-3-Clause
"""Numbers in 8, 16 or 32 bits, on the host: the entries of a matrix rounded to nearest, and back, exactly.

    a_ij = unit * scale_i * code_ij

float32 stands as it is. The 16-bit types share one power of two, `unit`, that brings the largest entry near
the top of float16: nothing overflows, and what float16 cannot hold is below 2^-39 of that entry. int8 has a
scale a row, its largest entry / 127, since rows of a transport differ in size by orders of magnitude.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ltcl.device.array import rounded


@dataclass(frozen=True)
class Precision:
    """A type of stored numbers: its `VALUES` in kernels/common/narrow.h and how it is written and read.

    `encode` takes what is left of the numbers once unit and scales are divided out; `decode` gives float64.
    """

    number: int
    dtype: type[np.generic]
    encode: Callable[[np.ndarray], np.ndarray]
    decode: Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Narrow:
    """Numbers of rows, stored: codes (nnz,), the unit of all, scales (M,) float32 of rows or none (0,)."""

    codes: np.ndarray
    unit: float
    scales: np.ndarray


def _to_bfloat16(values: np.ndarray) -> np.ndarray:
    bits = values.astype(np.float32).view(np.uint32)
    return ((bits + 0x7FFF + ((bits >> 16) & 1)) >> 16).astype(np.uint16)  # to nearest, ties to even


def _of_bfloat16(codes: np.ndarray) -> np.ndarray:
    return (codes.astype(np.uint32) << 16).view(np.float32).astype(np.float64)


def _widen(codes: np.ndarray) -> np.ndarray:
    return codes.astype(np.float64)


PRECISIONS = {
    "float32": Precision(0, np.float32, lambda values: rounded(values, np.float32), _widen),
    "bfloat16": Precision(1, np.uint16, _to_bfloat16, _of_bfloat16),
    "float16": Precision(2, np.float16, lambda values: values.astype(np.float16), _widen),
    "int8": Precision(3, np.int8, lambda values: np.clip(np.rint(values), -127, 127).astype(np.int8), _widen),
}


def decoded(stored: Narrow, indptr: np.ndarray, precision: str) -> np.ndarray:
    """The numbers that `narrow` gives, (nnz,) float64, exact."""
    values = PRECISIONS[precision].decode(stored.codes) * stored.unit
    return scaled_rows(values, indptr, stored.scales)


def scaled_rows(values: np.ndarray, indptr: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Values (nnz,) times the scale of their row, where there are scales."""
    return values * np.repeat(scales.astype(np.float64), np.diff(indptr)) if scales.size else values


def narrow(data: np.ndarray, indptr: np.ndarray, precision: str) -> Narrow:
    """The numbers `data` (nnz,) of rows between `indptr` (M + 1,) in a precision.

    >>> found = narrow(np.array([1.0, -127.0]), np.array([0, 2, 2]), "int8")
    >>> found.codes.tolist(), found.scales.tolist()
    ([1, -127], [1.0, 1.0])
    """
    rounded(data, np.float32)  # refuses what float32 arithmetic cannot hold
    largest = float(np.max(np.abs(data), initial=0.0))
    unit, scales = 1.0, np.zeros(0, np.float32)
    if precision in ("bfloat16", "float16") and largest > 0:
        unit = 2.0 ** max(int(np.frexp(largest)[1]) - 15, -126)
    if precision == "int8":
        scales = _scales(data, indptr)
    left = data.astype(np.float64) / unit
    if scales.size:
        left /= np.repeat(scales.astype(np.float64), np.diff(indptr))
    return Narrow(PRECISIONS[precision].encode(left), unit, scales)


def _scales(data: np.ndarray, indptr: np.ndarray) -> np.ndarray:
    """Largest entry of each row / 127; 1 in rows of zeros, and in those that float32 cannot divide."""
    filled = np.flatnonzero(np.diff(indptr))
    scales = np.ones(len(indptr) - 1, np.float32)
    if filled.size:
        scales[filled] = np.maximum.reduceat(np.abs(data), indptr[filled]) / 127
    scales[scales < np.finfo(np.float32).tiny] = 1
    return scales
