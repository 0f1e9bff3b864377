# SPDX-License-Identifier: BSD-3-Clause
"""What patterns of pixels, on or off, show on the pixels of the scan: columns of T, or sums of columns.

Every photograph goes the same way: exposures merged to radiance, on the projector's pixels, averaged over the
blocks of the scan, less the ambient light, in units of the light that all channels of the projector send.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import islice
from typing import Any, NamedTuple, Self

import numpy as np
import scipy.sparse

from ltcl.acquisition import anchor
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.geometry.resample import Blocks
from ltcl.acquisition.radiometry import Radiance, merge
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.scanning.checks import Checks, Shot
from ltcl.acquisition.session import acquisition_error
from ltcl.errors import AcquisitionError
from ltcl.store import BlockStore

UNKNOWN = np.float32(1e12)
"""The variance of a value of which nothing is known."""
_SEEN = 0.5  # of what a projector pixel is seen by: less of it valid tells nothing


class Picture(NamedTuple):
    """Light on M pixels in each channel, and its variance: float32, (channels, M). `UNKNOWN` is finite."""

    value: np.ndarray
    variance: np.ndarray


class Seen:
    """What a calibration shows of the pixels of the scan.

    Attributes
    ----------
    grid, channels : (h, w), 1 or 3
        Of the scan: M = N = h w.
    white, ambient : Picture, (channels, M)
        Row sums of T; the variance of the ambient light, which is subtracted from each picture.
    seen : (M,) bool
        Pixels that the camera sees, with `sharpness` (None: exactly).
    """

    def __init__(self, calibration: Calibration, side: int = 1) -> None:
        self.calibration, self.channels = calibration, len(calibration.offset)
        self.blocks = Blocks(calibration.resampling.grid, side)
        self.grid = self.blocks.grid
        self.seen = self.blocks.sum(calibration.resampling.seen.astype(np.float32)).ravel() > 0
        self.sharpness = calibration.sharpness and calibration.sharpness.of_blocks(side)
        self.white, self._dark = self._on_grid(calibration.white), self._on_grid(calibration.ambient)
        self.ambient = np.where(self._dark.variance < UNKNOWN, self._dark.variance, 0.0)

    @classmethod
    def of(cls, store: BlockStore) -> Self:
        """Of a store that `ltcl.acquire` made."""
        facts = store.attributes
        side = facts["settings"]["block"] if facts["strategy"] == "block" else 1
        return cls(Calibration.of(store), side)

    def _on_grid(self, light: Radiance) -> Picture:
        """Means over the blocks of the scan, as far as they are seen and valid."""
        R, valid, n = self.calibration.resampling, light.valid, self.channels
        value = R.apply(np.where(valid, light.value, 0.0))
        variance = R.variance(np.where(valid, light.variance, 0.0))
        weight = R.seen if valid.all() else R.apply(valid.astype(np.float32))
        value, variance, weight = (x.reshape(*R.grid, -1) for x in (value, variance, weight))
        good = np.broadcast_to(weight >= _SEEN, value.shape)
        share = np.where(good, 1.0 / np.maximum(weight, _SEEN), 0.0)
        value, variance, count = (
            np.moveaxis(self.blocks.sum(x), -1, 0).reshape(n, -1)
            for x in (value * share, variance * share**2, good.astype(np.float32))
        )
        pixels = np.maximum(count, 1.0) * self.calibration.light[:, None]
        variance = np.where(count > 0, variance / pixels**2, UNKNOWN)
        return Picture((value / pixels).astype(np.float32), variance.astype(np.float32))


class Pictures(Seen):
    """A rig that was calibrated, as a camera on the pixels of the scan."""

    def __init__(self, shots: Shots, calibration: Calibration, side: int = 1) -> None:
        super().__init__(calibration, side)
        self.shots, self._checks = shots, Checks(calibration, self.white, shots.name)

    def announce(self, patterns: Iterable[np.ndarray], size: int) -> None:
        """Tell the rig of patterns that come next, in batches of `size`, to be photographed in one go."""
        rest, times = iter(patterns), self.calibration.exposures
        while batch := [self.blocks.enlarged(pattern) for pattern in islice(rest, size)]:
            shots = [(codes, t) for codes in batch for t in times]
            self.shots.prepare([*shots, (anchor.marked(batch), times[0])])

    def take(self, patterns: Iterable[np.ndarray], progress: Callable[[int], None]) -> list[Picture]:
        """A picture under each pattern (h, w) of the scan, on where it is not 0; `progress(1)` after each.

        AcquisitionError where photographs deviate from what is known of them (`checks`).
        """
        patterns, times = list(patterns), self.calibration.exposures
        batch = [self.blocks.enlarged(pattern) for pattern in patterns]
        pictures: list[Picture] = []
        shots: list[Shot] = []
        for k, codes in enumerate(batch):
            shot = self._photograph(codes, times)
            if self._checks.deviation(shot) is not None:
                self._checks.refuse([shot, *(self._photograph(c, times) for c in batch[k + 1 : k + 2])])
            light = self._merge(shot)
            pictures.append(self._less_ambient(light))
            shots.append(shot._replace(images=[anchor.compact(light)]))
            progress(1)
        self._checks.refuse_misplaced(patterns, pictures, shots)
        blocks = self._photograph(anchor.marked(batch), times[:1])
        shots.append(blocks._replace(images=[anchor.compact(self._merge(blocks))]))
        self._checks.refuse_moved(blocks, shots)
        return pictures

    def _photograph(self, codes: np.ndarray, seconds: tuple[float, ...]) -> Shot:
        images = [self.shots.photograph(codes, t) for t in seconds]
        return Shot(codes, images, seconds, range(self.shots.number + 1 - len(images), self.shots.number + 1))

    def _merge(self, shot: Shot) -> Radiance:
        known = self.calibration
        levels = known.noise.levels or None
        with acquisition_error(f"photographs {shot.numbers[0]} to {shot.numbers[-1]}"):
            return merge(
                shot.images, shot.seconds, known.response, known.noise, levels=levels, black=known.offset
            )

    def _less_ambient(self, light: Radiance) -> Picture:
        lit = self._on_grid(light)
        known = (lit.variance < UNKNOWN) & (self._dark.variance < UNKNOWN)
        value = np.where(known, lit.value - self._dark.value, np.float32(0.0))
        return Picture(value, np.where(known, lit.variance, UNKNOWN))


class Log:
    """Pictures in the order in which an adaptive scan asks for them, a batch in each block of a store.

    What it asks for next depends on nothing but the pictures before. So a scan that was stopped is run again
    from its start with the pictures of the log, to the bit the same, until it asks for a new one. `done`
    counts those that were asked for.
    """

    def __init__(self, store: BlockStore, pictures: Pictures, progress: Callable[[int], None]) -> None:
        self._store, self._pictures, self._progress = store, pictures, progress
        self._batches = 0
        self.done = 0

    def announce(self, patterns: Iterable[np.ndarray]) -> None:
        """Tell the rig of the patterns of the next batches that are not in the store."""
        number = self._batches
        while self._written(number):
            number += 1
        size = self._store.layout.block_rows
        self._pictures.announce(islice(patterns, (number - self._batches) * size, None), size)

    def _written(self, number: int) -> bool:
        return all((c, number) in self._store.written for c in range(self._pictures.channels))

    def take(self, patterns: list[np.ndarray]) -> list[Picture]:
        """The pictures of the next batch of patterns, as many as a block has at most."""
        number, self._batches = self._batches, self._batches + 1
        if self._written(number):
            pictures = self._read(number, len(patterns))
            self._count(len(patterns))
        else:
            pictures = self._pictures.take(patterns, self._count)
            for c in range(self._pictures.channels):
                self._write(number, c, pictures)
        return pictures

    def _count(self, pictures: int) -> None:
        self.done += pictures
        self._progress(self.done)

    def _read(self, number: int, count: int) -> list[Picture]:
        blocks = [self._store.block(c, number) for c in range(self._pictures.channels)]
        pixels = self._store.layout.shape[0]
        data: Any = [(block.matrix.data, block.variance) for block in blocks]
        value, variance = np.reshape(data, (len(blocks), 2, -1, pixels)).transpose(1, 2, 0, 3)
        if len(value) != count:
            what = f"{len(value)} pictures in batch {number}; they must be {count}"
            raise AcquisitionError(f"{self._store.path} holds {what}: it is that of another scan")
        return list(map(Picture, value, variance))

    def _write(self, number: int, c: int, pictures: list[Picture]) -> None:
        rows, pixels = self._store.layout.block_shape(number, "columns")
        value, variance = np.concatenate([(p.value[c], p.variance[c]) for p in pictures], axis=1)
        places = np.tile(np.arange(pixels, dtype=np.int32), len(pictures))
        ends = np.minimum(np.arange(rows + 1), len(pictures)) * pixels  # rows without a picture are empty
        matrix = scipy.sparse.csr_array((value, places, ends), shape=(rows, pixels))
        self._store.write(c, number, matrix, variance)
