# SPDX-License-Identifier: BSD-3-Clause
"""What files hold, as linear light and back: integers by a table of the sRGB curve, floats as they are."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ltcl import checks
from ltcl.errors import InputError
from ltcl.images.srgb import from_srgb, to_srgb

Encoding = Literal["auto", "srgb", "linear"]
ENCODINGS = ("auto", "srgb", "linear")


def to_linear(stored: np.ndarray, encoding: Encoding) -> np.ndarray:
    """Float32 of `stored`, uint8, uint16 or float; "auto" takes integers as sRGB, floats as linear."""
    is_integer = stored.dtype.kind == "u"
    curve = encoding == "srgb" or (encoding == "auto" and is_integer)
    if is_integer:
        # A table in float64: exact, and the power is taken 256 or 65536 times instead of once per pixel.
        table = np.linspace(0, 1, np.iinfo(stored.dtype).max + 1)
        return (from_srgb(table) if curve else table).astype(np.float32)[stored]
    with np.errstate(over="ignore"):
        picture = checks.finite("the picture", stored.astype(np.float32, copy=False))
    return from_srgb(picture) if curve else picture


def from_linear(picture: np.ndarray, encoding: Encoding, bits: int, *, is_float: bool) -> np.ndarray:
    """What a file of `bits` a channel holds of `picture`; the inverse of `to_linear`."""
    if encoding == "srgb" or (encoding == "auto" and not is_float):
        picture = to_srgb(picture)
    if not is_float:
        most = (1 << bits) - 1
        return np.rint(np.clip(picture, 0, 1) * most).astype(np.uint8 if bits == 8 else np.uint16)
    with np.errstate(over="ignore"):
        stored = picture.astype(np.float16 if bits == 16 else np.float32, copy=False)
    if not np.all(np.isfinite(stored)):
        raise InputError(f"image reaches {np.abs(picture).max():g}; half floats end at 65504, use bits=32")
    return stored
