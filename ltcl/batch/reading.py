# SPDX-License-Identifier: BSD-3-Clause
"""Frames in batches, read while the batch before is being solved."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from typing import TypeVar

import numpy as np

from ltcl import images
from ltcl.errors import InputError
from ltcl.images.frames import Frame, Source

Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class Reader:
    """The first `limit` frames of a source, all where that is None, on a `grid`."""

    source: Source
    grid: tuple[int, int]
    resize: bool
    limit: int | None

    @property
    def count(self) -> int | None:
        """Of the frames, as far as the source tells."""
        count = self.source.count
        return count if count is None or self.limit is None else min(count, self.limit)

    def frames(self) -> Iterator[Frame]:
        """From the first one on."""
        return islice(self.source, self.limit)

    def picture(self, frame: Frame) -> np.ndarray:
        """The frame on the grid.

        Raises
        ------
        InputError
            It has another size and may not be scaled; cannot be read.
        """
        picture = frame.picture()
        if picture.shape[:2] == self.grid:
            return picture
        if self.resize:
            return images.resize(picture, self.grid)
        has, wants = ("{} x {}".format(*size) for size in (picture.shape[:2], self.grid))
        raise InputError(
            f"{self.source.place(frame.number)} is {has} pixels, but the camera has {wants}; "
            "give resize=True to scale all frames"
        )

    def sample(self, size: int) -> list[np.ndarray]:
        """About `size` frames, evenly spread; the first ones where their number is not known."""
        count = self.count
        places = np.linspace(1, count, min(size, count)) if count else np.arange(1, size + 1)
        wanted = set(np.rint(places).astype(int).tolist())
        frames = islice(self.frames(), max(wanted))
        return [self.picture(frame) for frame in frames if frame.number in wanted]


def batched(frames: Iterable[Frame], size: int) -> Iterator[list[Frame]]:
    """Lists of `size` frames, the last one perhaps shorter."""
    frames = iter(frames)
    while batch := list(islice(frames, size)):
        yield batch


def ahead(items: Iterator[Item]) -> Iterator[Item]:
    """The same items, each made by another thread while the one before is in use.

    >>> list(ahead(iter("abc")))
    ['a', 'b', 'c']
    """
    end = object()
    with ThreadPoolExecutor(1) as thread:
        coming = thread.submit(next, items, end)
        while (item := coming.result()) is not end:
            coming = thread.submit(next, items, end)
            yield item  # pyright: ignore[reportReturnType]
