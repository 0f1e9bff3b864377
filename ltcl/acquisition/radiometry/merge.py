# SPDX-License-Identifier: BSD-3-Clause
"""Photographs at several exposures as one picture of radiance, with its variance and what of it is valid.

The light f(code) - black = L t + noise of exposure k has the variance V(L t_k) of the noise model, so

    L = sum_k w_k t_k light_k / sum_k w_k t_k^2,    w_k = 1 / V(L t_k),    variance = 1 / sum_k w_k t_k^2

Weights of a noisy value itself would favour samples that came out low. So L is computed twice: as the sum of
light over the sum of seconds; then with the weights that this L predicts, and without exposures whose
predicted value lies within 2 standard deviations of saturation or of the lowest code. Where all do, those
that are not saturated count (known limit: there clipped noise makes the mean too high by up to 0.4 standard
deviations); a pixel whose photographs are saturated or at the lowest code is invalid.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from ltcl import checks
from ltcl.acquisition.radiometry.camera import NoiseModel, Stack, stack
from ltcl.acquisition.radiometry.response import Response
from ltcl.errors import InputError

_MARGIN = 2.0  # standard deviations: clipping there moves a mean by less than a hundredth of one
_BLOCK = 1 << 15  # pixels at once: 128 KiB of float32, which six exposures keep in a cache of 1 MiB
_VALUES = 4096  # linear values that weights are tabulated at: photon noise changes by 1 % from 0.02 on
_TINY = np.float32(1e-30)  # instead of a division by zero


@dataclass(frozen=True, repr=False, eq=False)
class Radiance:
    """Pictures (H, W) or (H, W, 3): linear sensor value per second, its variance, and where it is valid.

    float32, float32 and bool; where not valid, the value is 0 and the variance infinite.
    """

    value: np.ndarray
    variance: np.ndarray
    valid: np.ndarray

    def __repr__(self) -> str:
        return f"Radiance(shape={self.value.shape}, valid={self.valid.mean():.1%})"

    def __sub__(self, other: Radiance) -> Radiance:
        """Light of one less that of another, as a picture less its black frame; variances add."""
        valid = self.valid & other.valid
        value = np.where(valid, self.value - other.value, np.float32(0.0))
        return Radiance(value, np.where(valid, self.variance + other.variance, np.float32(np.inf)), valid)


def merge(
    images: Sequence[Any],
    seconds: Any,
    response: Response | None = None,
    noise: NoiseModel | None = None,
    *,
    levels: int | None = None,
    black: Any = None,
) -> Radiance:
    """Merge photographs of one scene into radiance, by weights of the noise model.

    `images` (H, W) or (H, W, 3) are uint8, uint16, or floats with 1 for the largest code, in any order of
    their `seconds`. `response` None: linear codes; `levels` (4096 for 12 bits in uint16) None: those of the
    noise model or the type; `black`, a float or one a channel: linear value without light, None for that of
    the noise model. InputError for mixed sizes or types, NaN, other seconds or levels, a longer exposure
    that is not brighter; a response of three channels for grey photographs; a black of another shape.

    >>> light = np.array([[0.2, 2.0, 400.0]])
    >>> merged = merge([np.clip(light * t, 0, 1) for t in (0.1, 1.0)], [0.1, 1.0])
    >>> merged.value.round(4).tolist(), merged.valid.tolist()
    ([[0.20000000298023224, 2.0, 0.0]], [[True, True, False]])
    """
    response, noise = response or Response.identity(), noise or NoiseModel()
    bracket = stack(images, seconds, levels or noise.levels or None)
    pixels, channels = bracket.images[0].shape
    if response.channels > channels:
        raise InputError("response has 3 channels, but images are grey; it must have one")
    offset = checks.finite("black", checks.real("black", noise.black if black is None else black))
    checks.shape("black", offset, (), (channels,))
    offset = np.broadcast_to(offset, (channels,)).astype(np.float32)
    planes = [np.empty((pixels, channels), dtype) for dtype in (np.float32, np.float32, bool)]
    mergers = [_Channel(bracket, response, noise, level, c) for c, level in enumerate(offset)]

    def run(block: tuple[int, int]) -> None:
        rows, c = slice(block[0], block[0] + _BLOCK), block[1]
        for plane, values in zip(planes, mergers[c](rows), strict=True):
            plane[rows, c] = values

    blocks = [(start, c) for start in range(0, pixels, _BLOCK) for c in range(channels)]
    if len(blocks) == 1:  # a thread takes longer to start than a small picture to merge
        run(blocks[0])
    else:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(run, blocks))
    return Radiance(*(plane.reshape(bracket.shape) for plane in planes))


class _Channel:
    """Merges blocks of pixels of one channel, arrays (pixels,), by tables that are made once."""

    def __init__(
        self, bracket: Stack, response: Response, noise: NoiseModel, black: np.float32, c: int
    ) -> None:
        self.response = Response(response.values[c % response.channels])
        self.black, self.saturation = black, np.float32(noise.saturation)
        self.images = [image[:, c] for image in bracket.images]
        self.t = [np.float32(t) for t in bracket.seconds]
        self.table = self.response.linear(np.linspace(0.0, 1.0, max(bracket.levels, 2)))
        # Of whole codes the lowest is 0; floats have no end there.
        self.lowest = self.table[0] if bracket.levels else np.float32(-np.inf)
        x = np.linspace(0.0, 1.0, _VALUES)
        slope = self.response.derivative(self.response.codes(x + black))
        variance = replace(noise, levels=bracket.levels).variance(x, slope)
        self.weights = (1.0 / variance).astype(np.float32)  # of the value x above black
        low, high = _MARGIN * np.sqrt(variance[[0, -1]]).astype(np.float32)
        # Values above black whose noise is clipped at neither end.
        self.clear = self.lowest + low - black, self.saturation - high - black

    def __call__(self, pixels: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Value, variance and validity of some pixels."""
        light = [self._linear(image[pixels]) for image in self.images]
        unsaturated = [value <= self.saturation for value in light]
        dark = [value <= self.lowest for value in light]
        light = [(value - self.black) * usable for value, usable in zip(light, unsaturated, strict=True)]
        time = sum(s * t for s, t in zip(unsaturated, self.t, strict=True))
        pilot = sum(light) / np.maximum(time, _TINY)
        low, high = self.clear
        clear = [s & (pilot > low / t) & (pilot < high / t) for s, t in zip(unsaturated, self.t, strict=True)]
        L, precision = self._mean(pilot, clear, light)
        valid = precision > 0
        rest = np.flatnonzero(~valid)
        if len(rest):
            unclear = [[array[rest] for array in arrays] for arrays in (unsaturated, light)]
            L[rest], precision[rest] = self._mean(pilot[rest], *unclear)
            valid[rest] = np.any([s[rest] & ~d[rest] for s, d in zip(unsaturated, dark, strict=True)], axis=0)
        variance = np.float32(1.0) / np.maximum(precision, _TINY)
        if not valid.all():
            L[~valid], variance[~valid] = 0.0, np.inf
        return L, variance, valid

    def _linear(self, codes: np.ndarray) -> np.ndarray:
        """Linear values, black still in them."""
        if codes.dtype.kind == "f":
            return self.response.linear(codes)
        if codes.dtype == np.uint8 and len(self.table) == 256:
            return cv2.LUT(np.ascontiguousarray(codes), self.table).ravel()
        return self.table.take(codes)

    def _mean(
        self, pilot: np.ndarray, usable: list[np.ndarray], light: list[np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """L and sum w t^2, by the weights that the pilot predicts."""
        total, precision = np.zeros_like(pilot), np.zeros_like(pilot)
        for t, counts, value in zip(self.t, usable, light, strict=True):
            place = (pilot * (t * np.float32(_VALUES - 1))).astype(np.int32)
            weight = self.weights.take(place, mode="clip")
            weight *= counts
            weight *= t
            precision += weight * t
            weight *= value
            total += weight
        return total / np.maximum(precision, _TINY), precision
