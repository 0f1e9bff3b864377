# SPDX-License-Identifier: BSD-3-Clause
"""The sRGB transfer curve (IEC 61966-2-1), both ways; past [0, 1] odd functions, as of scRGB."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ltcl import checks
from ltcl.errors import InputError

Encoding = Literal["auto", "srgb", "linear"]
ENCODINGS = ("auto", "srgb", "linear")


def from_srgb(encoded: ArrayLike) -> np.ndarray:
    """Linear light of sRGB-encoded values of any shape, 1 for white: divide codes by 255 or 65535 first.

    The result is float32, or float64 where `encoded` is. InputTypeError for other than real numbers.

    >>> float(from_srgb(np.float64(0.5)).round(4))
    0.214
    """
    value = _floating("encoded", encoded)
    size = np.abs(value)
    curve = np.where(size <= 0.04045, size / 12.92, ((size + 0.055) / 1.055) ** 2.4)
    return np.copysign(curve, value)


def to_srgb(linear: ArrayLike) -> np.ndarray:
    """Encode linear light as sRGB, the inverse of `from_srgb`.

    >>> float(to_srgb(np.float64(0.214)).round(3))
    0.5
    """
    value = _floating("linear", linear)
    size = np.abs(value)
    curve = np.where(size <= 0.0031308, size * 12.92, 1.055 * size ** (1 / 2.4) - 0.055)
    return np.copysign(curve, value)


def _floating(name: str, value: ArrayLike) -> np.ndarray:
    array = checks.real(name, value)
    return array.astype(np.float64 if array.dtype == np.float64 else np.float32, copy=False)


def to_linear(codes: np.ndarray, encoding: Encoding) -> np.ndarray:
    """Float32 of `codes`, uint8, uint16 or float; "auto" takes integers as sRGB, floats as linear."""
    is_integer = codes.dtype.kind == "u"
    is_srgb = encoding == "srgb" or (encoding == "auto" and is_integer)
    if is_integer:
        # A table in float64: exact, and the power is taken 256 or 65536 times instead of once per pixel.
        table = np.linspace(0, 1, np.iinfo(codes.dtype).max + 1)
        return (from_srgb(table) if is_srgb else table).astype(np.float32)[codes]
    with np.errstate(over="ignore"):
        picture = checks.finite("the picture", codes.astype(np.float32, copy=False))
    return from_srgb(picture) if is_srgb else picture


def from_linear(picture: np.ndarray, encoding: Encoding, bits: int, *, is_float: bool) -> np.ndarray:
    """The codes of `picture` in a file of `bits` per channel; the inverse of `to_linear`."""
    if encoding == "srgb" or (encoding == "auto" and not is_float):
        picture = to_srgb(picture)
    if not is_float:
        white = (1 << bits) - 1
        return np.rint(np.clip(picture, 0, 1) * white).astype(np.uint8 if bits == 8 else np.uint16)
    with np.errstate(over="ignore"):
        codes = picture.astype(np.float16 if bits == 16 else np.float32, copy=False)
    if not np.all(np.isfinite(codes)):
        raise InputError(f"image reaches {np.abs(picture).max():g}; half floats end at 65504, use bits=32")
    return codes
