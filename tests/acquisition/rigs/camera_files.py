# SPDX-License-Identifier: BSD-3-Clause
"""Files as cameras write them: JPEG, PNG and TIFF with EXIF, and a small uncompressed DNG."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

NOON = "2026:03:01 12:00:00"
BYTE, ASCII, SHORT, LONG, RATIONAL = 1, 2, 3, 4, 5
Entry = tuple[int, int, int, bytes]  # tag, type, count, value


def write(path: Path, codes: np.ndarray, seconds: float | None = None, time: str | None = None) -> None:
    """Save uint8 codes with EXIF; `time` may end in a fraction of a second."""
    exif = Image.Exif()
    exif[271] = "ltcl"  # Pillow saves none without a main tag
    inner = exif.get_ifd(0x8769)
    exif[0x8769] = 0  # its place, which Pillow fills in; without it a TIFF would lack the inner tags
    if seconds is not None:
        inner[33434] = IFDRational(round(seconds * 10**6), 10**6)
    if time is not None:
        inner[36867], _, fraction = time.partition(".")
        inner[37521] = fraction
    Image.fromarray(codes).save(path, exif=exif, quality=100, subsampling=0)


def write_dng(path: Path, raw: np.ndarray, seconds: float, *, black: int, white: int) -> None:
    """Save raw values (h, w) under a red-green-green-blue filter; Adobe's DNG specification 1.4."""
    at = 8
    size = len(_directory(at, _main(raw, 0, 0, black, white)))
    exif = _directory(at + size, [_rational(33434, [round(seconds * 1e6), 10**6]), _ascii(36867, NOON)])
    main = _directory(at, _main(raw, at + size, at + size + len(exif), black, white))
    path.write_bytes(b"II*\0" + struct.pack("<I", at) + main + exif + raw.astype("<u2").tobytes())


def _main(raw: np.ndarray, exif: int, pixels: int, black: int, white: int) -> list[Entry]:
    h, w = raw.shape
    matrix = [v for row in np.eye(3, dtype=int).tolist() for v in (x for cell in row for x in (cell, 1))]
    return [
        _long(254, 0),
        _long(256, w),
        _long(257, h),
        _short(258, 16),
        _short(259, 1),  # no compression
        _short(262, 32803),  # a colour filter array
        _ascii(271, "ltcl"),
        _ascii(272, "test"),
        _long(273, pixels),
        _short(274, 6),  # held upright: must not turn the pixels
        _short(277, 1),
        _long(278, h),
        _long(279, 2 * h * w),
        _ascii(306, NOON),
        _short(33421, 2, 2),
        (33422, BYTE, 4, bytes([0, 1, 1, 2])),
        _long(34665, exif),
        (50706, BYTE, 4, bytes([1, 4, 0, 0])),
        _ascii(50708, "ltcl test"),
        _short(50714, black),
        _short(50717, white),
        (50721, 10, 9, struct.pack("<18i", *matrix)),
        _rational(50728, [1, 2, 1, 1, 1, 3]),  # as-shot neutral: a white balance that must not be applied
        _short(50778, 21),
    ]


def _directory(at: int, entries: list[Entry]) -> bytes:
    """The entries at file offset `at`, their longer values behind them."""
    values = at + 2 + 12 * len(entries) + 4
    fields, behind = struct.pack("<H", len(entries)), b""
    for tag, kind, count, value in entries:
        stored = value.ljust(4, b"\0") if len(value) <= 4 else struct.pack("<I", values + len(behind))
        fields += struct.pack("<HHI", tag, kind, count) + stored
        behind += b"" if len(value) <= 4 else value + b"\0" * (len(value) % 2)
    return fields + struct.pack("<I", 0) + behind


def _short(tag: int, *values: int) -> Entry:
    return tag, SHORT, len(values), struct.pack(f"<{len(values)}H", *values)


def _long(tag: int, value: int) -> Entry:
    return tag, LONG, 1, struct.pack("<I", value)


def _ascii(tag: int, text: str) -> Entry:
    return tag, ASCII, len(text) + 1, text.encode() + b"\0"


def _rational(tag: int, values: list[int]) -> Entry:
    return tag, RATIONAL, len(values) // 2, struct.pack(f"<{len(values)}I", *values)
