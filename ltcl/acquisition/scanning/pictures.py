# SPDX-License-Identifier: BSD-3-Clause
"""Pictures of patterns, on or off, on the pixels of the scan: columns of T, or sums of columns.

Every photograph goes the same way: exposures merged to radiance, on the projector's pixels,
averaged over the blocks of the scan, less the ambient light, in units of the light that all
channels of the projector send. Before a batch is kept, its photographs are compared in units of the
noise (`agreement`):

    exposures     of one pattern show the same light
    patterns      no picture of a batch shows the pattern of another
    anchor        after each batch, the pattern of blocks looks as in the calibration

A lamp that fades (`anchor`) is corrected linearly between the ends of two batches.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, islice, product
from typing import Any, NamedTuple

import numpy as np

from ltcl.acquisition import anchor
from ltcl.acquisition.agreement import (
    ADVICE,
    Deviation,
    find_deviation,
    spread,
    standardised,
)
from ltcl.acquisition.calibration import Calibration, Setup
from ltcl.acquisition.geometry.blocks import Blocks
from ltcl.acquisition.radiance import (
    RadiancePicture,
    StoredRadiance,
    planes,
    valid_share,
    values_at,
)
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.scratch import ImageFile, StoredImage, scratch_array
from ltcl.acquisition.session import Photograph, merge_photographs
from ltcl.errors import AcquisitionError
from ltcl.store import BlockStore
from ltcl.transport.noise import Noise

UNKNOWN = np.float32(1e12)
"""The variance of an unknown value."""
KNOWN_VARIANCE = 1e-3 * UNKNOWN
"""The variance from which on a value is unknown."""
# Extra array of a store: the pixels that the projector lights, where those are not all.
LIT = "scanned.lit"
# Attribute of a store: the gain of the lamp at the end of the last batch.
LAMP_GAIN = "lamp_gain"
# Valid share of a projector pixel's camera pixels; less determines nothing.
MIN_VALID_SHARE = 0.5
# Standard deviations by which white must be above 0 for a pixel to count in comparisons.
CLEAR_SIGMAS = 5.0
# Pixels that are compared at most: scans of more light many at once.
MAX_COMPARED_PIXELS = 1 << 18
# Standard deviation, relative to white, of a pixel that counts in comparisons.
MAX_RELATIVE_NOISE = 0.25
# A picture shows the pattern of another if it is so many times as bright there, and brighter by so
# many standard deviations.
PATTERN_RATIO = 4.0
PATTERN_SIGMAS = 6.0
# Pixels that a pattern must light, and leave dark, to be told by its picture; and their share.
TELLING_PIXELS = 16
TELLING_SHARE = 0.25
# Correlation of a picture with its pattern, at least, and by how much that of another is clearer.
LEAST_RESEMBLANCE = 0.2
CLEAR_RESEMBLANCE = 0.2
# Relative systematic error of pictures, and the largest mean z^2 of pictures of the same light.
PICTURE_ERROR = 0.02
MAX_SAME_Z2 = 2.5


class Picture(NamedTuple):
    """Light on M pixels in each channel, and its variance: float32, (channels, M).

    `UNKNOWN` is finite.
    """

    value: np.ndarray
    variance: np.ndarray

    @property
    def known(self) -> np.ndarray:
        """Mask of known values, (channels, M) bool."""
        return self.variance < KNOWN_VARIANCE

    def scaled(self, factor: float) -> Picture:
        """The picture of light that is brighter by a factor."""
        if factor == 1.0:
            return self
        variance = np.where(self.known, self.variance * np.float32(factor**2), self.variance)
        return Picture(value=self.value * np.float32(factor), variance=variance)

    def stored(self) -> Picture:
        """The picture, in temporary files if it is large: a batch has several."""
        arrays = []
        for array in self:
            copy = scratch_array(array.shape, array.dtype)
            copy[:] = array
            arrays.append(copy)
        return Picture(*arrays)


class ScanGrid:
    """The pixels of a scan, with the light that the calibration shows there.

    Attributes
    ----------
    grid : tuple of int
        (h, w), with M = N = h w.
    channels : int
        1 or 3.
    blocks : Blocks
        The pixels as blocks of the projector's.
    white : Picture
        Row sums of T.
    ambient : (channels, M)
        Variance of the ambient light, which is subtracted from each picture.
    seen : (M,) of bool
        Pixels that the camera sees.
    sharpness : Sharpness, optional
        How sharply it sees them; None: exactly.
    lit : (h, w) of bool, optional
        Pixels that the projector lights, if others see only what bounces; None: all.
    """

    def __init__(
        self, calibration: Calibration, side: int = 1, lit: np.ndarray | None = None
    ) -> None:
        self.calibration = calibration
        self.lit = lit
        self.channels = len(calibration.offset)
        self.blocks = Blocks(calibration.resampling.grid, side)
        self.grid = self.blocks.grid
        seen_pixels = calibration.resampling.seen.astype(np.float32)
        self.seen = self.blocks.sum(seen_pixels).ravel() > 0
        self.sharpness = None
        if calibration.sharpness is not None:
            self.sharpness = calibration.sharpness.of_blocks(side)
        self.white = self.picture(calibration.white)
        self.dark = self.picture(calibration.ambient)
        is_known = self.dark.variance < UNKNOWN
        self.ambient = np.where(is_known, self.dark.variance, 0.0)

    @classmethod
    def of(cls, store: BlockStore) -> ScanGrid:
        """The pixels of a scan in a store of `ltcl.acquire`."""
        setup = Setup.of(store)
        lit = None
        if LIT in store.extras:
            lit = store.extra(LIT).astype(bool)
        return cls(setup.calibration, setup.blocks.side, lit)

    def light_of(self, pattern: np.ndarray) -> np.ndarray:
        """The light (h, w) of a pattern: pixels that the projector does not reach stay dark."""
        return pattern if self.lit is None else pattern * self.lit

    def noise(self, entries: Callable[[int], Any]) -> dict[str, np.ndarray]:
        """The noise of T for its store, by entries of each channel as `Noise.fit` takes them."""
        white = np.where(self.white.known, self.white.variance, np.inf)
        pixels = len(self.seen)
        samples = [entries(channel) for channel in range(self.channels)]
        return Noise.fit((pixels, pixels), samples, "acquired", white).to_arrays()

    def picture(self, light: RadiancePicture) -> Picture:
        """Means of a radiance over the blocks of the scan, as far as they are seen and valid."""
        resampling = self.calibration.resampling
        value = np.stack([*map(resampling.apply, planes(light, "value"))], axis=-1)
        variance = np.stack([*map(resampling.variance, planes(light, "variance"))], axis=-1)
        if valid_share(light) == 1.0:
            weight = resampling.seen[..., None]
        else:
            weight = np.stack([*map(resampling.apply, planes(light, "valid"))], axis=-1)

        is_good = np.broadcast_to(weight >= MIN_VALID_SHARE, value.shape)
        share = np.where(is_good, 1.0 / np.maximum(weight, MIN_VALID_SHARE), 0.0)
        light_sums = self._block_sums(value * share)
        variance_sums = self._block_sums(variance * share**2)
        count = self._block_sums(is_good.astype(np.float32))
        pixels = np.maximum(count, 1.0) * self.calibration.light[:, None]
        variance = np.where(count > 0, variance_sums / pixels**2, UNKNOWN)
        return Picture(
            value=(light_sums / pixels).astype(np.float32),
            variance=variance.astype(np.float32),
        )

    def merge(self, photographs: Sequence[Photograph]) -> StoredRadiance:
        """The radiance of a pattern by its photographs, ambient light included."""
        return merge_photographs(photographs, self.calibration.camera, None, ImageFile())

    def without_ambient(self, lit: Picture) -> Picture:
        """A picture less the ambient light, of whose variance each picture has the same part."""
        known = (lit.variance < UNKNOWN) & (self.dark.variance < UNKNOWN)
        return Picture(
            value=np.where(known, lit.value - self.dark.value, np.float32(0.0)),
            variance=np.where(known, lit.variance, UNKNOWN),
        )

    def _block_sums(self, picture: np.ndarray) -> np.ndarray:
        """Sums over the blocks, (channels, M), of a picture (h, w, channels)."""
        sums = np.moveaxis(self.blocks.sum(picture), -1, 0)
        return sums.reshape(self.channels, -1)


@dataclass(frozen=True, kw_only=True)
class _ExposedPattern:
    """The photographs of a pattern: its codes (h, w), and their seconds and numbers."""

    codes: np.ndarray
    images: Sequence[Photograph]
    seconds: Sequence[float]
    numbers: Sequence[int]
    # The radiance, by `anchor.compact`, once it is merged.
    light: StoredImage | None = None


class _OtherPattern(NamedTuple):
    """The first picture of a batch that shows another pattern than its own, and all in words."""

    number: int
    text: str


class ScanCamera(ScanGrid):
    """A rig that was calibrated, as a camera on the pixels of the scan."""

    def __init__(self, shots: Shots, calibration: Calibration, side: int = 1) -> None:
        super().__init__(calibration, side, getattr(shots.rig, "lit", None))
        self.shots = shots
        # Photographs are compared at some of the pixels that see the projector.
        seeing = calibration.resampling.camera_pixels()
        self._pixels = spread(seeing)
        # Ambient light at the pixels of the anchor.
        self._room = np.zeros(0)
        if calibration.anchor is not None:
            self._room = values_at(calibration.ambient, calibration.anchor.pixels, "value")
        # Gain of the lamp since the calibration at the last batch; a store keeps it.
        self.lamp_gain = 1.0
        # Names of the photographs of each pattern of the last batch.
        self.names: list[str] = []

    def announce(self, patterns: Iterable[np.ndarray], size: int) -> None:
        """Announce the patterns that come next to the rig, in batches of `size`."""
        times = self.calibration.exposures
        codes = map(self.blocks.enlarged, patterns)
        while batch := list(islice(codes, size)):
            shots = [*product(batch, times)]
            self.shots.prepare([*shots, (anchor.marked(batch), times[0])])

    def take(
        self, patterns: Iterable[np.ndarray], progress: Callable[[int], None]
    ) -> list[Picture]:
        """Take a picture under each pattern (h, w) of the scan, which is on where it is not 0.

        `progress(1)` is called after each. AcquisitionError if photographs deviate from what is
        known of them.
        """
        patterns = list(patterns)
        batch = [self.blocks.enlarged(pattern) for pattern in patterns]
        times = self.calibration.exposures
        pictures: list[Picture] = []
        exposed: list[_ExposedPattern] = []
        self._compact = ImageFile()
        for k, codes in enumerate(batch):
            photographs = self._photograph(codes, times)
            if self._deviation(photographs) is not None:
                self._refuse(photographs, batch[k + 1 : k + 2])
            light = self.merge(photographs.images)
            pictures.append(self.without_ambient(self.picture(light)).stored())
            stored = anchor.compact(light, self._compact)
            exposed.append(replace(photographs, images=[], light=stored))
            progress(1)
        unlike = self._find_other_pattern(patterns, pictures, exposed)
        blocks = self._photograph(anchor.marked(batch), times[:1])
        if unlike is not None:
            self._refuse_pattern(unlike, blocks, exposed)
        self.names = [self._names(photographs) for photographs in exposed]
        first = self.lamp_gain
        self.lamp_gain = self._check_anchor(blocks, exposed)
        gains = np.linspace(first, self.lamp_gain, len(pictures)).tolist()
        for number, gain in enumerate(gains):
            pictures[number] = pictures[number].scaled(1.0 / gain).stored()
        return pictures

    def _photograph(self, codes: np.ndarray, seconds: Sequence[float]) -> _ExposedPattern:
        # The file of the photographs is removed with the last of them.
        file = ImageFile()
        images = []
        for t in seconds:
            self.shots.expose(codes, t)
            images.append(Photograph.of(self.shots, t, file))
        end = self.shots.number + 1
        numbers = range(end - len(images), end)
        return _ExposedPattern(codes=codes, images=images, seconds=seconds, numbers=numbers)

    def _deviation(self, photographs: _ExposedPattern) -> Deviation | None:
        """Exposures of a pattern that deviate, at pixels that see the projector, or see it lit."""
        if len(photographs.images) < 2:
            return None
        is_lit = photographs.codes.reshape(*self.shots.grid, -1).any(axis=2)
        camera = self.calibration.camera
        seeing_lit = self.calibration.resampling.camera_pixels(np.flatnonzero(is_lit))
        for pixels in (self._pixels, spread(seeing_lit)):
            samples = [photograph.at(pixels) for photograph in photographs.images]
            deviation = find_deviation(samples, photographs.seconds, camera)
            if deviation is not None:
                return deviation
        return None

    def _refuse(self, photographs: _ExposedPattern, following: Sequence[np.ndarray]) -> None:
        """Raise AcquisitionError about a pattern that deviates.

        The pattern after it is photographed too: it tells whether photographs of both are mixed up.
        """
        seconds = photographs.seconds
        suspects = [photographs]
        suspects += [self._photograph(codes, seconds) for codes in following]
        texts = []
        for suspect in suspects:
            deviation = self._deviation(suspect)
            if deviation is not None:
                texts.append(deviation.describe(suspect.numbers, self.shots.name))
        text = "; ".join(texts)
        if len(texts) == 2:
            rearrangement = _Rearrangement(suspects, self._deviation, self.shots.name)
            order = rearrangement.describe()
            if order is not None:
                text = order
        raise AcquisitionError(f"{text}; {ADVICE}")

    def _find_other_pattern(
        self,
        patterns: Sequence[np.ndarray],
        pictures: Sequence[Picture],
        exposed: Sequence[_ExposedPattern],
    ) -> _OtherPattern | None:
        """Find pictures that show another pattern than their own."""
        comparison = _BatchComparison(self.white, patterns, pictures, self.lit)
        unlike = comparison.unlike_their_patterns().tolist()
        if unlike:
            names = " and ".join(self._names(exposed[a]) for a in unlike)
            return _OtherPattern(unlike[0], f"{names}: another pattern than in the list")
        for a, b in comparison.mixed_up():
            first = self._names(exposed[a])
            second = self._names(exposed[b])
            return _OtherPattern(min(a, b), f"{first} shows the pattern of {second}")
        return None

    def _refuse_pattern(
        self,
        unlike: _OtherPattern,
        blocks: _ExposedPattern,
        exposed: Sequence[_ExposedPattern],
    ) -> None:
        """Raise AcquisitionError about pictures of another pattern.

        The camera may have moved instead: then the pattern of blocks is moved, too, as all pictures
        since then are.
        """
        shifts = self._shifts(blocks, exposed)
        if len(shifts) == len(exposed) + 1:
            first = anchor.first_moved(shifts[:-1], shifts[-1])
            if first <= unlike.number and anchor.are_moved_alike(shifts[first:]):
                self._check_anchor(blocks, exposed)
        raise AcquisitionError(f"{unlike.text}; {ADVICE}")

    def _names(self, photographs: _ExposedPattern) -> str:
        return " or ".join(self.shots.name(number) for number in photographs.numbers)

    def _check_anchor(self, blocks: _ExposedPattern, exposed: Sequence[_ExposedPattern]) -> float:
        """Raise AcquisitionError if the pattern of blocks deviates from that of the calibration.

        Returns the gain of the lamp since then.

        It names the photographs of the batch (with `anchor.compact` images) that show it first, or
        just not.
        """
        known = self.calibration
        [image] = blocks.images
        [seconds] = blocks.seconds
        if known.anchor is None:
            return 1.0
        shot = image.at(known.anchor.pixels), seconds, known.camera, self._room
        gain = known.anchor.lamp_gain(*shot)
        if known.anchor.deviation(*shot, gain) is None:
            return gain
        series = [*exposed, blocks]
        shifts = self._shifts(blocks, exposed)
        *earlier, moved = shifts
        first = anchor.first_moved(earlier, moved)
        start = series[max(first - 1, 0)].numbers[0]
        stop = series[first].numbers[-1]
        raise AcquisitionError(
            f"{self.shots.name(blocks.numbers[0])}, of the pattern of blocks, deviates from that "
            f"of the calibration: from one of photographs {start} to {stop} on, the camera, the "
            "projector, the scene or the light changed "
            f"(moved by {np.hypot(*moved):.2g} camera pixels); {ADVICE}"
        )

    def _shifts(
        self, blocks: _ExposedPattern, exposed: Sequence[_ExposedPattern]
    ) -> list[np.ndarray]:
        """Movements of the pictures of a batch, and of the pattern of blocks after it."""
        known = self.calibration
        light = anchor.compact(self.merge(blocks.images), self._compact)
        setup = known.white, known.ambient, known.resampling
        shifts = []
        for photographs in [*exposed, replace(blocks, images=[], light=light)]:
            if photographs.light is not None:
                shifts.append(anchor.shift_of(photographs.codes, photographs.light, *setup))
        return shifts

    def keep_lamp_gain(self, store: BlockStore) -> None:
        """Keep the gain of the lamp in the store of a scan, which may go on from there."""
        if self.lamp_gain != store.attributes.get(LAMP_GAIN, 1.0):
            store.update(**{LAMP_GAIN: self.lamp_gain})


class _Rearrangement:
    """Another order of the photographs of two patterns in which all agree."""

    def __init__(
        self,
        patterns: Sequence[_ExposedPattern],
        deviation: Callable[[_ExposedPattern], Deviation | None],
        name: Callable[[int], str],
    ) -> None:
        self.patterns = patterns
        self.deviation = deviation
        self.images = []
        self.names = []
        for pattern in patterns:
            self.images += pattern.images
            self.names += map(name, pattern.numbers)

    def describe(self) -> str | None:
        """Photographs that are missing or exchanged; None if no such order makes all agree."""
        missing = self._missing()
        if missing:
            return f"{' or '.join(missing)} is missing, and the next ones have moved up by one"
        exchanged = self._exchanged()
        if exchanged:
            return f"{', or '.join(exchanged[:2])} are exchanged"
        return None

    def _missing(self) -> list[str]:
        """Names of photographs of the first pattern that may be missing."""
        count = len(self.images)
        names = []
        for k in range(count // 2):
            order = [*range(k), None, *range(k, count - 1)]
            if self._agrees(order):
                names.append(self.names[k])
        return names

    def _exchanged(self) -> list[str]:
        """Names of pairs that may be exchanged."""
        pairs = []
        for a, b in combinations(range(len(self.images)), 2):
            order: list[int | None] = [*range(len(self.images))]
            order[a] = b
            order[b] = a
            if self._agrees(order):
                pairs.append(f"{self.names[a]} and {self.names[b]}")
        return pairs

    def _agrees(self, order: Sequence[int | None]) -> bool:
        """True if the photographs agree in another order, in which None is a missing one."""
        remaining = iter(order)
        for pattern in self.patterns:
            images = []
            exposures = []
            for seconds in pattern.seconds:
                number = next(remaining)
                if number is not None:
                    images.append(self.images[number])
                    exposures.append(seconds)
            rearranged = replace(pattern, images=images, seconds=exposures)
            if self.deviation(rearranged) is not None:
                return False
        return True


class _BatchComparison:
    """Comparison of the pictures of a batch with the patterns of each other, relative to white."""

    def __init__(
        self,
        white: Picture,
        patterns: Sequence[np.ndarray],
        pictures: Sequence[Picture],
        lit: np.ndarray | None = None,
    ) -> None:
        light = white.value.sum(axis=0)
        is_clear = light > CLEAR_SIGMAS * np.sqrt(white.variance.sum(axis=0))
        if lit is not None:
            is_clear &= lit.ravel()
        chosen = _draw_pixels(np.flatnonzero(is_clear))
        light = light[chosen]
        values = np.stack([picture.value[:, chosen].sum(axis=0) for picture in pictures])
        variances = np.stack([picture.variance[:, chosen].sum(axis=0) for picture in pictures])
        self.value = values / light
        self.variance = variances / light**2
        self.known = self.variance < MAX_RELATIVE_NOISE**2
        self.lit = np.stack([pattern.ravel()[chosen] > 0 for pattern in patterns])

    def unlike_their_patterns(self) -> np.ndarray:
        """Numbers of pictures that resemble their own pattern hardly, or another one far more.

        By correlation over pixels, with direct light, of pictures relative to white. Only patterns
        that light many pixels, and leave as many dark, tell.
        """
        patterns = self.lit.astype(np.float64)
        pixels = patterns.shape[1]
        share = patterns.mean(axis=1) if pixels else np.zeros(len(patterns))
        tells = np.minimum(share, 1.0 - share) * pixels >= TELLING_PIXELS
        tells &= np.minimum(share, 1.0 - share) >= TELLING_SHARE
        tells &= self.known.all(axis=1)
        numbers = np.flatnonzero(tells)
        if not len(numbers):
            return numbers
        seen = standardised(self.value[numbers].T).T
        shown = standardised(patterns[numbers].T).T
        resemblance = seen @ shown.T / pixels
        own = np.diagonal(resemblance)
        best = resemblance.max(axis=1)
        return numbers[(own < LEAST_RESEMBLANCE) | (best > own + CLEAR_RESEMBLANCE)]

    def mixed_up(self) -> Iterator[tuple[int, int]]:
        """Pairs a, b of pictures of which a shows the pattern of b.

        As a may show a mirror, b must show another pattern too, or the same light as a.
        """
        shows = self._shown_patterns()
        for a, b in np.argwhere(shows).tolist():
            if shows[b].any() or self._shows_same_light(a, b):
                yield a, b

    def _shown_patterns(self) -> np.ndarray:
        """Matrix (a, b) that is True if picture a shows the pattern of b.

        Relative to white, it is four times as bright where b alone is lit as where a alone is,
        beyond the noise.
        """
        dark = self.known & ~self.lit
        lit = self.known & self.lit
        where_b, count_b, noise_b = self._means(dark, self.lit)
        where_a, count_a, noise_a = self._means(lit, ~self.lit)
        has_pixels = (count_a > 0) & (count_b > 0)
        is_brighter = where_b > PATTERN_RATIO * where_a
        noise = np.sqrt(noise_a + noise_b)
        is_certain = where_b - where_a > PATTERN_SIGMAS * noise
        return has_pixels & is_brighter & is_certain

    def _means(self, mask: np.ndarray, region: np.ndarray) -> tuple[np.ndarray, ...]:
        """Mean of picture a over pixels in its mask and in the region of b, (a, b).

        With the number of these pixels and the variance of the mean.
        """
        weight = mask.astype(np.float64)
        pixels = region.T.astype(np.float64)
        count = weight @ pixels
        total = np.maximum(count, 1.0)
        mean = (weight * self.value) @ pixels / total
        variance = (weight * self.variance) @ pixels / total**2
        return mean, count, variance

    def _shows_same_light(self, a: int, b: int) -> bool:
        """True if two pictures agree within their noise."""
        both = self.known[a] & self.known[b]
        if not both.any():
            return False
        systematic = (PICTURE_ERROR * self.value[b]) ** 2
        variance = self.variance[a] + self.variance[b] + systematic
        z2 = (self.value[a] - self.value[b]) ** 2 / variance
        return bool(np.mean(z2[both]) < MAX_SAME_Z2)


def _draw_pixels(pixels: np.ndarray) -> np.ndarray:
    """Draw at most `MAX_COMPARED_PIXELS` pixels: at random, as patterns repeat at even steps."""
    if len(pixels) <= MAX_COMPARED_PIXELS:
        return pixels
    random = np.random.default_rng(0)
    return np.sort(random.choice(pixels, MAX_COMPARED_PIXELS, replace=False))
