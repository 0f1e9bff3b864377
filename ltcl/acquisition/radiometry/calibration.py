# SPDX-License-Identifier: BSD-3-Clause
"""The response of a camera from photographs of one scene at several exposures, for any number of levels.

Pixel p with the radiance L_p, photographed for t_k seconds, has the code c_pk with f(c_pk) = L_p t_k plus
noise; f is a monotone spline that is 0 without light and 1 at the largest code. f and all L_p minimise

    sum_pk w_pk (f(c_pk) - L_p t_k)^2,    w_pk = 1 / variance(L_p t_k)

L_p is eliminated, which leaves a quadratic form in the coefficients of f, with the black offset among them:
-f(0). After a few rounds the form is linearised about the codes c'_pk that f and L_p predict,

    f(c_pk) = f(c'_pk) + f'(c'_pk) (c_pk - c'_pk)

(Gauss-Newton), so that noise in the codes neither flattens the curve nor chooses the weights. Exposures whose
prediction lies within the noise of an end take no part. Weights are Tukey's, against what moved.

Known limit: two exposures, or exposures that are all powers of one ratio, do not tell f from f times a
wobble of that period in log f; only smoothness does. Ratios such as 2, 3, 2, 3 are better than 4, 4, 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.optimize

from ltcl import checks
from ltcl.acquisition.radiometry import curve
from ltcl.acquisition.radiometry.noise import NoiseModel
from ltcl.acquisition.radiometry.response import Response
from ltcl.acquisition.radiometry.stack import BLACK, NO_LIGHT, Stack, normalised, photographs, stack
from ltcl.errors import InputError

_TABLE = 4097  # values of the response returned
_FINE = 2049  # values to invert the curve by
_BINS = 64  # of brightness, from which pixels are taken alike
_FIRST, _ROUNDS = 3, 12  # on the codes themselves; in all
_SMOOTH = 300.0  # weight of a relative change of slope by 1, in units of noise
_MARGIN = 2.5  # standard deviations that a prediction keeps from the ends
_TUKEY = 5.0  # standard deviations at which a residual counts no more
_LEAST = 50  # pixels
_CLIPPED = 0.01  # share of dark pixels with the lowest code


def calibrate(
    images: Sequence[Any],
    seconds: Any,
    *,
    levels: int | None = None,
    noise: NoiseModel | None = None,
    dark: Sequence[Any] | None = None,
    shared: bool = False,
    saturation: float = 0.98,
    samples: int = 4096,
    seed: int = 0,
) -> Response:
    """The camera's response, from one scene at two exposures or more; better are four to eight.

    Parameters
    ----------
    images : sequence of (H, W) or (H, W, 3)
        uint8, uint16, or floats in [0, 1]; nothing may move between them. Pixels from black to white tell
        most: photographs under a black projector may be put beside those under a white one.
    seconds : (K,)
        Of each photograph, in any order.
    levels : int, optional
        Codes of the camera: 4096 for 12 bits in uint16. None: 256 or 65536 by the type, 0 of floats.
    noise : NoiseModel, optional
        Its electrons and read noise weight the pixels; None finds them from the residuals.
    dark : sequence of (H, W) or (H, W, 3), optional
        Photographs without any light: the response is 0 at their mean code. None finds that code by how
        codes grow with the seconds.
    shared : bool
        One curve for all three channels; else one each.
    saturation : float
        Codes above are not used, as fractions of the largest.
    samples : int
        Pixels to take of each channel.
    seed : int
        Of the choice of pixels.

    Returns
    -------
    Response
        4097 values a channel, 1 at the largest code and 0 without light.

    Raises
    ------
    InputError
        What `stack` refuses; one exposure only; too few pixels that are seen at two exposures.

    Examples
    --------
    >>> light = np.linspace(0.002, 0.9, 10000).reshape(100, 100)
    >>> seconds = [0.1, 0.2, 0.6, 1.2]
    >>> shots = [np.rint(255 * np.clip(light * t, 0, 1) ** 0.5).astype(np.uint8) for t in seconds]
    >>> bool(abs(calibrate(shots, seconds).linear(np.array([0.5]))[0] - 0.25) < 0.002)
    True
    """
    bracket = stack(images, seconds, levels)
    if bracket.seconds[0] == bracket.seconds[-1]:
        raise InputError(
            f"seconds is {seconds!r}: a response needs photographs at two different exposures at least"
        )
    checks.number("saturation", saturation, above=0.0, most=1.0)
    checks.count("samples", samples, least=_LEAST)
    still = _dark_codes(dark, bracket)
    channels = [_samples(bracket, c, samples, seed) for c in range(bracket.channels)]
    if shared:
        channels = [np.concatenate(channels, axis=1)]
        still = None if still is None else [(sum(m for m, _ in still) / len(still), sum(n for _, n in still))]
    curves = [
        _fit(codes, bracket, noise, saturation, None if still is None else still[c])
        for c, codes in enumerate(channels)
    ]
    return Response(np.stack([curve.tabulate(theta, _TABLE) for theta in curves]))


@dataclass(frozen=True, eq=False)
class _State:
    """Curve, noise, and what they predict of codes (K, P)."""

    theta: np.ndarray
    noise: NoiseModel
    weight: np.ndarray  # (K, P)
    near: np.ndarray  # codes to linearise about
    offset: np.ndarray  # f'(near) (codes - near)


def _dark_codes(dark: Sequence[Any] | None, bracket: Stack) -> list[tuple[float, int]] | None:
    """Code without light, and how many pixels tell it, of each channel."""
    if dark is None:
        return None
    shots = photographs("dark", dark)
    checks.shape("dark[0]", shots[0], bracket.images[0].shape)
    codes = np.concatenate([normalised(s, bracket.levels).reshape(-1, bracket.channels) for s in shots])
    # A mean is finer than whole codes; but where noise is clipped at the lowest code only the median holds.
    clipped = np.mean(codes <= 0, axis=0) > _CLIPPED
    middle = np.where(clipped, np.median(codes, axis=0), codes.mean(axis=0, dtype=np.float64))
    return [(float(code), len(codes)) for code in middle]


def _samples(bracket: Stack, channel: int, count: int, seed: int) -> np.ndarray:
    """Codes (K, P) of pixels that are spread over all levels of brightness."""
    codes = np.stack([bracket.codes(k)[:, channel] for k in range(len(bracket.images))])
    brightness = codes.mean(axis=0)
    order = np.random.default_rng(seed).permutation(brightness.size)
    low, high = brightness.min(), brightness.max()
    bins = ((brightness[order] - low) * (_BINS / (high - low + 1e-9))).astype(int)
    order = order[np.argsort(bins, kind="stable")]
    place = np.sort(bins)
    # The n-th pixel of its bin: all bins give their first ones until there are enough.
    turn = np.arange(len(place)) - np.searchsorted(place, place)
    return codes[:, order[np.argsort(turn, kind="stable")[:count]]].astype(np.float64)


def _fit(
    codes: np.ndarray,
    bracket: Stack,
    noise: NoiseModel | None,
    saturation: float,
    still: tuple[float, int] | None,
) -> np.ndarray:
    """Coefficients of the curve of one channel."""
    levels = bracket.levels
    floor = 0.5 / (levels - 1) if levels else 0.0
    usable = (codes <= saturation) & (codes > floor)
    _check_seen(usable, bracket.seconds, float(codes.max()))
    model = replace(noise or NoiseModel(), levels=levels)
    state = _State(
        curve.PLACES.copy(), model, usable / (0.05 * (0.02 + codes)) ** 2, codes, np.zeros_like(codes)
    )
    for number in range(_ROUNDS):
        state = replace(state, theta=_solve(state, bracket.seconds, still))
        state = _predict(state, codes, usable, bracket.seconds, saturation, number >= _FIRST, noise is None)
    return state.theta


def _check_seen(usable: np.ndarray, seconds: np.ndarray, most: float) -> None:
    """Refuse where hardly a pixel is seen at two exposures."""
    shortest = np.where(usable, seconds[:, None], np.inf).min(axis=0)
    longest = np.where(usable, seconds[:, None], 0.0).max(axis=0)
    seen = int(np.count_nonzero(longest > shortest))
    if seen < _LEAST:
        _refuse_black(most)
        raise InputError(
            f"images have {seen} sampled pixel(s) that are neither black nor saturated at two exposures; "
            f"there must be {_LEAST}: take exposures closer to each other, or a scene with more between"
        )


def _refuse_black(most: float) -> None:
    if most < BLACK:
        raise InputError(f"images are black, with {most:.1%} of full scale at most: {NO_LIGHT}")


def _solve(state: _State, seconds: np.ndarray, still: tuple[float, int] | None) -> np.ndarray:
    """The curve that is best with all L_p free, for the weights given."""
    K, P = state.near.shape
    w, t = state.weight, seconds[:, None]
    B = curve.design(state.near.ravel())
    M = B.T @ (w.reshape(-1, 1) * B)
    v = B.T @ (w * state.offset).ravel()
    # L_p = sum_k w t (f + offset) / sum_k w t^2, put into the sum of squares.
    C = ((w * t)[:, :, None] * B.reshape(K, P, -1)).sum(axis=0)
    s = (w * t * state.offset).sum(axis=0)
    inverse = 1.0 / np.maximum((w * t**2).sum(axis=0), 1e-300)
    M -= C.T @ (inverse[:, None] * C)
    v -= C.T @ (inverse * s)
    if still is not None:
        b = curve.design(np.array([still[0]]))[0]
        M += np.outer(b, b) * still[1] / state.noise.variance(0.0)
    if not np.any(w > 0):
        _refuse_black(float(state.near.max()))
        raise InputError(
            "images tell no response: no pixel grows with the seconds as light does; the exposure of the "
            "camera must be what was asked for, and the scene must be lit"
        )
    D = curve.bends(state.theta)
    anchor = np.quantile(state.near[w > 0], [0.75])
    return curve.fit(M + _SMOOTH * D.T @ D, v, anchor, float((curve.design(anchor) @ state.theta)[0]))


def _predict(
    state: _State,
    codes: np.ndarray,
    usable: np.ndarray,
    seconds: np.ndarray,
    saturation: float,
    linearise: bool,
    learn: bool,
) -> _State:
    """Radiances, predicted codes, noise and weights for the curve at hand."""
    grid = np.linspace(0.0, 1.0, _FINE)
    table = curve.tabulate(state.theta, _FINE)
    slopes = np.gradient(table, grid)
    light = np.interp(codes, grid, table)
    if linearise:
        light = np.interp(state.near, grid, table) + state.offset
    w, t = state.weight, seconds[:, None]
    L = (w * t * light).sum(axis=0) / np.maximum((w * t**2).sum(axis=0), 1e-300)
    x = L * t
    near = np.interp(x, table, grid)
    slope = np.interp(near, grid, slopes)
    residual = np.interp(codes, grid, table) - x
    inside = usable & (near < saturation)
    noise = _learned(residual[inside], x[inside], slope[inside], state.noise) if learn else state.noise
    sigma = np.sqrt(noise.variance(x, slope))
    low, high = np.interp([0.0, saturation], grid, table)
    clear = usable & (x + _MARGIN * sigma < high) & (x - _MARGIN * sigma > low)
    robust = np.clip(1.0 - (residual / (_TUKEY * sigma)) ** 2, 0.0, 1.0) ** 2
    offset = slope * (codes - near)
    return _State(
        state.theta,
        noise,
        clear * robust / sigma**2,
        near if linearise else codes,
        offset if linearise else np.zeros_like(codes),
    )


def _learned(residual: np.ndarray, x: np.ndarray, slope: np.ndarray, noise: NoiseModel) -> NoiseModel:
    """Electrons and read noise that explain the residuals, by their median size in bins of light."""
    order = np.argsort(x)
    parts = [part for part in np.array_split(order, 16) if len(part) > 10]
    if len(parts) < 2:
        return noise
    spread = np.array([(1.4826 * np.median(np.abs(residual[part]))) ** 2 for part in parts])
    light = np.array([max(x[part].mean(), 0.0) for part in parts])
    rounding = np.array([np.mean(noise.rounding(slope[part])) for part in parts])
    spread = np.maximum(spread, rounding + 1e-12)
    columns = np.stack([light, np.ones_like(light)], axis=1) / spread[:, None]
    (gain, floor), _ = scipy.optimize.nnls(columns, (spread - rounding) / spread)
    return replace(noise, electrons=1.0 / max(gain, 1e-9), read=float(np.sqrt(floor)))
