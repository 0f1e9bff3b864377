# SPDX-License-Identifier: BSD-3-Clause
"""The response of a camera, estimated from photographs of one scene at several exposures.

A pixel p of radiance L_p, photographed for t_k seconds, has the code c_pk with f(c_pk) = L_p t_k
plus noise. f is a monotone cubic spline, 0 without light and 1 at the largest code; f and all L_p
minimise

    sum_pk w_pk (f(c_pk) - L_p t_k)^2,    w_pk = 1 / variance(L_p t_k)

L_p is eliminated, which leaves a quadratic form in the coefficients of f. After the first round it
is linearised about the codes c' that f and L_p predict, f(c) = f(c') + f'(c') (c - c')
(Gauss-Newton), so that noise of the codes does not flatten the curve. Exposures whose prediction
lies within the noise of saturation do not count. Those near black do: noise that is clipped there
bends the curve by less than one standard deviation, but without them its dark end is a guess.
Objects that moved are weighted down by Tukey's biweight. Known limit: exposures in equal ratios do
not separate f from f times a wobble of that period in log f; ratios of 2, 3, 2, 3 are better than
4, 4, 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.sparse
from scipy.interpolate import BSpline

from ltcl import checks
from ltcl.acquisition.radiometry.exposures import (
    MIN_BRIGHTNESS,
    NO_LIGHT,
    exposure_stack,
)
from ltcl.acquisition.radiometry.noise import NoiseModel
from ltcl.acquisition.radiometry.response import Response, interpolate
from ltcl.errors import InputError

# Values of a table of the result.
TABLE_SIZE = 4097

# Instead of a division by zero.
TINY = 1e-300


@dataclass(frozen=True)
class FitSettings:
    """Settings of the fit.

    In brackets: the error of an sRGB camera's curve, from 0.02 to 0.9 of full scale, measured.

    Attributes
    ----------
    candidates : int
        Pixels of the photographs, spread evenly, of which samples are drawn.
    samples : int
        Pixels of a channel (1024: 0.14 %, 4096: 0.08 %), unless `calibrate` is told.
    min_pixels : int
        Pixels between black and saturation at two exposures, at least two for an unknown.
    brightness_bins : int
        Bins of brightness, which have equal shares of the samples (16 to 128: 0.09 %).
    rounds : int
        Reweighted fits (5: 0.09 %, 8 to 20: 0.08 %).
    smoothness : float
        Weight of a relative change of slope by 1, in units of noise (30: 0.11 %, 1000: 0.07 %).
    margin : float
        Standard deviations that a prediction keeps from saturation (1: 0.08 %, 4: 0.09 %).
    tukey : float
        Standard deviations from which a residual does not count (3: 0.17 %, 8: 0.07 %).
    noise_bins : int
        Bins of light, in which the size of residuals gives the noise.
    grid_size : int
        Codes to linearise about, and of the table that inverts the curve: 1/8 code of 8 bits.
    """

    candidates: int = 1 << 18
    samples: int = 4096
    min_pixels: int = 50
    brightness_bins: int = 64
    rounds: int = 8
    smoothness: float = 300.0
    margin: float = 2.5
    tukey: float = 5.0
    noise_bins: int = 16
    grid_size: int = 2049


SETTINGS = FitSettings()

# The spline fits the curves of sRGB and of film to 4e-5 with cubics in 24 intervals.
SPLINE_DEGREE = 3
SPLINE_INTERVALS = 24
SPLINE_SIZE = SPLINE_INTERVALS + SPLINE_DEGREE

# Least step between coefficients, of a strictly monotone curve.
MIN_STEP = 1e-7

# Rounding errors of the normal equations.
RIDGE = 1e-12

# The median of |normal values| is 0.6745 standard deviations, 1 / 1.4826.
DEVIATION_OF_MEDIAN = 1.4826


def _spline_knots() -> np.ndarray:
    """Knots, closer at both ends, as toe and shoulder of a film curve need."""
    angles = np.pi * np.arange(SPLINE_INTERVALS + 1) / SPLINE_INTERVALS
    return np.pad((1.0 - np.cos(angles)) / 2.0, SPLINE_DEGREE, "edge")


def _greville_abscissae(knots: np.ndarray) -> np.ndarray:
    """Coefficients with which the curve is the identity."""
    windows = np.lib.stride_tricks.sliding_window_view(knots[1:-1], SPLINE_DEGREE)
    return windows.mean(axis=1)


# With coefficients that never fall a B-spline never falls.
KNOTS = _spline_knots()
GREVILLE_ABSCISSAE = _greville_abscissae(KNOTS)


def calibrate(
    images: Sequence[Any],
    seconds: Any,
    *,
    levels: int | None = None,
    saturation: float = 0.98,
    samples: int = SETTINGS.samples,
) -> Response:
    """Estimate the camera's response from photographs of one scene.

    Parameters
    ----------
    images : sequence of (H, W) or (H, W, 3) arrays
        Photographs as in `merge`, of a scene from black to white.
    seconds : sequence of float
        Their exposures: two at least; four to eight are better.
    levels : int, optional
        Number of codes of the camera; None for all of the type.
    saturation : float
        Codes above, of full scale, are not used.
    samples : int
        Pixels that are used, at most.

    Returns
    -------
    Response
        4097 values a channel, 1 at the largest code and 0 without light.

    Raises
    ------
    InputError
        As in `merge`; also for one exposure only, and if too few pixels are between black and
        saturation at two exposures.

    Examples
    --------
    >>> light = np.linspace(0.002, 0.9, 10000).reshape(100, 100)
    >>> seconds = [0.1, 0.2, 0.6, 1.2]
    >>> shots = [np.rint(255 * np.clip(light * t, 0, 1) ** 0.5).astype(np.uint8) for t in seconds]
    >>> bool(abs(calibrate(shots, seconds).linear(np.array([0.5]))[0] - 0.25) < 0.002)
    True
    """
    stack = exposure_stack(images, seconds, levels)
    stack.check_different_exposures(seconds)
    checks.number("saturation", saturation, above=0.0, most=1.0)
    checks.count("samples", samples)
    tables = []
    for codes in np.moveaxis(stack.codes(SETTINGS.candidates), -1, 0):
        fit = CurveFit(_sample_pixels(codes, samples), stack.seconds, stack.levels, saturation)
        tables.append(_tabulate(fit.run(), TABLE_SIZE))
    return Response(np.stack(tables))


def _sample_pixels(codes: np.ndarray, samples: int) -> np.ndarray:
    """Random pixels of codes (K, pixels), spread over all levels of brightness, as float64."""
    brightness = codes.mean(axis=0)
    low = brightness.min()
    high = brightness.max()
    scale = SETTINGS.brightness_bins / (high - low + 1e-9)
    bins = ((brightness - low) * scale).astype(int)
    # Weighted sampling without replacement (Efraimidis and Spirakis 2006), by 1 / size of a pixel's
    # bin.
    bin_sizes = np.bincount(bins)[bins]
    keys = np.random.default_rng(0).exponential(size=len(bins)) * bin_sizes
    count = min(samples, len(keys))
    chosen = np.argpartition(keys, count - 1)[:count]
    return codes[:, chosen].astype(np.float64)


class CurveFit:
    """Fit of the curve of one channel to codes (K, pixels) in [0, 1].

    `theta` are the coefficients of the spline, `weight` the weights of the codes, `near` the codes
    c' to linearise about, as numbers of the grid, and `offset` f'(c') (c - c'). A basis B gives
    f(codes) = B theta.
    """

    def __init__(
        self, codes: np.ndarray, seconds: np.ndarray, levels: int, saturation: float
    ) -> None:
        self.codes = codes
        self.t = seconds[:, None]
        self.levels = levels
        self.saturation = saturation
        self.grid = np.linspace(0.0, 1.0, SETTINGS.grid_size)
        self.rows_of_grid = _basis(self.grid).toarray()
        lowest = 0.5 / (levels - 1) if levels else 0.0
        self.is_usable = (codes <= saturation) & (codes > lowest)
        self._check_pixels()
        self.theta = GREVILLE_ABSCISSAE
        # First round: errors of 5 % of the code, and of a thousandth of full scale.
        self.weight = self.is_usable / (0.05 * (0.02 + codes)) ** 2
        self.near = self._nearest(codes)
        self.offset = codes - self.grid[self.near]

    def run(self) -> np.ndarray:
        """Coefficients of the curve."""
        for _ in range(SETTINGS.rounds):
            if not np.any(self.weight > 0):
                raise InputError(
                    "images determine no response: no pixel grows with the seconds as light does; "
                    "exposures of the camera must be as listed, and the scene must be lit"
                )
            self.theta = self._fit_curve()
            self._linearise()
        return self.theta

    def _check_pixels(self) -> None:
        """Refuse photographs that are black, or show too few pixels at two exposures."""
        brightest = self.codes.max()
        if brightest < MIN_BRIGHTNESS:
            raise InputError(
                f"images are black, with {brightest:.1%} of full scale at most: {NO_LIGHT}"
            )
        longest = (self.is_usable * self.t).max(axis=0)
        shortest = np.where(self.is_usable, self.t, np.inf).min(axis=0)
        pixels = int(np.count_nonzero(longest > shortest))
        if pixels < SETTINGS.min_pixels:
            raise InputError(
                f"images have {pixels} sampled pixel(s) that are neither black nor saturated at "
                f"two exposures; there must be {SETTINGS.min_pixels}: take exposures closer to "
                "each other, or a scene with more between"
            )

    def _nearest(self, codes: np.ndarray) -> np.ndarray:
        """Numbers of the codes of the grid that are nearest; noise of floats may be below 0."""
        last = len(self.grid) - 1
        return np.clip(np.rint(codes * last), 0, last).astype(np.intp)

    def _linearise(self) -> None:
        """Predict codes from curve and light; set weights and linearisation of the next round."""
        grid = self.grid
        table = self.rows_of_grid @ self.theta
        light = table[self.near] + self.offset
        squares = np.maximum((self.weight * self.t**2).sum(axis=0), TINY)
        L = (self.weight * self.t * light).sum(axis=0) / squares
        x = L * self.t

        self.near = self._nearest(np.interp(x, table, grid))
        slope = np.gradient(table, grid)[self.near]
        self.offset = slope * (self.codes - grid[self.near])

        residual = interpolate(self.codes, table) - x
        is_inside = self.is_usable & (grid[self.near] < self.saturation)
        noise = _residual_noise(residual[is_inside], x[is_inside], slope[is_inside], self.levels)
        sigma = np.sqrt(noise.variance(x, slope))
        high = np.interp(self.saturation, grid, table)
        is_clear = self.is_usable & (x + SETTINGS.margin * sigma < high)
        deviation = residual / (SETTINGS.tukey * sigma)
        biweight = np.clip(1.0 - deviation**2, 0.0, 1.0) ** 2
        self.weight = is_clear * biweight / sigma**2

    def _fit_curve(self) -> np.ndarray:
        """The monotone curve that is best with all L_p free.

        L_p = sum_k w t (f + offset) / sum_k w t^2 leaves theta^T M theta + 2 v^T theta to minimise.
        The curve keeps its value at one code: scaled at the code 1, where hardly any pixel
        determines the curve, it would have a jump there.
        """
        M, v = self._quadratic_form()
        D = self._slope_changes()
        M = M + SETTINGS.smoothness * D.T @ D

        # Non-negative least squares in steps d between coefficients, theta = value + P d.
        anchor_code = np.quantile(self.grid[self.near[self.weight > 0]], [0.75])
        anchor = _basis(anchor_code).toarray()
        value = float((anchor @ self.theta)[0])
        P = np.tril(np.ones((SPLINE_SIZE, SPLINE_SIZE)), -1)[:, :-1]
        P = P - anchor @ P
        H = P.T @ M @ P
        constant = np.full(SPLINE_SIZE, value)
        least_steps = np.full(SPLINE_SIZE - 1, MIN_STEP)
        g = -P.T @ (M @ constant + v) - H @ least_steps
        scale = 1.0 / np.sqrt(np.diagonal(H))
        scaled = H * scale * scale[:, None]
        root = scipy.linalg.cholesky(scaled + RIDGE * np.eye(SPLINE_SIZE - 1))
        right = scipy.linalg.solve_triangular(root, g * scale, trans=1)
        steps, _ = scipy.optimize.nnls(root, right, maxiter=1000)
        theta = value + P @ (steps * scale + MIN_STEP)
        return theta / theta[-1]

    def _quadratic_form(self) -> tuple[np.ndarray, np.ndarray]:
        """M and v of the residuals, with all L_p eliminated."""
        w = self.weight
        B = self.rows_of_grid[self.near]
        C = np.einsum("kp,kpj->pj", w * self.t, B)
        inverse = 1.0 / np.maximum((w * self.t**2).sum(axis=0), TINY)
        # Codes near the same code of the grid have the same row of the basis.
        size = len(self.grid)
        near = self.near.ravel()
        weight_of_code = np.bincount(near, w.ravel(), size)
        offset_of_code = np.bincount(near, (w * self.offset).ravel(), size)
        M = self.rows_of_grid.T @ (weight_of_code[:, None] * self.rows_of_grid)
        M -= C.T @ (inverse[:, None] * C)
        light_offset = inverse * (w * self.t * self.offset).sum(axis=0)
        v = self.rows_of_grid.T @ offset_of_code - C.T @ light_offset
        return M, v

    def _slope_changes(self) -> np.ndarray:
        """D with the changes of slope D @ theta, relative to the slopes of the round before."""
        steps = np.diff(GREVILLE_ABSCISSAE)
        slopes = np.diff(np.eye(SPLINE_SIZE), axis=0) / steps[:, None]
        size = np.maximum(slopes @ self.theta, 1e-3)
        smaller = np.minimum(size[1:], size[:-1])
        return np.diff(slopes, axis=0) / smaller[:, None]


def _residual_noise(
    residual: np.ndarray, x: np.ndarray, slope: np.ndarray, levels: int
) -> NoiseModel:
    """Electrons and read noise that explain the median size of residuals in bins of light x.

    Unlike `estimate` of repeated photographs, there is one sample of each pixel, and outliers.
    """
    if len(x) < 2:
        return NoiseModel(levels=levels)
    count = min(SETTINGS.noise_bins, len(x))
    bins = np.array_split(np.argsort(x), count)
    rounding_model = NoiseModel(read=0.0, levels=levels)
    variance = np.empty(len(bins))
    light = np.empty(len(bins))
    rounding = np.empty(len(bins))
    for k, pixels in enumerate(bins):
        median = np.median(np.abs(residual[pixels]))
        variance[k] = (DEVIATION_OF_MEDIAN * median) ** 2
        light[k] = max(x[pixels].mean(), 0.0)
        rounding[k] = rounding_model.variance(0.0, slope[pixels]).mean()
    variance = np.maximum(variance, rounding + 1e-12)
    columns = np.stack([light / variance, 1.0 / variance], axis=1)
    line, _ = scipy.optimize.nnls(columns, 1.0 - rounding / variance)
    gain, floor = line
    electrons = 1.0 / max(gain, 1e-9)
    return NoiseModel(electrons=electrons, read=float(np.sqrt(floor)), levels=levels)


def _basis(codes: np.ndarray) -> scipy.sparse.csr_array:
    """B with curve(codes) = B @ theta: (len(codes), SPLINE_SIZE), four numbers in a row."""
    clipped = np.clip(codes, 0.0, 1.0)
    return BSpline.design_matrix(clipped, KNOTS, SPLINE_DEGREE)


def _tabulate(theta: np.ndarray, count: int) -> np.ndarray:
    """Values of the curve at `count` equally spaced codes."""
    return _basis(np.linspace(0.0, 1.0, count)) @ theta
