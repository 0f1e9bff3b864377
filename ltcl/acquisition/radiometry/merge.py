# SPDX-License-Identifier: BSD-3-Clause
"""Photographs at several exposures as one picture of radiance, with its variance and valid pixels.

The light f(code) - black = L t + noise of exposure k has the variance V(L t_k) of the noise model,
so

    L        = sum_k w_k t_k light_k / sum_k w_k t_k^2,    w_k = 1 / V(L t_k)
    variance = 1 / sum_k w_k t_k^2

Weights of a noisy value itself would favour samples that came out low. So L is computed twice:
first as the sum of light over the sum of seconds; then with the weights that this L predicts, and
without exposures whose predicted value lies within 2 standard deviations of saturation or of the
lowest code. If all do, those that are not saturated count (known limit: there clipped noise makes
the mean too high by up to 0.4 standard deviations). A pixel is invalid if all its photographs are
saturated or at the lowest code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from ltcl import checks
from ltcl.acquisition.radiometry.exposures import exposure_stack
from ltcl.acquisition.radiometry.noise import NoiseModel, choose_levels
from ltcl.acquisition.radiometry.response import Response
from ltcl.acquisition.radiometry.strips import in_strips
from ltcl.errors import InputError

# Standard deviations: clipping there moves a mean by less than a hundredth of one.
MARGIN = 2.0

# Pixels at once: 64 KiB of float32, which six exposures keep in a cache of 1 MiB.
BLOCK_PIXELS = 1 << 14

# Linear values that weights are tabulated at: photon noise changes by 1 % from 0.02 on.
TABULATED_VALUES = 4096

# Instead of a division by zero.
TINY = np.float32(1e-30)


@dataclass(frozen=True, repr=False, eq=False)
class Radiance:
    """A picture of radiance: linear sensor value per second.

    Parameters
    ----------
    value : (H, W) or (H, W, 3) float32
        Radiance; 0 where not valid.
    variance : float32, same shape
        Variance of the value; infinite where not valid.
    valid : bool, same shape
        Whether a photograph shows the pixel between black and saturation.
    """

    value: np.ndarray
    variance: np.ndarray
    valid: np.ndarray

    @property
    def shape(self) -> tuple[int, ...]:
        """(H, W[, 3])."""
        return self.value.shape

    def rows(self, rows: slice) -> Radiance:
        """The picture in some rows."""
        return Radiance(self.value[rows], self.variance[rows], self.valid[rows])

    def part(self, name: str, rows: slice) -> np.ndarray:
        """Value, variance or valid in some rows."""
        return getattr(self, name)[rows]

    def __repr__(self) -> str:
        return f"Radiance(shape={self.value.shape}, valid={self.valid.mean():.1%})"

    def __sub__(self, other: Radiance) -> Radiance:
        """Difference of two pictures, such as one and its black frame; variances add."""
        valid = self.valid & other.valid
        sum_of_variances = self.variance + other.variance
        value = np.where(valid, self.value - other.value, np.float32(0.0))
        variance = np.where(valid, sum_of_variances, np.float32(np.inf))
        return Radiance(value, variance, valid)


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
    images : sequence of (H, W) or (H, W, 3) arrays
        uint8, uint16, or floats with 1 for the largest code.
    seconds : sequence of float
        Exposures of the images, in any order.
    response : Response, optional
        Response of the camera; None for linear codes.
    noise : NoiseModel, optional
        Noise of the camera; None for `NoiseModel()`.
    levels : int, optional
        Number of codes of the camera (4096 for 12 bits in uint16); None for that of the noise
        model, or all of the type.
    black : float or (channels,), optional
        Linear value without light; None for that of the noise model.

    Returns
    -------
    Radiance

    Raises
    ------
    InputError
        Images have mixed sizes or types, or NaN; seconds, levels or black do not fit; a longer
        exposure is not brighter; the response has three channels, the photographs one.

    Examples
    --------
    >>> light = np.array([[0.2, 2.0, 400.0]])
    >>> merged = merge([np.clip(light * t, 0, 1) for t in (0.1, 1.0)], [0.1, 1.0])
    >>> merged.value.round(4).tolist(), merged.valid.tolist()
    ([[0.20000000298023224, 2.0, 0.0]], [[True, True, False]])
    """
    if response is None:
        response = Response.identity()
    if noise is None:
        noise = NoiseModel()
    stack = exposure_stack(images, seconds, choose_levels(levels, noise))
    pixels, channels = stack.images[0].shape
    if response.channels > channels:
        raise InputError("response has 3 channels, but images are grey; it must have one")
    if black is None:
        black = noise.black
    merger = Merger(
        stack.seconds, response, noise, levels=stack.levels, black=black, channels=channels
    )
    value = np.empty((pixels, channels), np.float32)
    variance = np.empty((pixels, channels), np.float32)
    valid = np.empty((pixels, channels), bool)

    def merge_rows(rows: slice) -> None:
        for c in range(channels):
            codes = np.stack([image[rows, c] for image in stack.images])
            light = merger.linear(codes, c)
            value[rows, c], variance[rows, c], valid[rows, c] = merger.merge(light, c)

    in_strips(pixels, BLOCK_PIXELS, merge_rows)
    shape = stack.shape
    return Radiance(value.reshape(shape), variance.reshape(shape), valid.reshape(shape))


def _channel_offsets(black: Any, channels: int) -> np.ndarray:
    """Linear value without light of each channel, (channels,) float32."""
    offset = checks.finite("black", checks.real("black", black))
    checks.shape("black", offset, (), (channels,))
    return np.broadcast_to(offset, (channels,)).astype(np.float32)


class Merger:
    """Merges linear values of photographs, by the exposures and the camera that took them.

    Parameters
    ----------
    seconds : (K,) float64
        Exposures, ascending.
    response, noise, black : Response, NoiseModel, float or (channels,)
        As in `merge`.
    levels : int
        Number of codes of the camera, 0 if it is not known.
    channels : int
        Channels of a photograph.
    """

    def __init__(
        self,
        seconds: np.ndarray,
        response: Response,
        noise: NoiseModel,
        *,
        levels: int,
        black: Any,
        channels: int,
    ) -> None:
        self._channels = []
        for c, offset in enumerate(_channel_offsets(black, channels)):
            table = Response(response.values[c % response.channels])
            self._channels.append(ChannelMerger(seconds, levels, table, noise, offset))

    def linear(self, codes: np.ndarray, channel: int) -> np.ndarray:
        """Linear values of codes of a channel, black still in them."""
        return self._channels[channel].linear(codes)

    def merge(self, light: np.ndarray, channel: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Value, variance and validity of linear values (K, pixels) of a channel."""
        return self._channels[channel].merge(light)


class ChannelMerger:
    """Merges blocks of pixels of one channel, arrays (K, pixels) of K exposures, by tables."""

    def __init__(
        self,
        seconds: np.ndarray,
        levels: int,
        response: Response,
        noise: NoiseModel,
        black: np.float32,
    ) -> None:
        self.response = response
        self.black = black
        self.saturation = np.float32(noise.saturation)
        self.t = seconds.astype(np.float32)[:, None]
        codes = np.linspace(0.0, 1.0, max(levels, 2))
        self.linear_of_code = self.response.linear(codes)

        # Above black. The lowest whole code is 0; floats have no end there.
        self.lowest = np.float32(-np.inf)
        if levels:
            self.lowest = self.linear_of_code[0] - black

        # Weights at linear values above black.
        x = np.linspace(0.0, 1.0, TABULATED_VALUES)
        slope = self.response.derivative(self.response.codes(x + black))
        variance = replace(noise, levels=levels).variance(x, slope)
        self.weights = (1.0 / variance).astype(np.float32)

        # Radiance whose noise is clipped at neither end of an exposure.
        deviations = np.sqrt(variance[[0, -1]]).astype(np.float32)
        low_margin, high_margin = MARGIN * deviations
        self.min_clear = (self.lowest + low_margin) / self.t
        self.max_clear = (self.saturation - high_margin - black) / self.t

    def merge(self, light: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Value, variance and validity of some pixels, by linear values with black in them."""
        is_unsaturated = light <= self.saturation
        light = light - self.black
        light *= is_unsaturated

        # First L: the sum of light over the sum of seconds.
        seconds = np.einsum("kn,k->n", is_unsaturated, self.t[:, 0])
        pilot = light.sum(axis=0) / np.maximum(seconds, TINY)

        # Second L: by the weights that the first predicts.
        is_inside = (pilot > self.min_clear) & (pilot < self.max_clear)
        is_clear = is_unsaturated & is_inside
        value, precision = self._weighted_mean(pilot, is_clear, light)

        # Pixels without a clear exposure: those that are not saturated count.
        unclear = np.flatnonzero(precision == 0)
        if len(unclear):
            is_usable = is_unsaturated[:, unclear]
            some_light = light[:, unclear]
            mean, weight = self._weighted_mean(pilot[unclear], is_usable, some_light)
            is_above_black = is_usable & (some_light > self.lowest)
            value[unclear] = mean
            precision[unclear] = weight * is_above_black.any(axis=0)

        valid = precision > 0
        variance = 1.0 / np.maximum(precision, TINY)
        variance[~valid] = np.inf
        return value * valid, variance, valid

    def linear(self, codes: np.ndarray) -> np.ndarray:
        """Linear values, black still in them."""
        if codes.dtype.kind == "f":
            return self.response.linear(codes)
        if codes.dtype == np.uint8 and len(self.linear_of_code) == 256:
            return cv2.LUT(codes, self.linear_of_code)
        return self.linear_of_code.take(codes)

    def _weighted_mean(
        self, pilot: np.ndarray, is_usable: np.ndarray, light: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """L and sum w t^2, by the weights that the pilot predicts."""
        place = self.t * (pilot * np.float32(TABULATED_VALUES - 1))
        index = place.astype(np.int32)
        weight = self.weights.take(index, mode="clip")
        weight *= is_usable
        weight *= self.t
        precision = np.einsum("kn,k->n", weight, self.t[:, 0])
        value = np.einsum("kn,kn->n", weight, light) / np.maximum(precision, TINY)
        return value, precision
