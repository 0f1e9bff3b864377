# SPDX-License-Identifier: BSD-3-Clause
"""Codes of picture files and linear light: the sRGB curve, scales and types.

    srgb = 12.92 x                     for x up to 0.0031308
    srgb = 1.055 x^(1 / 2.4) - 0.055   above

The curve is that of IEC 61966-2-1. Outside [0, 1] it is odd about 0 and continued, as in scRGB.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from ltcl import checks
from ltcl.errors import InputError

Encoding = Literal["auto", "srgb", "linear"]
ENCODINGS = get_args(Encoding)


def from_srgb(encoded: ArrayLike) -> np.ndarray:
    """Decode sRGB values into linear light.

    Parameters
    ----------
    encoded : array_like
        Real numbers, 1 for white: codes over 255 or 65535.

    Returns
    -------
    ndarray
        float64 for float64 values, else float32; same shape.

    Examples
    --------
    >>> float(from_srgb(np.float64(0.5)).round(4))
    0.214
    """
    value = _as_floats("encoded", encoded)
    size = np.abs(value)
    curve = np.where(size <= 0.04045, size / 12.92, ((size + 0.055) / 1.055) ** 2.4)
    return np.copysign(curve, value)


def to_srgb(linear: ArrayLike) -> np.ndarray:
    """Encode linear light as sRGB, the inverse of `from_srgb`.

    Parameters
    ----------
    linear : array_like
        Real numbers, 1 for white.

    Returns
    -------
    ndarray
        float64 for float64 values, else float32; same shape.

    Examples
    --------
    >>> float(to_srgb(np.float64(0.214)).round(3))
    0.5
    """
    value = _as_floats("linear", linear)
    size = np.abs(value)
    curve = np.where(size <= 0.0031308, size * 12.92, 1.055 * size ** (1 / 2.4) - 0.055)
    return np.copysign(curve, value)


def to_linear(codes: np.ndarray, encoding: Encoding) -> np.ndarray:
    """Linear light, float32, of uint8, uint16 or float codes.

    The encoding "auto" takes integers as sRGB and floats as linear.
    """
    is_integer = codes.dtype.kind == "u"
    is_srgb = encoding == "srgb" or (encoding == "auto" and is_integer)
    if is_integer:
        # A table in float64 is exact, and takes the power 256 or 65536 times, not once per pixel.
        table = np.linspace(0, 1, np.iinfo(codes.dtype).max + 1)
        if is_srgb:
            table = from_srgb(table)
        return table.astype(np.float32)[codes]
    if is_srgb:
        return from_srgb(codes)
    return codes.astype(np.float32, copy=False)


def from_linear(
    picture: np.ndarray, encoding: Encoding, bits: int, *, is_float: bool
) -> np.ndarray:
    """Codes of a linear picture in a file of `bits` per channel, the inverse of `to_linear`."""
    if encoding == "srgb" or (encoding == "auto" and not is_float):
        picture = to_srgb(picture)
    if not is_float:
        largest_code = (1 << bits) - 1
        codes = np.rint(np.clip(picture, 0, 1) * largest_code)
        return codes.astype(np.uint8 if bits == 8 else np.uint16)

    with np.errstate(over="ignore"):
        codes = picture.astype(np.float16 if bits == 16 else np.float32, copy=False)
    if not np.isfinite(codes).all():
        largest = np.abs(picture).max()
        raise InputError(f"image reaches {largest:g}; half floats end at 65504, use bits=32")
    return codes


def _as_floats(name: str, value: ArrayLike) -> np.ndarray:
    array = checks.real(name, value)
    if array.dtype == np.float64:
        return array
    return array.astype(np.float32, copy=False)
