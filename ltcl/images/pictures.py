# SPDX-License-Identifier: BSD-3-Clause
"""Read, write and resize pictures in linear light: PNG, JPEG, TIFF, BMP and EXR files."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ltcl import checks
from ltcl.errors import FileError, InputError
from ltcl.files import as_path, replace_file, unknown_extension
from ltcl.images import png
from ltcl.images.decoders import Decoded, decode_file, decoding, turn_upright
from ltcl.images.encoding import ENCODINGS, Encoding, from_linear, to_linear
from ltcl.images.exr import write_exr

# Ways to bring a picture of other proportions onto a grid.
RESIZES = ("crop", "letterbox", "stretch")
# Bits that a format can be written with, by its extension; the default first.
BITS: dict[str, tuple[int, ...]] = {
    ".png": (8, 16),
    ".jpg": (8,),
    ".jpeg": (8,),
    ".bmp": (8,),
    ".tif": (32, 8, 16),
    ".tiff": (32, 8, 16),
    ".exr": (32, 16),
}

# 4:4:4 at 95: colour must not bleed between neighbouring projector pixels more than JPEG has to.
JPEG_OPTIONS = [
    cv2.IMWRITE_JPEG_QUALITY,
    95,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
]
ENCODER_OPTIONS = {".jpg": JPEG_OPTIONS, ".jpeg": JPEG_OPTIONS}

# Larger than any memory: only the memory of the host limits a picture.
NO_LIMIT = 1 << 62


def read(
    path: str | os.PathLike[str],
    *,
    encoding: Encoding = "auto",
    upright: bool = True,
    memory: int = NO_LIMIT,
) -> np.ndarray:
    """Read a picture as linear light.

    Parameters
    ----------
    path : path
        A .png, .jpg, .jpeg, .bmp, .tif, .tiff (8, 16 or 32 bits) or .exr file, opaque everywhere.
    encoding : "auto", "srgb" or "linear"
        Encoding of the codes in the file; "auto" takes integers as sRGB and floats as linear, or
        as a PNG says (gAMA, cICP).
    upright : bool
        Apply the orientation in the header (EXIF, TIFF). False keeps the pixels of the file, as a
        photograph of a scan needs.
    memory : int
        Most bytes that the picture may take, 24 a pixel.

    Returns
    -------
    ndarray
        float32, (h, w) or (h, w, 3) RGB; white of an integer format is 1.

    Raises
    ------
    FileError
        The file is missing, damaged or transparent, holds NaN, or is HDR by its own word.
    MemoryLimitError
        The picture needs more than `memory`, or more than the host has.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "grey.png"
    >>> write(path, np.full((1, 3), 0.5), bits=16)
    >>> read(path).round(2)
    array([[0.5, 0.5, 0.5]], dtype=float32)
    """
    checks.one_of("encoding", encoding, ENCODINGS)
    stored = _read_stored(as_path(path), encoding, upright=upright, memory=memory)
    return stored.light(encoding)


def read_srgb(path: str | os.PathLike[str], *, encoding: Encoding = "auto") -> np.ndarray:
    """Read the sRGB codes of a picture, or its light where it has no such codes.

    Parameters
    ----------
    path, encoding
        As in `read`.

    Returns
    -------
    ndarray
        (h, w) or (h, w, 3) RGB, upright: uint8 or uint16 codes of sRGB, or float32 linear light.

    Raises
    ------
    FileError, MemoryLimitError
        As in `read`.
    """
    checks.one_of("encoding", encoding, ENCODINGS)
    stored = _read_stored(as_path(path), encoding, upright=True, memory=NO_LIMIT)
    is_integer = stored.codes.dtype.kind == "u"
    if is_integer and encoding != "linear" and stored.power is None:
        return stored.codes
    return stored.light(encoding)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Stored:
    """Codes of a file, and the power by which a PNG says that they become light, if it does."""

    codes: np.ndarray
    power: float | None

    def light(self, encoding: Encoding) -> np.ndarray:
        """Linear light, float32."""
        if self.power is not None:
            return to_linear(self.codes, "linear") ** np.float32(self.power)
        return to_linear(self.codes, encoding)


def _read_stored(path: Path, encoding: Encoding, *, upright: bool, memory: int) -> _Stored:
    picture = _decode(path, memory)
    codes = picture.codes
    if upright:
        codes = turn_upright(codes, picture.orientation)
    power = None
    if encoding == "auto" and picture.png_header is not None:
        with decoding(path):
            power = png.power(picture.png_header)
    return _Stored(codes=np.ascontiguousarray(codes), power=power)


def read_codes(path: str | os.PathLike[str]) -> np.ndarray:
    """Read the codes of a picture file, without curve, scale or orientation.

    Parameters
    ----------
    path : path
        A picture file, as in `read`.

    Returns
    -------
    ndarray
        (h, w) or (h, w, 3) RGB, uint8, uint16, float16 or float32 as in the file.

    Raises
    ------
    FileError
        The file is missing, damaged or transparent, or holds NaN.
    """
    return np.ascontiguousarray(_decode(as_path(path), NO_LIMIT).codes)


def write_codes(path: str | os.PathLike[str], codes: np.ndarray) -> None:
    """Write codes as they are, without curve or scale; `read_codes` reads them.

    Parameters
    ----------
    path : path
        The extension names the format, as in `read`; it must hold as many bits as the codes have.
    codes : (h, w) or (h, w, 3) RGB, uint8 or uint16

    Raises
    ------
    InputError
        Codes of another shape or type, or of bits that the format has not.
    FileError
        The extension is unknown, or the file cannot be written.
    """
    path = as_path(path)
    is_picture = codes.ndim == 2 or codes.shape[2:] == (3,)
    if not is_picture or codes.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"codes are {codes.shape} of {codes.dtype}; they must be (h, w) or (h, w, 3), uint8 or "
            "uint16"
        )
    bits = 8 * codes.dtype.itemsize
    if bits not in _possible_bits(path):
        raise InputError(f"codes have {bits} bits, which {path.suffix} does not hold")
    _write(path, codes)


def write(
    path: str | os.PathLike[str],
    image: ArrayLike,
    *,
    encoding: Encoding = "auto",
    bits: int | None = None,
) -> None:
    """Write linear light as a picture, which replaces an earlier file whole or not at all.

    Parameters
    ----------
    path : path
        The extension names the format, as in `read`.
    image : array_like
        (h, w) or (h, w, 3) RGB. Integer formats clip to [0, 1]; floats are never clipped.
    encoding : "auto", "srgb" or "linear"
        Encoding of the codes in the file; "auto" is sRGB in integers and linear in floats.
    bits : int, optional
        8 (default) or 16 for .png; 8, 16 or 32 (float, default) for .tif; 16 (half) or 32 (default)
        for .exr; 8 for other formats.

    Raises
    ------
    InputError
        The image has another shape, NaN or Inf, or `bits` does not fit the format.
    FileError
        The extension is unknown, or the file cannot be written.
    """
    checks.one_of("encoding", encoding, ENCODINGS)
    path = as_path(path)
    suffix = path.suffix.lower()
    possible_bits = _possible_bits(path)
    if bits is None:
        bits = possible_bits[0]
    if bits not in possible_bits:
        allowed = " or ".join(map(str, possible_bits))
        raise InputError(f"bits is {bits!r}; for {path.suffix} it must be {allowed}")
    is_float = suffix == ".exr" or bits == 32
    codes = from_linear(as_picture("image", image), encoding, bits, is_float=is_float)
    _write(path, codes)


def _write(path: Path, codes: np.ndarray) -> None:
    """Replace a file by one of these codes, (h, w) or (h, w, 3) RGB."""
    suffix = path.suffix.lower()
    with replace_file(path) as temporary:
        try:
            if suffix == ".exr":
                write_exr(temporary, codes)
                return
            if codes.ndim == 3:
                codes = np.ascontiguousarray(codes[..., ::-1])  # OpenCV keeps BGR
            success, data = cv2.imencode(suffix, codes, ENCODER_OPTIONS.get(suffix, []))
        except (cv2.error, RuntimeError) as error:  # a full disk
            reason = " ".join(str(error).split())
            raise FileError(f"{path}: cannot be written: {reason}") from error
        if not success:
            h, w = codes.shape[:2]
            raise FileError(f"{path}: {h} x {w} pixels do not fit this format")
        temporary.write_bytes(data.tobytes())


def resize(image: ArrayLike, grid: tuple[int, int], how: str = "stretch") -> np.ndarray:
    """Resample a linear picture to another grid.

    Areas are averaged where the picture shrinks; values are interpolated linearly where it grows.

    Parameters
    ----------
    image : array_like
        (h, w) or (h, w, 3).
    grid : (int, int)
        Height and width of the result.
    how : "crop", "letterbox" or "stretch"
        What becomes of a picture of other proportions: its middle fills the grid; all of it lies
        between black bars; or it is distorted.

    Returns
    -------
    ndarray
        float32, (h, w) or (h, w, 3) of that grid.

    Raises
    ------
    InputError
        The image has another shape, NaN or Inf, the grid is not two positive integers, or there is
        no such way.

    Examples
    --------
    >>> resize(np.array([[0.0, 1.0], [2.0, 3.0]]), (1, 1))
    array([[1.5]], dtype=float32)
    >>> resize(np.ones((2, 2)), (2, 4), "letterbox")
    array([[0., 1., 1., 0.],
           [0., 1., 1., 0.]], dtype=float32)
    """
    picture = as_picture("image", image)
    h, w = checks.grid("grid", grid)
    checks.one_of("how", how, RESIZES)
    size = picture.shape[0], picture.shape[1]
    if how == "crop":
        picture = np.ascontiguousarray(picture[_middle(size, (h, w))])
    if how == "letterbox":
        between_bars = np.zeros((h, w, *picture.shape[2:]), np.float32)
        inside = between_bars[_middle((h, w), size)]
        inside[...] = _stretched(picture, (inside.shape[0], inside.shape[1]))
        return between_bars
    return _stretched(picture, (h, w))


def _middle(frame: tuple[int, int], proportions: tuple[int, int]) -> tuple[slice, slice]:
    """Rows and columns of the largest part of a frame, in its middle, with other proportions."""
    h, w = proportions
    scale = min(frame[0] / h, frame[1] / w)
    rows = min(max(round(scale * h), 1), frame[0])
    columns = min(max(round(scale * w), 1), frame[1])
    top = (frame[0] - rows) // 2
    left = (frame[1] - columns) // 2
    return slice(top, top + rows), slice(left, left + columns)


def _stretched(picture: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """A picture on a grid, whatever its proportions."""
    h, w = grid
    # One axis at a time: OpenCV averages areas only where no axis grows, and one may grow as the
    # other shrinks.
    for rows, columns in ((h, picture.shape[1]), (h, w)):
        shrinks = rows < picture.shape[0] or columns < picture.shape[1]
        filter = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        picture = cv2.resize(picture, (columns, rows), interpolation=filter)
    return picture


def as_picture(name: str, image: ArrayLike) -> np.ndarray:
    """Return `image` as contiguous float32; refuse other than (h, w) or (h, w, 3), NaN and Inf."""
    array = checks.real(name, image)
    if array.ndim < 2 or array.shape[2:] not in ((), (3,)) or array.size == 0:
        raise InputError(
            f"{name} has shape {array.shape}; it must be (h, w) or (h, w, 3), not empty"
        )
    with np.errstate(over="ignore"):
        array = np.ascontiguousarray(array, dtype=np.float32)
    return checks.finite(name, array)


def _decode(path: Path, memory: int) -> Decoded:
    """Decode a file; an unknown extension is refused."""
    _possible_bits(path)
    return decode_file(path, memory)


def _possible_bits(path: Path) -> tuple[int, ...]:
    suffix = path.suffix.lower()
    if suffix not in BITS:
        raise FileError(f"{path}: {unknown_extension(path)}; pictures are {', '.join(BITS)}")
    return BITS[suffix]
