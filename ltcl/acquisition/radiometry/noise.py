# SPDX-License-Identifier: BSD-3-Clause
"""Noise and black level of a camera: the model, and its estimates from photographs.

    variance = max(x, 0) / electrons + read^2 + (slope / (levels - 1))^2 / 12

is the sum of photon noise, read noise and rounding; x is the linear sensor value above black, 1 at
full scale; `slope` is linear value per code. Photon transfer (`estimate`): the variance of a pixel
among repeated photographs against their mean is a straight line, fitted with weights 1 /
variance^2, as samples of a variance have them.

Known limit: noise below 0.4 codes does not show in the variance of whole codes, so that `read` is
never below 0.2 codes, and in 8 bits electrons may come out 16 % too many.

Black level (`black_level`): under a black projector pixel p has the linear value b + a_p t_k after
t_k seconds: a level b of its channel, and ambient light a_p. By least squares with weights w_k of
the mean of each photograph

    b = sum_p (Y0 - Y1 S1 / S2) / sum_p (S0 - S1^2 / S2)
    Sn = sum_k w_k t_k^n,    Yn = sum_k w_k t_k^n y_pk
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its subpackage optimize is loaded at the first use

from ltcl import checks
from ltcl.acquisition.radiometry.exposures import (
    MAX_PIXELS,
    MIN_BRIGHTNESS,
    NO_LIGHT,
    check_photographs,
    code_levels,
    exposure_stack,
    normalise_codes,
)
from ltcl.acquisition.radiometry.response import Response
from ltcl.errors import InputError

# Bins of pixels of equal number: the noise of a variance among their mean is 8 times that of all.
BINS = 64

# Reweighted fits: the line stands to 1e-5 after two (measured).
ROUNDS = 5

# Share of a bin's samples at either end of the codes: a variance is then low by 0.4 %.
MAX_CLIPPED_SHARE = 0.002

# More electrons than any pixel holds, for codes without photon noise.
MAX_ELECTRONS = 1e9

# Standard deviations above the line from which the variance of a bin is not noise alone.
OUTLIER_DEVIATIONS = 5.0

# Standard deviation, in codes, that whole codes may hide.
HIDDEN_CODES = 0.2

# Instead of a division by zero.
TINY = 1e-30


@dataclass(frozen=True)
class NoiseModel:
    """Noise of a linear sensor value in [0, 1].

    Parameters
    ----------
    electrons : float
        Electrons at full scale.
    read : float
        Standard deviation without light.
    black : float
        Linear value without light.
    saturation : float
        Largest linear value that is valid.
    levels : int
        Number of codes of the camera; 0 for no rounding.

    Raises
    ------
    InputError
        A value is out of its range.

    Examples
    --------
    >>> round(float(NoiseModel(electrons=10000.0, read=0.003).variance(0.5)) ** 0.5, 5)
    0.00768
    """

    electrons: float = 10000.0
    read: float = 0.002
    black: float = 0.0
    saturation: float = 0.96
    levels: int = 0

    def __post_init__(self) -> None:
        checks.number("electrons", self.electrons, above=0.0)
        checks.number("read", self.read, least=0.0)
        checks.number("black", self.black)
        checks.number("saturation", self.saturation, above=self.black, most=1.0)
        checks.count("levels", self.levels, least=0)

    def variance(self, linear: Any, slope: Any = 1.0) -> np.ndarray:
        """Variance of linear values above black, if the response rises by `slope` a code."""
        step_variance = 0.0
        if self.levels > 1:
            step_variance = 1.0 / (12.0 * (self.levels - 1) ** 2)
        rounding = np.square(slope) * step_variance
        return np.maximum(linear, 0) * (1.0 / self.electrons) + self.read**2 + rounding


def estimate(
    bursts: Sequence[Sequence[Any]], *, response: Response | None = None, levels: int | None = None
) -> NoiseModel:
    """Estimate the noise model of a camera from photographs that were repeated without any change.

    Parameters
    ----------
    bursts : sequence of sequences of (H, W) or (H, W, 3) arrays
        Each burst holds 2 or more photographs, as `merge` takes them, of one scene and exposure;
        all bursts together reach from dark to bright.
    response : Response, optional
        Response of the camera, 0 without light; None for linear codes.
    levels : int, optional
        Number of codes of the camera; None for all of the type.

    Returns
    -------
    NoiseModel

    Raises
    ------
    InputError
        There are no bursts, or a burst has one photograph, mixed shapes, or no pixel between black
        and saturation.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> light = np.linspace(0, 0.9, 10000).reshape(100, 100)
    >>> burst = [
    ...     rng.poisson(light * 5000) / 5000 + rng.normal(0, 0.004, light.shape) for _ in range(8)
    ... ]
    >>> round(estimate([burst]).electrons, -2), round(estimate([burst]).read, 3)
    (5000.0, 0.004)
    """
    checks.count("len(bursts)", len(bursts), least=1)
    statistics = []
    brightest = 0.0
    for number, burst in enumerate(bursts):
        shots = check_photographs(f"bursts[{number}]", burst)
        if len(shots) < 2:
            raise InputError(f"bursts[{number}] holds one photograph; noise needs at least two")
        levels = code_levels(shots, levels)
        codes = normalise_codes(np.stack(shots), levels)
        brightest = max(brightest, float(codes.mean(axis=0).max()))
        statistics.append(_burst_statistics(codes, response))
    bins = _bin_pixels(np.concatenate(statistics, axis=1))
    if len(bins.light) == 0:
        reason = "other exposures are needed"
        if brightest < MIN_BRIGHTNESS:
            reason = NO_LIGHT
        raise InputError(f"bursts have no pixels between black and saturation; {reason}")
    if not levels:
        levels = 0
    return _fit_line(bins, levels)


def choose_levels(levels: int | None, noise: NoiseModel) -> int | None:
    """Number of codes of the camera: `levels`, else that of the noise model, else None."""
    if levels:
        return levels
    if noise.levels:
        return noise.levels
    return None


def _burst_statistics(codes: np.ndarray, response: Response | None) -> np.ndarray:
    """Statistics of each pixel of a burst of codes (K, ...): six rows, (6, pixels) float64.

    Rows: mean and variance of the linear value, squared slope of the response, share of photographs
    at code 0, share above saturation, and degrees of freedom of the variance.
    """
    mean_code = codes.mean(axis=0)
    if response is None:
        linear = codes.astype(np.float64)
        slope = np.ones_like(mean_code)
    else:
        linear = response.linear(codes).astype(np.float64)
        slope = response.derivative(mean_code)
    rows = (
        linear.mean(axis=0),
        linear.var(axis=0, ddof=1),
        np.square(slope),
        (codes == 0).mean(axis=0),
        (linear > NoiseModel.saturation).mean(axis=0),
        np.full(mean_code.shape, len(codes) - 1.0),
    )
    return np.stack([row.ravel() for row in rows])


@dataclass(frozen=True, kw_only=True)
class PhotonTransfer:
    """Variance against light in bins of pixels, arrays (bins,) float64."""

    light: np.ndarray
    variance: np.ndarray
    squared_slope: np.ndarray
    freedom: np.ndarray


def _bin_pixels(statistics: np.ndarray) -> PhotonTransfer:
    """Means of `_burst_statistics` in bins of light, without those at either end of the codes."""
    statistics = statistics[:, np.argsort(statistics[0], kind="stable")]
    pixels = statistics.shape[1]
    starts = np.unique(np.linspace(0, pixels, BINS + 1).astype(int)[:-1])
    weights = statistics[-1]
    freedom = np.add.reduceat(weights, starts)
    sums = np.add.reduceat(statistics[:-1] * weights, starts, axis=1)
    light, variance, squared_slope, black_share, saturated_share = sums / freedom

    # Whole bins are left out, and all beyond: a pixel selected by its own noise would bias the
    # variance.
    is_black = black_share > MAX_CLIPPED_SHARE
    is_saturated = saturated_share > MAX_CLIPPED_SHARE
    is_above_black = np.cumsum(is_black[::-1])[::-1] == 0
    is_below_saturation = np.cumsum(is_saturated) == 0
    is_used = is_above_black & is_below_saturation
    return PhotonTransfer(
        light=light[is_used],
        variance=variance[is_used],
        squared_slope=squared_slope[is_used],
        freedom=freedom[is_used],
    )


def _fit_line(bins: PhotonTransfer, levels: int) -> NoiseModel:
    """Electrons and read noise of the line through variances, by reweighted least squares."""
    rounding = np.zeros_like(bins.light)
    if levels:
        rounding = np.maximum(bins.squared_slope, TINY) / (12.0 * (levels - 1) ** 2)
    light = np.maximum(bins.light, 0.0)
    columns = np.stack([light, np.ones_like(light)], axis=1)
    min_variance = 1e-3 * bins.variance.mean() + TINY
    unrounded = np.maximum(bins.variance - rounding, 0.0)
    outlier_factor = 1.0 + OUTLIER_DEVIATIONS * np.sqrt(2.0 / bins.freedom)

    expected = np.maximum(bins.variance, min_variance)
    gain = 0.0
    floor = 0.0
    for _ in range(ROUNDS):
        # Bins far above the line have edges of a scene that moved: weighted by their own variance
        # they hardly count.
        is_outlier = bins.variance > outlier_factor * expected
        scale = np.where(is_outlier, bins.variance, expected)
        weights = np.sqrt(bins.freedom) / scale
        weighted = columns * weights[:, None]
        line, _ = scipy.optimize.nnls(weighted, unrounded * weights)
        gain, floor = line
        expected = np.maximum(columns @ line + rounding, min_variance)

    hidden = 12.0 * HIDDEN_CODES**2 * float(rounding.min())
    return NoiseModel(
        electrons=float(1.0 / max(gain, 1.0 / MAX_ELECTRONS)),
        read=float(np.sqrt(max(floor, hidden))),
        levels=levels,
    )


def black_level(
    images: Sequence[Any],
    seconds: Any,
    response: Response,
    noise: NoiseModel,
    *,
    levels: int | None = None,
) -> np.ndarray:
    """Linear value of a camera without light: the `black` of `merge`.

    Parameters
    ----------
    images : sequence of (H, W) or (H, W, 3) arrays
        Photographs as in `merge`, under a black projector.
    seconds : sequence of float
        Their exposures, at least two different ones.
    response : Response
        Response of the camera.
    noise : NoiseModel
        Noise of the camera; its `black` is not used.
    levels : int, optional
        Number of codes of the camera; None for that of the noise model, or all of the type.

    Returns
    -------
    (channels,) float64

    Raises
    ------
    InputError
        As in `merge`; also for one exposure only, and if every pixel is saturated in some
        photograph.

    Examples
    --------
    >>> from ltcl.acquisition.radiometry import Response
    >>> shots = [0.01 + t * np.array([[0.0, 0.1, 0.2]]) for t in (0.5, 1.0, 2.0)]
    >>> black_level(shots, [0.5, 1.0, 2.0], Response.identity(), NoiseModel()).round(4)
    array([0.01])
    """
    stack = exposure_stack(images, seconds, choose_levels(levels, noise))
    stack.check_different_exposures(seconds)
    light = response.linear(stack.codes(MAX_PIXELS))
    channels = light.shape[2]
    level = np.empty(channels)
    for c in range(channels):
        is_clear = light[..., c].max(axis=0) <= noise.saturation
        y = light[:, is_clear, c].astype(np.float64)
        if y.shape[1] == 0:
            raise InputError(
                "images are saturated at every pixel; they need shorter exposures or less light"
            )
        level[c] = _intercept(stack.seconds, y, noise)
    return level


def _intercept(t: np.ndarray, y: np.ndarray, noise: NoiseModel) -> float:
    """The common value at 0 seconds of the lines through y (K, pixels) at t (K,)."""
    w = 1.0 / noise.variance(y.mean(axis=1))
    S0 = float(np.sum(w))
    S1 = float(np.sum(w * t))
    S2 = float(np.sum(w * t**2))
    pixels = y.shape[1]
    return np.sum((w - w * t * (S1 / S2)) @ y) / (pixels * (S0 - S1**2 / S2))
