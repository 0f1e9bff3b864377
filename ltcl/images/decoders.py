# SPDX-License-Identifier: BSD-3-Clause
"""Codes of picture files: PNG, JPEG, BMP, TIFF and EXR.

Pillow decodes 8 bits, up to 179 million pixels; OpenCV decodes 16-bit PNG and TIFF; OpenEXR decodes
its own format. Known limits: some damage gives a wrong picture where a format has no checksum
(JPEG, BMP, TIFF).
"""

from __future__ import annotations

import contextlib
import io
import re
import threading
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from ltcl import checks
from ltcl.errors import FileError, LtclError, MemoryLimitError
from ltcl.files import input_file
from ltcl.images import png, tiff
from ltcl.images.exr import read_exr

UPRIGHT = 1

# A pixel takes three codes and three floats of 4 bytes each in memory.
BYTES_PER_PIXEL = 24

# Modes of Pillow that hold grey or RGB of 8 bits, and the mode each is converted to.
PILLOW_MODES = {"1": "L", "L": "L", "LA": "LA", "P": "RGBA", "RGB": "RGB", "RGBA": "RGBA"}

_log_lock = threading.Lock()


@dataclass(frozen=True)
class Decoded:
    """A decoded picture file.

    Attributes
    ----------
    codes : ndarray
        (h, w) or (h, w, 3) RGB, on the pixels of the file.
    orientation : int
        Orientation of EXIF.
    png_header : Header or None
        Header of a PNG file, which may name a curve.
    """

    codes: np.ndarray
    orientation: int = UPRIGHT
    png_header: png.Header | None = None


@contextlib.contextmanager
def decoding(path: Path) -> Iterator[None]:
    """Name the file in every error, and keep decoders off stderr.

    OpenCV's log level and Pillow's warnings are global: one thread at a time changes them.
    """
    with _log_lock, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            yield
        except MemoryLimitError as error:
            raise MemoryLimitError(f"{path}: {error}") from None
        except LtclError as error:
            raise FileError(f"{path}: {error}") from None
        except Exception as error:
            reason = _one_line(error)
            raise FileError(
                f"{path}: is truncated, damaged or no picture: {reason:.200}"
            ) from error
        finally:
            cv2.utils.logging.setLogLevel(level)


def _one_line(error: Exception) -> str:
    """Message of a decoder's error on one line, without addresses of objects."""
    message = " ".join(str(error).split())
    message = re.sub(r" <\S+ object at \w+>", "", message)
    if not message:
        return type(error).__name__
    return message


def decode_file(path: Path, memory: int) -> Decoded:
    """Decode a picture file.

    MemoryLimitError for a picture that needs more than `memory` bytes; FileError for a damaged or
    transparent one.
    """
    with decoding(input_file(path)):
        if path.suffix.lower() == ".exr":
            return Decoded(_without_alpha(read_exr(path, BYTES_PER_PIXEL, memory)))
        checks.fits_host("the file", path.stat().st_size)
        data = path.read_bytes()
        if data.startswith((b"II", b"MM")):
            return _decode_tiff(data, memory)
        return _decode_plain(data, memory)


def turn_upright(codes: np.ndarray, orientation: int) -> np.ndarray:
    """Turn codes upright: EXIF 2.32, tag 274, tells the place of the first row and column."""
    if orientation in (5, 6, 7, 8):
        codes = codes.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        codes = codes[::-1]
    if orientation in (2, 3, 6, 7):
        codes = codes[:, ::-1]
    return codes


def _decode_plain(data: bytes, memory: int) -> Decoded:
    """Decode a PNG, JPEG or BMP file."""
    picture = Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "BMP"))
    _check_memory(picture.width, picture.height, memory)
    if picture.format == "PNG":
        header = png.read_header(data)
        if header.depth == 16:
            codes = _decode_with_opencv(png.without_extras(header))
            if header.colour_type == png.GREY_WITH_ALPHA:
                # OpenCV repeats the grey in each colour.
                codes = codes[..., 0]
        else:
            codes = _decode_with_pillow(picture)
        _check_opaque(png.transparent_pixels(header, codes))
    else:
        header = None
        codes = _decode_with_pillow(picture)
    # After decoding: the EXIF header may stand behind the pixels.
    exif = Image.Image.getexif(picture)
    return Decoded(codes, exif.get(tiff.ORIENTATION, UPRIGHT), header)


def _check_memory(width: int, height: int, memory: int) -> None:
    checks.fits_host("the picture", BYTES_PER_PIXEL * width * height, memory)


def _decode_with_pillow(picture: Image.Image) -> np.ndarray:
    if picture.mode not in PILLOW_MODES:
        raise FileError(f"holds {picture.mode} pixels; it must be grey or RGB")
    # A transparent colour of grey and RGB is not Pillow's to apply: it takes codes of 2 and 4 bits
    # for those of 8.
    return _without_alpha(np.array(picture.convert(PILLOW_MODES[picture.mode])))


def _decode_with_opencv(data: bytes) -> np.ndarray:
    codes = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if codes is None:
        raise FileError("is truncated or damaged, or its pixels are of an unknown kind")
    if codes.dtype == np.float64:
        codes = codes.astype(np.float32)
    codes = _without_alpha(codes)
    if codes.ndim == 3:
        codes = codes[..., ::-1]  # OpenCV keeps BGR
    return codes


def _decode_tiff(data: bytes, memory: int) -> Decoded:
    """Decode a TIFF file."""
    directory = tiff.read_directory(data)
    tiff.check_layout(directory)
    _check_memory(int(directory[tiff.WIDTH]), int(directory[tiff.HEIGHT]), memory)
    orientation = directory.get(tiff.ORIENTATION) or UPRIGHT
    if tiff.is_grey_with_alpha(directory):
        file = io.BytesIO(tiff.with_alpha(data, directory))
        codes = _decode_with_pillow(Image.open(file, formats=("TIFF",)))
    else:
        codes = _decode_with_opencv(data)
    if tiff.is_inverted(directory, codes):
        codes = np.iinfo(codes.dtype).max - codes
    # Both turn a TIFF upright. The inverse turn gives the pixels of the file; only quarter turns,
    # 6 and 8, are not their own inverse.
    inverse = {6: 8, 8: 6}.get(orientation, orientation)
    return Decoded(turn_upright(codes, inverse), orientation)


def _without_alpha(codes: np.ndarray) -> np.ndarray:
    """Drop an alpha channel that is opaque; refuse another, as the light there is unknown."""
    if codes.ndim == 2:
        codes = codes[..., None]
    channels = codes.shape[2]
    dtype = codes.dtype
    if channels > 4 or dtype not in (np.uint8, np.uint16, np.float16, np.float32):
        raise FileError(
            f"holds {channels} channels of {dtype}; it must be grey or RGB, unsigned or floats"
        )
    checks.finite("the picture", codes)
    if channels in (2, 4):
        opaque = np.iinfo(dtype).max if dtype.kind == "u" else 1
        _check_opaque(int(np.count_nonzero(codes[..., -1] != opaque)))
    if channels < 3:
        return codes[..., 0]
    return codes[..., :3]


def _check_opaque(transparent: int) -> None:
    """Refuse a picture of so many transparent pixels."""
    if transparent:
        raise FileError(
            f"has {transparent} transparent pixel(s), whose light is not known; make them opaque"
        )
