# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of Gray code, read by rows: in memory, or in a file that grows by one at a time.

42 photographs of 45 megapixels are 2 gigabytes of codes and 8 of floats. A calibration appends each
to a file when it is taken, and decodes some rows of all of them at once.
"""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from ltcl import checks
from ltcl.acquisition.radiometry.exposures import check_photographs

# Steps of a linear value in a file.
STEPS = np.iinfo(np.uint16).max

# Rows that are converted at once.
ROWS_AT_ONCE = 64


class Photographs(Protocol):
    """Grey photographs of one shape (H, W)."""

    @property
    def count(self) -> int:
        """Number of photographs."""
        ...

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        ...

    @property
    def code_step(self) -> float:
        """Difference of two codes, 0 if it is not known."""
        ...

    def read(self, number: int, rows: slice) -> np.ndarray:
        """Rows of one photograph, float32; negative numbers count from the last."""
        ...


class PhotographList:
    """Photographs in memory, (H, W) or (H, W, 3), checked."""

    def __init__(self, images: Sequence[Any]) -> None:
        self.images = check_photographs("photographs", images)

    @property
    def count(self) -> int:
        """Number of photographs."""
        return len(self.images)

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return self.images[0].shape[:2]

    @property
    def code_step(self) -> float:
        """1 for integers."""
        return float(self.images[0].dtype.kind == "u")

    def read(self, number: int, rows: slice) -> np.ndarray:
        """Rows of one photograph, float32."""
        return _as_grey(self.images[number][rows])


class PhotographFile:
    """Grey photographs of linear values in [0, 1], appended one at a time to a temporary file.

    Values are kept in steps of 1 / 65535.

    Parameters
    ----------
    folder : path, optional
        Folder of the file, by default that of the system for temporary files.

    Examples
    --------
    >>> with PhotographFile() as photographs:
    ...     photographs.append(np.full((2, 3), 0.5))
    ...     photographs[0].round(4).tolist()
    [[0.5, 0.5, 0.5], [0.5, 0.5, 0.5]]
    """

    def __init__(self, folder: str | os.PathLike[str] | None = None) -> None:
        self._file = tempfile.TemporaryFile(dir=folder, prefix="ltcl-")  # noqa: SIM115
        self._lock = threading.Lock()
        self.count = 0
        self.shape = (0, 0)
        self.code_step = 0.0

    def __enter__(self) -> PhotographFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Remove the file."""
        self._file.close()

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, number: int) -> np.ndarray:
        return self.read(number, slice(None))

    def append(self, image: np.ndarray) -> None:
        """Append a photograph (H, W) or (H, W, 3); all must have one shape."""
        if self.count == 0:
            self.shape = (image.shape[0], image.shape[1])
        checks.shape(f"photographs[{self.count}]", image, self.shape, (*self.shape, 3))
        self._file.seek(0, os.SEEK_END)
        for top in range(0, self.shape[0], ROWS_AT_ONCE):
            grey = _as_grey(image[top : top + ROWS_AT_ONCE])
            steps = np.rint(STEPS * np.clip(grey, 0.0, 1.0))
            self._file.write(steps.astype(np.uint16))
        self.count += 1

    def read(self, number: int, rows: slice) -> np.ndarray:
        """Rows of one photograph, float32; negative numbers count from the last."""
        H, W = self.shape
        numbers = range(H)[rows]
        steps = np.empty((len(numbers), W), np.uint16)
        first = (number % self.count) * H
        with self._lock:
            if numbers.step == 1:
                self._read_into(steps, first + numbers.start)
            else:
                for row, place in zip(steps, numbers, strict=True):
                    self._read_into(row, first + place)
        return steps * np.float32(1.0 / STEPS)

    def _read_into(self, steps: np.ndarray, row: int) -> None:
        self._file.seek(row * self.shape[1] * steps.itemsize)
        self._file.readinto(steps)


def _as_grey(image: np.ndarray) -> np.ndarray:
    """Mean of the channels of an image (H, W[, c]), float32."""
    if image.ndim == 3:
        return image.mean(axis=2, dtype=np.float32)
    return image.astype(np.float32)
