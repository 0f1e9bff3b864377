# SPDX-License-Identifier: BSD-3-Clause
"""Bytes of the messages between viewer and page, the same in both directions.

A text frame is a JSON header. A binary frame is the length of its header (uint32, little-endian), the header,
padded with spaces so that arrays begin at multiples of 4, then the arrays, each padded to a multiple of 4:

    {"id": 7, "do": "relight", "arrays": [{"name": "pattern", "shape": [h, w, c], "dtype": "f2", "scale": s}]}

Values are scale * numbers. Half floats are scaled by the largest value, so that none overflows.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np

from ltcl import checks, report
from ltcl.errors import InputError

DTYPES = {"f2": np.dtype("<f2"), "f4": np.dtype("<f4"), "u1": np.dtype("u1")}
LARGEST_HEADER = 4096  # bytes of a question
_DARK = 1e-30  # what is not brighter is 0
_KEYS = {"name", "shape", "dtype", "scale"}


def largest(pixels: int) -> int:
    """Bytes of the largest question about a grid of so many pixels."""
    return 8 * 3 * pixels + LARGEST_HEADER


def encode(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray] | None = None) -> str | bytes:
    """A message of pictures (h, w[, 3]): float ones as half floats, uint8 as they are."""
    entries, parts = [], []
    for name, array in (arrays or {}).items():
        values, scale = array.reshape(*array.shape[:2], -1), 1.0
        if array.dtype != np.uint8:
            values = values.astype(np.float32, copy=False)
            scale = max(float(values.max()), -float(values.min()), _DARK)
            values = (values * np.float32(1.0 / scale)).astype("<f2")
        dtype = "u1" if array.dtype == np.uint8 else "f2"
        entries.append({"name": name, "shape": values.shape, "dtype": dtype, "scale": scale})
        parts += [values.tobytes(), bytes(-values.nbytes % 4)]
    if not entries:
        return json.dumps(report.plain(header), ensure_ascii=False, allow_nan=False)
    text = json.dumps(
        report.plain({**header, "arrays": entries}), ensure_ascii=False, allow_nan=False
    ).encode()
    text += b" " * (-len(text) % 4)
    return b"".join([len(text).to_bytes(4, "little"), text, *parts])


def decode(message: str | bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays, float32 or uint8 codes, of a question; InputError where it is none."""
    if isinstance(message, str):
        return _header(message.encode("utf-8", "surrogatepass")), {}
    start = 4 + int.from_bytes(message[:4], "little")
    if len(message) < 4 or start > len(message):
        raise InputError(f"message has {len(message)} bytes; it must hold the header that it announces")
    header, arrays = _header(message[4:start]), {}
    entries = header.pop("arrays", [])
    if not isinstance(entries, list) or start % 4:
        raise InputError("message has arrays that are no list, or do not begin at a multiple of 4")
    for entry in entries:
        if not isinstance(entry, dict) or entry.keys() != _KEYS or not isinstance(entry["name"], str):
            raise InputError(f"arrays[{len(arrays)}] must have {', '.join(sorted(_KEYS))}")
        dtype = DTYPES[checks.one_of("dtype", str(entry["dtype"]), DTYPES)]
        if not isinstance(shape := entry["shape"], list) or len(shape) != 3:
            raise InputError(f"shape is {checks.shown(shape)}; it must be [h, w, channels]")
        h, w, c = (checks.count("shape", n, most=1 << 24) for n in shape)
        nbytes = h * w * c * dtype.itemsize
        if start + nbytes > len(message):
            raise InputError(f"{entry['name']} has {len(message) - start} bytes; it must have {nbytes}")
        values = np.frombuffer(message, dtype, h * w * c, start).reshape(h, w, c)
        start += nbytes + -nbytes % 4
        if dtype != np.uint8:
            with np.errstate(over="ignore", invalid="ignore"):
                values = values.astype(np.float32) * np.float32(checks.number("scale", entry["scale"]))
            checks.finite(entry["name"], values)
        arrays[entry["name"]] = values[..., 0] if c == 1 else values
    if start != len(message) or len(arrays) != len(entries):
        raise InputError(f"message has {len(message)} bytes; its arrays have names of their own and {start}")
    return header, arrays


def _header(text: bytes) -> dict[str, Any]:
    if len(text) > LARGEST_HEADER:
        raise InputError(f"header has {len(text)} bytes; it must have at most {LARGEST_HEADER}")
    try:
        header = json.loads(text, parse_constant=_refuse)
    except (ValueError, RecursionError):
        raise InputError("header is no JSON; it must be one object, in UTF-8") from None
    if not isinstance(header, dict) or not isinstance(header.get("do"), str):
        raise InputError("header has no 'do'; it must say what is asked for")
    checks.number("id", header.get("id"))
    return header


def _refuse(constant: str) -> NoReturn:
    raise ValueError(constant)
