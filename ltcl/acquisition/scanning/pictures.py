# SPDX-License-Identifier: BSD-3-Clause
"""What patterns of pixels, on or off, show on the pixels of the scan: columns of T, or sums of columns.

Every photograph goes the same way: exposures merged to radiance, on the projector's pixels, averaged over the
blocks of the scan, less the ambient light, in units of the light that all channels of the projector send.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple, Self

import numpy as np

from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.exposing import telling
from ltcl.acquisition.radiometry import Radiance, merge
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.scanning import exposed, order
from ltcl.acquisition.scanning.block import Blocks
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
    sharpness : Sharpness or None
        Of the camera on these.
    """

    def __init__(self, calibration: Calibration, side: int = 1) -> None:
        self.calibration, self.channels = calibration, len(calibration.offset)
        self.blocks = Blocks(calibration.resampling.grid, side)
        self.grid = self.blocks.grid
        self._scale = calibration.light.astype(np.float32)[:, None]
        self.seen = self.blocks.sum(calibration.resampling.seen.astype(np.float32)).ravel() > 0
        sharp = calibration.sharpness
        self.sharpness = None if sharp is None else sharp.of_blocks(side)
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
            Photographs do not show their patterns (`exposed`, `order`).
        """
        patterns = list(patterns)
        codes = [self._codes(pattern) for pattern in patterns]
        times = self.calibration.exposures
        self.shots.prepare([(part, t) for part in codes for t in times])
        found, contradictions = [], []
        for part in codes:
            images = [self.shots.photograph(part, t) for t in times]
            contradictions.append(exposed.contradiction(images, self.calibration, part))
            try:
                found.append(self._picture(images))
            except AcquisitionError:
                exposed.check(contradictions, self._names(len(contradictions)))  # may name an earlier one
                raise
            tell()
        exposed.check(contradictions, self._names(len(found)))
        value, variance = (np.stack(part) for part in zip(*found, strict=True))
        lit = np.stack(patterns).reshape(len(found), -1)
        order.check(lit, value, variance, self.ambient, self.white, self._names(len(found)))
        return found

    def _names(self, count: int) -> Callable[[int], str]:
        """What the photographs of each of the last `count` pictures are called."""
        each = len(self.calibration.exposures)
        before = self.shots.number - each * count

        def name(a: int) -> str:
            last = before + (a + 1) * each
            return f"photograph {last}" if each == 1 else f"photographs {last + 1 - each} to {last}"

        return name

    def _codes(self, pattern: np.ndarray) -> np.ndarray:
        return self.blocks.enlarged(np.asarray(pattern, np.float32))

    def _picture(self, images: list[np.ndarray]) -> Picture:
        told = self.calibration
        levels = told.noise.levels or None
        last = self.shots.number
        with telling(f"photographs {last + 1 - len(images)} to {last}"):
            merged = merge(
                images, told.exposures, told.response, told.noise, levels=levels, black=told.offset
            )
        lit = self._on_grid(merged)
        variance = np.where(lit.variance < UNKNOWN, lit.variance / self._scale**2, UNKNOWN)
        known = (variance < UNKNOWN) & (self._dark.variance < UNKNOWN)
        value = np.where(known, lit.value - self._dark.value, np.float32(0.0)) / self._scale
        return Picture(value, np.where(known, variance, UNKNOWN).astype(np.float32))
