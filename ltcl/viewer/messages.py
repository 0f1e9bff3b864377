# SPDX-License-Identifier: BSD-3-Clause
"""Bytes of the messages between viewer and page, the same in both directions.

A text frame is a JSON header. A binary frame is the length of its header (uint32, little-endian),
the header, padded with spaces so that arrays begin at multiples of 4, then the arrays, each padded
to a multiple of 4:

    {"id": 7, "do": "relight", "arrays": [{"name": "pattern", "shape": [h, w, c], "dtype": "u1"}]}

Light goes to the page as float32 ("f4"), codes either way as uint8 ("u1"). A fourth channel, alpha
of a canvas, is left out.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError, LtclError
from ltcl.tasks import report

LARGEST_HEADER = 4096  # bytes of a question


def largest(pixels: int) -> int:
    """Bytes of the largest question about a grid of so many pixels."""
    return 4 * pixels + LARGEST_HEADER


def encode(
    header: Mapping[str, Any], arrays: Mapping[str, np.ndarray] | None = None
) -> str | bytes:
    """A message of pictures (h, w[, 3]): uint8 ones as they are, others as float32."""
    entries, parts = [], []
    for name, array in (arrays or {}).items():
        dtype = "u1" if array.dtype == np.uint8 else "f4"
        values = checks.finite(name, array.reshape(*array.shape[:2], -1).astype(dtype, copy=False))
        entries.append({"name": name, "shape": values.shape, "dtype": dtype})
        parts += [values.tobytes(), bytes(-values.nbytes % 4)]
    text = json.dumps(
        report.plain({**header, "arrays": entries} if entries else header), allow_nan=False
    )
    if not entries:
        return text
    text += " " * (-len(text) % 4)
    return b"".join([len(text).to_bytes(4, "little"), text.encode(), *parts])


def decode(message: str | bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of codes, (h, w[, c]) uint8, of a question; InputError where it is none."""
    data = b"" if isinstance(message, str) else message
    start = 4 + int.from_bytes(data[:4], "little") if data else 0
    text = message if isinstance(message, str) else data[4:start]
    checks.count("length of the header", len(text), most=LARGEST_HEADER)
    try:
        header, arrays = json.loads(text), {}
        checks.one_of("type of do", type(header["do"]), [str])
        checks.number("id", header["id"])
        for entry in header.pop("arrays", []):
            checks.one_of("dtype", entry["dtype"], ["u1"])
            h, w, c = (checks.count("shape", n, most=1 << 24) for n in entry["shape"])
            codes = np.frombuffer(data, np.uint8, h * w * c, start).reshape(h, w, c)
            arrays[str(entry["name"])] = (
                codes[..., 0] if c == 1 else codes[..., : 3 if c == 4 else c]
            )
            start += codes.nbytes + -codes.nbytes % 4
    except LtclError:
        raise
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"message is none: {type(error).__name__}: {error}") from None
    if start != len(data):
        raise InputError(
            f"message has {len(data)} bytes; header and arrays must have as many: {start}"
        )
    return header, arrays
