# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of Gray code, read by rows: in memory, or in a file that grows by one at a time.

42 photographs of 45 megapixels are 2 gigabytes of codes and 8 of floats. A calibration appends each
to a file when it is taken, and decodes some rows of all of them at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, final

import numpy as np

from ltcl import checks
from ltcl.acquisition.radiometry.exposures import check_photographs
from ltcl.acquisition.scratch import ImageFile, StoredImage

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


@final
class PhotographFile:
    """Grey photographs of linear values in [0, 1], appended one at a time to a temporary file.

    Values are kept in steps of 1 / 65535.

    Parameters
    ----------
    file : ImageFile, optional
        The file, by default a new one.

    Examples
    --------
    >>> photographs = PhotographFile()
    >>> photographs.append(np.full((2, 3), 0.5))
    >>> photographs[0].round(4).tolist()
    [[0.5, 0.5, 0.5], [0.5, 0.5, 0.5]]
    """

    code_step = 0.0

    def __init__(self, file: ImageFile | None = None) -> None:
        if file is None:
            file = ImageFile()
        self._file = file
        self._images: list[StoredImage] = []

    @property
    def count(self) -> int:
        """Number of photographs."""
        return len(self._images)

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        H, W = self._images[0].shape
        return H, W

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, number: int) -> np.ndarray:
        return self.read(number, slice(None))

    def append(self, image: np.ndarray) -> None:
        """Append a photograph (H, W) or (H, W, 3); all must have one shape."""
        if self._images:
            checks.shape(f"photographs[{self.count}]", image, self.shape, (*self.shape, 3))
        self.append_rows((image.shape[0], image.shape[1]), image.__getitem__)

    def append_rows(self, shape: tuple[int, int], read: Callable[[slice], np.ndarray]) -> None:
        """Append a photograph of which `read` returns rows."""
        stored = self._file.reserve(shape, np.uint16)
        for top in range(0, shape[0], ROWS_AT_ONCE):
            grey = np.clip(_as_grey(read(slice(top, top + ROWS_AT_ONCE))), 0.0, 1.0)
            stored.write(top, np.rint(STEPS * grey).astype(np.uint16))
        self._images.append(stored)

    def read(self, number: int, rows: slice) -> np.ndarray:
        """Rows of one photograph, float32; negative numbers count from the last."""
        return self._images[number].read(rows) * np.float32(1.0 / STEPS)

    def exchanged(self, first: int, second: int) -> PhotographFile:
        """The same photographs, two of which have changed places."""
        photographs = PhotographFile(self._file)
        photographs._images = self._images.copy()
        photographs._images[first] = self._images[second]
        photographs._images[second] = self._images[first]
        return photographs


def _as_grey(image: np.ndarray) -> np.ndarray:
    """Mean of the channels of an image (H, W[, c]), float32."""
    if image.ndim == 2:
        return image.astype(np.float32)
    # Three times as fast as a mean along the shortest axis.
    channels = image.shape[2]
    total = image[..., 0].astype(np.float32)
    for c in range(1, channels):
        total += image[..., c]
    total /= np.float32(channels)
    return total
