# SPDX-License-Identifier: BSD-3-Clause
"""Numbers of tiles in 8, 16 or 32 bits, on the host: rounded to nearest, and back, exactly.

    a = unit * scale of the tile * code

float32 stands as it is. The others share one power of two, `unit`, that brings the largest number near the
top of float16: nothing overflows, and what is left out for want of subnormal numbers, which some devices take
for zeros, is below 2^-28 of the largest. Codes of int8 share a scale in a tile, of 5 bits of exponent and 3
of fraction. One a row would take fewer bytes, but a row of wavelet coefficients of a transport spans too
much: rounding lost 5 times as much. Such a number has 11 significant bits at most: float16 holds it exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ltcl.device.array import rounded


@dataclass(frozen=True)
class Precision:
    """A type of stored numbers: its `VALUES` in kernels/common/narrow.h, how it is written and read.

    `encode` takes what is left of numbers once unit and scales are divided out; `decode` gives float64.
    `exact` is the precision that holds each number without a scale.
    """

    number: int
    dtype: type[np.generic]
    encode: Callable[[np.ndarray], np.ndarray]
    decode: Callable[[np.ndarray], np.ndarray]
    exact: str


@dataclass(frozen=True, eq=False)
class Narrow:
    """Numbers as they are stored: codes (tiles, width), scales (tiles,) uint8 or none (0,), a unit of all."""

    precision: str
    codes: np.ndarray
    scales: np.ndarray
    unit: float

    @property
    def nbytes(self) -> int:
        """Bytes of codes and scales."""
        return self.codes.nbytes + self.scales.nbytes

    def decoded(self) -> np.ndarray:
        """The numbers they stand for, (tiles, width) float64."""
        numbers = PRECISIONS[self.precision].decode(self.codes) * self.unit
        if self.scales.size:
            numbers *= _scale(self.scales)[:, None]
        return numbers


def _scale(bits: np.ndarray) -> np.ndarray:
    return np.ldexp(1 + (bits & 7) / 8, (bits >> 3).astype(np.int32) - 15)


def _scales(numbers: np.ndarray) -> np.ndarray:
    """Bits of the smallest scale of each tile that lets no code pass 127; at least 2^-14."""
    fraction, exponent = np.frexp(np.abs(numbers).max(axis=1, initial=0.0) / 127)  # in 1/2 .. 1
    bits = (exponent + 14) * 8 + np.ceil(16 * fraction - 8).astype(np.int64)
    return np.where(fraction > 0, np.maximum(bits, 8), 8).astype(np.uint8)


def _to_bfloat16(numbers: np.ndarray) -> np.ndarray:
    bits = numbers.astype(np.float32).view(np.uint32)
    return ((bits + 0x7FFF + ((bits >> 16) & 1)) >> 16).astype(np.uint16)  # to nearest, ties to even


def _of_bfloat16(codes: np.ndarray) -> np.ndarray:
    return (codes.astype(np.uint32) << 16).view(np.float32).astype(np.float64)


def _to_float16(numbers: np.ndarray) -> np.ndarray:
    least = np.where(np.abs(numbers) < 2.0**-15, 0.0, np.copysign(2.0**-14, numbers))
    return np.where(np.abs(numbers) < 2.0**-14, least, numbers).astype(np.float16)


def _to_int8(numbers: np.ndarray) -> np.ndarray:
    return np.rint(numbers).astype(np.int8)


def _to_float32(numbers: np.ndarray) -> np.ndarray:
    return rounded(numbers, np.float32)


def _widen(codes: np.ndarray) -> np.ndarray:
    return codes.astype(np.float64)


PRECISIONS = {
    "float32": Precision(0, np.float32, _to_float32, _widen, "float32"),
    "bfloat16": Precision(1, np.uint16, _to_bfloat16, _of_bfloat16, "bfloat16"),
    "float16": Precision(2, np.float16, _to_float16, _widen, "float16"),
    "int8": Precision(3, np.int8, _to_int8, _widen, "float16"),
}


def narrow(numbers: np.ndarray, precision: str, unit: float | None = None) -> Narrow:
    """The numbers of tiles, (tiles, width), in a precision; `unit` is given where they have had one before.

    >>> found = narrow(np.array([[1.2, -127.0]]), "int8")
    >>> found.codes.tolist(), found.decoded().tolist(), found.nbytes
    ([[1, -127]], [[1.0, -127.0]], 3)
    """
    _to_float32(numbers)  # refuses what float32 arithmetic cannot hold
    if unit is None:
        unit = 1.0 if precision == "float32" else _unit(float(np.max(np.abs(numbers), initial=0.0)))
    left, scales = numbers / unit, np.zeros(0, np.uint8)
    if precision == "int8":
        scales = _scales(left)
        left = left / _scale(scales)[:, None]
    return Narrow(precision, PRECISIONS[precision].encode(left), scales, unit)


def _unit(largest: float) -> float:
    """The power of two, in the range of float32, in which the largest number is between 2^14 and 2^15."""
    return 2.0 ** max(int(np.frexp(largest)[1]) - 15, -126) if largest > 0 else 1.0
