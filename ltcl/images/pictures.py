# SPDX-License-Identifier: BSD-3-Clause
"""Pictures in linear light: PNG, JPEG, TIFF, BMP and EXR files in and out, the sRGB curve, other grids.

Pillow decodes 8 bits, up to 179 million pixels, OpenCV 16-bit PNG and TIFF, OpenEXR its own. Known
limits: some damage is a wrong picture where a format has no checksum (JPEG, BMP, TIFF); OpenEXR
also writes to stderr about some. The curve is that of IEC 61966-2-1, outside [0, 1] odd and
continued as of scRGB.
"""

from __future__ import annotations

import base64
import contextlib
import html
import io
import os
import re
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, get_args

import cv2
import numpy as np
import OpenEXR
from numpy.typing import ArrayLike
from PIL import Image, TiffImagePlugin

from ltcl import checks
from ltcl.errors import FileError, InputError, LtclError, MemoryLimitError
from ltcl.files import as_path, input_file, replace_file, unknown_extension

Encoding = Literal["auto", "srgb", "linear"]
ENCODINGS = get_args(Encoding)
BITS: dict[str, tuple[int, ...]] = {".png": (8, 16), ".jpg": (8,), ".jpeg": (8,), ".bmp": (8,)}
BITS |= {
    ".tif": (32, 8, 16),
    ".tiff": (32, 8, 16),
    ".exr": (32, 16),
}  # that can be written, default first
_ORIENTATION = 274  # the tag of EXIF and TIFF
_BYTES = 24  # of a pixel in memory: three codes and three floats of 4 bytes each
# 4:4:4 at 95: colour must not bleed between neighbouring projector pixels more than JPEG has to.
_JPEG = [
    cv2.IMWRITE_JPEG_QUALITY,
    95,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
]
_log_lock = threading.Lock()
_FIGURE = """<figure style="display:inline-block;margin:4px"><img src="data:image/png;base64,{}"
style="width:128px;image-rendering:pixelated"><figcaption>{}: white is {:.2g}</figcaption></figure>"""


def read(
    path: str | os.PathLike[str],
    *,
    encoding: Encoding = "auto",
    upright: bool = True,
    memory: int = 1 << 62,
) -> np.ndarray:
    """Read a picture as linear light: float32, (h, w) or (h, w, 3) RGB, white of an integer format is 1.

    `path` is a .png, .jpg, .jpeg, .bmp, .tif, .tiff (8, 16 or 32 bits) or .exr file, opaque
    everywhere. `encoding` is what it holds, "srgb" or "linear"; "auto" takes integers as sRGB and
    floats as linear. The orientation in the header (EXIF, TIFF) is applied, unless `upright` is
    False, as for a photograph. FileError for a damaged or transparent one, NaN; MemoryLimitError
    for 24 bytes a pixel beyond `memory`.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "grey.png"
    >>> write(path, np.full((1, 3), 0.5), bits=16)
    >>> read(path).round(2)
    array([[0.5, 0.5, 0.5]], dtype=float32)
    """
    checks.one_of("encoding", encoding, ENCODINGS)
    codes, orientation = _stored(as_path(path), memory)
    return to_linear(
        np.ascontiguousarray(_turned(codes, orientation) if upright else codes), encoding
    )


def read_codes(path: str | os.PathLike[str]) -> np.ndarray:
    """Codes of a picture file, (h, w) or (h, w, 3) RGB, in its dtype: no curve, scale or orientation."""
    return np.ascontiguousarray(_stored(as_path(path))[0])


def write(
    path: str | os.PathLike[str],
    image: ArrayLike,
    *,
    encoding: Encoding = "auto",
    bits: int | None = None,
) -> None:
    """Write linear light (h, w) or (h, w, 3) as a picture, which replaces another whole or not at all.

    The extension of `path` names the format, as in `read`. `encoding` "auto" is sRGB in integers,
    which are clipped to [0, 1], and linear in floats, which never are. `bits` are 8 (default) or 16
    for .png, 8, 16 or 32 (float, default) for .tif, 16 (half) or 32 (default) for .exr, 8 for
    others. InputError for NaN, too.
    """
    checks.one_of("encoding", encoding, ENCODINGS)
    path = as_path(path)
    suffix, possible = path.suffix.lower(), _bits(path)
    bits = possible[0] if bits is None else bits
    if bits not in possible:
        raise InputError(
            f"bits is {bits!r}; for {path.suffix} it must be {' or '.join(map(str, possible))}"
        )
    codes = from_linear(
        as_picture("image", image), encoding, bits, is_float=suffix == ".exr" or bits == 32
    )
    with replace_file(path) as temporary:
        try:
            if suffix == ".exr":
                OpenEXR.File({}, {"Y" if codes.ndim == 2 else "RGB": codes}).write(str(temporary))
                return
            stored = codes if codes.ndim == 2 else np.ascontiguousarray(codes[..., ::-1])  # BGR
            success, data = cv2.imencode(suffix, stored, _JPEG if "jp" in suffix else [])
        except (cv2.error, RuntimeError) as error:  # a full disk
            raise FileError(f"{path}: cannot be written: {' '.join(str(error).split())}") from error
        if not success:
            raise FileError(
                f"{path}: {codes.shape[0]} x {codes.shape[1]} pixels do not fit this format"
            )
        temporary.write_bytes(data.tobytes())


def resize(image: ArrayLike, grid: tuple[int, int]) -> np.ndarray:
    """Resample a linear picture, (h, w) or (h, w, 3), to `grid` pixels, float32.

    Area average where it shrinks, linear interpolation where it grows. InputError for another shape
    or NaN.

    >>> resize(np.array([[0.0, 1.0], [2.0, 3.0]]), (1, 1))
    array([[1.5]], dtype=float32)
    """
    picture = as_picture("image", image)
    h, w = checks.grid("grid", grid)
    # One axis at a time: OpenCV averages areas only where no axis grows; one may grow as the other
    # shrinks.
    for rows, columns in ((h, picture.shape[1]), (h, w)):
        shrinks = rows < picture.shape[0] or columns < picture.shape[1]
        filter = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        picture = cv2.resize(picture, (columns, rows), interpolation=filter)
    return picture


def thumbnails(title: object, pictures: dict[str, np.ndarray]) -> str:
    """HTML for a notebook: linear pictures, or first frames, each as bright as its label says."""
    figures = [f"<div>{html.escape(str(title))}</div>"]
    for label, picture in pictures.items():
        light = np.nan_to_num(np.atleast_2d(picture))
        while light.ndim > 3 or light.shape[2:] not in ((), (3,)):
            light = light[0]
        (h, w), scale = light.shape[:2], min(64 / max(light.shape[:2]), 1)
        light = resize(light, (max(round(scale * h), 1), max(round(scale * w), 1)))
        white = float(np.quantile(light, 0.99)) or float(light.max()) or 1.0
        codes = from_linear(light / white, "srgb", 8, is_float=False)
        png = cv2.imencode(".png", codes if codes.ndim == 2 else codes[..., ::-1])[1]
        figures.append(
            _FIGURE.format(base64.b64encode(png.tobytes()).decode(), html.escape(label), white)
        )
    return "".join(figures)


def from_srgb(encoded: ArrayLike) -> np.ndarray:
    """Linear light, float32 or float64, of sRGB-encoded real numbers, 1 for white: codes over 255 or 65535.

    >>> float(from_srgb(np.float64(0.5)).round(4))
    0.214
    """
    value = _floating("encoded", encoded)
    size = np.abs(value)
    curve = np.where(size <= 0.04045, size / 12.92, ((size + 0.055) / 1.055) ** 2.4)
    return np.copysign(curve, value)


def to_srgb(linear: ArrayLike) -> np.ndarray:
    """Encode linear light as sRGB, the inverse of `from_srgb`.

    >>> float(to_srgb(np.float64(0.214)).round(3))
    0.5
    """
    value = _floating("linear", linear)
    size = np.abs(value)
    curve = np.where(size <= 0.0031308, size * 12.92, 1.055 * size ** (1 / 2.4) - 0.055)
    return np.copysign(curve, value)


def _floating(name: str, value: ArrayLike) -> np.ndarray:
    array = checks.real(name, value)
    return array.astype(np.float64 if array.dtype == np.float64 else np.float32, copy=False)


def as_picture(name: str, image: ArrayLike) -> np.ndarray:
    """Return `image` as contiguous float32 (h, w) or (h, w, 3); refuse other shapes, NaN and Inf."""
    array = checks.real(name, image)
    if array.ndim < 2 or array.shape[2:] not in ((), (3,)) or array.size == 0:
        raise InputError(
            f"{name} has shape {array.shape}; it must be (h, w) or (h, w, 3), not empty"
        )
    with np.errstate(over="ignore"):
        array = np.ascontiguousarray(array, dtype=np.float32)
    return checks.finite(name, array)


def to_linear(codes: np.ndarray, encoding: Encoding) -> np.ndarray:
    """Float32 of `codes`, uint8, uint16 or float; "auto" takes integers as sRGB, floats as linear."""
    is_srgb = encoding == "srgb" or (encoding == "auto" and codes.dtype.kind == "u")
    if codes.dtype.kind == "u":
        # A table in float64: exact, and the power is taken 256 or 65536 times instead of once per
        # pixel.
        table = np.linspace(0, 1, np.iinfo(codes.dtype).max + 1)
        return (from_srgb(table) if is_srgb else table).astype(np.float32)[codes]
    return from_srgb(codes) if is_srgb else codes.astype(np.float32, copy=False)


def from_linear(
    picture: np.ndarray, encoding: Encoding, bits: int, *, is_float: bool
) -> np.ndarray:
    """The codes of `picture` in a file of `bits` per channel; the inverse of `to_linear`."""
    if encoding == "srgb" or (encoding == "auto" and not is_float):
        picture = to_srgb(picture)
    if not is_float:
        white = (1 << bits) - 1
        return np.rint(np.clip(picture, 0, 1) * white).astype(np.uint8 if bits == 8 else np.uint16)
    with np.errstate(over="ignore"):
        codes = picture.astype(np.float16 if bits == 16 else np.float32, copy=False)
    if not np.isfinite(codes).all():
        raise InputError(
            f"image reaches {np.abs(picture).max():g}; half floats end at 65504, use bits=32"
        )
    return codes


@contextlib.contextmanager
def decoding(path: Path) -> Iterator[None]:
    """Name the file in every error; keep OpenCV's log and Pillow's warnings, which are global, off stderr."""
    with _log_lock, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            yield
        except LtclError as error:
            kind = MemoryLimitError if isinstance(error, MemoryLimitError) else FileError
            raise kind(f"{path}: {error}") from None
        except Exception as error:
            reason = (
                re.sub(r" <\S+ object at \w+>", "", " ".join(f"{error}".split()))
                or type(error).__name__
            )
            raise FileError(
                f"{path}: is truncated, damaged or no picture: {reason:.200}"
            ) from error
        finally:
            cv2.utils.logging.setLogLevel(level)


def _bits(path: Path) -> tuple[int, ...]:
    if path.suffix.lower() not in BITS:
        raise FileError(f"{path}: {unknown_extension(path)}; pictures are {', '.join(BITS)}")
    return BITS[path.suffix.lower()]


def _stored(path: Path, memory: int = 1 << 62) -> tuple[np.ndarray, int]:
    """Codes, (h, w) or (h, w, 3) RGB, on the pixels of the file, and their orientation, 1 for upright."""
    _bits(path)
    with decoding(input_file(path)):
        if path.suffix.lower() == ".exr":
            return _exr(path, memory), 1
        checks.fits_host("the file", path.stat().st_size)
        data = path.read_bytes()
        if data.startswith((b"II", b"MM")):
            return _tiff(data, memory)
        picture = Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "BMP"))
        checks.fits_host("the picture", _BYTES * picture.width * picture.height, memory)
        if picture.format == "PNG":
            Image.open(io.BytesIO(data)).verify()  # checksums, which decoding does not look at
            if b"\0\0\0\0IEND\xaeB`\x82" not in data:  # libpng would write to stderr
                raise FileError("is truncated: its last chunk, IEND, is not whole")
        is_deep = picture.format == "PNG" and "16" in str(picture.tile[0][3])
        codes = _opencv(data) if is_deep else _pillow(picture)
        return codes, Image.Image.getexif(picture).get(_ORIENTATION, 1)


def _opaque(codes: np.ndarray) -> np.ndarray:
    """The codes without an alpha channel; one that is not opaque is refused, the light there is unknown."""
    codes = codes[..., None] if codes.ndim == 2 else codes
    channels, kind = codes.shape[2], codes.dtype
    if channels > 4 or kind not in (np.uint8, np.uint16, np.float16, np.float32):
        raise FileError(
            f"holds {channels} channels of {kind}; it must be grey or RGB, unsigned or floats"
        )
    checks.finite("the picture", codes)
    if channels in (2, 4):
        opaque = np.iinfo(kind).max if kind.kind == "u" else 1
        if clear := np.count_nonzero(codes[..., -1] != opaque):
            raise FileError(
                f"has {clear} transparent pixel(s), whose light is not known; make them opaque"
            )
    return codes[..., 0] if channels < 3 else codes[..., :3]


def _pillow(picture: Image.Image) -> np.ndarray:
    modes = {"1": "L", "L": "L", "LA": "LA", "P": "RGBA", "RGB": "RGB", "RGBA": "RGBA"}
    if picture.mode not in modes:
        raise FileError(f"holds {picture.mode} pixels; it must be grey or RGB")
    mode = "RGBA" if picture.has_transparency_data else modes[picture.mode]
    return _opaque(np.array(picture.convert(mode)))


def _opencv(data: bytes) -> np.ndarray:
    stored = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if stored is None:
        raise FileError("is truncated or damaged, or its pixels are of an unknown kind")
    codes = _opaque(stored.astype(np.float32) if stored.dtype == np.float64 else stored)
    return codes[..., ::-1] if codes.ndim == 3 else codes  # OpenCV keeps BGR


def _tiff(data: bytes, memory: int) -> tuple[np.ndarray, int]:
    """Codes and orientation; as a picture, Pillow would refuse float RGB, and write on stderr."""
    file = io.BytesIO(data)
    directory = TiffImagePlugin.ImageFileDirectory_v2(file.read(16 if data[2:3] == b"+" else 8))
    file.seek(directory.next)
    directory.load(file)
    if directory.next:
        raise FileError("holds several pages; it must hold one picture, so save each to a file")
    checks.fits_host("the picture", _BYTES * int(directory[256]) * int(directory[257]), memory)
    orientation = directory.get(_ORIENTATION) or 1
    # OpenCV turns a TIFF upright whatever its flags: turned back.
    return _turned(_opencv(data), {6: 8, 8: 6}.get(orientation, orientation)), orientation


def _exr(path: Path, memory: int) -> np.ndarray:
    """(h, w) or (h, w, 3), float16 or float32, of an EXR of one part with R, G, B or a single channel."""
    head = OpenEXR.File(str(path), header_only=True)
    header = head.header()
    if len(head.parts) > 1 or header["type"] not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
        raise FileError("is a deep or multi-part EXR; it must hold one plain picture")
    window, display = (np.array(header[key], int) for key in ("dataWindow", "displayWindow"))
    if not np.array_equal(window, display):
        raise FileError(f"has the data window {window.tolist()}; it must be the display window")
    w, h = (window[1] - window[0] + 1).tolist()
    checks.fits_host("the picture", _BYTES * h * w, memory)
    names = sorted((channel.name for channel in header["channels"]), key="RGBA".find)
    if len(names) != 1 and names not in ([*"RGB"], [*"RGBA"]):
        raise FileError(f"holds the channels {names}; they must be R, G, B, or one")
    # `File` prints what is wrong with pixels on sys.stdout; `InputFile` crashes on headers refused
    # above.
    file = OpenEXR.InputFile(str(path))
    kinds = {str(file.header()["channels"][name].type) for name in names}
    if kinds not in ({"HALF"}, {"FLOAT"}):
        raise FileError(
            f"holds {', '.join(sorted(kinds))} channels; they must be all HALF or all FLOAT"
        )
    dtype = np.float16 if kinds == {"HALF"} else np.float32
    planes = [np.frombuffer(pixels, dtype).reshape(h, w) for pixels in file.channels(names)]
    return _opaque(np.stack(planes, axis=-1))


def _turned(codes: np.ndarray, orientation: int) -> np.ndarray:
    """The codes upright: EXIF 2.32, tag 274, tells the place of the first row and the first column."""
    if orientation in (5, 6, 7, 8):
        codes = codes.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        codes = codes[::-1]
    return codes[:, ::-1] if orientation in (2, 3, 6, 7) else codes
