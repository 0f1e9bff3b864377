# SPDX-License-Identifier: BSD-3-Clause
"""Chunks of a PNG file (W3C, third edition): size, transparent colour, curve of the codes, damage.

Decoders differ in what they do with chunks, and print on stderr what is wrong with them; so what
codes mean is read here, and damage is found before a decoder sees it.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections import defaultdict
from dataclasses import dataclass
from math import ceil

import numpy as np
from PIL import Image

from ltcl.errors import FileError

SIGNATURE = b"\x89PNG\r\n\x1a\n"
# The last chunk, with its length and checksum.
END = b"\0\0\0\0IEND\xaeB`\x82"

# Samples of a pixel by the type of colour: grey, RGB, palette, grey with alpha, RGB with alpha.
SAMPLES = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
GREY_OR_RGB = (0, 2)
GREY_WITH_ALPHA = 4
# First column and row of the pixels of a pass, and steps to the next ones.
ONE_PASS = ((0, 0, 1, 1),)
ADAM7 = (
    (0, 0, 8, 8),
    (4, 0, 8, 8),
    (0, 4, 4, 8),
    (2, 0, 4, 4),
    (0, 2, 2, 4),
    (1, 0, 2, 2),
    (0, 1, 1, 2),
)
LARGEST_FILTER = 4

# Curves of cICP (ITU-T H.273): like sRGB or unknown; powers; HDR.
SRGB_LIKE = (1, 2, 6, 11, 12, 13, 14, 15)
POWERS = {4: 2.2, 5: 2.8, 8: 1.0}
HDR_CURVES = {16: "PQ", 18: "HLG"}
# A gAMA of 1 / 2.2 stands for sRGB; values are rounded in several ways.
SRGB_GAMMA = 1 / 2.2
GAMMA_TOLERANCE = 0.01


@dataclass(frozen=True, kw_only=True)
class Header:
    """Size, kind and chunks of a PNG file."""

    width: int
    height: int
    depth: int
    colour_type: int
    is_interlaced: bool
    chunks: dict[bytes, list[bytes]]


def read_header(data: bytes) -> Header:
    """Read all chunks; FileError for a wrong checksum, or without the end."""
    # Pillow checks order and checksums, but asks for no end.
    Image.open(io.BytesIO(data), formats=("PNG",)).verify()
    if END not in data:
        raise FileError("is truncated: its last chunk, IEND, is not whole")
    chunks = defaultdict(list)
    place = len(SIGNATURE)
    while place < len(data):
        length, kind = struct.unpack_from(">I4s", data, place)
        chunks[kind].append(data[place + 8 : place + 8 + length])
        if kind == b"IEND":
            break
        place += length + 12
    width, height, depth, colour_type, compression, filters, interlace = struct.unpack(
        ">IIBBBBB", chunks[b"IHDR"][0]
    )
    # Pillow does not look at them, and libpng writes to stderr.
    if compression != 0 or filters != 0 or interlace not in (0, 1):
        raise FileError(
            f"is damaged: compression {compression}, filter {filters} or interlace {interlace} is "
            "unknown; they must be 0, 0, and 0 or 1"
        )
    return Header(
        width=width,
        height=height,
        depth=depth,
        colour_type=colour_type,
        is_interlaced=interlace == 1,
        chunks=chunks,
    )


def without_extras(header: Header) -> bytes:
    """The same picture of its pixels alone, uncompressed; FileError if these are damaged.

    libpng writes to stderr of chunks that it does not like, and of damaged pixels.
    """
    pixels = zlib.compress(_inflate(header), 0)
    data = [SIGNATURE]
    for chunk in (b"IHDR" + header.chunks[b"IHDR"][0], b"IDAT" + pixels, b"IEND"):
        data += [struct.pack(">I", len(chunk) - 4), chunk, struct.pack(">I", zlib.crc32(chunk))]
    return b"".join(data)


def _inflate(header: Header) -> bytes:
    """Rows of all passes, each after its filter; FileError if they are too few, or damaged."""
    passes = _row_bytes(header)
    size = sum(rows * row_bytes for rows, row_bytes in passes)
    decompressor = zlib.decompressobj()
    pixels = decompressor.decompress(b"".join(header.chunks[b"IDAT"]), size)
    # The checksum comes after the last pixel. Some programs write more, which does no harm.
    decompressor.decompress(decompressor.unconsumed_tail, 1)
    if len(pixels) < size:
        raise FileError("is damaged: it has fewer pixels than it says")
    place = 0
    for rows, row_bytes in passes:
        filters = pixels[place : place + rows * row_bytes : row_bytes]
        if max(filters) > LARGEST_FILTER:
            raise FileError("is damaged: the filter of a row is unknown")
        place += rows * row_bytes
    return pixels


def _row_bytes(header: Header) -> list[tuple[int, int]]:
    """Number of rows of each pass, and bytes of a row with its filter."""
    bits = header.depth * SAMPLES[header.colour_type]
    passes = []
    for x, y, x_step, y_step in ADAM7 if header.is_interlaced else ONE_PASS:
        columns = ceil((header.width - x) / x_step)
        rows = ceil((header.height - y) / y_step)
        if columns > 0 and rows > 0:
            passes.append((rows, 1 + ceil(columns * bits / 8)))
    return passes


def transparent_pixels(header: Header, codes: np.ndarray) -> int:
    """Number of pixels in the transparent colour of a grey or RGB picture (tRNS)."""
    if header.colour_type not in GREY_OR_RGB or b"tRNS" not in header.chunks:
        return 0
    samples = SAMPLES[header.colour_type]
    key = np.array(struct.unpack(f">{samples}H", header.chunks[b"tRNS"][0]))
    key &= (1 << header.depth) - 1
    if header.depth < 8:
        # Decoders spread the codes over 8 bits.
        key *= 255 // ((1 << header.depth) - 1)
    is_key = codes.reshape(header.height, header.width, samples) == key
    return int(np.count_nonzero(is_key.all(axis=-1)))


def power(header: Header) -> float | None:
    """Exponent from codes to light, by the chunk of highest rank; None for sRGB.

    Programs that write a profile (iCCP) tell its exponent by gAMA as well.
    FileError for HDR and other curves that are no power.
    """
    chunks = header.chunks
    if b"cICP" in chunks:
        curve = chunks[b"cICP"][0][1]
        if curve not in SRGB_LIKE and curve not in POWERS:
            name = HDR_CURVES.get(curve, f"number {curve} of H.273")
            raise FileError(
                f"has codes of the curve {name} (cICP), which is not known here; "
                "convert it to sRGB, or give the encoding 'srgb' or 'linear'"
            )
        return POWERS.get(curve)
    if b"sRGB" in chunks or b"gAMA" not in chunks:
        return None
    gamma = struct.unpack(">I", chunks[b"gAMA"][0])[0] / 1e5
    if gamma <= 0 or abs(gamma - SRGB_GAMMA) < GAMMA_TOLERANCE:
        return None
    return 1 / gamma
