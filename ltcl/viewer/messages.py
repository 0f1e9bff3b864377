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

# Bytes of the header of a question.
LARGEST_HEADER = 4096
# Bytes of the length of a header, and multiple at which arrays begin.
LENGTH_BYTES = 4
ALIGNMENT = 4
# Channels of a canvas: red, green, blue, alpha.
CANVAS_CHANNELS = 4
MAX_SIDE = 1 << 24


def largest_question(pixels: int) -> int:
    """Return the bytes of the largest question about a grid of so many pixels."""
    return CANVAS_CHANNELS * pixels + LARGEST_HEADER


def encode(
    header: Mapping[str, Any], arrays: Mapping[str, np.ndarray] | None = None
) -> str | bytes:
    """Make a message with pictures (h, w[, 3]): uint8 ones as they are, others as float32."""
    if not arrays:
        return _dump(header)
    entries = []
    parts = []
    for name, array in arrays.items():
        dtype = "u1" if array.dtype == np.uint8 else "f4"
        values = array.reshape(*array.shape[:2], -1).astype(dtype, copy=False)
        checks.finite(name, values)
        entries.append({"name": name, "shape": values.shape, "dtype": dtype})
        parts.append(values.tobytes())
        parts.append(bytes(_padding(values.nbytes)))
    text = _dump({**header, "arrays": entries})
    text += " " * _padding(len(text))
    length = len(text).to_bytes(LENGTH_BYTES, "little")
    return b"".join([length, text.encode(), *parts])


def _dump(header: Mapping[str, Any]) -> str:
    return json.dumps(report.plain(dict(header)), allow_nan=False)


def _padding(size: int) -> int:
    return -size % ALIGNMENT


def decode(message: str | bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Decode a question: header and arrays of codes, (h, w[, c]) uint8; InputError if invalid."""
    if isinstance(message, str):
        text: str | bytes = message
        data = b""
        start = 0
    else:
        data = message
        start = LENGTH_BYTES + int.from_bytes(data[:LENGTH_BYTES], "little") if data else 0
        text = data[LENGTH_BYTES:start]
    checks.count("length of the header", len(text), most=LARGEST_HEADER)
    try:
        header = json.loads(text)
        checks.one_of("type of do", type(header["do"]), [str])
        checks.number("id", header["id"])
        arrays, end = _decode_arrays(header.pop("arrays", []), data, start)
    except LtclError:
        raise
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise InputError(f"message is not a question: {reason}") from None
    if end != len(data):
        raise InputError(
            f"message has {len(data)} bytes; header and arrays must have as many: {end}"
        )
    return header, arrays


def _decode_arrays(entries: Any, data: bytes, start: int) -> tuple[dict[str, np.ndarray], int]:
    """Return the arrays from byte `start` on, and the byte after them."""
    arrays = {}
    for entry in entries:
        checks.one_of("dtype", entry["dtype"], ["u1"])
        height, width, channels = (
            checks.count("shape", size, most=MAX_SIDE) for size in entry["shape"]
        )
        codes = np.frombuffer(data, np.uint8, height * width * channels, start)
        start += codes.nbytes + _padding(codes.nbytes)
        codes = codes.reshape(height, width, channels)
        if channels == 1:
            codes = codes[..., 0]
        elif channels == CANVAS_CHANNELS:
            codes = codes[..., :3]
        arrays[str(entry["name"])] = codes
    return arrays, start
