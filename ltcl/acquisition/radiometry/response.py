# SPDX-License-Identifier: BSD-3-Clause
"""The response of a camera, from codes to linear light, and its estimation from photographs of one scene.

A pixel p of radiance L_p, photographed for t_k seconds, has the code c_pk with f(c_pk) = L_p t_k
plus noise. f is a monotone cubic spline, 0 without light and 1 at the largest code; f and all L_p
minimise

    sum_pk w_pk (f(c_pk) - L_p t_k)^2,    w_pk = 1 / variance(L_p t_k)

L_p is eliminated, which leaves a quadratic form in the coefficients of f. After the first round it
is linearised about the codes c' that f and L_p predict, f(c) = f(c') + f'(c') (c - c')
(Gauss-Newton), so that noise of the codes does not flatten the curve. Exposures whose prediction
lies within the noise of either end do not count; what moved is weighted down by Tukey's biweight.
Known limit: exposures in equal ratios do not separate f from f times a wobble of that period in log
f; ratios of 2, 3, 2, 3 are better than 4, 4, 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
import scipy.optimize
from scipy.interpolate import BSpline

from ltcl import checks
from ltcl.acquisition.radiometry.camera import BLACK, MOST, NO_LIGHT, NoiseModel, Stack, stack
from ltcl.errors import InputError

_TABLE, _FINE = 4097, 2049  # codes of the result; of the table that inverts it: 1/8 code of 8 bits
# In brackets: the error of an sRGB camera's curve, from 0.02 to 0.9 of full scale, measured.
_SAMPLES, _LEAST = (
    4096,
    50,
)  # pixels of a channel (1024: 0.14 %, 4096: 0.08 %); at least two an unknown
_BINS = 64  # of brightness, which have equal shares (16 to 128: 0.09 %)
_ROUNDS = 8  # of reweighting (5: 0.09 %, 8 to 20: 0.08 %)
_SMOOTH = (
    300.0  # weight of a relative change of slope by 1, in units of noise (30: 0.11 %, 1000: 0.07 %)
)
_MARGIN = 2.5  # standard deviations that a prediction keeps from the ends (1: 0.08 %, 4: 0.09 %)
_TUKEY = 5.0  # standard deviations at which a residual counts no more (3: 0.17 %, 8: 0.07 %)
_NOISE_BINS = 16  # of light, in which the size of residuals gives the noise
_DEGREE, _INTERVALS = 3, 24  # of the spline: it fits the curves of sRGB and of film to 4e-5
_RISE, _RIDGE = (
    1e-7,
    1e-12,
)  # least step between coefficients, of a strictly monotone curve; rounding errors

# Knots lie closer at both ends, as toe and shoulder of a film curve need. With coefficients that
# never fall a B-spline never falls. With coefficients _PLACES (Greville's abscissae) the curve is
# the identity.
_KNOTS = np.pad(
    (1.0 - np.cos(np.pi * np.arange(_INTERVALS + 1) / _INTERVALS)) / 2.0, _DEGREE, "edge"
)
_SIZE = _INTERVALS + _DEGREE
_PLACES = np.lib.stride_tricks.sliding_window_view(_KNOTS[1:-1], _DEGREE).mean(axis=1)


@dataclass(frozen=True, repr=False, eq=False)
class Response:
    """Tables (1, n) or (3, n) from n equally spaced codes in [0, 1] to linear sensor values, float64.

    A table never falls; it is linear between and beyond its codes. Those of `calibrate` are 0
    without light, their first values negative. InputError for other shapes, NaN, and a table that
    falls or never rises.

    >>> gamma = Response(np.linspace(0, 1, 257) ** 2.0)
    >>> gamma.linear(np.array([[0.0, 0.5, 1.0]]))
    array([[0.  , 0.25, 1.  ]], dtype=float32)
    """

    values: np.ndarray

    def __post_init__(self) -> None:
        values = np.atleast_2d(checks.real("values", self.values)).astype(np.float64)
        if values.ndim != 2 or values.shape[0] not in (1, 3) or values.shape[1] < 2:
            raise InputError(
                f"values has shape {values.shape}; it must be (1, n) or (3, n), n at least 2"
            )
        checks.finite("values", values)
        if np.diff(values).min() < 0 or not np.all(values[:, -1] > values[:, 0]):
            raise InputError("values falls, or stays the same throughout; a response must rise")
        values.setflags(write=False)
        object.__setattr__(self, "values", values)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(channels={self.channels}, n={self.values.shape[1]})"

    @classmethod
    def identity(cls) -> Response:
        """Codes that are linear already."""
        return cls(np.array([[0.0, 1.0]]))

    @property
    def channels(self) -> int:
        """1 or 3."""
        return self.values.shape[0]

    def linear(self, image: Any) -> np.ndarray:
        """Linear sensor values of codes (..., [3]) in [0, 1]; float32, same shape."""
        return self._by_channel(image, lambda codes, table: _interpolate(codes, table)[0])

    def derivative(self, image: Any) -> np.ndarray:
        """Linear value per code, at codes (..., [3]) in [0, 1]; float32, same shape."""
        return self._by_channel(
            image, lambda codes, table: (len(table) - 1) * _interpolate(codes, table)[1]
        )

    def codes(self, linear: Any) -> np.ndarray:
        """Codes (..., [3]) that have these linear values, within [0, 1]; float32, same shape."""
        return self._by_channel(
            linear, lambda x, table: np.interp(x, table, np.linspace(0, 1, len(table)))
        )

    def _by_channel(self, image: Any, function: Any) -> np.ndarray:
        array = checks.real("image", image)
        if array.dtype.kind != "f":
            raise InputError(f"image holds {array.dtype}; codes must be floats, 1 for the largest")
        if self.channels == 1:
            return np.asarray(function(array, self.values[0]), np.float32).reshape(array.shape)
        if array.shape[-1:] != (3,):
            raise InputError(f"image has shape {array.shape}; this response needs (..., 3)")
        channels = [function(array[..., c], table) for c, table in enumerate(self.values)]
        return np.stack(channels, axis=-1).astype(np.float32)


def _interpolate(codes: np.ndarray, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Value at codes, which may lie beyond the ends of the table, and how much it rises in their interval."""
    place = np.asarray(codes, np.float64) * (len(table) - 1)
    i = np.clip(place.astype(np.int32), 0, len(table) - 2)
    rise = np.diff(table)[i]
    return table[i] + (place - i) * rise, rise


def calibrate(
    images: Sequence[Any], seconds: Any, *, levels: int | None = None, saturation: float = 0.98
) -> Response:
    """Estimate the camera's response from one scene at two exposures or more; four to eight are better.

    Photographs are as in `merge`, of a scene from black to white. Codes above `saturation` are not
    used. The response has 4097 values a channel, 1 at the largest code and 0 without light.
    InputError for what `merge` refuses, one exposure only, and too few pixels that are seen at two
    exposures.

    >>> light = np.linspace(0.002, 0.9, 10000).reshape(100, 100)
    >>> seconds = [0.1, 0.2, 0.6, 1.2]
    >>> shots = [np.rint(255 * np.clip(light * t, 0, 1) ** 0.5).astype(np.uint8) for t in seconds]
    >>> bool(abs(calibrate(shots, seconds).linear(np.array([0.5]))[0] - 0.25) < 0.002)
    True
    """
    bracket = stack(images, seconds, levels)
    if bracket.seconds[0] == bracket.seconds[-1]:
        raise InputError(f"seconds is {seconds!r}; it must hold at least two different exposures")
    checks.number("saturation", saturation, above=0.0, most=1.0)
    codes = np.moveaxis(bracket.codes(MOST), -1, 0)
    curves = [_fit(channel, bracket, saturation) for channel in codes]
    return Response(np.stack([_tabulate(theta, _TABLE) for theta in curves]))


def _fit(codes: np.ndarray, bracket: Stack, saturation: float) -> np.ndarray:
    """Coefficients of the curve of one channel, from its codes (K, pixels).

    P random pixels count, spread over all levels of brightness.
    """
    brightness = codes.mean(axis=0)
    low, high = brightness.min(), brightness.max()
    bins = ((brightness - low) * (_BINS / (high - low + 1e-9))).astype(int)
    # Weighted sampling without replacement (Efraimidis and Spirakis 2006), by 1 / size of a pixel's
    # bin.
    keys = np.random.default_rng(0).exponential(size=len(bins)) * np.bincount(bins)[bins]
    codes = codes[:, np.argsort(keys)[:_SAMPLES]].astype(np.float64)
    t, grid = bracket.seconds[:, None], np.linspace(0.0, 1.0, _FINE)
    usable = (codes <= saturation) & (
        codes > (0.5 / (bracket.levels - 1) if bracket.levels else 0.0)
    )
    seen = int(np.count_nonzero((usable * t).max(axis=0) > np.where(usable, t, np.inf).min(axis=0)))
    if codes.max() < BLACK:
        raise InputError(
            f"images are black, with {codes.max():.1%} of full scale at most: {NO_LIGHT}"
        )
    if seen < _LEAST:
        raise InputError(
            f"images have {seen} sampled pixel(s) that are neither black nor saturated at two exposures; "
            f"there must be {_LEAST}: take exposures closer to each other, or a scene with more between"
        )
    # Weights of a first round: errors of 5 % of the code, and of a thousandth of full scale.
    theta, weight = _PLACES, usable / (0.05 * (0.02 + codes)) ** 2
    near, offset = codes, np.zeros_like(codes)  # codes c' to linearise about; f'(c') (c - c')
    for _ in range(_ROUNDS):
        if not np.any(weight > 0):
            raise InputError(
                "images determine no response: no pixel grows with the seconds as light does; exposures of "
                "the camera must be as listed, and the scene must be lit"
            )
        theta = _solve(theta, weight, near, offset, t)
        table = _tabulate(theta, _FINE)
        light = np.interp(near, grid, table) + offset
        x = (
            (weight * t * light).sum(axis=0) / np.maximum((weight * t**2).sum(axis=0), 1e-300) * t
        )  # L_p t_k
        near = np.interp(x, table, grid)
        slope = np.interp(near, grid, np.gradient(table, grid))
        residual = np.interp(codes, grid, table) - x
        inside = usable & (near < saturation)
        noise = _noise(residual[inside], x[inside], slope[inside], bracket.levels)
        sigma = np.sqrt(noise.variance(x, slope))
        low, high = np.interp([0.0, saturation], grid, table)
        clear = usable & (x + _MARGIN * sigma < high) & (x - _MARGIN * sigma > low)
        weight = clear * np.clip(1.0 - (residual / (_TUKEY * sigma)) ** 2, 0.0, 1.0) ** 2 / sigma**2
        offset = slope * (codes - near)
    return theta


def _noise(residual: np.ndarray, x: np.ndarray, slope: np.ndarray, levels: int) -> NoiseModel:
    """Electrons and read noise that explain the median size of residuals in bins of light x."""
    bins = [members for members in np.array_split(np.argsort(x), _NOISE_BINS) if len(members)]
    if len(bins) < 2:
        return NoiseModel(levels=levels)
    # The median of |normal values| is 0.6745 standard deviations, 1 / 1.4826.
    variance = np.array([(1.4826 * np.median(np.abs(residual[members]))) ** 2 for members in bins])
    light = np.array([max(x[members].mean(), 0.0) for members in bins])
    rounding = [
        NoiseModel(read=0.0, levels=levels).variance(0.0, slope[members]).mean() for members in bins
    ]
    variance = np.maximum(variance, np.array(rounding) + 1e-12)
    columns = np.stack([light, np.ones_like(light)], axis=1) / variance[:, None]
    (gain, floor), _ = scipy.optimize.nnls(columns, 1.0 - rounding / variance)
    return NoiseModel(1.0 / max(gain, 1e-9), float(np.sqrt(floor)), levels=levels)


def _solve(
    theta: np.ndarray, w: np.ndarray, near: np.ndarray, offset: np.ndarray, t: np.ndarray
) -> np.ndarray:
    """The monotone curve that is best with all L_p free: L_p = sum_k w t (f + offset) / sum_k w t^2.

    It minimises theta^T M theta + 2 v^T theta, and keeps its value at one code: scaled at the code
    1, where hardly any pixel determines the curve, it would have a jump there.
    """
    B = _design(near.ravel())
    C = ((w * t)[:, :, None] * B.reshape(*near.shape, _SIZE)).sum(axis=0)
    inverse = 1.0 / np.maximum((w * t**2).sum(axis=0), 1e-300)
    M = B.T @ (w.reshape(-1, 1) * B) - C.T @ (inverse[:, None] * C)
    v = B.T @ (w * offset).ravel() - C.T @ (inverse * (w * t * offset).sum(axis=0))
    # Relative change of slope from one coefficient to the next, at the curve of the round before.
    slopes = np.diff(np.eye(_SIZE), axis=0) / np.diff(_PLACES)[:, None]
    size = np.maximum(slopes @ theta, 1e-3)
    D = np.diff(slopes, axis=0) / np.minimum(size[1:], size[:-1])[:, None]
    M = M + _SMOOTH * D.T @ D
    # Non-negative least squares in steps d between coefficients, theta = value + P d.
    anchor = _design(np.quantile(near[w > 0], [0.75]))
    value, P = float((anchor @ theta)[0]), np.tril(np.ones((_SIZE, _SIZE)), -1)[:, :-1]
    P = P - anchor @ P
    H = P.T @ M @ P
    g = -P.T @ (M @ np.full(_SIZE, value) + v) - H @ np.full(_SIZE - 1, _RISE)
    scale = 1.0 / np.sqrt(np.diagonal(H))
    root = scipy.linalg.cholesky(H * scale * scale[:, None] + _RIDGE * np.eye(_SIZE - 1))
    right = scipy.linalg.solve_triangular(root, g * scale, trans=1)
    steps, _ = scipy.optimize.nnls(root, right, maxiter=1000)
    theta = value + P @ (steps * scale + _RISE)
    return theta / theta[-1]


def _design(codes: np.ndarray) -> np.ndarray:
    """B with curve(codes) = B @ theta: (len(codes), _SIZE)."""
    return BSpline.design_matrix(np.clip(codes, 0.0, 1.0), _KNOTS, _DEGREE).toarray()


def _tabulate(theta: np.ndarray, count: int) -> np.ndarray:
    return _design(np.linspace(0.0, 1.0, count)) @ theta
