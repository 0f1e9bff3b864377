# SPDX-License-Identifier: BSD-3-Clause
"""Codes of picture files: PNG, JPEG, BMP, TIFF and EXR.

Pillow decodes 8 bits, up to 179 million pixels; OpenCV decodes 16-bit PNG and TIFF; OpenEXR decodes
its own format. Known limits: some damage gives a wrong picture where a format has no checksum
(JPEG, BMP, TIFF); OpenEXR also writes to stderr about some damage.
"""

from __future__ import annotations

import contextlib
import io
import re
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
from PIL import Image, TiffImagePlugin

from ltcl import checks
from ltcl.errors import FileError, LtclError, MemoryLimitError
from ltcl.files import input_file

# Tags of TIFF 6.0 and EXIF 2.32.
WIDTH_TAG = 256
HEIGHT_TAG = 257
ORIENTATION_TAG = 274

UPRIGHT = 1

# A pixel takes three codes and three floats of 4 bytes each in memory.
BYTES_PER_PIXEL = 24

# The last chunk of a PNG file, with its length and checksum.
PNG_END = b"\0\0\0\0IEND\xaeB`\x82"

# Modes of Pillow that hold grey or RGB of 8 bits, and the mode each is converted to.
PILLOW_MODES = {"1": "L", "L": "L", "LA": "LA", "P": "RGBA", "RGB": "RGB", "RGBA": "RGBA"}

_log_lock = threading.Lock()


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


def decode_file(path: Path, memory: int) -> tuple[np.ndarray, int]:
    """Codes (h, w) or (h, w, 3) RGB, on the pixels of the file, and its EXIF orientation.

    MemoryLimitError for a picture that needs more than `memory` bytes; FileError for a damaged or
    transparent one.
    """
    with decoding(input_file(path)):
        if path.suffix.lower() == ".exr":
            return _decode_exr(path, memory), UPRIGHT
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


def _decode_plain(data: bytes, memory: int) -> tuple[np.ndarray, int]:
    """Codes and orientation of a PNG, JPEG or BMP file."""
    picture = Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "BMP"))
    checks.fits_host("the picture", BYTES_PER_PIXEL * picture.width * picture.height, memory)
    is_deep = False
    if picture.format == "PNG":
        _check_png(data)
        is_deep = "16" in str(picture.tile[0][3])
    codes = _decode_with_opencv(data) if is_deep else _decode_with_pillow(picture)
    # After decoding: the header may stand behind the pixels.
    exif = Image.Image.getexif(picture)
    return codes, exif.get(ORIENTATION_TAG, UPRIGHT)


def _check_png(data: bytes) -> None:
    """Refuse a PNG file with a wrong checksum or without its end."""
    Image.open(io.BytesIO(data)).verify()  # decoding does not look at checksums
    if PNG_END not in data:  # libpng would write to stderr
        raise FileError("is truncated: its last chunk, IEND, is not whole")


def _decode_with_pillow(picture: Image.Image) -> np.ndarray:
    if picture.mode not in PILLOW_MODES:
        raise FileError(f"holds {picture.mode} pixels; it must be grey or RGB")
    mode = "RGBA" if picture.has_transparency_data else PILLOW_MODES[picture.mode]
    return _without_alpha(np.array(picture.convert(mode)))


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


def _decode_tiff(data: bytes, memory: int) -> tuple[np.ndarray, int]:
    """Codes and orientation of a TIFF file.

    Only its directory is read with Pillow, which would refuse float RGB and write to stderr.
    """
    file = io.BytesIO(data)
    is_big_tiff = data[2:3] == b"+"
    header_size = 16 if is_big_tiff else 8
    directory = TiffImagePlugin.ImageFileDirectory_v2(file.read(header_size))
    file.seek(directory.next)
    directory.load(file)
    if directory.next:
        raise FileError("holds several pages; it must hold one picture, so save each to a file")
    pixels = int(directory[WIDTH_TAG]) * int(directory[HEIGHT_TAG])
    checks.fits_host("the picture", BYTES_PER_PIXEL * pixels, memory)
    orientation = directory.get(ORIENTATION_TAG)
    if not orientation:
        orientation = UPRIGHT
    # OpenCV turns a TIFF upright whatever its flags. The inverse turn gives the pixels of the file;
    # only quarter turns, 6 and 8, are not their own inverse.
    inverse = {6: 8, 8: 6}.get(orientation, orientation)
    return turn_upright(_decode_with_opencv(data), inverse), orientation


def _decode_exr(path: Path, memory: int) -> np.ndarray:
    """Codes, float16 or float32, of an EXR file of one part with R, G, B or a single channel."""
    names, h, w = _exr_channels(path)
    checks.fits_host("the picture", BYTES_PER_PIXEL * h * w, memory)
    # `OpenEXR.File` prints on sys.stdout what is wrong with pixels; `InputFile` crashes on headers
    # that `_exr_channels` refuses.
    file = OpenEXR.InputFile(str(path))
    channels = file.header()["channels"]
    types = {str(channels[name].type) for name in names}
    if types == {"HALF"}:
        dtype = np.float16
    elif types == {"FLOAT"}:
        dtype = np.float32
    else:
        raise FileError(
            f"holds {', '.join(sorted(types))} channels; they must be all HALF or all FLOAT"
        )
    planes = [np.frombuffer(pixels, dtype).reshape(h, w) for pixels in file.channels(names)]
    return _without_alpha(np.stack(planes, axis=-1))


def _exr_channels(path: Path) -> tuple[list[str], int, int]:
    """Names of the channels of an EXR file, R, G and B first, and its height and width."""
    file = OpenEXR.File(str(path), header_only=True)
    header = file.header()
    is_plain = header["type"] in (OpenEXR.scanlineimage, OpenEXR.tiledimage)
    if len(file.parts) > 1 or not is_plain:
        raise FileError("is a deep or multi-part EXR; it must hold one plain picture")
    window = np.array(header["dataWindow"], int)
    display = np.array(header["displayWindow"], int)
    if not np.array_equal(window, display):
        raise FileError(f"has the data window {window.tolist()}; it must be the display window")
    w, h = (window[1] - window[0] + 1).tolist()
    names = sorted((channel.name for channel in header["channels"]), key="RGBA".find)
    if len(names) != 1 and names not in ([*"RGB"], [*"RGBA"]):
        raise FileError(f"holds the channels {names}; they must be R, G, B, or one")
    return names, h, w


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
        transparent = np.count_nonzero(codes[..., -1] != opaque)
        if transparent:
            raise FileError(
                f"has {transparent} transparent pixel(s), whose light is not known; "
                "make them opaque"
            )
    if channels < 3:
        return codes[..., 0]
    return codes[..., :3]
