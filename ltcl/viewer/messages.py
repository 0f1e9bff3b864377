# SPDX-License-Identifier: BSD-3-Clause
"""Bytes of the messages between viewer and page, the same in both directions.

A text frame is a JSON header. A binary frame is the length of its header (uint32, little-endian), the header,
padded with spaces so that arrays begin at multiples of 4, then the arrays, each padded to a multiple of 4:

    {"id": 7, "do": "relight", "arrays": [{"name": "pattern", "shape": [h, w, c], "dtype": "f2", "scale": s}]}

Values are scale * numbers. Half floats are scaled by the largest value, so that none overflows. A fourth
channel, alpha of a canvas, is left out.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from ltcl import checks, report
from ltcl.errors import InputError, LtclError

DTYPES = {"f2": "<f2", "f4": "<f4", "u1": "u1"}
LARGEST_HEADER = 4096  # bytes of a question
_ROUNDED = np.float32(0.75)
_DARK = 1e-30  # what is not brighter is 0


def largest(pixels: int) -> int:
    """Bytes of the largest question about a grid of so many pixels."""
    return 8 * 3 * pixels + LARGEST_HEADER


def encode(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray] | None = None) -> str | bytes:
    """A message of pictures (h, w[, 3]): float ones as half floats, uint8 as they are."""
    entries, parts = [], []
    for name, array in (arrays or {}).items():
        values, scale, dtype = array.reshape(*array.shape[:2], -1), 1.0, "u1"
        if array.dtype != np.uint8:
            most, dtype = max(float(values.max()), -float(values.min()), _DARK), "f2"
            scale = checks.number(f"the largest value of {name}", most)
            values = values.astype(np.float32, copy=False) * np.float32(1.0 / scale)
            values += _ROUNDED  # to what half floats near 0 hold: NumPy is slow where one underflows
            values -= _ROUNDED
            values = values.astype(DTYPES[dtype])
        entries.append({"name": name, "shape": values.shape, "dtype": dtype, "scale": scale})
        parts += [values.tobytes(), bytes(-values.nbytes % 4)]
    text = json.dumps(report.plain({**header, "arrays": entries} if entries else header), allow_nan=False)
    if not entries:
        return text
    text += " " * (-len(text) % 4)
    return b"".join([len(text).to_bytes(4, "little"), text.encode(), *parts])


def decode(message: str | bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays, float32 or uint8, of a question; InputError where it is none."""
    data = b"" if isinstance(message, str) else message
    start = 4 + int.from_bytes(data[:4], "little") if data else 0
    text = message.encode("utf-8", "replace") if isinstance(message, str) else data[4:start]
    checks.count("length of the header", len(text), most=LARGEST_HEADER)
    try:
        header, arrays = json.loads(text), {}
        checks.one_of("type of do", type(header["do"]), [str])
        checks.number("id", header["id"])
        for entry in header.pop("arrays", []):
            h, w, c = (checks.count("shape", n, most=1 << 24) for n in entry["shape"])
            values = np.frombuffer(data, DTYPES[entry["dtype"]], h * w * c, start).reshape(h, w, c)
            start += values.nbytes + -values.nbytes % 4
            if values.dtype != np.uint8:
                scale = np.float32(checks.number("scale", entry["scale"], most=1e38))
                with np.errstate(over="ignore"):
                    values = checks.finite("arrays", values.astype(np.float32) * scale)
            arrays[str(entry["name"])] = values[..., 0] if c == 1 else values[..., : 3 if c == 4 else c]
    except LtclError:
        raise
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"message is none: {type(error).__name__}: {error}") from None
    if start != len(data):
        raise InputError(f"message has {len(data)} bytes; header and arrays must have as many: {start}")
    return header, arrays
