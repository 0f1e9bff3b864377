# SPDX-License-Identifier: BSD-3-Clause
"""Photographs at several exposures as one picture of radiance, with its variance and what of it is valid.

The light f(code) - black = L t + noise of exposure k has a variance V(L t_k) that the noise model tells, so

    L = sum_k w_k t_k light_k / sum_k w_k t_k^2,    w_k = 1 / V(L t_k),    variance = 1 / sum_k w_k t_k^2

Weights of a noisy value itself would favour samples that came out low. So L is found twice: as the sum of
light over the sum of seconds, which is best where photons make the noise; then with the weights that this L
predicts, and without exposures whose predicted value lies within 2 standard deviations of saturation or of
the lowest code. An exposure left out by the merged value, not by its own, leaves no bias: L of fewer
exposures less the best L of all does not depend on the latter.

Where no exposure is clear of both ends, all that are not saturated count; there the camera has clipped the
noise itself, and without light the mean is too high by up to 0.4 standard deviations of the longest exposure
(a black offset of twice the read noise prevents it). A pixel is invalid, value 0 and variance infinite, where
every photograph that is not saturated has the lowest code. Radiance is never clipped: without light it
scatters about 0.
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
from ltcl.acquisition.radiometry.noise import NoiseModel
from ltcl.acquisition.radiometry.response import Response
from ltcl.acquisition.radiometry.stack import Stack, stack
from ltcl.errors import InputError

_MARGIN = 2.0  # standard deviations: clipping there moves a mean by less than a hundredth of one
_BLOCK = 1 << 15  # pixels at once: enough to hide the calls, few enough for the cache
_VALUES = 4096  # linear values that weights are tabulated at
_TINY = np.float32(1e-30)


@dataclass(frozen=True, repr=False, eq=False)
class Radiance:
    """Pictures (H, W) or (H, W, 3), as the photographs.

    Attributes
    ----------
    value : array
        float32, linear sensor value per second; 0 where invalid.
    variance : array
        float32, of value; infinite where invalid.
    valid : array
        bool.
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

    Parameters
    ----------
    images : sequence of (H, W) or (H, W, 3)
        One or more: uint8, uint16, or floats with 1 for the largest code; floats above it are saturated.
    seconds : (K,)
        Of each photograph, in any order; repeated exposures are averaged.
    response : Response, optional
        From codes to light; None for linear codes.
    noise : NoiseModel, optional
        None for one of 10000 electrons, a read noise of 0.002, and no black.
    levels : int, optional
        Codes of the camera, 4096 for 12 bits in uint16. None: the noise model's, or those of the type.
    black : float, (channels,), (H, W) or (H, W, 3), optional
        Linear value without light; None takes that of the noise model.

    Returns
    -------
    Radiance

    Raises
    ------
    InputError
        What `stack` refuses: mixed sizes or types, NaN, seconds that do not fit, a longer exposure that is
        not brighter; a response of three channels for grey photographs; a black of another shape.

    Examples
    --------
    >>> light = np.array([[0.2, 0.02], [2.0, 400.0]])
    >>> shots = [np.clip(light * t, 0, 1) for t in (0.1, 1.0)]
    >>> merged = merge(shots, [0.1, 1.0])
    >>> merged.value.round(4)
    array([[0.2 , 0.02],
           [2.  , 0.  ]], dtype=float32)
    >>> merged.valid
    array([[ True,  True],
           [ True, False]])
    """
    response, noise = response or Response.identity(), noise or NoiseModel()
    bracket = stack(images, seconds, levels or noise.levels or None)
    if response.channels == 3 and bracket.channels == 1:
        raise InputError("response has 3 channels, but images are grey; it must have one")
    offset = _black(black, noise, bracket)
    channels = [_Channel(bracket, response, noise, offset, c) for c in range(bracket.channels)]
    shape = bracket.images[0].shape
    out = Radiance(np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, bool))
    flat = [part.reshape(bracket.pixels, -1) for part in (out.value, out.variance, out.valid)]

    def run(place: tuple[int, int]) -> None:
        part, c = slice(place[0], place[0] + _BLOCK), place[1]
        for whole, found in zip(flat, channels[c](part), strict=True):
            whole[part, c] = found

    blocks = [(start, c) for start in range(0, bracket.pixels, _BLOCK) for c in range(bracket.channels)]
    if len(blocks) == 1:  # a thread takes longer to start than a small picture to merge
        run(blocks[0])
        return out
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(run, blocks))
    return out


def _black(black: Any, noise: NoiseModel, bracket: Stack) -> np.ndarray:
    """(1 or pixels, 1 or channels), float32."""
    value = checks.finite("black", checks.real("black", noise.black if black is None else black))
    shape, channels = bracket.images[0].shape, bracket.channels
    if value.ndim >= 2:
        checks.shape("black", value, shape, shape[:2])
        return value.reshape(bracket.pixels, -1).astype(np.float32)
    checks.shape("black", value, (), (channels,))
    return np.broadcast_to(value, (channels,))[None].astype(np.float32)


class _Channel:
    """Merges blocks of pixels of one channel. Arrays are (pixels,); tables are made once."""

    def __init__(
        self, bracket: Stack, response: Response, noise: NoiseModel, black: np.ndarray, c: int
    ) -> None:
        one = Response(response.values[c % response.channels])
        self.noise, self.black = noise, black[:, c % black.shape[1]]
        self.images = [image.reshape(bracket.pixels, -1)[:, c] for image in bracket.images]
        self.t = [np.float32(t) for t in bracket.seconds]
        self.response = one
        self.table = one.tables(bracket.levels)[0] if self.images[0].dtype.kind == "u" else None
        # Of whole codes the lowest is 0; floats have no end there.
        self.lowest = float(one.linear(np.zeros(1))[0]) if bracket.levels else -np.inf
        x = np.linspace(0.0, 1.0, _VALUES)
        variance = replace(noise, levels=bracket.levels).variance(
            x, one.derivative(one.codes(x + black.mean()))
        )
        self.weights = (1.0 / variance).astype(np.float32)  # of the value x above black
        self.margin = _MARGIN * np.sqrt(variance[[0, -1]])  # at both ends

    def __call__(self, part: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Value, variance and validity of some pixels."""
        black = self.black if len(self.black) == 1 else self.black[part]
        light = [self._linear(image[part]) for image in self.images]
        seen = [value <= np.float32(self.noise.saturation) for value in light]
        dim = [value <= np.float32(self.lowest) for value in light]
        light = [(value - black) * usable for value, usable in zip(light, seen, strict=True)]
        pilot = sum(light) / np.maximum(sum(s * t for s, t in zip(seen, self.t, strict=True)), _TINY)
        low, high = self.lowest + self.margin[0] - black, self.noise.saturation - self.margin[1] - black
        clear = [s & (pilot > low / t) & (pilot < high / t) for s, t in zip(seen, self.t, strict=True)]
        L, precision = self._mean(pilot, clear, light)
        valid = precision > 0
        rest = np.flatnonzero(~valid)
        if len(rest):
            unclear = [[array[rest] for array in arrays] for arrays in (seen, light)]
            L[rest], precision[rest] = self._mean(pilot[rest], *unclear)
            valid[rest] = np.any([u[rest] & ~d[rest] for u, d in zip(seen, dim, strict=True)], axis=0)
        return self._result(L, precision, valid)

    def _linear(self, codes: np.ndarray) -> np.ndarray:
        """Linear values, black still in them."""
        if self.table is None:
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

    @staticmethod
    def _result(
        L: np.ndarray, precision: np.ndarray, valid: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        variance = np.float32(1.0) / np.maximum(precision, _TINY)
        if not valid.all():
            L[~valid], variance[~valid] = 0.0, np.inf
        return L, variance, valid
