# SPDX-License-Identifier: BSD-3-Clause
"""The directory of a TIFF file (TIFF 6.0), and whether OpenCV decodes its pixels right.

OpenCV gives wrong pixels, without a word, for planes apart, JPEG 2000, more channels than colours
and others. So what is not known to be right is refused: `check_layout` lists what is.
"""

from __future__ import annotations

import io
import struct
from typing import Any, NamedTuple

import numpy as np
from PIL import TiffImagePlugin

from ltcl.errors import FileError

WIDTH = 256
HEIGHT = 257
BITS = 258
COMPRESSION = 259
PHOTOMETRIC = 262
FILL_ORDER = 266
ORIENTATION = 274
SAMPLES = 277
PLANAR = 284
PREDICTOR = 317
EXTRA_SAMPLES = 338
SAMPLE_FORMAT = 339

WHITE_IS_ZERO = 0
BLACK_IS_ZERO = 1
RGB = 2
PALETTE = 3
YCBCR = 6

GREY = {(BLACK_IS_ZERO, 1)}
INVERTED = {(WHITE_IS_ZERO, 1)}
COLOUR = {(RGB, 3), (RGB, 4)}
# Kinds and channels that are decoded right, by the bits of a channel.
LAYOUTS = {
    1: GREY | INVERTED,
    8: GREY | INVERTED | COLOUR | {(BLACK_IS_ZERO, 2), (PALETTE, 1), (YCBCR, 3)},
    10: GREY,
    12: GREY,
    14: GREY,
    16: GREY | INVERTED | COLOUR,
    32: GREY | COLOUR | {(BLACK_IS_ZERO, 3)},
    64: GREY | COLOUR | {(BLACK_IS_ZERO, 3)},
}
KINDS = {
    WHITE_IS_ZERO: "inverted grey",
    BLACK_IS_ZERO: "grey",
    RGB: "RGB",
    PALETTE: "palette",
    5: "CMYK",
    YCBCR: "YCbCr",
    8: "CIELab",
}

NO_COMPRESSION = 1
PACK_BITS = 32773
# LZW and Deflate: they alone may store differences.
PREDICTED = {5, 8, 32946}
LOSSLESS = {NO_COMPRESSION, PACK_BITS} | PREDICTED
FAX = {2, 3, 4}
JPEG = 7
COMPRESSIONS = {
    1: LOSSLESS | FAX,
    8: LOSSLESS | {JPEG},
    10: {NO_COMPRESSION},
    12: {NO_COMPRESSION},
    14: {NO_COMPRESSION},
}

# Type of 16-bit values; what ExtraSamples says of a channel beyond the colours.
SHORT = 3
UNSPECIFIED = 0
ALPHA = 2

NUMBERS = {1: "uint", 2: "int", 3: "float"}
CURE = "save it as RGB or grey of 8 or 16 bits or float32, uncompressed or with LZW or Deflate"

Directory = Any


class _Layout(NamedTuple):
    """Bytes of the header and of an entry, `struct` types of offsets and of the entry count."""

    header_size: int
    entry_size: int
    offset_type: str
    count_type: str

    @property
    def start_place(self) -> int:
        """Place in the header of the offset of the first directory."""
        return self.header_size - struct.calcsize(f"={self.offset_type}")


CLASSIC_TIFF = _Layout(header_size=8, entry_size=12, offset_type="I", count_type="H")
BIG_TIFF = _Layout(header_size=16, entry_size=20, offset_type="Q", count_type="Q")


def _find_layout(data: bytes) -> _Layout:
    return BIG_TIFF if data[2:3] == b"+" else CLASSIC_TIFF


def read_directory(data: bytes) -> Directory:
    """The tags of a file of one picture.

    Pillow reads the directory alone: it would refuse float RGB, and write to stderr.
    """
    file = io.BytesIO(data)
    header = file.read(_find_layout(data).header_size)
    directory = TiffImagePlugin.ImageFileDirectory_v2(header)
    file.seek(directory.next)
    directory.load(file)
    if directory.next:
        raise FileError("holds several pages; it must hold one picture, so save each to a file")
    return directory


def check_layout(directory: Directory) -> None:
    """Refuse pixels in a layout that OpenCV does not decode, or decodes wrong."""
    samples = int(directory.get(SAMPLES, 1))
    bits = _bits(directory)
    photometric = directory.get(PHOTOMETRIC)
    are_planes = samples > 1 and directory.get(PLANAR, 1) != 1
    # libtiff itself puts planes of 8 bits together.
    if are_planes and (photometric, bits) != (RGB, 8):
        raise FileError(f"stores its channels in separate planes; {CURE}")
    if (photometric, samples) not in LAYOUTS.get(bits, ()):
        kind = KINDS.get(photometric, f"kind {photometric}")
        raise FileError(f"holds {samples} channel(s) of {bits} bits, {kind}; {CURE}")
    compression = directory.get(COMPRESSION, NO_COMPRESSION)
    if compression not in COMPRESSIONS.get(bits, LOSSLESS):
        raise FileError(f"is compressed by method {compression} of {bits} bits; {CURE}")
    if directory.get(PREDICTOR, 1) != 1 and compression not in PREDICTED:
        raise FileError(f"stores differences, uncompressed or by a method without; {CURE}")
    if directory.get(FILL_ORDER, 1) != 1:
        raise FileError(f"stores its bits in reverse order; {CURE}")


def _bits(directory: Directory) -> int:
    """Bits of each channel; FileError if they differ, or are no unsigned integers or floats."""
    sizes = {*directory.get(BITS, (1,))}
    formats = {*directory.get(SAMPLE_FORMAT, (1,))}
    if len(sizes) > 1 or len(formats) > 1:
        raise FileError(f"holds channels of different types; {CURE}")
    (bits,) = sizes
    numbers = NUMBERS.get(formats.pop(), "complex")
    expected = "float" if bits >= 32 else "uint"
    if numbers != expected:
        raise FileError(f"holds {numbers}{bits} numbers; {CURE}")
    return bits


def is_inverted(directory: Directory, codes: np.ndarray) -> bool:
    """True if white is 0 in codes that OpenCV decoded: it inverts those of 8 bits itself."""
    return directory[PHOTOMETRIC] == WHITE_IS_ZERO and codes.dtype == np.uint16


def is_grey_with_alpha(directory: Directory) -> bool:
    """True for two channels: OpenCV drops the second."""
    return directory.get(SAMPLES, 1) == 2


def with_alpha(data: bytes, directory: Directory) -> bytes:
    """A file of grey with a second channel, which its directory calls alpha or nothing special.

    Pillow decodes no other. But files leave the tag out, or say that the grey is multiplied by
    alpha, which is the same where that is opaque. The new directory stands at the end.
    """
    if directory.get(EXTRA_SAMPLES) in ((UNSPECIFIED,), (ALPHA,)):
        return data
    order = "<" if data.startswith(b"II") else ">"
    layout = _find_layout(data)
    entry_size = layout.entry_size
    (start,) = struct.unpack_from(order + layout.offset_type, data, layout.start_place)
    (count,) = struct.unpack_from(order + layout.count_type, data, start)
    first = start + struct.calcsize(layout.count_type)
    entries = {}
    for number in range(count):
        entry_start = first + number * entry_size
        entry = data[entry_start : entry_start + entry_size]
        (tag,) = struct.unpack_from(order + "H", entry)
        entries[tag] = entry
    alpha = struct.pack(f"{order}HH{layout.offset_type}H", EXTRA_SAMPLES, SHORT, 1, ALPHA)
    entries[EXTRA_SAMPLES] = alpha.ljust(entry_size, b"\0")
    sorted_entries = b"".join(entries[tag] for tag in sorted(entries))
    # Directories begin at an even byte.
    padded = data + b"\0" * (len(data) % 2)
    header = padded[: layout.start_place] + struct.pack(order + layout.offset_type, len(padded))
    size = struct.pack(order + layout.count_type, len(entries))
    last = struct.pack(order + layout.offset_type, 0)
    return header + padded[len(header) :] + size + sorted_entries + last
