# SPDX-License-Identifier: BSD-3-Clause
"""Photographs at several exposures as one picture of radiance, with its variance and what of it is valid.

The light f(code) - black = L t + noise of exposure k has the variance V(L t_k) of the noise model,
so

    L = sum_k w_k t_k light_k / sum_k w_k t_k^2,    w_k = 1 / V(L t_k),    variance = 1 / sum_k w_k
    t_k^2

Weights of a noisy value itself would favour samples that came out low. So L is computed twice: as
the sum of light over the sum of seconds; then with the weights that this L predicts, and without
exposures whose predicted value lies within 2 standard deviations of saturation or of the lowest
code. Where all do, those that are not saturated count (known limit: there clipped noise makes the
mean too high by up to 0.4 standard deviations); a pixel whose photographs are saturated or at the
lowest code is invalid.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
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
_BLOCK = 1 << 14  # pixels at once: 64 KiB of float32, which six exposures keep in a cache of 1 MiB
_VALUES = (
    4096  # linear values that weights are tabulated at: photon noise changes by 1 % from 0.02 on
)
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
        return Radiance(
            value, np.where(valid, self.variance + other.variance, np.float32(np.inf)), valid
        )


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

    `images` (H, W) or (H, W, 3) are uint8, uint16, or floats with 1 for the largest code, in any
    order of their `seconds`. `response` None: linear codes; `levels` (4096 for 12 bits in uint16)
    None: those of the noise model or the type; `black`, a float or one a channel: linear value
    without light, None for that of the noise model. InputError for mixed sizes or types, NaN, other
    seconds or levels, a longer exposure that is not brighter; a response of three channels for grey
    photographs; a black of another shape.

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

    def run(rows: slice) -> None:
        for c, merge_channel in enumerate(mergers):
            for plane, values in zip(planes, merge_channel(rows), strict=True):
                plane[rows, c] = values

    in_strips(pixels, _BLOCK, run)
    return Radiance(*(plane.reshape(bracket.shape) for plane in planes))


def in_strips(H: int, rows: int, work: Callable[[slice], None]) -> None:
    """Do `work` on slices of at most `rows` (at least one) of H rows, in parallel."""
    strips = [slice(top, min(top + max(rows, 1), H)) for top in range(0, H, max(rows, 1))]
    if len(strips) == 1:  # a thread takes longer to start than a small picture to merge
        return work(strips[0])
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(work, strips))


class _Channel:
    """Merges blocks of pixels of one channel, arrays (K, pixels) of K exposures, by tables made once."""

    def __init__(
        self, bracket: Stack, response: Response, noise: NoiseModel, black: np.float32, c: int
    ) -> None:
        self.response = Response(response.values[c % response.channels])
        self.black, self.saturation = black, np.float32(noise.saturation)
        self.images = [image[:, c] for image in bracket.images]
        self.t = bracket.seconds.astype(np.float32)[:, None]
        self.table = self.response.linear(np.linspace(0.0, 1.0, max(bracket.levels, 2)))
        # Above black. Of whole codes the lowest is 0; floats have no end there.
        self.lowest = self.table[0] - black if bracket.levels else np.float32(-np.inf)
        x = np.linspace(0.0, 1.0, _VALUES)
        slope = self.response.derivative(self.response.codes(x + black))
        variance = replace(noise, levels=bracket.levels).variance(x, slope)
        self.weights = (1.0 / variance).astype(np.float32)  # of the value x above black
        low, high = _MARGIN * np.sqrt(variance[[0, -1]]).astype(np.float32)
        # Radiance whose noise is clipped at neither end of an exposure.
        self.clear = (self.lowest + low) / self.t, (self.saturation - high - black) / self.t

    def __call__(self, pixels: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Value, variance and validity of some pixels."""
        light = self._linear(np.stack([image[pixels] for image in self.images]))
        unsaturated = light <= self.saturation
        light -= self.black
        light *= unsaturated
        pilot = light.sum(axis=0) / np.maximum(
            np.einsum("kn,k->n", unsaturated, self.t[:, 0]), _TINY
        )
        clear = unsaturated & (pilot > self.clear[0]) & (pilot < self.clear[1])
        L, precision = self._mean(pilot, clear, light)
        rest = np.flatnonzero(precision == 0)
        if len(rest):
            L[rest], precision[rest] = self._mean(pilot[rest], unsaturated[:, rest], light[:, rest])
            precision[rest] *= (unsaturated & (light > self.lowest))[:, rest].any(axis=0)
        valid = precision > 0
        variance = np.where(valid, 1.0 / np.maximum(precision, _TINY), np.float32(np.inf))
        return L * valid, variance, valid

    def _linear(self, codes: np.ndarray) -> np.ndarray:
        """Linear values, black still in them."""
        if codes.dtype.kind == "f":
            return self.response.linear(codes)
        if codes.dtype == np.uint8 and len(self.table) == 256:
            return cv2.LUT(codes, self.table)
        return self.table.take(codes)

    def _mean(
        self, pilot: np.ndarray, usable: np.ndarray, light: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """L and sum w t^2, by the weights that the pilot predicts."""
        place = (self.t * (pilot * np.float32(_VALUES - 1))).astype(np.int32)
        weight = self.weights.take(place, mode="clip")
        weight *= usable
        weight *= self.t
        precision = np.einsum("kn,k->n", weight, self.t[:, 0])
        return np.einsum("kn,kn->n", weight, light) / np.maximum(precision, _TINY), precision
