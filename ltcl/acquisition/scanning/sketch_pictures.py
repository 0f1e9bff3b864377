# SPDX-License-Identifier: BSD-3-Clause
"""`SketchPictures`: patterns and pictures of a sketch, which grow by rounds in temporary files.

Pictures of 1920 x 1080 pixels in colour take 50 MB each with their variances. White comes first and
those that judge come last, so that all that are fitted are a slice, which copies nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ltcl.acquisition.estimation.pairs import Pairs
from ltcl.acquisition.scanning.picture_log import BATCH_SIZE, PictureLog
from ltcl.acquisition.scanning.pictures import UNKNOWN, ScanGrid
from ltcl.acquisition.scratch import ScratchFrames
from ltcl.store import BlockStore


class SketchPictures:
    """Pairs of patterns and pictures, as they are photographed.

    Pictures of a scan are in units of the light that a channel answers to, those of pairs in that
    of the camera.

    Parameters
    ----------
    grid : ScanGrid
        Its calibration has white.
    log : PictureLog

    Attributes
    ----------
    numbers : list of int
        The number of each pair in the order in which they were photographed; white is 0.
    """

    def __init__(self, grid: ScanGrid, log: PictureLog) -> None:
        self.numbers = [0]
        self._grid = grid
        self._log = log
        self._judges = 0
        self._light = grid.calibration.light.astype(np.float32)
        pixels = len(grid.seen)
        self._patterns = ScratchFrames((pixels,), np.uint8)
        self._photographs = ScratchFrames((pixels, grid.channels), np.float32)
        self._variance = ScratchFrames((pixels, grid.channels), np.float32)
        self._patterns.extend(1)[0] = grid.light_of(np.ones(grid.grid, np.float32)).ravel()
        self._photographs.extend(1)[0] = grid.white.value.T * self._light
        self._variance.extend(1)[0] = grid.white.variance.T * self._light**2

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def judging(self) -> np.ndarray:
        """Numbers of the pairs that judge."""
        return np.arange(len(self) - self._judges, len(self))

    @property
    def names(self) -> list[str]:
        """Names of all pairs but white."""
        return [self._log.names[number - 1] for number in self.numbers[1:]]

    def take(self, shown: Sequence[np.ndarray], judges: int = 0) -> None:
        """Photograph patterns (h, w), which come before those that judge.

        So many of the last ones judge, in one call alone.
        """
        first = len(self)
        self.numbers += range(first, first + len(shown))
        arrays = []
        for frames in (self._patterns, self._photographs, self._variance):
            arrays.append(frames.extend(len(shown)))
        if self._judges:
            first -= self._judges
            judging = self.numbers[first : first + self._judges]
            self.numbers = [*self.numbers[:first], *self.numbers[first + self._judges :], *judging]
            for array in arrays:
                _move_to_end(array, first, self._judges)
        self._judges += judges
        patterns, photographs, variance = arrays
        frame = first
        for start in range(0, len(shown), BATCH_SIZE):
            batch = [*shown[start : start + BATCH_SIZE]]
            for pattern, picture in zip(batch, self._log.take(batch), strict=True):
                patterns[frame] = self._grid.light_of(pattern).ravel()
                photographs[frame] = picture.value.T * self._light
                noise = np.where(picture.known, picture.variance + self._grid.ambient, UNKNOWN)
                variance[frame] = noise.T * self._light**2
                frame += 1

    def pairs(self) -> Pairs:
        """All pairs."""
        photographs = self._photographs.array
        patterns = self._patterns.array
        return Pairs(
            grid=self._grid.grid,
            camera_grid=self._grid.grid,
            patterns=np.broadcast_to(patterns[:, :, None], photographs.shape),
            photographs=photographs,
            variance=self._variance.array,
        )


def _move_to_end(array: np.ndarray, first: int, count: int) -> None:
    """Move frames to the end of an array, over frames that were not written yet."""
    for place in reversed(range(count)):
        array[len(array) - count + place] = array[first + place]


def keep_stripes(store: BlockStore, grid: ScanGrid) -> list[str]:
    """Keep the calibration's photographs of Gray code as the first pictures of a sketch.

    Returns what names them in messages.
    """
    log = PictureLog(store, None, lambda done: None)
    stripes = grid.calibration.stripes
    for start in range(0, len(stripes), BATCH_SIZE):
        pictures = []
        for photograph in stripes[start : start + BATCH_SIZE]:
            light = grid.merge([photograph])
            pictures.append(grid.without_ambient(grid.picture(light)).stored())
        log.put(pictures)
    return [f"photograph {photograph.number}" for photograph in stripes]
