# SPDX-License-Identifier: BSD-3-Clause
"""Arrays in temporary files instead of memory: `ImageFile`, `scratch_array`, `ScratchFrames`.

A calibration takes about 150 photographs, of which 45 megapixels in colour are 20 gigabytes.
"""

from __future__ import annotations

import math
import os
import tempfile
import threading
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

# Bytes of a scratch array that are kept in memory.
MAX_ARRAY_BYTES = 1 << 24
# Values of a strip of rows.
STRIP_VALUES = 1 << 20


class ImageFile:
    """A temporary file of pictures, which is removed when it is closed or no longer used.

    Parameters
    ----------
    folder : path, optional
        Folder of the file, by default that of the system for temporary files.

    Examples
    --------
    >>> image = ImageFile().append(np.arange(6).reshape(3, 2))
    >>> image.read(slice(1, 3)).tolist()
    [[2, 3], [4, 5]]
    """

    def __init__(self, folder: str | os.PathLike[str] | None = None) -> None:
        self._file: Any = tempfile.TemporaryFile(dir=folder, prefix="ltcl-")  # noqa: SIM115
        weakref.finalize(self, self._file.close)
        self._lock = threading.Lock()
        self._end = 0

    def append(self, image: np.ndarray) -> StoredImage:
        """Write a picture (H, W[, c]) to the end of the file."""
        stored = self.reserve(image.shape, image.dtype)
        stored.write(0, image)
        return stored

    def reserve(self, shape: tuple[int, ...], dtype: Any) -> StoredImage:
        """Room for a picture at the end of the file, to be written row by row."""
        dtype = np.dtype(dtype)
        with self._lock:
            offset = self._end
            self._end += math.prod(shape) * dtype.itemsize
        return StoredImage(file=self, offset=offset, shape=shape, dtype=dtype)

    def write(self, array: np.ndarray, offset: int) -> None:
        """Write an array from `offset` on."""
        with self._lock:
            self._file.seek(offset)
            self._file.write(np.ascontiguousarray(array).data.cast("B"))

    def read_into(self, array: np.ndarray, offset: int) -> None:
        """Fill a contiguous array with the bytes from `offset` on."""
        with self._lock:
            self._file.seek(offset)
            self._file.readinto(array.data.cast("B"))


def scratch_array(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """An array of zeros, which stands in a temporary file if it is large.

    The file is removed with the array.

    >>> scratch_array((2, 3), "float32").sum()
    np.float32(0.0)
    """
    dtype = np.dtype(dtype)
    if math.prod(shape) * dtype.itemsize <= MAX_ARRAY_BYTES:
        return np.zeros(shape, dtype)
    with tempfile.TemporaryFile(prefix="ltcl-") as file:
        return np.memmap(file, dtype, "w+", shape=shape)


class ScratchFrames:
    """Frames of one shape, to which more are added, in a temporary file once they are large.

    Examples
    --------
    >>> frames = ScratchFrames((2,), "float32")
    >>> frames.extend(1)[0] = 1, 2
    >>> frames.extend(2).tolist()
    [[1.0, 2.0], [0.0, 0.0], [0.0, 0.0]]
    """

    def __init__(self, shape: tuple[int, ...], dtype: Any) -> None:
        self.array = np.zeros((0, *shape), dtype)
        self._file: Any = None

    def extend(self, count: int) -> np.ndarray:
        """All frames with `count` more of zeros; arrays from before must not be written to."""
        before = self.array
        shape = (len(before) + count, *before.shape[1:])
        if self._file is None and math.prod(shape) * before.itemsize <= MAX_ARRAY_BYTES:
            self.array = np.concatenate([before, np.zeros((count, *shape[1:]), before.dtype)])
            return self.array
        if self._file is None:
            file = tempfile.TemporaryFile(prefix="ltcl-")  # noqa: SIM115
            weakref.finalize(self, file.close)
            self._file = file
            self.array = np.memmap(file, before.dtype, "w+", shape=shape)
            self.array[: len(before)] = before
            return self.array
        # Makes the file longer, and keeps what it holds.
        file: Any = self._file
        self.array = np.memmap(file, before.dtype, "r+", shape=shape)
        return self.array


@dataclass(frozen=True, kw_only=True)
class StoredImage:
    """A picture in an `ImageFile`."""

    file: ImageFile
    offset: int
    shape: tuple[int, ...]
    dtype: np.dtype

    def read(self, rows: slice = slice(None)) -> np.ndarray:
        """The picture in some rows."""
        numbers = range(self.shape[0])[rows]
        array = np.empty((len(numbers), *self.shape[1:]), self.dtype)
        if len(numbers) == 0:
            return array
        row_bytes = array[0].nbytes
        if numbers.step == 1:
            self.file.read_into(array, self.offset + numbers.start * row_bytes)
            return array
        for row, number in zip(array, numbers, strict=True):
            self.file.read_into(row, self.offset + number * row_bytes)
        return array

    def write(self, top: int, rows: np.ndarray) -> None:
        """Write rows of the picture, from the row `top` on."""
        row_values = math.prod(self.shape[1:])
        offset = self.offset + top * row_values * self.dtype.itemsize
        self.file.write(np.asarray(rows, self.dtype), offset)

    def at(self, pixels: np.ndarray) -> np.ndarray:
        """Values at pixels, numbered row by row in ascending order: (n, c)."""
        channels = math.prod(self.shape[2:])
        width = self.shape[1]
        values = np.empty((len(pixels), channels), self.dtype)
        for rows in row_strips(self.shape):
            first, last = np.searchsorted(pixels, [rows.start * width, rows.stop * width])
            if first < last:
                strip = self.read(rows).reshape(-1, channels)
                values[first:last] = strip[pixels[first:last] - rows.start * width]
        return values


def row_strips(shape: tuple[int, ...], values: int = STRIP_VALUES) -> Iterator[slice]:
    """Strips of rows of about so many values, of a picture of this shape.

    >>> list(row_strips((5, 2), 4))
    [slice(0, 2, None), slice(2, 4, None), slice(4, 5, None)]
    """
    height = shape[0]
    step = max(values // max(math.prod(shape[1:]), 1), 1)
    for top in range(0, height, step):
        yield slice(top, min(top + step, height))
