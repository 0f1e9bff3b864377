# SPDX-License-Identifier: BSD-3-Clause
"""Bytes of the messages between viewer and page, the same in both directions and on any carrier.

A text message is a JSON header. A binary message is the length of its header (uint32,
little-endian), the header, padded with spaces so that arrays begin at multiples of 4, then the
arrays, each padded to a multiple of 4:

    {"id": 7, "do": "relight", "arrays": [{"name": "pattern", "shape": [h, w, c], "dtype": "u1"}]}

Light goes to the page as float32 ("f4"), codes either way as uint8 ("u1"). A fourth channel, alpha
of a canvas, is left out. The bytes of a file have the shape [size].
"""

from __future__ import annotations

import json
import math
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
MAX_SIDE = 1 << 26
# Numbers in the shapes of a file and of a picture.
DIMENSIONS = (1, 3)
# Bytes of a file that a page gives.
LARGEST_FILE = 64 << 20


def largest_question(pixels: int) -> int:
    """Return the bytes of the largest question about a grid of so many pixels."""
    return max(CANVAS_CHANNELS * pixels, LARGEST_FILE) + LARGEST_HEADER


def encode(
    header: Mapping[str, Any], arrays: Mapping[str, np.ndarray] | None = None
) -> str | bytes:
    """Make a message with pictures (h, w[, 3]) and files (size,).

    Arrays of uint8 go as they are, others as float32.
    """
    if not arrays:
        return _dump(header)
    entries = []
    parts = []
    for name, array in arrays.items():
        dtype = "u1" if array.dtype == np.uint8 else "f4"
        shape = array.shape if array.ndim == 1 else (*array.shape[:2], -1)
        values = array.reshape(shape).astype(dtype, copy=False)
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
    """Decode a question; InputError if it is invalid.

    Returns its header, and its arrays of uint8: codes (h, w[, c]) and files (size,).
    """
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
        shape = [checks.count("shape", size, most=MAX_SIDE) for size in entry["shape"]]
        checks.one_of("dimensions of the shape", len(shape), DIMENSIONS)
        codes = np.frombuffer(data, np.uint8, math.prod(shape), start)
        start += codes.nbytes + _padding(codes.nbytes)
        arrays[str(entry["name"])] = _without_alpha(codes.reshape(shape))
    return arrays, start


def _without_alpha(codes: np.ndarray) -> np.ndarray:
    """Return a picture without alpha, a grey one as (h, w); a file as it is."""
    if codes.ndim == 1:
        return codes
    channels = codes.shape[2]
    if channels == 1:
        return codes[..., 0]
    if channels == CANVAS_CHANNELS:
        return codes[..., :3]
    return codes
