# SPDX-License-Identifier: BSD-3-Clause
"""OpenEXR pictures: linear half or float, grey (Y) or RGB.

The OpenEXR package reads the pixels. On a broken file it prints, on stdout and stderr, and may allocate what
the header asks for; so the header and the table of chunks are walked here first (layout: "OpenEXR File
Layout" of the OpenEXR documentation). Known limits: one part, no deep data, no subsampled channels.
"""

from __future__ import annotations

import contextlib
import io
import struct
import sys
import threading
from pathlib import Path
from typing import NamedTuple

import numpy as np
import OpenEXR

from ltcl import checks
from ltcl.errors import FileError
from ltcl.images import headers
from ltcl.images.pictures import check_opaque

_MAGIC = b"\x76\x2f\x31\x01"
_TILED, _DEEP, _MULTIPART = 0x200, 0x800, 0x1000
# Rows per chunk, by number of the compression: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB.
_ROWS = dict(enumerate((1, 1, 1, 16, 32, 16, 32, 32, 32, 256)))
_alone = threading.Lock()


class _Header(NamedTuple):
    flags: int
    attributes: dict[str, bytes]
    end: int  # first byte behind the header: the table of chunks


def read(path: Path) -> np.ndarray:
    """Return the picture of an EXR file: (h, w) or (h, w, 3) RGB, float16 or float32.

    Raises
    ------
    FileError, MemoryLimitError
        Without the file's name, which the caller puts in front.
    """
    checks.fits_host("the file", path.stat().st_size)
    _check(path.read_bytes())
    printed = io.StringIO()
    try:
        # The package prints its trouble with pixels on sys.stdout, where a program's own results go. One
        # thread at a time: two that swap sys.stdout in turns would leave it swapped.
        with _alone, contextlib.redirect_stdout(printed):
            file = OpenEXR.File(str(path), separate_channels=True)
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, TypeError, MemoryError) as error:
        reason = " ".join((printed.getvalue() or str(error)).split())
        raise FileError(f"is no readable EXR picture: {reason}") from None
    if printed.getvalue():  # all was well, so this came from other threads
        sys.stdout.write(printed.getvalue())
    return _picture(channels)


def write(path: Path, picture: np.ndarray) -> None:
    """Write (h, w) or (h, w, 3) float16 or float32 pixels, losslessly compressed."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        OpenEXR.File(header, {"Y" if picture.ndim == 2 else "RGB": picture}).write(str(path))
    except RuntimeError as error:  # a full disk, for one
        raise FileError(f"cannot be written: {' '.join(str(error).split())}") from error


def _picture(channels: dict[str, np.ndarray]) -> np.ndarray:
    named = ", ".join(repr(name) for name in sorted(channels)) or "none"
    kinds = {pixels.dtype.name for pixels in channels.values()}
    if not kinds <= {"float16", "float32"}:
        raise FileError(f"holds {', '.join(sorted(kinds))} channels; they must be half or float")
    alpha = channels.pop("A", None)
    if alpha is not None:
        check_opaque(alpha, 1)
    if set(channels) == {"R", "G", "B"}:
        return np.stack([channels[name] for name in "RGB"], axis=-1)
    if len(channels) == 1:
        return next(iter(channels.values()))
    raise FileError(f"holds the channels {named}; they must be R, G, B or a single one")


def _check(data: bytes) -> None:
    """Refuse a file whose header asks for more than the file holds, or for what is not supported."""
    try:
        header = _header(data)
        left, top, right, bottom = struct.unpack("<4i", header.attributes["dataWindow"])
        display = struct.unpack("<4i", header.attributes["displayWindow"])
    except (struct.error, KeyError, ValueError):
        raise FileError("is no EXR picture, or its header is damaged or cut off") from None
    if header.flags & (_DEEP | _MULTIPART):
        raise FileError("is a deep or multi-part EXR; it must hold one plain picture")
    if (left, top, right, bottom) != display:
        raise FileError(
            f"has the data window {(left, top, right, bottom)} in the display window {display}; they must be "
            "equal, or pixels would move"
        )
    headers.check_size((bottom - top + 1, right - left + 1), len(data))
    _check_sampling(header.attributes.get("channels", b""))
    rows = _ROWS.get(int.from_bytes(header.attributes.get("compression", b""), "little"))
    if rows and not header.flags & _TILED:
        _check_chunks(data, header.end, -(-(bottom - top + 1) // rows))


def _header(data: bytes) -> _Header:
    if not data.startswith(_MAGIC):
        raise ValueError("magic number")
    (version,) = struct.unpack_from("<I", data, 4)
    attributes, start = {}, 8
    while (name := data.index(b"\0", start, start + 256)) > start:  # an empty name ends the header
        kind = data.index(b"\0", name + 1, name + 257)
        (length,) = struct.unpack_from("<I", data, kind + 1)
        attributes[data[start:name].decode("latin-1")] = data[kind + 5 : kind + 5 + length]
        start = kind + 5 + length
    return _Header(version, attributes, start + 1)


def _check_sampling(channels: bytes) -> None:
    start = 0
    while start < len(channels) - 1:
        end = channels.find(b"\0", start)
        if end < 0 or end + 17 > len(channels):
            raise FileError("has a damaged list of channels")
        if struct.unpack_from("<2i", channels, end + 9) != (1, 1):
            raise FileError(f"has a subsampled channel {channels[start:end]!r}; all must be full")
        start = end + 17


def _check_chunks(data: bytes, start: int, count: int) -> None:
    if start + 8 * count > len(data):
        raise FileError(f"is truncated: {len(data)} bytes cannot hold its table of {count} chunks")
    for place in np.frombuffer(data, "<u8", count, start).tolist():
        if place + 8 > len(data) or place + 8 + int.from_bytes(data[place + 4 : place + 8], "little") > len(
            data
        ):
            raise FileError(
                f"is truncated or incomplete: a chunk at byte {place} is not within {len(data)} bytes"
            )
