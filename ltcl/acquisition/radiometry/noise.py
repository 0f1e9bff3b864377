# SPDX-License-Identifier: BSD-3-Clause
"""The noise of a camera: photons, reading, rounding; and how it is measured from repeated photographs.

    variance = max(x, 0) / electrons + read^2 + (slope / (levels - 1))^2 / 12

x is the linear sensor value above black, 1 at full scale; `slope` is linear value per code where the response
is no straight line. Photon transfer: the variance of a pixel among repeated photographs against their mean is
a straight line, fitted with weights 1 / variance^2 as samples of a variance have them.

Whole codes hide noise of less than half of one. A normal value with the deviation s codes, about any mean
with the same chance, has among repeated photographs the variance

    V(s) = s^2 + 1/12 - sum_k exp(-(2 pi k s)^2) / (2 pi^2 k^2)

not s^2 + 1/12: the rest is an error that each photograph repeats. V is undone where the pixels of a bin lie
about many means. Where they do not, as in the dark, they only tell how large s may be: 0.2 where one code
comes again and again, for 0.5 codes away the next would be seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import scipy.optimize

from ltcl import checks
from ltcl.acquisition.radiometry.response import Response
from ltcl.acquisition.radiometry.stack import BLACK, NO_LIGHT, levels_of, normalised, photographs
from ltcl.errors import InputError

_BINS, _ROUNDS = 64, 10
_FEW = 10  # samples that tell no distribution
_MOST_CLIPPED = 0.002  # share of a bin's samples at either end
_MOST_ELECTRONS = 1e9
_DITHERED, _HIDDEN = 0.4, 0.2  # codes: V is s^2 + 1/12 from there at any mean; what one code can hide
_TERMS = 2.0 * np.pi**2 * np.arange(1, 401)[:, None] ** 2  # of V
_SPREADS = np.concatenate([[0.0], np.geomspace(1e-3, 2.0, 200)])
_VARIANCES = _SPREADS**2 + 1 / 12 - (np.exp(-2.0 * _TERMS * _SPREADS**2) / _TERMS).sum(axis=0)


@dataclass(frozen=True)
class NoiseModel:
    """Noise of a linear sensor value in [0, 1].

    Attributes
    ----------
    electrons : float
        At full scale, above 0: photon noise has the variance x / electrons.
    read : float
        Standard deviation without light, of full scale.
    black : float
        What the response's linear value is without light; 0 of responses from `calibrate`.
    saturation : float
        Largest linear value that is still valid.
    levels : int
        Codes of the camera, for the noise of rounding; 0 for none.

    Examples
    --------
    >>> float(NoiseModel(electrons=10000.0, read=0.003).variance(0.5)) ** 0.5  # doctest: +ELLIPSIS
    0.00768...
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
        """Variance of linear values above black, where the response rises by `slope` a code."""
        return np.maximum(linear, 0) * (1.0 / self.electrons) + self.read**2 + self.rounding(slope)

    def rounding(self, slope: Any = 1.0) -> Any:
        """The part of the variance that is due to whole codes."""
        return np.square(slope) * (1.0 / (12.0 * (self.levels - 1) ** 2) if self.levels > 1 else 0.0)


def estimate(
    bursts: Sequence[Sequence[Any]],
    *,
    response: Response | None = None,
    levels: int | None = None,
    black: float = 0.0,
    saturation: float = 0.96,
) -> NoiseModel:
    """The noise model of a camera from photographs that were repeated without any change.

    Parameters
    ----------
    bursts : sequence of sequences of (H, W) or (H, W, 3)
        Each holds 2 or more photographs of one scene and exposure: uint8, uint16, or floats in [0, 1].
        Together they should reach from dark to bright.
    response : Response, optional
        Of the camera; None for linear codes.
    levels : int, optional
        As in `calibrate`.
    black, saturation : float
        Linear values, as in `NoiseModel`.

    Raises
    ------
    InputError
        No bursts, a burst of one photograph, mixed shapes, or no pixel between black and saturation.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> light = np.linspace(0, 0.9, 10000).reshape(100, 100)
    >>> burst = [rng.poisson(light * 5000) / 5000 + rng.normal(0, 0.004, light.shape) for _ in range(8)]
    >>> found = estimate([burst])
    >>> round(found.electrons, -2), round(found.read, 3)
    (5000.0, 0.004)
    """
    if len(bursts) == 0:
        raise InputError("bursts is empty; it must hold one burst of photographs at least")
    response = response or Response.identity()
    rows = []
    for number, burst in enumerate(bursts):
        shots = photographs(f"bursts[{number}]", burst)
        if len(shots) < 2:
            raise InputError(f"bursts[{number}] holds one photograph; noise needs two at least")
        levels = levels_of(shots, levels)
        rows.append(_moments(shots, response, levels, saturation))
    model = NoiseModel(1.0, 0.0, black, saturation, levels or 0)
    return _line(np.concatenate(rows, axis=1), model)


def _moments(shots: tuple[np.ndarray, ...], response: Response, levels: int, saturation: float) -> np.ndarray:
    """Of each pixel: mean, variance, slope, code, shares of shots with the lowest and the last, freedom."""
    codes = np.stack([normalised(shot, levels) for shot in shots])
    linear = response.linear(codes).astype(np.float64)
    mean, variance = linear.mean(axis=0), linear.var(axis=0, ddof=1)
    code = codes.mean(axis=0)
    low, high = np.mean(_lowest(codes, levels), axis=0), np.mean(linear > saturation, axis=0)
    slope, freedom = response.derivative(code), np.full(mean.shape, len(shots) - 1.0)
    parts = (mean, variance, slope, code, low, high, freedom)
    return np.stack([part.ravel() for part in parts])


def _lowest(codes: np.ndarray, levels: int) -> np.ndarray:
    """Samples (shots, H, W) or (shots, H, W, channels) whose noise the camera has clipped.

    Those of code 0; and of the lowest value where noise piles up, for an offset may be added behind the end.
    """
    found = (codes <= 0) & (levels > 0)
    for c in np.ndindex(codes.shape[3:]):
        part = codes[..., *c]
        least = part.min()
        above = part[part > least]
        if above.size and _piled(part, float(least), float(above.min())):
            found[..., *c] |= part == least
    return found


def _piled(codes: np.ndarray, least: float, following: float) -> bool:
    """Whether the lowest value of noisy pixels is commoner than the next; a tail would grow rarer."""
    step = following - least
    noisy = np.ptp(codes, axis=0) > 2.5 * step  # else all may be within a code
    count = np.count_nonzero(codes[:, noisy] == least)
    return bool(count > max(_FEW, np.count_nonzero(codes[:, noisy] <= least + 1.5 * step) - count))


@dataclass(frozen=True)
class _Bins:
    """Pixels of about the same mean, from dark to bright: (bins,) each."""

    light: np.ndarray  # above black
    found: np.ndarray  # variance without that of whole codes
    whole: np.ndarray  # variance
    count: np.ndarray  # degrees of freedom
    least: np.ndarray  # the variance that whole codes may hide; infinite where they hide none

    def __getitem__(self, kept: np.ndarray) -> _Bins:
        return _Bins(*(getattr(self, part.name)[kept] for part in fields(self)))


def _bins(rows: np.ndarray, model: NoiseModel) -> _Bins:
    mean, variance, slope, code, low, high, freedom = rows[:, np.argsort(rows[0], kind="stable")]
    cuts = np.linspace(0, len(mean), min(_BINS, len(mean)) + 1).astype(int)[:-1]
    count = np.add.reduceat(freedom, cuts)
    # A code squared; not 0 where a response is flat.
    rounding = np.maximum(12.0 * model.rounding(slope) * np.ones_like(mean), 1e-30)
    parts = (mean - model.black, variance, rounding, low, high)
    light, whole, step, low, high = (np.add.reduceat(part * freedom, cuts) / count for part in parts)
    # Whole bins go, and all beyond: a pixel chosen by its own noise would bias the variance.
    dark, full = low > _MOST_CLIPPED, high > _MOST_CLIPPED
    kept = (np.cumsum(dark[::-1])[::-1] == 0) & (np.cumsum(full) == 0)
    if not kept.any():
        why = NO_LIGHT if code.max() < BLACK else "other exposures are needed"
        raise InputError(f"bursts have no pixels between black and saturation; {why}")
    if not model.levels:
        return _Bins(light, whole, whole, count, np.full_like(light, np.inf))[kept]
    least, most = (pick.reduceat(code, cuts) * (model.levels - 1) for pick in (np.minimum, np.maximum))
    place, narrow = (least + most) / 2, most - least < 1.0
    # Sorted by their noise, bins of one mean differ in variance: only together they tell how large it may be.
    near = (np.abs(place - place[:, None]) < 1.0) * count
    together = _undone((near @ whole) / (near @ step))
    hidden = np.where(narrow & (together < _DITHERED), np.maximum(together, _HIDDEN) ** 2 * step, np.inf)
    return _Bins(light, _undone(whole / step) ** 2 * step, whole, count, hidden)[kept]


def _undone(variance: np.ndarray) -> np.ndarray:
    """s of V(s), in codes.

    >>> _undone(np.array([0.0, 1.0 + 1 / 12, 100.0 + 1 / 12])).round(3)
    array([ 0.,  1., 10.])
    """
    far = np.sqrt(np.maximum(variance - 1 / 12, 0.0))
    return np.where(variance < _VARIANCES[-1], np.interp(variance, _VARIANCES, _SPREADS), far)


def _line(rows: np.ndarray, model: NoiseModel) -> NoiseModel:
    """Straight line through variances, averaged in bins of equal mean, weighted as samples of a variance."""
    every = _bins(rows, model)
    clear = np.isinf(every.least)
    bins = every[clear] if clear.any() else every
    columns = np.stack([np.maximum(bins.light, 0.0), np.ones_like(bins.light)], axis=1)
    least = 1e-3 * bins.whole.mean() + 1e-30
    expected, gain, floor, scale = np.maximum(bins.whole, least), 0.0, 0.0, np.ones_like(bins.light)
    for _ in range(_ROUNDS):
        scale = np.sqrt(bins.count / 2.0) / expected
        (gain, floor), _ = scipy.optimize.nnls(columns * scale[:, None], bins.found * scale)
        expected = np.maximum(columns @ (gain, floor) + bins.whole - bins.found, least)
    error = _error_of_floor(columns[:, 0] * scale, scale)
    # Not told from none, it may be as large as its error, but not more than all noise of a bin, nor than what
    # whole codes could hide.
    most = min(float((expected + 1.0 / scale).min()), float(every.least.min()))
    floor = min(floor if floor > error else floor + error, most)
    electrons = float(1.0 / max(gain, 1.0 / _MOST_ELECTRONS))
    return NoiseModel(electrons, float(np.sqrt(floor)), model.black, model.saturation, model.levels)


def _error_of_floor(x: np.ndarray, w: np.ndarray) -> float:
    """Standard deviation of b, of least squares over x a + w b; infinite where nothing tells a from b."""
    xx, xw, ww = (float(np.sum(part)) for part in (x * x, x * w, w * w))
    alone = ww - xw**2 / xx if xx > 0 else ww
    return alone**-0.5 if alone > 1e-12 * ww else np.inf
