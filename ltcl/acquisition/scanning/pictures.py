# SPDX-License-Identifier: BSD-3-Clause
"""What patterns of pixels, on or off, show on the pixels of the scan: columns of T, or sums of columns.

Every photograph goes the same way: exposures merged to radiance, on the projector's pixels, averaged over the
blocks of the scan, less the ambient light, in units of the light that all channels of the projector send.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import islice
from typing import NamedTuple, Self

import numpy as np

from ltcl.acquisition import anchor
from ltcl.acquisition.agreement import Deviation
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.exposure import acquisition_error
from ltcl.acquisition.radiometry import Radiance, merge
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.scanning.cells import Blocks
from ltcl.acquisition.scanning.checks import Checks, Shot
from ltcl.store import BlockStore

UNKNOWN = np.float32(1e12)
"""The variance of a value of which nothing is known."""
_CLEAR = 5.0  # standard deviations of white
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
        self.checks = Checks(calibration, shots.name)

    def announce(self, patterns: Iterable[np.ndarray], size: int) -> None:
        """Tell the rig of patterns that come next, in batches of `size`, to be photographed in one go."""
        rest = iter(patterns)
        while batch := list(islice(rest, size)):
            self.shots.prepare(self._listed([self._codes(part) for part in batch]))

    def _listed(self, batch: list[np.ndarray]) -> list[tuple[np.ndarray, float]]:
        """What is photographed for a batch of codes: each at all exposures, then the anchor."""
        times = self.calibration.exposures
        return [*((part, t) for part in batch for t in times), (anchor.marked(batch), times[0])]

    def take(self, patterns: Iterable[np.ndarray], tell: Callable[[], None]) -> list[Picture]:
        """A picture under each pattern (h, w) of the scan, on where it is not 0; told of each.

        Raises
        ------
        AcquisitionError
            Photographs deviate from what is known of them (`checks`).
        """
        patterns = list(patterns)
        codes = [self._codes(pattern) for pattern in patterns]
        self.shots.prepare(self._listed(codes))
        merged: list[tuple[Shot, Radiance]] = []
        deviations: list[tuple[Shot, Deviation]] = []
        following = None
        for part in codes:
            shot = self._photographed(part, self.calibration.exposures)
            found = self.checks.deviation(shot)
            following = shot if deviations and following is None else following
            if found is not None:
                deviations.append((shot, found))
            if len(deviations) > 1:
                break
            if not deviations:
                merged.append((shot._replace(images=[]), self._merged(shot)))
            tell()
        self.checks.refuse(deviations, following)
        pictures = [self._picture(light) for _, light in merged]
        self._check_places(patterns, pictures, [shot.numbers for shot, _ in merged])
        blocks = self._photographed(anchor.marked(codes), self.calibration.exposures[:1])
        self.checks.refuse_moved(blocks, merged)
        return pictures

    def _check_places(
        self, patterns: list[np.ndarray], pictures: list[Picture], numbers: list[range]
    ) -> None:
        """Refuse pictures that show other patterns of their batch, where white is well above its noise."""
        white = self.white.value.sum(axis=0)
        clear = white > _CLEAR * np.sqrt(self.white.variance.sum(axis=0))
        value = np.stack([picture.value.sum(axis=0) for picture in pictures])[:, clear] / white[clear]
        variance = (
            np.stack([picture.variance.sum(axis=0) for picture in pictures])[:, clear] / white[clear] ** 2
        )
        lit = np.stack(patterns).reshape(len(patterns), -1)[:, clear] > 0
        self.checks.refuse_misplaced(lit, value, variance, numbers)

    def _codes(self, pattern: np.ndarray) -> np.ndarray:
        return self.blocks.enlarged(np.asarray(pattern, np.float32))

    def _photographed(self, codes: np.ndarray, seconds: tuple[float, ...]) -> Shot:
        images = [self.shots.photograph(codes, t) for t in seconds]
        return Shot(codes, images, range(self.shots.number + 1 - len(images), self.shots.number + 1))

    def _merged(self, shot: Shot) -> Radiance:
        told = self.calibration
        levels = told.noise.levels or None
        with acquisition_error(f"photographs {shot.numbers[0]} to {shot.numbers[-1]}"):
            return merge(
                shot.images, told.exposures, told.response, told.noise, levels=levels, black=told.offset
            )

    def _picture(self, merged: Radiance) -> Picture:
        lit = self._on_grid(merged)
        variance = np.where(lit.variance < UNKNOWN, lit.variance / self._scale**2, UNKNOWN)
        known = (variance < UNKNOWN) & (self._dark.variance < UNKNOWN)
        value = np.where(known, lit.value - self._dark.value, np.float32(0.0)) / self._scale
        return Picture(value, np.where(known, variance, UNKNOWN).astype(np.float32))
