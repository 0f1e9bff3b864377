# SPDX-License-Identifier: BSD-3-Clause
"""`ImageFile`: pictures in a temporary file instead of memory, read back whole or by rows.

A calibration takes about 150 photographs, of which 45 megapixels in colour are 20 gigabytes.
"""

from __future__ import annotations

import os
import tempfile
import threading
import weakref
from dataclasses import dataclass
from typing import Any

import numpy as np


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

    def append(self, image: np.ndarray) -> StoredImage:
        """Write a picture (H, W[, c]) to the end of the file."""
        with self._lock:
            offset = self._file.seek(0, os.SEEK_END)
            self._file.write(np.ascontiguousarray(image).data.cast("B"))
        return StoredImage(file=self, offset=offset, shape=image.shape, dtype=image.dtype)

    def read_into(self, array: np.ndarray, offset: int) -> None:
        """Fill a contiguous array with the bytes from `offset` on."""
        with self._lock:
            self._file.seek(offset)
            self._file.readinto(array.data.cast("B"))


@dataclass(frozen=True, kw_only=True)
class StoredImage:
    """A picture in an `ImageFile`."""

    file: ImageFile
    offset: int
    shape: tuple[int, ...]
    dtype: np.dtype

    def read(self, rows: slice = slice(None)) -> np.ndarray:
        """Some rows of the picture."""
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
