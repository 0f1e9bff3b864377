# SPDX-License-Identifier: BSD-3-Clause
"""What a PNG, JPEG, TIFF or BMP file says of itself, read before a decoder allocates anything.

A file of a few bytes can declare a picture of terabytes, and decoders allocate first. The size is read here
with bounds on every step; a header that cannot be followed gives None and is left to the decoder.
"""

from __future__ import annotations

import struct
import zlib
from itertools import pairwise

from ltcl import checks
from ltcl.errors import FileError

TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # little- and big-endian, classic and BigTIFF
PNG = b"\x89PNG\r\n\x1a\n"
MOST_PIXELS = 1 << 30  # OpenCV's own limit
# Deflate reaches 1032 bytes for one, and a byte holds 8 pixels at best; eight times that is a lie.
PIXELS_PER_BYTE = 1 << 16


def check_size(size: tuple[int, int] | None, nbytes: int) -> None:
    """Refuse a declared (h, w) that a file of `nbytes` cannot hold, or that memory cannot.

    Raises
    ------
    FileError, MemoryLimitError
        Without the file's name, which the caller puts in front.
    """
    if size is None:
        return
    h, w = size
    if h < 1 or w < 1:
        raise FileError(f"declares a picture of {w} x {h} pixels; both must be positive")
    if h * w > min(MOST_PIXELS, PIXELS_PER_BYTE * nbytes):
        raise FileError(
            f"declares a picture of {w} x {h} pixels in {checks.size(nbytes)}; "
            f"at most {min(MOST_PIXELS, PIXELS_PER_BYTE * nbytes)} pixels are possible there"
        )
    checks.fits_host(f"a picture of {w} x {h} pixels", h * w * 3 * (4 + 4))


def declared_size(data: bytes) -> tuple[int, int] | None:
    """(h, w) that the header declares, or None where it is not understood."""
    try:
        if data.startswith(PNG):
            w, h = struct.unpack_from(">II", data, 16)
        elif data.startswith(b"BM"):
            w, h = (abs(v) for v in struct.unpack_from("<ii", data, 18))  # h < 0: rows from the top
        elif data.startswith(b"\xff\xd8"):
            return _jpeg_size(data)
        elif data[:4] in TIFF:
            return _tiff_size(data)
        else:
            return None
    except struct.error:
        return None
    return h, w


def check_png_chunks(data: bytes) -> None:
    """Refuse a PNG whose chunks are cut off or fail their checksums.

    libpng would notice too, but it writes to stderr on its own and OpenCV then only says "no picture".

    Raises
    ------
    FileError
        Without the file's name, which the caller puts in front.
    """
    view, start, kind = memoryview(data), len(PNG), b""
    while kind != b"IEND":
        length = int.from_bytes(view[start : start + 4], "big")
        kind, end = bytes(view[start + 4 : start + 8]), start + 12 + length
        if end > len(data):
            raise FileError(f"is truncated: {len(data)} bytes, but a part at byte {start} goes on to {end}")
        if zlib.crc32(view[start + 4 : end - 4]) != int.from_bytes(view[end - 4 : end], "big"):
            raise FileError(f"is damaged: the checksum of the part at byte {start} does not match")
        start = end


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    start = 2
    while start < len(data):
        marker, length = struct.unpack_from(">HH", data, start)
        if marker == 0xFFFF:  # padding before a marker
            start += 1
            continue
        if marker < 0xFFC0 or marker == 0xFFDA or length < 2:
            return None
        if marker <= 0xFFCF and marker not in (0xFFC4, 0xFFC8, 0xFFCC):  # a start of frame
            h, w = struct.unpack_from(">HH", data, start + 5)
            return h, w
        start += 2 + length
    return None


def _tiff_size(data: bytes) -> tuple[int, int] | None:
    """Tags 256 (width) and 257 (length) of the first directory; classic TIFF and BigTIFF."""
    order = "<" if data[:2] == b"II" else ">"
    big = b"+" in data[2:4]
    offset, count, entry = ("Q", "Q", 20) if big else ("I", "H", 12)
    (start,) = struct.unpack_from(order + offset, data, 8 if big else 4)
    if start > len(data):
        return None
    (entries,) = struct.unpack_from(order + count, data, start)
    found = {}
    first = start + struct.calcsize(order + count)
    stop = min(first + entries * entry, len(data))
    for place, _ in pairwise(range(first, stop + 1, entry)):
        tag, kind = struct.unpack_from(order + "HH", data, place)
        if tag in (256, 257) and kind in (3, 4, 16):
            width = {3: "H", 4: "I", 16: "Q"}[kind]
            (found[tag],) = struct.unpack_from(order + width, data, place + (12 if big else 8))
    return (found[257], found[256]) if len(found) == 2 else None
