# SPDX-License-Identifier: BSD-3-Clause
"""What patterns of pixels, on or off, show on the pixels of the scan: columns of T, or sums of columns.

Every photograph goes the same way: exposures merged to radiance, on the projector's pixels,
averaged over the blocks of the scan, less the ambient light, in units of the light that all
channels of the projector send. Before a batch is kept, its photographs are compared in units of the
noise (`agreement`):

    exposures     of one pattern show the same light
    patterns      no picture of a batch shows the pattern of another (all that one exposure allows)
    anchor        after each batch, the pattern of blocks shows what it showed in the calibration
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import combinations, islice
from typing import Any, NamedTuple, Self

import numpy as np
import scipy.sparse

from ltcl.acquisition import anchor
from ltcl.acquisition.agreement import (
    ADVICE,
    CameraModel,
    Deviation,
    find_deviation,
    sample,
    spread,
)
from ltcl.acquisition.calibration import Calibration, Setup
from ltcl.acquisition.geometry.blocks import Blocks
from ltcl.acquisition.radiometry import Radiance, merge
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.session import acquisition_error
from ltcl.errors import AcquisitionError
from ltcl.store import BlockStore
from ltcl.transport.noise import Noise

UNKNOWN = np.float32(1e12)
"""The variance of a value of which nothing is known."""
_SEEN = 0.5  # of what a projector pixel is seen by: less of it valid determines nothing
_CLEAR = 5.0  # standard deviations of white that count
_CERTAIN = 0.25  # standard deviation, relative to white, of a pixel that counts
_RATIO, _SIGMAS = 4.0, 6.0
_MODEL, _SAME = 0.02, 2.5  # relative systematic error; mean z^2 of pictures that are the same


class Picture(NamedTuple):
    """Light on M pixels in each channel, and its variance: float32, (channels, M). `UNKNOWN` is finite."""

    value: np.ndarray
    variance: np.ndarray

    @property
    def known(self) -> np.ndarray:
        """Where the value is known, (channels, M) bool."""
        return self.variance < 1e-3 * UNKNOWN


class _Shot(NamedTuple):
    """The photographs of a pattern: its codes (h, w), images, their seconds and numbers."""

    codes: np.ndarray
    images: Sequence[np.ndarray]
    seconds: Sequence[float]
    numbers: Sequence[int]


class Seen:
    """What a calibration shows of the pixels of the scan: M = N = h w of its `grid`, in 1 or 3 `channels`.

    `white` is the picture of row sums of T, `ambient` (channels, M) the variance of the ambient
    light, which is subtracted from each picture; the camera sees the pixels `seen` (M,), with
    `sharpness` (None: exactly).
    """

    def __init__(self, calibration: Calibration, side: int = 1) -> None:
        self.calibration, self.channels = calibration, len(calibration.offset)
        self.blocks = Blocks(calibration.resampling.grid, side)
        self.grid = self.blocks.grid
        self.seen = self.blocks.sum(calibration.resampling.seen.astype(np.float32)).ravel() > 0
        self.sharpness = calibration.sharpness and calibration.sharpness.of_blocks(side)
        self.white, self._dark = (
            self._on_grid(calibration.white),
            self._on_grid(calibration.ambient),
        )
        self.ambient = np.where(self._dark.variance < UNKNOWN, self._dark.variance, 0.0)

    @classmethod
    def of(cls, store: BlockStore) -> Self:
        """Of a store that `ltcl.acquire` made."""
        setup = Setup.of(store)
        return cls(setup.calibration, setup.blocks.side)

    def noise(self, samples: Callable[[int], Any]) -> dict[str, np.ndarray]:
        """The noise of T for its store, by samples of a channel as `Noise.fit` takes them."""
        white = np.where(self.white.known, self.white.variance, np.inf)
        N, channels = len(self.seen), list(map(samples, range(self.channels)))
        return Noise.fit((N, N), channels, "acquired", white).to_arrays()

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
        self.shots = shots
        self._sensor = CameraModel(calibration.response, calibration.noise, calibration.offset)
        self._pixels = spread(np.unique(calibration.resampling.weights.indices))

    def announce(self, patterns: Iterable[np.ndarray], size: int) -> None:
        """Tell the rig of patterns that come next, in batches of `size`, to be photographed in one go."""
        rest, times = iter(patterns), self.calibration.exposures
        while batch := [self.blocks.enlarged(pattern) for pattern in islice(rest, size)]:
            shots = [(codes, t) for codes in batch for t in times]
            self.shots.prepare([*shots, (anchor.marked(batch), times[0])])

    def take(
        self, patterns: Iterable[np.ndarray], progress: Callable[[int], None]
    ) -> list[Picture]:
        """A picture under each pattern (h, w) of the scan, on where it is not 0; `progress(1)` after each.

        AcquisitionError where photographs deviate from what is known of them.
        """
        patterns, times = list(patterns), self.calibration.exposures
        batch = [self.blocks.enlarged(pattern) for pattern in patterns]
        pictures: list[Picture] = []
        shots: list[_Shot] = []
        for k, codes in enumerate(batch):
            shot = self._photograph(codes, times)
            if self._deviation(shot) is not None:
                suspects = [shot, *(self._photograph(c, times) for c in batch[k + 1 : k + 2])]
                found = [(s.numbers, d) for s in suspects if (d := self._deviation(s)) is not None]
                texts = [
                    deviation.describe(numbers, self.shots.name) for numbers, deviation in found
                ]
                text = self._rearranged(suspects) if len(texts) == 2 else None
                raise AcquisitionError(f"{text or '; '.join(texts)}; {ADVICE}")
            light = self._merge(shot)
            lit, dark = self._on_grid(light), self._dark
            known = (lit.variance < UNKNOWN) & (dark.variance < UNKNOWN)
            value = np.where(known, lit.value - dark.value, np.float32(0.0))
            pictures.append(Picture(value, np.where(known, lit.variance, UNKNOWN)))
            shots.append(shot._replace(images=[anchor.compact(light)]))
            progress(1)
        self._check_patterns(patterns, pictures, shots)
        blocks = self._photograph(anchor.marked(batch), times[:1])
        self._check_anchor(blocks, shots)
        return pictures

    def _photograph(self, codes: np.ndarray, seconds: tuple[float, ...]) -> _Shot:
        images = [self.shots.photograph(codes, t) for t in seconds]
        end = self.shots.number + 1
        return _Shot(codes, images, seconds, range(end - len(images), end))

    def _merge(self, shot: _Shot) -> Radiance:
        (response, noise, offset), exposed = self._sensor, (shot.images, shot.seconds)
        with acquisition_error(f"photographs {shot.numbers[0]} to {shot.numbers[-1]}"):
            return merge(*exposed, response, noise, levels=noise.levels or None, black=offset)

    def _deviation(self, shot: _Shot) -> Deviation | None:
        """Which exposures of a pattern deviate, at pixels that see the projector or where it is lit."""
        lit = np.flatnonzero(shot.codes if shot.codes.ndim == 2 else shot.codes.any(axis=2))
        of_lit = np.unique(self.calibration.resampling.weights[lit].indices)
        for pixels in (self._pixels, spread(of_lit)) if len(shot.images) > 1 else ():
            samples = [sample(image, pixels) for image in shot.images]
            if deviation := find_deviation(samples, shot.seconds, self._sensor):
                return deviation
        return None

    def _rearranged(self, shots: Sequence[_Shot]) -> str | None:
        """Which photographs are exchanged, or which is missing, if that makes all of two patterns agree."""
        images = [image for shot in shots for image in shot.images]
        names = [self.shots.name(n) for shot in shots for n in shot.numbers]

        def agree(order: Sequence[int | None]) -> bool:
            """Whether photographs agree in another order; None: there is none."""
            rest = iter(order)
            for shot in shots:
                pairs = [(images[k], t) for t in shot.seconds if (k := next(rest)) is not None]
                exposed, seconds = zip(*pairs, strict=True)
                if self._deviation(shot._replace(images=exposed, seconds=seconds)):
                    return False
            return True

        every = list(range(len(images)))
        missing = [
            names[k] for k in every[: len(every) // 2] if agree([*every[:k], None, *every[k:-1]])
        ]
        if missing:
            return f"{' or '.join(missing)} is missing, and the next ones have moved up by one"
        orders = (
            (a, b, [{a: b, b: a}.get(k, k) for k in every]) for a, b in combinations(every, 2)
        )
        pairs = [f"{names[a]} and {names[b]}" for a, b, order in orders if agree(order)]
        return f"{', or '.join(pairs[:2])} are exchanged" if pairs else None

    def _check_patterns(
        self, patterns: Sequence[np.ndarray], pictures: Sequence[Picture], shots: Sequence[_Shot]
    ) -> None:
        """Raise AcquisitionError about a picture a that shows the pattern of another one of its batch, b.

        Relative to white, it is four times as bright where b alone is lit as where a alone is,
        beyond the noise. As it may show a mirror, b must show another pattern too, or the same
        light as a.
        """
        w, noise = np.sum(self.white, axis=1)
        clear = w > _CLEAR * np.sqrt(noise)
        value, variance = np.moveaxis(np.sum(pictures, axis=2)[..., clear], 1, 0)
        value, variance = value / w[clear], variance / w[clear] ** 2
        lit = np.stack(patterns).reshape(len(patterns), -1)[:, clear] > 0
        known = variance < _CERTAIN**2
        masks = np.stack([known & ~lit, known & lit]).astype(np.float64)
        others = np.stack([lit.T, ~lit.T]).astype(np.float64)
        count = masks @ others  # (2, a, b): pixels of b alone, of a alone
        pixels = np.maximum(count, 1.0)
        of_b, of_a = (masks * value) @ others / pixels
        noise = np.sum((masks * variance) @ others / pixels**2, axis=0)
        shows = (
            (count > 0).all(axis=0)
            & (of_b > _RATIO * of_a)
            & (of_b - of_a > _SIGMAS * np.sqrt(noise))
        )
        for a, b in np.argwhere(shows):
            both = known[a] & known[b]
            z2 = (value[a] - value[b]) ** 2 / (variance[a] + variance[b] + (_MODEL * value[b]) ** 2)
            if shows[b].any() or (both.any() and np.mean(z2[both]) < _SAME):
                first, other = (" or ".join(map(self.shots.name, shots[k].numbers)) for k in (a, b))
                raise AcquisitionError(f"{first} shows the pattern of {other}; {ADVICE}")

    def _check_anchor(self, blocks: _Shot, shots: Sequence[_Shot]) -> None:
        """Raise AcquisitionError if the pattern of blocks is not what it was in the calibration.

        It names the photographs of the batch (with `anchor.compact` images) that show it first, or
        just not.
        """
        known, (image,), (seconds,) = self.calibration, blocks.images, blocks.seconds
        if known.anchor is None or known.anchor.deviation(image, seconds, self._sensor) is None:
            return
        shots = [*shots, blocks._replace(images=[anchor.compact(self._merge(blocks))])]
        *shifts, moved = (
            anchor.shift_of(
                shot.codes, shot.images[0], known.white, known.ambient, known.resampling
            )
            for shot in shots
        )
        first = anchor.first_moved(shifts, moved)
        start, stop = shots[max(first - 1, 0)].numbers[0], shots[first].numbers[-1]
        raise AcquisitionError(
            f"{self.shots.name(blocks.numbers[0])}, of the pattern of blocks, is not what the calibration "
            f"showed: from one of photographs {start} to {stop} on, the camera, the projector, the scene or "
            f"the light changed (moved by {np.hypot(*moved):.2g} camera pixels); {ADVICE}"
        )


class Log:
    """Pictures in the order in which an adaptive scan asks for them, a batch in each block of a store.

    What it asks for next depends on nothing but the pictures before. So a scan that was stopped is
    run again from its start with the pictures of the log, to the bit the same, until it asks for a
    new one. `done` counts those that were asked for.
    """

    def __init__(
        self, store: BlockStore, pictures: Pictures, progress: Callable[[int], None]
    ) -> None:
        self._store, self._pictures, self._progress = store, pictures, progress
        self._batches = self.done = 0

    def announce(self, patterns: Iterable[np.ndarray]) -> None:
        """Tell the rig of the patterns of the next batches that are not in the store."""
        number, size = self._batches, self._store.layout.block_rows
        while self._is_written(number):
            number += 1
        self._pictures.announce(islice(patterns, (number - self._batches) * size, None), size)

    def take(self, patterns: list[np.ndarray]) -> list[Picture]:
        """The pictures of the next batch of patterns, as many as a block has at most."""
        number, self._batches = self._batches, self._batches + 1
        _, pixels = shape = self._store.layout.block_shape(number, "columns")
        if self._is_written(number):
            blocks = [self._store.block(c, number) for c in range(self._pictures.channels)]
            data: Any = [(block.matrix.data, block.variance) for block in blocks]
            value, variance = np.reshape(data, (len(blocks), 2, -1, pixels)).transpose(1, 2, 0, 3)
            if len(value) != len(patterns):
                what = f"{len(value)} pictures in batch {number}; it must have {len(patterns)}"
                raise AcquisitionError(f"{self._store.path} has {what}: it is that of another scan")
            self._count(len(patterns))
            return list(map(Picture, value, variance))
        pictures = self._pictures.take(patterns, self._count)
        places = tuple(np.indices((len(pictures), pixels)).reshape(2, -1))
        for c in range(self._pictures.channels):
            value, variance = np.concatenate(
                [(p.value[c], p.variance[c]) for p in pictures], axis=1
            )
            self._store.write(
                c, number, scipy.sparse.csr_array((value, places), shape=shape), variance
            )
        return pictures

    def _is_written(self, number: int) -> bool:
        return all((c, number) in self._store.written for c in range(self._pictures.channels))

    def _count(self, pictures: int) -> None:
        self.done += pictures
        self._progress(self.done)
