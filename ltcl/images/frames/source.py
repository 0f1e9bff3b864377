# SPDX-License-Identifier: BSD-3-Clause
"""What every source of frames has in common: numbers, names, a size that stays."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ltcl.errors import FileError
from ltcl.images.codes import Encoding


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame; nothing of a folder's is read before it is asked for.

    Attributes
    ----------
    number : int
        From 1.
    name : str
        Of its file, or of the video and its number there.
    digest : callable
        SHA-256, in hexadecimal digits, of what it holds, by which a frame is known again.
    picture : callable
        Linear float32, (h, w) or (h, w, 3); FileError where it cannot be read or has another size than those
        before.
    """

    number: int
    name: str
    digest: Callable[[], str]
    picture: Callable[[], np.ndarray]


class Source(ABC):
    """Frames in order, the same at every iteration.

    Attributes
    ----------
    path : Path
    encoding : str
    count : int or None
        As the folder or the video tells; None where it does not.
    fps : float or None
        Frames a second, of a video.
    """

    def __init__(self, path: Path, encoding: Encoding) -> None:
        self.path = path
        self.encoding: Encoding = encoding
        self.count: int | None = None
        self.fps: float | None = None
        self._first: tuple[int, tuple[int, int]] | None = None  # number and size of the first one read

    @abstractmethod
    def __iter__(self) -> Iterator[Frame]:
        """All frames from the first one on; FileError where one is missing."""

    def place(self, number: int) -> str:
        """The frame in words, as refusals begin."""
        of = "" if self.count is None else f" of {self.count}"
        return f"{self.path}: frame {number}{of}"

    def _same_size(self, number: int, picture: np.ndarray) -> np.ndarray:
        h, w = picture.shape[:2]
        if self._first is None:
            self._first = number, (h, w)
        first, (height, width) = self._first
        if (h, w) != (height, width):
            raise FileError(
                f"{self.place(number)} is {h} x {w} pixels; it must be {height} x {width} as frame {first}"
            )
        return picture
