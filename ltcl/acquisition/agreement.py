# SPDX-License-Identifier: BSD-3-Clause
"""Whether photographs show the light that is already known, in units of the noise of the camera.

Of linear values x_k above black after t_k seconds under one pattern, of variance v_k, each photograph is
compared with the radiance L of the others, at pixels where neither is saturated:

    z_k = (x_k - t_k L) / sqrt(v_k + t_k^2 v_L),    L = sum_j x_j t_j / v_j / sum_j t_j^2 / v_j

v is noise, (2 % of x)^2 for inexact exposures and response curves, and (0.1 % of full scale)^2 for the level
of black. A photograph deviates where the mean of min(z^2, 100) is above 2.5, two pixels left out that may be
defects; of fewer than 8 pixels, where it is above 27.5. In the same way a photograph is compared with one
that was taken before (`known`), and sums of patterns and their inverses with each other: all are white.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations, pairwise
from typing import Any, NamedTuple

import numpy as np

from ltcl.acquisition.radiometry import NoiseModel, Radiance, Response
from ltcl.errors import AcquisitionError

_SCALE, _FLOOR = 0.02, 0.001  # systematic errors: of light, of full scale
_CLIP, _DEFECTS, _MEAN = 100.0, 2, 2.5
_SINGLE = 25.0  # z^2 of each of a few pixels, which a single one has by noise once in a million
_RANGE = 0.95  # of saturation; above, pixels may be clipped
_SIGMAS = 5.0  # below saturation, of pixels that must not be saturated
_SUSPECTS = 4  # photographs with the largest scores
_PIXELS = 1 << 13  # of a photograph, at most
ROUGH = NoiseModel(electrons=500.0, read=0.01)
"""Noise of a camera that is not measured yet: more than most have."""
_INVERSES = "a pattern and its inverse must add up to white, as the other ones do"
ADVICE = "photographs must be in the order of the list, exposed as listed, and the set-up must not change"

Name = Callable[[int], str]
name_number: Name = "photograph {}".format


class Sensor(NamedTuple):
    """What is known of a camera: response, noise, linear value without light (a float, or one a channel)."""

    response: Response
    noise: NoiseModel = ROUGH
    offset: Any = 0.0


def find_inverses(
    images: Sequence[np.ndarray], codes: Sequence[np.ndarray], sensor: Sensor
) -> tuple[int, ...] | None:
    """Which photographs of a pattern of 0 and 1 and its inverse do not add up as others do, or None."""
    first = [
        k
        for k, (one, other) in enumerate(pairwise(codes))
        if one.shape == other.shape and np.all(one + other == 1.0) and np.all(one * other == 0.0)
    ]
    if len(first) < 3:
        return None
    light = Light.of(images, sensor)
    sums = light.at(first) + light.at([k + 1 for k in first])
    deviation = _deviation(sums, np.ones(len(first)), len(first))
    if deviation is None:
        return None
    pairs = (deviation.odd if len(deviation.odd) < 3 else ()) or (deviation.last,)
    return tuple(first[k] + i for k in pairs for i in (0, 1))


class Record:
    """Photographs of a calibration, at some pixels, to be compared when its noise is known.

    Examples
    --------
    >>> record, codes = Record(), np.ones((2, 2))
    >>> for number, light in enumerate((0.2, 0.2, 0.5), 1):
    ...     record.add(codes, 1.0, np.full((4, 4), light), number)
    >>> record.check(Sensor(Response.identity()))  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ltcl.errors.AcquisitionError: photograph 3 is too bright nearly everywhere: ...
    """

    def __init__(self) -> None:
        self._codes: list[np.ndarray] = []
        self._seconds: list[float] = []
        self._images: list[np.ndarray] = []
        self._numbers: list[int] = []

    def add(self, codes: np.ndarray, seconds: float, image: np.ndarray, number: int) -> None:
        """One photograph, (H, W) or (H, W, c) in [0, 1]."""
        pixels = spread(image.shape[0] * image.shape[1])
        self._codes.append(codes)
        self._seconds.append(seconds)
        self._images.append(image.reshape(-1, 1, *image.shape[2:])[pixels])
        self._numbers.append(number)

    def check(self, sensor: Sensor, name: Name = name_number) -> None:
        """Refuse photographs of one pattern, or of patterns and their inverses, that deviate from each other.

        Where several do, those that deviate first are named.

        Raises
        ------
        AcquisitionError
            It names the photograph, or the few of which one must be wrong.
        """
        same: dict[bytes, list[int]] = {}
        for k, codes in enumerate(self._codes):
            same.setdefault(codes.tobytes(), []).append(k)
        findings: list[tuple[int, str]] = []
        for group in same.values():
            images, seconds = [self._images[k] for k in group], [self._seconds[k] for k in group]
            deviation = find_deviation(images, seconds, sensor)
            if deviation is not None:
                numbers = [self._numbers[k] for k in group]
                findings.append((numbers[deviation.last], deviation.describe(numbers, name)))
        for seconds in sorted(set(self._seconds)):
            some = [k for k, t in enumerate(self._seconds) if t == seconds]
            images, codes = [self._images[k] for k in some], [self._codes[k] for k in some]
            pair = find_inverses(images, codes, sensor)
            if pair is not None:
                numbers = [self._numbers[some[k]] for k in pair]
                both = " or ".join(map(name, numbers))
                findings.append((numbers[-1], f"{both} deviates: {_INVERSES}"))
        if findings:
            raise AcquisitionError(f"{min(findings)[1]}; {ADVICE}")


class Light(NamedTuple):
    """Linear values above black (k, n, c) of k photographs, their variance, and which are not saturated.

    `limit` (k, 1, c): from there on they are saturated.
    """

    x: np.ndarray
    variance: np.ndarray
    usable: np.ndarray
    limit: np.ndarray

    @classmethod
    def of(cls, images: Sequence[np.ndarray], sensor: Sensor, pixels: np.ndarray | None = None) -> Light:
        """Of photographs (H, W[, c]) at some pixels (n,); by default spread over all."""
        response, noise, offset = sensor
        pixels = spread(images[0].shape[0] * images[0].shape[1]) if pixels is None else pixels
        channels = images[0].shape[2] if images[0].ndim == 3 else 1
        codes = np.stack([np.asarray(image).reshape(-1, channels)[pixels] for image in images])
        curve = codes if channels > 1 else codes[..., 0]
        x = response.linear(curve).reshape(codes.shape) - offset
        variance = noise.variance(x, response.derivative(curve).reshape(codes.shape))
        variance = variance + (_SCALE * x) ** 2 + _FLOOR**2
        limit = np.broadcast_to(_RANGE * (noise.saturation - np.asarray(offset)), (len(x), 1, channels))
        return cls(x, variance, x < limit, limit)

    def at(self, numbers: Sequence[int]) -> Light:
        """Some of the photographs."""
        return Light(*(values[list(numbers)] for values in self))

    def __add__(self, other: Light) -> Light:  # pyright: ignore[reportIncompatibleMethodOverride]
        usable = self.usable & other.usable
        return Light(self.x + other.x, self.variance + other.variance, usable, self.limit + other.limit)

    def with_known(self, known: Radiance, seconds: float, pixels: np.ndarray) -> Light:
        """One more, as a photograph of so many seconds would show what is known."""
        channels = self.x.shape[2]
        value, variance, valid = (
            np.asarray(part).reshape(-1, channels)[pixels]
            for part in (known.value, known.variance, known.valid)
        )
        x = np.where(valid, seconds * value, 0.0)
        variance = np.where(valid, seconds**2 * variance, 0.0) + (_SCALE * x) ** 2 + _FLOOR**2
        more = (x, variance, valid, np.full(self.limit.shape[1:], np.inf))
        return Light(*(np.concatenate([a, b[None]]) for a, b in zip(self, more, strict=True)))

    def expected(
        self, seconds: np.ndarray, use: np.ndarray, k: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What photographs `use` (k,) other than k predict for it, the variance, and where they do."""
        use = use & (np.arange(len(use)) != k)
        t = seconds[use][:, None, None]
        weight = np.where(self.usable[use], t / self.variance[use], 0.0)
        total = np.sum(weight * t, axis=0)
        known = total > 0
        total = np.where(known, total, 1.0)
        return seconds[k] * np.sum(weight * self.x[use], axis=0) / total, seconds[k] ** 2 / total, known

    def scores(self, seconds: np.ndarray, use: np.ndarray) -> np.ndarray:
        """How far each photograph of `use` (k,) is from the others: it deviates above 1; 0 elsewhere."""
        result = np.zeros(len(use))
        for k in np.flatnonzero(use).tolist():
            expected, variance, known = self.expected(seconds, use, k)
            both = known & self.usable[k] & (expected < self.limit[k])
            z2 = np.minimum((self.x[k] - expected)[both] ** 2 / (self.variance[k] + variance)[both], _CLIP)
            dim = expected + _SIGMAS * np.sqrt(variance + self.variance[k]) < self.limit[k]
            saturated = np.count_nonzero(known & ~self.usable[k] & dim)
            count = z2.size + saturated
            if count:
                allowed = _MEAN * count + min(_DEFECTS * _CLIP, _SINGLE * count)
                result[k] = (z2.sum() + _CLIP * saturated) / allowed
        return result

    def agree(self, seconds: np.ndarray, use: np.ndarray) -> bool:
        """Whether photographs `use` (k,) agree."""
        return bool(self.scores(seconds, use).max(initial=0.0) <= 1.0)

    def change(self, seconds: np.ndarray) -> int:
        """The first photograph that, with those before, does not agree."""
        numbers = np.arange(len(seconds))
        return next(
            (k for k in range(1, len(seconds)) if not self.agree(seconds, numbers <= k)), len(seconds) - 1
        )

    def gain(self, seconds: np.ndarray, k: int) -> tuple[float, bool]:
        """How bright photograph k is relative to the others, at bright pixels; and whether nearly all are."""
        expected, _, known = self.expected(seconds, np.ones(len(seconds), bool), k)
        both = known & self.usable[k]
        if not both.any():
            return 1.0, False
        x, expected = self.x[k][both], expected[both]
        bright = expected >= 0.3 * np.quantile(expected, 0.99)
        gain = np.median(x[bright] / np.maximum(expected[bright], 1e-9))
        return float(gain), bool(np.mean(x > expected) > 0.9)


class Deviation(NamedTuple):
    """Photographs `odd` (indices) of one pattern, each of which may be the one that deviates.

    `since`: or all from there on, or None; `gain`: how bright the first is relative to the others, at bright
    pixels; `uniform`: it is brighter nearly everywhere; `exchanged`: they agree when the two are exchanged.
    """

    odd: tuple[int, ...]
    since: int | None = None
    gain: float = 1.0
    uniform: bool = False
    exchanged: bool = False

    @property
    def last(self) -> int:
        """The last photograph that may be the first that deviates."""
        return max([*self.odd, *([] if self.since is None else [self.since])])

    def describe(self, numbers: Sequence[int], name: Name = name_number) -> str:
        """In one line, with the likely cause."""
        names = [name(numbers[k]) for k in self.odd]
        if self.exchanged:
            return f"{names[0]} and {names[1]} are exchanged"
        since = None if self.since is None else f"all of its pattern from {name(numbers[self.since])} on"
        if not names:
            return f"{since} deviate from those before: the camera, the scene or the light changed"
        some = " or ".join(names) if len(names) < 4 else f"one of {names[0]} to {names[-1]}"
        if self.uniform and self.gain > 1.0:
            cause = "is too bright nearly everywhere: another light was on, or the exposure was too long"
        elif abs(self.gain - 1.0) > 3 * _SCALE:
            cause = f"is {self.gain:.2g} times as bright as the others of its pattern"
        else:
            cause = "deviates from the others of its pattern: another pattern, or the camera or scene moved"
        return f"{some} {cause}" + (f"; or {since}" if since else "")


def find_deviation(
    images: Sequence[np.ndarray],
    seconds: Sequence[float],
    sensor: Sensor,
    *,
    known: Radiance | None = None,
    pixels: Sequence[np.ndarray] = (),
) -> Deviation | None:
    """Which photographs of one pattern deviate, if any; `pixels`: sets (n,) of them, each decides alone."""
    if len(images) < 2 and known is None:
        return None
    for places in pixels or [spread(images[0].shape[0] * images[0].shape[1])]:
        t = np.asarray(seconds, np.float64)
        light = Light.of(images, sensor, places)
        if known is not None:
            light, t = light.with_known(known, float(t.min()), places), np.append(t, t.min())
        deviation = _deviation(light, t, len(images))
        if deviation is not None:
            return deviation
    return None


def _deviation(light: Light, t: np.ndarray, count: int) -> Deviation | None:
    """Which of the first `count` photographs deviate; what is known stands behind them."""
    every = np.ones(len(t), bool)
    scores = light.scores(t, every)
    if scores.max(initial=0.0) <= 1.0:
        return None
    suspects = [k for k in np.argsort(-scores).tolist() if k < count][:_SUSPECTS]
    for a, b in combinations(sorted(suspects), 2):
        order = np.arange(len(t))
        order[[a, b]] = b, a
        if t[a] != t[b] and light.agree(t[order], every):
            return Deviation((a, b), exchanged=True)
    odd = [k for k in sorted(suspects) if light.agree(t, every & (np.arange(len(t)) != k))]
    since = light.change(t) if count == len(t) > 2 else None
    if not odd:
        return Deviation((0,) if since is None else (), since)
    gain, uniform = light.gain(t, odd[0])
    return Deviation(tuple(odd), since if since not in odd else None, gain, uniform)


def spread(pixels: int | np.ndarray) -> np.ndarray:
    """At most `_PIXELS` of so many pixels, or of an array of their numbers, evenly."""
    numbers = np.arange(pixels) if isinstance(pixels, int) else pixels
    return numbers[:: -(-max(len(numbers), 1) // _PIXELS)]
