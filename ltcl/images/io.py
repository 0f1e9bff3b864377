# SPDX-License-Identifier: BSD-3-Clause
"""Pictures on disk: PNG, JPEG, TIFF, BMP and EXR in, linear float32 out, and back.

Headers are read by Pillow and OpenEXR, and sizes checked before a decoder allocates. Pillow decodes 8 bits,
OpenCV 16-bit PNG and TIFF: the silent one of both. Known limits: where a format has no checksum (JPEG, BMP,
TIFF), some damage is a wrong picture; about damaged pixels of an EXR, OpenEXR itself writes to stderr, too.
"""

from __future__ import annotations

import contextlib
import io
import os
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
from numpy.typing import ArrayLike
from PIL import BmpImagePlugin, Image, JpegImagePlugin, PngImagePlugin, TiffImagePlugin

from ltcl import checks
from ltcl.errors import FileError, InputError, LtclError, MemoryLimitError
from ltcl.files import as_path, input_file, replace_file, unknown_extension
from ltcl.images.srgb import ENCODINGS, Encoding, from_linear, to_linear

_TIFF = (32, 8, 16)
BITS: dict[str, tuple[int, ...]] = {".png": (8, 16), ".jpg": (8,), ".jpeg": (8,), ".bmp": (8,)}
BITS |= {".tif": _TIFF, ".tiff": _TIFF, ".exr": (32, 16)}
"""Known extensions and the bits per channel that each can be written with, the default first."""

_PLUGINS = {  # used directly: `Image.open` warns of pictures beyond 89 million pixels, and refuses 179
    b"\x89PNG": PngImagePlugin.PngImageFile,
    b"\xff\xd8": JpegImagePlugin.JpegImageFile,
    b"BM": BmpImagePlugin.BmpImageFile,
}
_alone = threading.Lock()
_ORIENTATION = 274  # the tag of EXIF and TIFF
_MOST_PIXELS = 1 << 30  # OpenCV's own limit
# Deflate reaches 1032 bytes for one, and a byte holds 8 pixels at best; eight times that is a lie.
_PIXELS_PER_BYTE = 1 << 16
_JPEG_SIDE = 65500  # that libjpeg writes
# 4:4:4 at 95: colour must not bleed between neighbouring projector pixels more than JPEG has to.
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]


def read(path: str | os.PathLike[str], *, encoding: Encoding = "auto", upright: bool = True) -> np.ndarray:
    """Read a picture as linear light.

    Parameters
    ----------
    path
        A .png, .jpg, .jpeg, .tif, .tiff, .bmp (8 or 16 bits, float TIFF) or .exr file, opaque everywhere.
    encoding
        What the file holds: "srgb" or "linear"; "auto" takes integers as sRGB and floats as linear.
    upright
        Apply the orientation in the header (EXIF, TIFF). False keeps a photograph on the camera's pixels.

    The result is float32, (h, w) or (h, w, 3) RGB; white of an integer format is 1. FileError for no picture,
    a damaged or transparent one, NaN; MemoryLimitError for one larger than the host can hold.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "grey.png"
    >>> write(path, np.full((1, 3), 0.5), bits=16)
    >>> read(path).round(2)
    array([[0.5, 0.5, 0.5]], dtype=float32)
    """
    checks.one_of("encoding", encoding, ENCODINGS)
    path = as_path(path)
    codes, orientation = _stored(path)
    with _naming(path):
        return to_linear(np.ascontiguousarray(_turned(codes, orientation) if upright else codes), encoding)


def read_codes(path: str | os.PathLike[str]) -> np.ndarray:
    """Codes of a picture file, (h, w) or (h, w, 3) RGB, in its dtype: no curve, scale or orientation."""
    return np.ascontiguousarray(_stored(as_path(path))[0])


def write(
    path: str | os.PathLike[str], image: ArrayLike, *, encoding: Encoding = "auto", bits: int | None = None
) -> None:
    """Write linear light as a picture; an earlier file is replaced whole or not at all.

    Parameters
    ----------
    path
        Its extension names the format, as in `read`.
    image
        (h, w) or (h, w, 3) RGB, linear; clipped to [0, 1] in the integer formats, never in the float ones.
    encoding
        What the file shall hold: "srgb" or "linear"; "auto" gives sRGB to 8 and 16 bits in integer formats.
    bits
        Per channel: 8 or 16 for .png (default 8); 8, 16 or 32 (float) for .tif (default 32); 16 (half) or 32
        for .exr (default 32); 8 for .jpg and .bmp. InputError for others, another shape or NaN.
    """
    checks.one_of("encoding", encoding, ENCODINGS)
    path = as_path(path)
    suffix, possible = path.suffix.lower(), _bits(path)
    bits = possible[0] if bits is None else bits
    if bits not in possible:
        raise InputError(f"bits is {bits!r}; for {path.suffix} it must be {' or '.join(map(str, possible))}")
    codes = from_linear(as_picture("image", image), encoding, bits, is_float=suffix == ".exr" or bits == 32)
    if "jp" in suffix and max(codes.shape[:2]) > _JPEG_SIDE:
        raise FileError(
            f"{path}: the picture is {codes.shape}; sides of a JPEG are at most {_JPEG_SIDE} pixels"
        )
    with replace_file(path) as temporary:
        try:
            if suffix == ".exr":
                header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
                OpenEXR.File(header, {"Y" if codes.ndim == 2 else "RGB": codes}).write(str(temporary))
            else:
                stored = codes if codes.ndim == 2 else np.ascontiguousarray(codes[..., ::-1])
                data = cv2.imencode(suffix, stored, _JPEG if "jp" in suffix else [])[1]
                temporary.write_bytes(data.tobytes())
        except (cv2.error, RuntimeError) as error:  # a full disk
            raise FileError(f"{path}: cannot be written: {' '.join(str(error).split())}") from error


def as_picture(name: str, image: ArrayLike) -> np.ndarray:
    """Return `image` as contiguous float32 (h, w) or (h, w, 3); refuse other shapes, NaN and Inf."""
    array = checks.real(name, image)
    if array.ndim not in (2, 3) or array.shape[2:] not in ((), (3,)) or array.size == 0:
        raise InputError(f"{name} has shape {array.shape}; it must be (h, w) or (h, w, 3), not empty")
    with np.errstate(over="ignore"):
        array = np.ascontiguousarray(array, dtype=np.float32)
    return checks.finite(name, array)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep OpenCV's log and Pillow's warnings off stderr; both are global, so one thread at a time."""
    with _alone, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            yield
        finally:
            cv2.utils.logging.setLogLevel(level)


def _bits(path: Path) -> tuple[int, ...]:
    if path.suffix.lower() not in BITS:
        raise FileError(f"{path}: {unknown_extension(path)}; pictures are {', '.join(BITS)}")
    return BITS[path.suffix.lower()]


@contextlib.contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Put the file's name before every refusal of the block; whatever a library raises becomes one."""
    try:
        yield
    except MemoryLimitError as error:
        raise MemoryLimitError(f"{path}: {error}") from None
    except LtclError as error:
        raise FileError(f"{path}: {error}") from None
    except Exception as error:
        reason = " ".join(f"{error}".split()) or type(error).__name__
        raise FileError(f"{path}: is truncated, damaged or no picture: {reason:.200}") from error


def _stored(path: Path) -> tuple[np.ndarray, int]:
    """Codes, (h, w) or (h, w, 3) RGB, on the pixels of the file, and their orientation, 1 for upright."""
    _bits(path)
    input_file(path)
    with _naming(path):
        if path.suffix.lower() == ".exr":
            return _exr(path), 1
        checks.fits_host("the file", path.stat().st_size)
        data = path.read_bytes()
        if data.startswith((b"II", b"MM")):
            return _tiff(data)
        plugin = next((plugin for magic, plugin in _PLUGINS.items() if data.startswith(magic)), None)
        if plugin is None:
            raise FileError(f"is no PNG, JPEG, TIFF, BMP or EXR picture; it begins with {data[:8]!r}")
        with quiet():
            picture = plugin(io.BytesIO(data))
        _check_size(picture.size, len(data))
        if picture.format == "PNG":
            plugin(io.BytesIO(data)).verify()  # checksums, which decoding does not look at
        is_deep = picture.format == "PNG" and "16" in str(picture.tile[0][3])
        codes = _opencv(data) if is_deep else _pillow(picture)
        with quiet():
            return codes, Image.Image.getexif(picture).get(_ORIENTATION, 1)


def _check_size(size: tuple[int, int], nbytes: int) -> None:
    """Refuse a declared (w, h) that a file of `nbytes` cannot hold, or that memory cannot."""
    w, h = (int(side) for side in size)
    most = min(_MOST_PIXELS, _PIXELS_PER_BYTE * nbytes)
    if w < 1 or h < 1 or w * h > most:
        raise FileError(f"declares {w} x {h} pixels in {checks.size(nbytes)}; it must be 1 to {most} pixels")
    checks.fits_host(f"a picture of {w} x {h} pixels", h * w * 3 * (4 + 4))


def _opaque(codes: np.ndarray) -> np.ndarray:
    """The codes without an alpha channel; one that is not opaque is refused, the light there is unknown."""
    if codes.dtype not in (np.uint8, np.uint16, np.float16, np.float32, np.float64):
        raise FileError(f"holds {codes.dtype} pixels; they must be unsigned integers or floats")
    channels = codes.shape[2] if codes.ndim == 3 else 1
    if channels in (2, 4):
        opaque = np.iinfo(codes.dtype).max if codes.dtype.kind == "u" else 1
        if clear := np.count_nonzero(codes[..., -1] != opaque):
            raise FileError(f"has {clear} transparent pixel(s), whose light is not known; make them opaque")
        codes = codes[..., : channels - 1]
    elif channels not in (1, 3):
        raise FileError(f"holds {channels} channels; it must be grey or RGB")
    return codes[..., 0] if codes.shape[2:] == (1,) else codes


def _pillow(picture: Image.Image) -> np.ndarray:
    if picture.mode == "P" or "transparency" in picture.info:
        picture = picture.convert("RGBA" if "transparency" in picture.info else "RGB")
    if picture.mode not in ("1", "L", "LA", "RGB", "RGBA"):
        raise FileError(f"holds {picture.mode} pixels; it must be grey or RGB")
    return _opaque(np.array(picture.convert("L") if picture.mode == "1" else picture))


def _opencv(data: bytes) -> np.ndarray:
    with quiet():
        stored = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if stored is None:
        raise FileError("is truncated or damaged, or its pixels are of an unknown kind")
    codes = _opaque(stored)
    return codes[..., ::-1] if codes.ndim == 3 else codes  # OpenCV keeps BGR


def _tiff(data: bytes) -> tuple[np.ndarray, int]:
    """Codes and orientation; as a picture, Pillow would refuse float RGB, and write on stderr."""
    file = io.BytesIO(data)
    with quiet():
        directory = TiffImagePlugin.ImageFileDirectory_v2(file.read(16 if data[2:3] == b"+" else 8))
        file.seek(directory.next)
        directory.load(file)
        size, orientation = (directory.get(256, 0), directory.get(257, 0)), directory.get(_ORIENTATION) or 1
    _check_size(size, len(data))
    if directory.next:
        raise FileError("holds several pages; it must hold one picture, so save each to a file")
    # OpenCV turns a TIFF upright whatever its flags: turned back.
    return _turned(_opencv(data), {6: 8, 8: 6}.get(orientation, orientation)), orientation


def _exr(path: Path) -> np.ndarray:
    """(h, w) or (h, w, 3), float16 or float32, of an EXR of one part with R, G, B or a single channel."""
    head = OpenEXR.File(str(path), header_only=True)
    header = head.header()
    window, display = (np.array(header[key], int) for key in ("dataWindow", "displayWindow"))
    if len(head.parts) > 1 or header["type"] not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
        raise FileError("is a deep or multi-part EXR; it must hold one plain picture")
    if not np.array_equal(window, display):
        raise FileError(
            f"has another data window than its display window {display.tolist()}; make them equal"
        )
    w, h = window[1] - window[0] + 1
    _check_size((w, h), path.stat().st_size)
    channels = {channel.name: (channel.xSampling, channel.ySampling) for channel in header["channels"]}
    alpha = ["A"] if "A" in channels and len(channels) > 1 else []
    colours = sorted({*channels} - {*alpha}, reverse=True)  # R, G, B
    if (len(colours) != 1 and colours != ["R", "G", "B"]) or {*channels.values()} != {(1, 1)}:
        raise FileError(f"holds the channels {channels}; they must be R, G, B or one, and not subsampled")
    file = OpenEXR.InputFile(str(path))  # `OpenEXR.File` prints on sys.stdout what is wrong with pixels
    kinds = {str(file.header()["channels"][name].type) for name in channels}
    if kinds not in ({"HALF"}, {"FLOAT"}):
        raise FileError(f"holds {', '.join(sorted(kinds))} channels; they must be all HALF or all FLOAT")
    dtype = np.float16 if kinds == {"HALF"} else np.float32
    planes = [np.frombuffer(pixels, dtype).reshape(h, w) for pixels in file.channels(colours + alpha)]
    file.close()
    return _opaque(np.stack(planes, axis=-1))


def _turned(codes: np.ndarray, orientation: int) -> np.ndarray:
    """The codes upright: EXIF 2.32, tag 274, tells the place of the first row and the first column."""
    if orientation in (5, 6, 7, 8):
        codes = codes.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        codes = codes[::-1]
    return codes[:, ::-1] if orientation in (2, 3, 6, 7) else codes
