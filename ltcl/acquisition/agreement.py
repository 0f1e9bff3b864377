# SPDX-License-Identifier: BSD-3-Clause
"""Test whether photographs show the light that is already known, in units of the camera's noise.

Linear values x_k above black after t_k seconds under one pattern have variances v_k. Each
photograph is compared with the radiance L of the others, at pixels where neither is saturated:

    z_k = (x_k - t_k L) / sqrt(v_k + t_k^2 v_L),    L = sum_j x_j t_j / v_j / sum_j t_j^2 / v_j

v is the sum of noise, (2 % of x)^2 for inexact exposures and response curves, and for the level
of black (0.1 % of full scale)^2 and (3 electrons)^2: cameras without an offset clip the noise
there, which bends their curves. Where black lies within four deviations of the noise above the
first code, as with a pure power of 2.2, dim pixels have one deviation in common, which is not
averaged.

A photograph deviates if the mean of min(z^2, 100) is above 2.5, two pixels left out that may be
defects; for fewer than 8 pixels, if it is above 27.5. It also deviates if the sum of
t_k L (x_k - t_k L) over pixels exceeds 5 of its standard deviations: an exposure is wrong, and
each pixel alone is dim. A photograph is compared in the same way with an earlier one (`known`),
and sums of patterns and their inverses with each other.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import combinations, pairwise
from typing import Any, NamedTuple

import numpy as np

from ltcl.acquisition.radiometry import NoiseModel, Response
from ltcl.acquisition.rig import shot_key

# Systematic errors, relative to light and to full scale.
SCALE_ERROR = 0.02
BLACK_ERROR = 0.001
# Error of the level of black in electrons, of a camera with at least so many at full scale;
# fewer are measured only where photographs of one pattern differ.
BLACK_ELECTRONS = 3.0
MIN_ELECTRONS = 300.0
# Pixels below this multiple of the error of black have that error in common.
DIM_FACTOR = 3.0
# Noise is clipped where black is less than so many of its standard deviations above the first code.
CLIPPED_SIGMAS = 4.0
# Common error of all pixels, relative to the noise without light.
COMMON_ERROR = 0.2
# Largest z^2 that counts, number of defects that may have it, largest mean z^2 of the others.
MAX_Z2 = 100.0
MAX_DEFECTS = 2
MAX_MEAN_Z2 = 2.5
# z^2 that noise exceeds once in a million; allowed for each of a few pixels.
SINGLE_Z2 = 25.0
# Share of saturation above which pixels may be clipped.
CLIPPING_SHARE = 0.95
# Standard deviations by which pixels that must not be saturated are below saturation.
SATURATION_SIGMAS = 5.0
# Number of photographs with the largest scores that are considered as a cause.
MAX_SUSPECTS = 4
# Largest number of pixels of a photograph that are compared.
MAX_PIXELS = 1 << 13
# Share of the brightest light above which pixels tell the ratio of two photographs.
BRIGHT_SHARE = 0.3

ROUGH_NOISE = NoiseModel(electrons=500.0, read=0.01)
"""Noise of a camera that is not measured yet: more than most have."""
ADVICE = (
    "photographs must be in the order of the list, exposed as listed, "
    "and the set-up must not change"
)

PhotographName = Callable[[int], str]


def name_by_number(number: int) -> str:
    """Name of a photograph in messages: its number."""
    return f"photograph {number}"


@dataclass(frozen=True, kw_only=True)
class CameraModel:
    """Response and noise of a camera, and its linear value without light.

    `offset` is a float, or one for each channel.
    """

    response: Response
    noise: NoiseModel = ROUGH_NOISE
    offset: Any = 0.0

    def clipped_noise(self) -> np.ndarray:
        """Deviation of noise without light where the first code clips it, else 0, (1 or 3,)."""
        deviation = np.sqrt(self.noise.variance(0.0))
        depth = np.asarray(self.offset) - self.response.values[:, 0]
        return np.where(depth < CLIPPED_SIGMAS * deviation, deviation, 0.0)


@dataclass(frozen=True, kw_only=True)
class Deviation:
    """Photographs (indices) one of which deviates, or two exchanged ones; and the likely cause."""

    suspects: tuple[int, ...]
    cause: str
    is_exchange: bool = False

    def describe(self, numbers: Sequence[int], name: PhotographName = name_by_number) -> str:
        """Describe the deviation of photographs with these numbers in one line."""
        names = [name(numbers[k]) for k in self.suspects]
        conjunction = " and " if self.is_exchange else " or "
        return f"{conjunction.join(names)} {self.cause}"


def spread(pixels: int | np.ndarray) -> np.ndarray:
    """Choose at most `MAX_PIXELS` of so many pixels, or of an array of numbers, spread evenly."""
    numbers = np.arange(pixels) if isinstance(pixels, int) else pixels
    step = -(-max(len(numbers), 1) // MAX_PIXELS)
    return numbers[::step]


def sample(image: np.ndarray, pixels: np.ndarray | None = None) -> np.ndarray:
    """A photograph (H, W[, c]) at some pixels, (n, c); by default spread over all."""
    if pixels is None:
        pixels = spread(image.shape[0] * image.shape[1])
    channels = image.shape[2] if image.ndim == 3 else 1
    return image.reshape(-1, channels)[pixels]


def find_deviation(
    samples: Sequence[np.ndarray],
    seconds: Sequence[float],
    camera: CameraModel,
    known: tuple[np.ndarray, np.ndarray] | None = None,
) -> Deviation | None:
    """Find which photographs of one pattern deviate, if any.

    Parameters
    ----------
    samples : sequence of (n, c) arrays
        Codes of each photograph at the same pixels (`sample`).
    seconds : sequence of float
        Their exposures.
    camera : CameraModel
        What is known of the camera.
    known : pair of (n, c) arrays, optional
        Radiance at these pixels, ambient light included, and its variance.
    """
    if known is None:
        light = LinearLight.from_samples(samples, seconds, camera)
    else:
        value, variance = known
        measured = LinearLight.from_samples(samples, seconds, camera, value)
        light = measured.with_known(value, variance)
    return _deviation(light, len(samples))


@dataclass(frozen=True, kw_only=True)
class RecordedPhotograph:
    """Pattern, seconds and number of a photograph, and its image at some pixels.

    `pattern` is the key of its codes, which need not stay in memory, `inverse` that of the inverse
    pattern, if they are 0 and 1, and `uniform` the code if all are the same.
    """

    pattern: str
    inverse: str | None
    uniform: float | None
    seconds: float
    sample: np.ndarray
    number: int


class AgreementRecord:
    """Photographs of a calibration, at some pixels, to be compared when its noise is known."""

    def __init__(self) -> None:
        self._by_pattern: dict[str, list[RecordedPhotograph]] = defaultdict(list)
        self._by_exposure: dict[float, list[RecordedPhotograph]] = defaultdict(list)

    def add(self, codes: np.ndarray, seconds: float, image: np.ndarray, number: int) -> None:
        """Record one photograph, (H, W) or (H, W, c) in [0, 1]."""
        self.add_sample(codes, seconds, sample(image), number)

    def add_sample(
        self, codes: np.ndarray, seconds: float, sample: np.ndarray, number: int
    ) -> None:
        """Record one photograph by its values (n, c) at the pixels of `sample`."""
        is_binary = bool(np.all((codes == 0) | (codes == 1)))
        photograph = RecordedPhotograph(
            pattern=shot_key(codes),
            inverse=shot_key(1.0 - codes) if is_binary else None,
            uniform=float(codes.flat[0]) if codes.min() == codes.max() else None,
            seconds=seconds,
            sample=sample,
            number=number,
        )
        self._by_pattern[photograph.pattern].append(photograph)
        self._by_exposure[seconds].append(photograph)

    def first_finding(
        self, camera: CameraModel, name: PhotographName = name_by_number
    ) -> Finding | None:
        """The first deviation among photographs of a pattern, or of it and its inverse, if any.

        It names the photograph, or the few of which one must be wrong.
        """
        findings = []

        def note(group: list[RecordedPhotograph], deviation: Deviation | None) -> None:
            if deviation is not None:
                numbers = [photograph.number for photograph in group]
                suspects = [numbers[k] for k in deviation.suspects]
                text = deviation.describe(numbers, name)
                findings.append(Finding(tuple(suspects), text, deviation.is_exchange))

        for group in self._by_pattern.values():
            samples = [photograph.sample for photograph in group]
            seconds = [photograph.seconds for photograph in group]
            note(group, find_deviation(samples, seconds, camera))
        for group in self._by_exposure.values():
            note(group, _deviation_of_inverses(group, camera))
        return min(findings, key=lambda finding: max(finding.suspects), default=None)

    @property
    def photographs(self) -> list[RecordedPhotograph]:
        """All photographs, in order."""
        groups = self._by_exposure.values()
        photographs = [photograph for group in groups for photograph in group]
        return sorted(photographs, key=lambda photograph: photograph.number)


class Finding(NamedTuple):
    """Numbers of photographs one of which deviates, or two exchanged ones; and that in words."""

    suspects: tuple[int, ...]
    text: str
    is_exchange: bool


def _deviation_of_inverses(
    group: Sequence[RecordedPhotograph], camera: CameraModel
) -> Deviation | None:
    """Patterns and inverses, at one exposure, that do not add up to the same as the others."""
    first = []
    for k, (photograph, following) in enumerate(pairwise(group)):
        if photograph.inverse == following.pattern:
            first.append(k)
    if len(first) < 3:
        return None
    samples = []
    for k in first:
        samples += [group[k].sample, group[k + 1].sample]
    light = LinearLight.from_samples(samples, np.ones(len(samples)), camera)
    patterns = range(0, len(samples), 2)
    inverses = range(1, len(samples), 2)
    sums = light.select(patterns).plus(light.select(inverses))
    deviation = _deviation(sums, len(first))
    if deviation is None:
        return None
    pairs = deviation.suspects
    if len(pairs) >= 3:
        pairs = pairs[-1:]
    suspects = []
    for pair in pairs:
        suspects += [first[pair], first[pair] + 1]
    return Deviation(
        suspects=tuple(suspects),
        cause="deviates: a pattern and its inverse must add up to white, as the other ones do "
        "(is a dynamic contrast on?)",
    )


@dataclass(frozen=True, kw_only=True)
class _MeanLight:
    """Radiance (n, c) by photographs, its variance, common errors, and where it is known."""

    value: np.ndarray
    variance: np.ndarray
    bias: np.ndarray
    clipping: np.ndarray
    known: np.ndarray


@dataclass(frozen=True, kw_only=True)
class LinearLight:
    """Linear values above black of k photographs at n pixels, with their variance.

    Attributes
    ----------
    seconds : (k, 1, 1)
    value, variance : (k, n, c)
        The value is inf where it is saturated.
    limit : (k, 1, c)
        Value from which on a pixel is saturated.
    bias, dim_bias : (k, 1, c)
        Common error of all pixels, and what dim pixels have of it in addition.
    clipping : (k, n, c)
        Common error of dim pixels whose noise is clipped.
    """

    seconds: np.ndarray
    value: np.ndarray
    variance: np.ndarray
    limit: np.ndarray
    bias: np.ndarray
    dim_bias: np.ndarray
    clipping: np.ndarray

    @classmethod
    def from_samples(
        cls,
        samples: Sequence[np.ndarray],
        seconds: Any,
        camera: CameraModel,
        radiance: np.ndarray | None = None,
    ) -> LinearLight:
        """Linear values of codes, whose noise follows from the radiance (n, c).

        By default it is the mean over all photographs: by its own value each pixel would have the
        less noise the darker it is by chance.
        """
        noise = camera.noise
        codes = np.stack(samples)
        curve = codes if codes.shape[2] > 1 else codes[..., 0]
        value = camera.response.linear(curve).reshape(codes.shape) - camera.offset
        saturation = noise.saturation - np.asarray(camera.offset)
        limit = np.broadcast_to(CLIPPING_SHARE * saturation, (len(value), 1, value.shape[2]))
        t = np.asarray(seconds, np.float64)[:, None, None]
        if radiance is None:
            radiance = _mean_radiance(value, t, value < limit)
        slope = camera.response.derivative(curve).reshape(codes.shape)
        dim_bias = BLACK_ELECTRONS / max(noise.electrons, MIN_ELECTRONS)
        variance = noise.variance(t * radiance, slope)
        variance = variance + (SCALE_ERROR * t * radiance) ** 2 + BLACK_ERROR**2 + dim_bias**2
        bias = COMMON_ERROR * np.sqrt(noise.variance(0.0))
        clipped_noise = camera.clipped_noise()
        is_dim = t * radiance < DIM_FACTOR * clipped_noise
        return cls(
            seconds=t,
            value=np.where(value < limit, value, np.inf),
            variance=variance,
            limit=limit,
            bias=np.full(limit.shape, bias),
            dim_bias=np.full(limit.shape, dim_bias),
            clipping=is_dim * clipped_noise,
        )

    def with_known(self, radiance: np.ndarray, variance: np.ndarray) -> LinearLight:
        """Add a photograph of known light at the shortest exposure."""
        t = self.seconds.min(axis=0, keepdims=True)
        value = t * radiance
        shape = (1, 1, value.shape[2])
        known = LinearLight(
            seconds=t,
            value=value,
            variance=t**2 * variance + (SCALE_ERROR * value) ** 2 + BLACK_ERROR**2,
            limit=np.full(shape, np.inf),
            bias=np.zeros(shape),
            dim_bias=np.zeros(shape),
            clipping=np.zeros(value.shape),
        )
        return LinearLight.joined([self, known])

    @classmethod
    def joined(cls, parts: Sequence[LinearLight]) -> LinearLight:
        """Photographs of several parts, in order."""

        def join(name: str) -> np.ndarray:
            return np.concatenate([getattr(light, name) for light in parts])

        return cls(**{field.name: join(field.name) for field in fields(cls)})

    def select(self, numbers: Sequence[int]) -> LinearLight:
        """Select photographs by their places."""
        chosen = list(numbers)
        return LinearLight(
            seconds=self.seconds[chosen],
            value=self.value[chosen],
            variance=self.variance[chosen],
            limit=self.limit[chosen],
            bias=self.bias[chosen],
            dim_bias=self.dim_bias[chosen],
            clipping=self.clipping[chosen],
        )

    def without(self, k: int) -> LinearLight:
        """Leave one photograph out."""
        return self.select([number for number in range(len(self.value)) if number != k])

    def plus(self, addend: LinearLight) -> LinearLight:
        """Sums of the values of photographs, for the seconds of the first ones."""
        return LinearLight(
            seconds=self.seconds,
            value=self.value + addend.value,
            variance=self.variance + addend.variance,
            limit=self.limit + addend.limit,
            bias=self.bias + addend.bias,
            dim_bias=self.dim_bias + addend.dim_bias,
            clipping=self.clipping + addend.clipping,
        )

    def mean(self) -> _MeanLight:
        """Radiance by all photographs, with weights 1 / variance."""
        usable = np.isfinite(self.value)
        weight = np.where(usable, self.seconds / self.variance, 0.0)
        precision = np.sum(weight * self.seconds, axis=0)
        known = precision > 0
        precision = np.where(known, precision, 1.0)
        light = np.where(usable, self.value, 0.0)
        return _MeanLight(
            value=np.sum(weight * light, axis=0) / precision,
            variance=1.0 / precision,
            bias=np.sum(weight * self.bias, axis=0) / precision,
            clipping=np.sum(weight * self.clipping, axis=0) / precision,
            known=known,
        )

    def scores(self) -> np.ndarray:
        """Distance of each photograph from the others, (k,): it deviates above 1."""
        mean = np.maximum(self.mean().value, 0.0)
        return np.array([self._score(k, mean) for k in range(len(self.value))])

    def _score(self, k: int, mean: np.ndarray) -> float:
        """Distance of one photograph from the others; `mean` is the radiance (n, c) by all."""
        others = self.without(k).mean()
        t = self.seconds[k]
        value = self.value[k]
        expected = t * others.value
        clipping = self.clipping[k] + t * others.clipping
        variance = self.variance[k] + t**2 * others.variance + clipping**2
        z2 = np.minimum((value - expected) ** 2 / variance, MAX_Z2)

        # 1. Each pixel by itself, where the photograph must not be saturated.
        is_saturated = ~np.isfinite(value)
        margin = SATURATION_SIGMAS * np.sqrt(variance)
        lowest = np.where(is_saturated, expected + margin, t * mean)
        compared = others.known & (lowest < self.limit[k])
        count = np.count_nonzero(compared)
        allowed = MAX_MEAN_Z2 * count + min(MAX_DEFECTS * MAX_Z2, SINGLE_Z2 * count)
        by_pixel = z2[compared].sum() / max(allowed, 1.0)

        # 2. All pixels together, weighted with their light; s is the error they have in common.
        near = compared & (z2 < MAX_Z2)
        is_dim = t * mean < DIM_FACTOR * self.dim_bias[k]
        common = self.bias[k] + t * others.bias + self.dim_bias[k] * is_dim
        w = (t * mean)[near]
        d = (value - expected)[near]
        s = common[near]
        spread_of_sum = w**2 @ variance[near] + (SCALE_ERROR * w @ w) ** 2 + (w @ s) ** 2
        together = (w @ d) ** 2 / max(spread_of_sum, 1e-30)
        return max(by_pixel, together / SINGLE_Z2)

    def agrees(self) -> bool:
        """True if no photograph deviates."""
        return bool(self.scores().max(initial=0.0) <= 1.0)

    def likely_cause(self, k: int) -> str:
        """Why photograph k may deviate: its ratio to the others at bright pixels tells."""
        others = self.without(k).mean()
        both = others.known & np.isfinite(self.value[k])
        if both.any():
            value = self.value[k][both]
            expected = (self.seconds[k] * others.value)[both]
            bright = expected >= BRIGHT_SHARE * np.quantile(expected, 0.99)
            gain = float(np.median(value[bright] / np.maximum(expected[bright], 1e-9)))
            if gain > 1.0 and np.mean(value > expected) > 0.9:
                return (
                    "is too bright nearly everywhere: another light was on, "
                    "or the exposure was too long"
                )
            if abs(gain - 1.0) > 3 * SCALE_ERROR:
                return f"is {gain:.2g} times as bright as the others of its pattern"
        return (
            "deviates from the others of its pattern: another pattern, or the camera or scene moved"
        )


def _mean_radiance(value: np.ndarray, seconds: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Mean radiance (n, c) by the usable ones of linear values (k, n, c)."""
    light = np.sum(value * usable, axis=0)
    total_seconds = np.sum(seconds * usable, axis=0)
    return light / np.maximum(total_seconds, 1e-30)


def _deviation(light: LinearLight, count: int) -> Deviation | None:
    """Find which of the first `count` photographs deviate; known light follows them."""
    scores = light.scores()
    if scores.max(initial=0.0) <= 1.0:
        return None
    worst = np.argsort(-scores[:count])[:MAX_SUSPECTS]
    suspects = sorted(worst.tolist())
    exchange = _exchanged_pair(light, suspects)
    if exchange is not None:
        return Deviation(suspects=exchange, cause="are exchanged", is_exchange=True)

    # Photographs without which the others agree.
    single = [k for k in suspects if light.without(k).agrees()]
    total = len(light.value)
    if count < total or count < 3:
        chosen = single if single else [0]
        return Deviation(suspects=tuple(chosen), cause=light.likely_cause(chosen[0]))
    change = _first_change(light)
    if single:
        chosen = sorted({*single, change})
        return Deviation(suspects=tuple(chosen), cause=light.likely_cause(single[0]))
    cause = "and those after it deviate: the camera or scene moved, or the light changed"
    return Deviation(suspects=(change,), cause=cause)


def _exchanged_pair(light: LinearLight, suspects: Sequence[int]) -> tuple[int, int] | None:
    """Two photographs whose exchange makes all agree."""
    for a, b in combinations(suspects, 2):
        if light.seconds[a] == light.seconds[b]:
            continue
        order = np.arange(len(light.value))
        order[[a, b]] = b, a
        if replace(light, seconds=light.seconds[order]).agrees():
            return a, b
    return None


def _first_change(light: LinearLight) -> int:
    """The first photograph that does not agree with those before it, or the last."""
    last = len(light.value) - 1
    for k in range(1, last):
        if not light.select(range(k + 1)).agrees():
            return k
    return last


def standardised(values: np.ndarray) -> np.ndarray:
    """Values (frames, pixels) less their mean over frames, in units of its deviation."""
    centred = values - values.mean(axis=0)
    deviation = centred.std(axis=0)
    return centred / np.where(deviation > 0, deviation, 1.0)
