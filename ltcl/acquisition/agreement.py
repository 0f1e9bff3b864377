# SPDX-License-Identifier: BSD-3-Clause
"""Whether photographs show the light that is already known, in units of the noise of the camera.

Of linear values x_k above black after t_k seconds under one pattern, of variance v_k, each
photograph is compared with the radiance L of the others, at pixels where neither is saturated:

    z_k = (x_k - t_k L) / sqrt(v_k + t_k^2 v_L),    L = sum_j x_j t_j / v_j / sum_j t_j^2 / v_j

v is noise, (2 % of x)^2 for inexact exposures and response curves, and for the level of black (0.1
% of full scale)^2 and (3 electrons)^2: cameras without an offset clip the noise there, which bends
their curves. A photograph deviates where the mean of min(z^2, 100) is above 2.5, two pixels left
out that may be defects; of fewer than 8 pixels, where it is above 27.5. Or where the sum of t_k L
(x_k - t_k L) over pixels exceeds 5 of its standard deviations: an exposure is wrong, and each pixel
alone is dim. In the same way a photograph is compared with an earlier one (`known`), and sums of
patterns and their inverses with each other.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from itertools import combinations, pairwise
from typing import Any, NamedTuple

import numpy as np

from ltcl.acquisition.radiometry import NoiseModel, Response
from ltcl.errors import AcquisitionError

_SCALE, _FLOOR = 0.02, 0.001  # systematic errors: of light, of full scale
_ELECTRONS = (
    3.0  # of light: error of the level of black, of a camera of at least `_LEAST` at full scale
)
_LEAST = 300.0  # fewer are measured only where photographs of one pattern differ
_DIM = 3.0  # times that light: what pixels below have of this error, they have in common
_BIAS = 0.2  # of the noise without light: common error of all pixels there
_CLIP, _DEFECTS, _MEAN = 100.0, 2, 2.5
_SINGLE = 25.0  # z^2 of each of a few pixels, which a single one has by noise once in a million
_RANGE = 0.95  # of saturation; above, pixels may be clipped
_SIGMAS = 5.0  # below saturation, of pixels that must not be saturated
_SUSPECTS = 4  # photographs with the largest scores
_PIXELS = 1 << 13  # of a photograph, at most
ROUGH_NOISE = NoiseModel(electrons=500.0, read=0.01)
"""Noise of a camera that is not measured yet: more than most have."""
ADVICE = "photographs must be in the order of the list, exposed as listed, and the set-up must not change"

Name = Callable[[int], str]
name_number: Name = "photograph {}".format


class CameraModel(NamedTuple):
    """What is known of a camera: response, noise, linear value without light (a float, or one a channel)."""

    response: Response
    noise: NoiseModel = ROUGH_NOISE
    offset: Any = 0.0


class Deviation(NamedTuple):
    """Photographs (indices) of which one deviates, or two that are exchanged; and the likely cause."""

    suspects: tuple[int, ...]
    cause: str
    exchanged: bool = False

    def describe(self, numbers: Sequence[int], name: Name = name_number) -> str:
        """In one line, of photographs with these numbers."""
        names = [name(numbers[k]) for k in self.suspects]
        return f"{(' and ' if self.exchanged else ' or ').join(names)} {self.cause}"


def spread(pixels: int | np.ndarray) -> np.ndarray:
    """At most `_PIXELS` of so many pixels, or of an array of their numbers, evenly."""
    numbers = np.arange(pixels) if isinstance(pixels, int) else pixels
    return numbers[:: -(-max(len(numbers), 1) // _PIXELS)]


def sample(image: np.ndarray, pixels: np.ndarray | None = None) -> np.ndarray:
    """A photograph (H, W[, c]) at some pixels, (n, c); by default spread over all."""
    pixels = spread(image.shape[0] * image.shape[1]) if pixels is None else pixels
    return image.reshape(-1, image.shape[2] if image.ndim == 3 else 1)[pixels]


def find_deviation(
    samples: Sequence[np.ndarray],
    seconds: Sequence[float],
    sensor: CameraModel,
    known: tuple[np.ndarray, np.ndarray] | None = None,
) -> Deviation | None:
    """Which photographs of one pattern deviate, if any; each is its codes at the same pixels (`sample`).

    `known`: radiance (n, c) there, ambient light included, and its variance.
    """
    if known is None:
        return _deviation(_Light.of(samples, seconds, sensor), len(samples))
    return _deviation(
        _Light.of(samples, seconds, sensor, known[0]).with_known(*known), len(samples)
    )


class AgreementRecord:
    """Photographs of a calibration, at some pixels, to be compared when its noise is known."""

    def __init__(self) -> None:
        # Codes, seconds, samples and number of the photographs of one pattern (bytes) and of one
        # exposure.
        self._groups: dict[bytes | float, list[tuple[Any, ...]]] = defaultdict(list)

    def add(self, codes: np.ndarray, seconds: float, image: np.ndarray, number: int) -> None:
        """One photograph, (H, W) or (H, W, c) in [0, 1]."""
        for key in (codes.tobytes(), seconds):
            self._groups[key].append((codes, seconds, sample(image), number))

    def check(self, sensor: CameraModel, name: Name = name_number) -> None:
        """Raise AcquisitionError where photographs of a pattern, or of it and its inverse, deviate.

        It names the photograph, or the few of which one must be wrong; of several, the first.
        """
        findings: list[tuple[int, str]] = []
        for key, group in self._groups.items():
            codes, seconds, samples, numbers = zip(*group, strict=True)
            one_pattern = isinstance(key, bytes)
            deviation = (
                find_deviation(samples, seconds, sensor)
                if one_pattern
                else _in_inverses(codes, samples, sensor)
            )
            if deviation is not None:
                findings.append(
                    (numbers[max(deviation.suspects)], deviation.describe(numbers, name))
                )
        if findings:
            raise AcquisitionError(f"{min(findings)[1]}; {ADVICE}")


def _in_inverses(
    codes: Sequence[np.ndarray], samples: Sequence[np.ndarray], sensor: CameraModel
) -> Deviation | None:
    """Which photographs of a pattern of 0 and 1 and its inverse, at one exposure, do not add up as others."""
    first = [
        k
        for k, (a, b) in enumerate(pairwise(codes))
        if a.shape == b.shape and np.all(a + b == 1.0) and np.all(a * b == 0.0)
    ]
    if len(first) < 3:
        return None
    light = _Light.of(samples, np.ones(len(samples)), sensor)
    deviation = _deviation(light.at(first) + light.at([k + 1 for k in first]), len(first))
    if deviation is None:
        return None
    pairs = deviation.suspects if len(deviation.suspects) < 3 else deviation.suspects[-1:]
    cause = "deviates: a pattern and its inverse must add up to white, as the other ones do"
    return Deviation(tuple(first[k] + i for k in pairs for i in (0, 1)), cause)


class _Light(NamedTuple):
    """Seconds (k, 1, 1) of photographs, linear values x above black (k, n, c) and their variance.

    x is inf from `limit` (k, 1, c) on, where it is saturated; `bias`: common error of all pixels;
    `few`: more of it, of pixels that have hardly more light.
    """

    seconds: np.ndarray
    x: np.ndarray
    variance: np.ndarray
    limit: np.ndarray
    bias: np.ndarray
    few: np.ndarray

    @classmethod
    def of(
        cls, samples: Sequence[np.ndarray], seconds: Any, sensor: CameraModel, L: Any = None
    ) -> _Light:
        """`L`: radiance (n, c), where it is known; that of all photographs determines their noise if not.

        By its own value each pixel would have the less noise the darker it is by chance.
        """
        response, noise, offset = sensor
        codes = np.stack(samples)
        curve = codes if codes.shape[2] > 1 else codes[..., 0]
        x = response.linear(curve).reshape(codes.shape) - offset
        limit = np.broadcast_to(
            _RANGE * (noise.saturation - np.asarray(offset)), (len(x), 1, x.shape[2])
        )
        t = np.asarray(seconds, np.float64)[:, None, None]
        if L is None:
            usable = x < limit
            L = np.sum(x * usable, axis=0) / np.maximum(np.sum(t * usable, axis=0), 1e-30)
        variance = noise.variance(t * L, response.derivative(curve).reshape(codes.shape))
        few = _ELECTRONS / max(noise.electrons, _LEAST)
        variance = variance + (_SCALE * t * L) ** 2 + _FLOOR**2 + few**2
        bias, few = (np.full(limit.shape, b) for b in (_BIAS * np.sqrt(noise.variance(0.0)), few))
        return cls(t, np.where(x < limit, x, np.inf), variance, limit, bias, few)

    def with_known(self, value: np.ndarray, variance: np.ndarray) -> _Light:
        """One more, as the shortest photograph would show what is known."""
        t = self.seconds.min(axis=0, keepdims=True)
        x = t * value
        v = t**2 * variance + (_SCALE * x) ** 2 + _FLOOR**2
        known = t, x, v, np.full((1, 1, x.shape[2]), np.inf), *np.zeros((2, 1, 1, x.shape[2]))
        return _Light(*(np.concatenate(pair) for pair in zip(self, known, strict=True)))

    def at(self, numbers: Sequence[int]) -> _Light:
        return _Light(*(values[list(numbers)] for values in self))

    def without(self, k: int) -> _Light:
        return self.at([other for other in range(len(self.x)) if other != k])

    def __add__(self, other: _Light) -> _Light:  # pyright: ignore[reportIncompatibleMethodOverride]
        return _Light(self.seconds, *(a + b for a, b in zip(self[1:], other[1:], strict=True)))

    def mean(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Radiance (n, c) by all photographs, its variance and bias, and where any shows it."""
        t, x, variance, _, bias, _ = self
        usable = np.isfinite(x)
        weight = np.where(usable, t / variance, 0.0)
        total = np.sum(weight * t, axis=0)
        known = total > 0
        total = np.where(known, total, 1.0)
        L, bias = (
            np.sum(weight * values, axis=0) / total for values in (np.where(usable, x, 0.0), bias)
        )
        return L, 1.0 / total, bias, known

    def scores(self) -> np.ndarray:
        """How far each photograph is from the others: it deviates above 1."""
        result = np.zeros(len(self.x))
        whole = np.maximum(self.mean()[0], 0.0)
        for k, (t, x, v, limit, bias, few) in enumerate(zip(*self, strict=True)):
            L, v_L, bias_L, known = self.without(k).mean()
            variance = v + t**2 * v_L
            z2 = np.minimum((x - t * L) ** 2 / variance, _CLIP)
            least = np.where(np.isfinite(x), t * whole, t * L + _SIGMAS * np.sqrt(variance))
            use = known & (least < limit)
            count = np.count_nonzero(use)
            allowed = _MEAN * count + min(_DEFECTS * _CLIP, _SINGLE * count)
            near = use & (z2 < _CLIP)
            s = bias + t * bias_L + few * (t * whole < _DIM * few)
            w, d, s = ((t * whole)[near], (x - t * L)[near], s[near])
            together = (w @ d) ** 2 / max(
                w**2 @ variance[near] + (_SCALE * w @ w) ** 2 + (w @ s) ** 2, 1e-30
            )
            result[k] = max(z2[use].sum() / max(allowed, 1.0), together / _SINGLE)
        return result

    def agrees(self) -> bool:
        return bool(self.scores().max(initial=0.0) <= 1.0)

    def cause(self, k: int) -> str:
        """Why photograph k may deviate from the others: their ratio at bright pixels tells."""
        L, _, _, known = self.without(k).mean()
        both = known & np.isfinite(self.x[k])
        if both.any():
            x, expected = self.x[k][both], (self.seconds[k] * L)[both]
            bright = expected >= 0.3 * np.quantile(expected, 0.99)
            gain = float(np.median(x[bright] / np.maximum(expected[bright], 1e-9)))
            if gain > 1.0 and np.mean(x > expected) > 0.9:
                return "is too bright nearly everywhere: another light was on, or the exposure was too long"
            if abs(gain - 1.0) > 3 * _SCALE:
                return f"is {gain:.2g} times as bright as the others of its pattern"
        return (
            "deviates from the others of its pattern: another pattern, or the camera or scene moved"
        )


def _deviation(light: _Light, count: int) -> Deviation | None:
    """Which of the first `count` photographs deviate; what is known stands behind them."""
    scores, every = light.scores(), range(len(light.x))
    if scores.max(initial=0.0) <= 1.0:
        return None
    worst = sorted(np.argsort(-scores[:count])[:_SUSPECTS].tolist())
    for a, b in combinations(worst, 2):
        order = [{a: b, b: a}.get(k, k) for k in every]
        if (
            light.seconds[a] != light.seconds[b]
            and light._replace(seconds=light.seconds[order]).agrees()
        ):
            return Deviation((a, b), "are exchanged", exchanged=True)
    alone = [k for k in worst if light.without(k).agrees()]
    if count < len(every) or count < 3:
        return Deviation(tuple(alone or [0]), light.cause((alone or [0])[0]))
    since = next((k for k in every[1:] if not light.at(every[: k + 1]).agrees()), count - 1)
    if alone:
        return Deviation(tuple(sorted({*alone, since})), light.cause(alone[0]))
    return Deviation(
        (since,), "and those after it deviate: the camera or scene moved, or the light changed"
    )
