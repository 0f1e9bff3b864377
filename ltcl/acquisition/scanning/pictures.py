# SPDX-License-Identifier: BSD-3-Clause
"""What patterns of pixels, on or off, show on the pixels of the scan: columns of T, or sums of columns.

Every photograph goes the same way: exposures merged to radiance, on the projector's pixels, averaged over the
blocks of the scan, less the ambient light, in units of the light that all channels of the projector send.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple, Self

import numpy as np

from ltcl.acquisition import agreeing
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.exposing import telling
from ltcl.acquisition.radiometry import Radiance, merge
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.scanning import order
from ltcl.acquisition.scanning.block import Blocks
from ltcl.store import BlockStore

UNKNOWN = np.float32(1e12)
"""The variance of a value of which nothing is known."""
_SEEN = 0.5  # of what a projector pixel is seen by: less of it valid tells nothing


class Picture(NamedTuple):
    """Light on M pixels in each channel, and its variance: float32, (channels, M). `UNKNOWN` is finite."""

    value: np.ndarray
    variance: np.ndarray


class Seen:
    """What a calibration tells of the pixels of the scan.

    Attributes
    ----------
    calibration : Calibration
    grid : (h, w)
        Of the scan: M = N = h w.
    channels : 1 or 3
    ambient : (channels, M)
        Variance of what is subtracted from each picture, the same in all.
    white : Picture
        Under all of the projector: row sums of T.
    seen : (M,) bool
        Pixels that the camera sees.
    """

    def __init__(self, calibration: Calibration, side: int = 1) -> None:
        self.calibration, self.channels = calibration, len(calibration.offset)
        self.blocks = Blocks(calibration.resampling.grid, side)
        self.grid = self.blocks.grid
        self._scale = calibration.light.astype(np.float32)[:, None]
        self.seen = self.blocks.sum(calibration.resampling.seen.astype(np.float32)).ravel() > 0
        self._dark = self._on_grid(calibration.ambient)
        self.ambient = np.where(self._dark.variance < UNKNOWN, self._dark.variance, 0.0) / self._scale**2
        white = self._on_grid(calibration.white)
        self.white = Picture(white.value / self._scale, white.variance / self._scale**2)

    @classmethod
    def of(cls, store: BlockStore) -> Self:
        """Of a store that `ltcl.acquire` made."""
        told = store.attributes
        return cls(Calibration.of(store), told["settings"]["block"] if told["strategy"] == "block" else 1)

    def _on_grid(self, light: Radiance) -> Picture:
        """Means over the blocks of the scan, as far as they are seen and valid."""
        R, n = self.calibration.resampling, self.channels
        known = light.valid.astype(np.float32)
        value = R.apply(np.where(light.valid, light.value, 0.0))
        variance = R.variance(np.where(light.valid, light.variance, 0.0))
        if light.valid.all():
            weight = R.seen.astype(np.float32)[..., None]
        else:
            weight = R.apply(known).reshape(*R.grid, n)
        good = weight >= _SEEN
        part = np.where(good, 1.0 / np.maximum(weight, _SEEN), 0.0)
        value = self.blocks.sum(value.reshape(*R.grid, n) * part)
        variance = self.blocks.sum(variance.reshape(*R.grid, n) * part**2)
        count = self.blocks.sum(np.broadcast_to(good, (*R.grid, n)).astype(np.float32))
        told = np.moveaxis(count, -1, 0).reshape(n, -1)
        value, variance = (np.moveaxis(part, -1, 0).reshape(n, -1) for part in (value, variance))
        pixels = np.maximum(told, 1.0)
        variance = np.where(told > 0, variance / pixels**2, UNKNOWN)
        return Picture((value / pixels).astype(np.float32), variance.astype(np.float32))


class Pictures(Seen):
    """A rig that was calibrated, as a camera on the pixels of the scan."""

    def __init__(self, shots: Shots, calibration: Calibration, side: int = 1) -> None:
        super().__init__(calibration, side)
        self.shots = shots

    def announce(self, patterns: Iterable[np.ndarray]) -> None:
        """Tell the rig of patterns that will be asked for, so that a person can photograph all in one go."""
        times = self.calibration.exposures
        self.shots.prepare((self._codes(part), t) for part in patterns for t in times)

    def take(self, patterns: Iterable[np.ndarray], tell: Callable[[], None]) -> list[Picture]:
        """A picture under each pattern (h, w) of the scan, on where it is not 0; told of each.

        Raises
        ------
        AcquisitionError
            Photographs do not show their patterns (`order`).
        """
        patterns = list(patterns)
        codes = [self._codes(pattern) for pattern in patterns]
        times, first = self.calibration.exposures, self.shots.count
        self.shots.prepare([(part, t) for part in codes for t in times])
        found = []
        for part in codes:
            found.append(self._picture([self.shots.photograph(part, t) for t in times]))
            tell()
        lit = np.stack(patterns).reshape(len(found), -1)
        value, variance = (np.stack(part) for part in zip(*found, strict=True))
        order.check(lit, value, variance, self.ambient, self.white, lambda a: _numbered(first, a, len(times)))
        return found

    def _codes(self, pattern: np.ndarray) -> np.ndarray:
        return self.blocks.enlarged(np.asarray(pattern, np.float32))

    def _picture(self, images: list[np.ndarray]) -> Picture:
        told = self.calibration
        levels = told.noise.levels or None
        last = self.shots.count
        first = last + 1 - len(images)
        sensor = (told.response, told.noise, told.offset)
        agreeing.refuse_unlike(images, told.exposures, range(first, last + 1), *sensor)
        with telling(f"photographs {first} to {last}"):
            merged = merge(
                images, told.exposures, told.response, told.noise, levels=levels, black=told.offset
            )
        lit = self._on_grid(merged)
        variance = np.where(lit.variance < UNKNOWN, lit.variance / self._scale**2, UNKNOWN)
        known = (variance < UNKNOWN) & (self._dark.variance < UNKNOWN)
        value = np.where(known, lit.value - self._dark.value, np.float32(0.0)) / self._scale
        return Picture(value, np.where(known, variance, UNKNOWN).astype(np.float32))


def _numbered(before: int, picture: int, each: int) -> str:
    """The photographs of a picture of a batch, before which there were some.

    >>> _numbered(10, 0, 1), _numbered(10, 1, 2)
    ('photograph 11', 'photographs 13 to 14')
    """
    last = before + (picture + 1) * each
    return f"photograph {last}" if each == 1 else f"photographs {last + 1 - each} to {last}"
