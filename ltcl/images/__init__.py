# SPDX-License-Identifier: BSD-3-Clause
"""Pictures on disk: PNG, JPEG, TIFF, BMP and EXR in, linear float32 out, and back.

A picture in ltcl is linear radiance, float32, (h, w) or (h, w, 3) RGB. Integer formats hold sRGB codes unless
said otherwise, float ones hold linear light. Geometry is never changed on the way (EXIF rotations are
ignored), and values are clipped to [0, 1] only where an integer format can hold no others.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ltcl import checks
from ltcl.errors import FileError, InputError, MemoryLimitError
from ltcl.files import as_path, input_file, replace_file, unknown_extension
from ltcl.images import codes, exr, raster
from ltcl.images.codes import Encoding
from ltcl.images.pictures import as_picture
from ltcl.images.scaling import resize
from ltcl.images.srgb import from_srgb, to_srgb

__all__ = ["BITS", "from_srgb", "read", "read_codes", "resize", "to_srgb", "write"]

BITS: dict[str, tuple[int, ...]] = {**raster.BITS, ".exr": (32, 16)}
"""Known extensions and the bits per channel that each can be written with, the default first."""


def read(path: str | os.PathLike[str], *, encoding: Encoding = "auto") -> np.ndarray:
    """Read a picture as linear light.

    Parameters
    ----------
    path
        A .png, .jpg, .jpeg, .tif, .tiff, .bmp (8 or 16 bits, float TIFF) or .exr file. An alpha channel that
        is opaque everywhere is dropped.
    encoding
        What the file holds: "srgb" or "linear"; "auto" takes integers as sRGB and floats as linear.

    Returns
    -------
    np.ndarray
        float32, (h, w) or (h, w, 3) RGB; white of an integer format is 1.

    Raises
    ------
    FileError
        Missing, empty, not a picture, truncated, transparent, NaN inside, or larger than such a file can be.
    MemoryLimitError
        The declared size does not fit the host.
    InputError
        An unknown encoding.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "grey.png"
    >>> write(path, np.full((2, 3), 0.5))
    >>> read(path).round(2)
    array([[0.5, 0.5, 0.5],
           [0.5, 0.5, 0.5]], dtype=float32)
    """
    checks.one_of("encoding", encoding, codes.ENCODINGS)
    path = as_path(path)
    stored = read_codes(path)
    with _naming(path):
        return codes.to_linear(stored, encoding)


def read_codes(path: str | os.PathLike[str]) -> np.ndarray:
    """Read what a picture file holds, as it stands: no transfer curve, no scale, no rotation.

    Parameters
    ----------
    path
        As in `read`.

    Returns
    -------
    np.ndarray
        (h, w) or (h, w, 3) RGB; uint8, uint16, float16, float32 or float64, as the file holds it. Floats may
        be NaN.

    Raises
    ------
    FileError, MemoryLimitError
        As in `read`.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "grey.png"
    >>> write(path, np.full((1, 2), 0.5), encoding="linear")
    >>> read_codes(path)
    array([[128, 128]], dtype=uint8)
    """
    path = as_path(path)
    _bits(path)
    input_file(path)
    with _naming(path):
        return exr.read(path) if path.suffix.lower() == ".exr" else raster.read(path)


@contextlib.contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Put the name of the file in front of what its reading refuses."""
    try:
        yield
    except MemoryLimitError as error:
        raise MemoryLimitError(f"{path}: {error}") from None
    except InputError as error:
        raise FileError(f"{path}: {error}") from None
    except OSError as error:
        raise FileError(f"{path}: cannot be read: {error.strerror or error}") from error


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
        for .exr (default 32); 8 for .jpg and .bmp.

    Raises
    ------
    InputError
        An unusable shape, NaN or infinite values, an unknown encoding or number of bits.
    FileError
        An unknown extension, or the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> write(Path(tempfile.mkdtemp()) / "pattern.png", np.zeros((4, 4, 3)), encoding="linear", bits=16)
    """
    checks.one_of("encoding", encoding, codes.ENCODINGS)
    path = as_path(path)
    possible = _bits(path)
    if bits is None:
        bits = possible[0]
    if bits not in possible:
        raise InputError(f"bits is {bits!r}; for {path.suffix} it must be {' or '.join(map(str, possible))}")
    picture = as_picture("image", image)
    is_exr = path.suffix.lower() == ".exr"
    stored = codes.from_linear(picture, encoding, bits, is_float=is_exr or bits == 32)
    with replace_file(path) as temporary:
        try:
            (exr if is_exr else raster).write(temporary, stored)
        except FileError as error:
            raise FileError(f"{path}: {error}") from None


def _bits(path: Path) -> tuple[int, ...]:
    try:
        return BITS[path.suffix.lower()]
    except KeyError:
        raise FileError(f"{path}: {unknown_extension(path)}; pictures are {', '.join(BITS)}") from None
