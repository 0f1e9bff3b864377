# SPDX-License-Identifier: BSD-3-Clause
"""The noise of a camera: photons, reading, rounding; and its estimation from repeated photographs.

    variance = max(x, 0) / electrons + read^2 + (slope / (levels - 1))^2 / 12

x is the linear sensor value above black, 1 at full scale; `slope` is linear value per code where the response
is no straight line. Photon transfer: the variance of a pixel among repeated photographs against their mean is
a straight line, fitted with weights 1 / variance^2 as samples of a variance have them.

Whole codes add 1/12 to the variance s^2 of a normal value (in codes; Sheppard), to 0.2 % from s = 0.4 on at
any mean. Less noise shows only on average over means that are spread evenly between codes: there the sum is

    V(s) = s^2 + 1/12 - sum_k exp(-(2 pi k s)^2) / (2 pi^2 k^2)

which is inverted. Pixels of one mean, as in the dark, then only bound s: by 0.2 where one code comes again
and again, for with more noise the next, 0.5 away, would be seen in one photograph of 160.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.optimize

from ltcl import checks
from ltcl.acquisition.radiometry.stack import BLACK, NO_LIGHT, levels_of, normalised, photographs
from ltcl.errors import InputError

if TYPE_CHECKING:
    from ltcl.acquisition.radiometry.response import Response

_BINS = 64  # of pixels of equal number: the noise of a variance among their mean is 8 times that of all
_ROUNDS = 5  # of reweighting: the line stands to 1e-5 after two (measured)
_MOST_CLIPPED = 0.002  # share of a bin's samples at either end: a variance is then low by 0.4 %
_MOST_ELECTRONS = 1e9  # more than any pixel holds, for codes without photon noise
_DITHERED, _HIDDEN = 0.4, 0.2  # codes: V(s) is s^2 + 1/12 at any mean; what one code can hide
_K = 2.0 * np.pi**2 * np.arange(1, 401)[:, None] ** 2  # terms of V: the rest is below 2e-3 of 1/12
_SPREADS = np.concatenate([[0.0], np.geomspace(1e-3, 2.0, 200)])
_VARIANCES = _SPREADS**2 + 1 / 12 - (np.exp(-2.0 * _K * _SPREADS**2) / _K).sum(axis=0)


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
    saturation: float = 0.96,
) -> NoiseModel:
    """The noise model of a camera from photographs that were repeated without any change.

    Parameters
    ----------
    bursts : sequence of sequences of (H, W) or (H, W, 3)
        Each holds 2 or more photographs of one scene and exposure: uint8, uint16, or floats in [0, 1].
        Together they should reach from dark to bright.
    response : Response, optional
        Of the camera, 0 without light; None for linear codes.
    levels : int, optional
        As in `calibrate`.
    saturation : float
        Largest linear value that is still valid.

    Raises
    ------
    InputError
        No bursts, a burst of one photograph, mixed shapes, or no pixel between black and saturation.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> light = np.linspace(0, 0.9, 10000).reshape(100, 100)
    >>> burst = [rng.poisson(light * 5000) / 5000 + rng.normal(0, 0.004, light.shape) for _ in range(8)]
    >>> model = estimate([burst])
    >>> round(model.electrons, -2), round(model.read, 3)
    (5000.0, 0.004)
    """
    if len(bursts) == 0:
        raise InputError("bursts is empty; it must hold one burst of photographs at least")
    rows = []
    for number, burst in enumerate(bursts):
        shots = photographs(f"bursts[{number}]", burst)
        if len(shots) < 2:
            raise InputError(f"bursts[{number}] holds one photograph; noise needs two at least")
        levels = levels_of(shots, levels)
        codes = np.stack([normalised(shot, levels) for shot in shots])
        rows.append(_moments(codes, response, levels, saturation))
    return _line(np.concatenate(rows, axis=1), NoiseModel(1.0, 0.0, 0.0, saturation, levels or 0))


def _moments(codes: np.ndarray, response: Response | None, levels: int, saturation: float) -> np.ndarray:
    """Of each pixel: mean, variance, slope, code, shares of samples at the ends, degrees of freedom."""
    linear = (codes if response is None else response.linear(codes)).astype(np.float64)
    code = codes.mean(axis=0)
    slope = np.ones_like(code) if response is None else response.derivative(code)
    low, high = np.mean(_clipped(codes, levels), axis=0), np.mean(linear > saturation, axis=0)
    freedom = np.full(code.shape, len(codes) - 1.0)
    parts = (linear.mean(axis=0), linear.var(axis=0, ddof=1), slope, code, low, high, freedom)
    return np.stack([part.ravel() for part in parts])


def _clipped(codes: np.ndarray, levels: int) -> np.ndarray:
    """Samples (shots, H, W[, channels]) whose noise the camera has clipped: those of code 0.

    Also those of the lowest value, where it is commoner than the next: an offset may be added after clipping,
    and the tail of a distribution would grow rarer. Pixels that stay within two codes do not count there.
    """
    clipped = (codes <= 0) & (levels > 0)
    for c in np.ndindex(codes.shape[3:]):
        channel = codes[..., *c]
        least = channel.min()
        step = float(channel[channel > least].min(initial=np.inf) - least)
        noisy = channel[:, np.ptp(channel, axis=0) > 2.5 * step]
        count, following = np.count_nonzero(noisy == least), np.count_nonzero(noisy <= least + 1.5 * step)
        if count > max(10, following - count):
            clipped[..., *c] |= channel == least
    return clipped


def _line(rows: np.ndarray, model: NoiseModel) -> NoiseModel:
    """Straight line through variances, averaged in bins of equal mean, weighted as samples of a variance."""
    mean, variance, slope, code, low, high, freedom = rows[:, np.argsort(rows[0], kind="stable")]
    cuts = np.linspace(0, len(mean), min(_BINS, len(mean)) + 1).astype(int)[:-1]
    count = np.add.reduceat(freedom, cuts)
    # A code squared; not 0 where a response is flat.
    step = np.maximum(12.0 * model.rounding(slope) * np.ones_like(mean), 1e-30)
    light, whole, step, low, high = (
        np.add.reduceat(part * freedom, cuts) / count for part in (mean, variance, step, low, high)
    )
    # Whole bins go, and all beyond: a pixel selected by its own noise would bias the variance.
    dark, full = low > _MOST_CLIPPED, high > _MOST_CLIPPED
    keep = (np.cumsum(dark[::-1])[::-1] == 0) & (np.cumsum(full) == 0)
    if not keep.any():
        why = NO_LIGHT if code.max() < BLACK else "other exposures are needed"
        raise InputError(f"bursts have no pixels between black and saturation; {why}")
    unrounded, bound = whole, np.full_like(light, np.inf)  # variance without that of whole codes; its bound
    if model.levels:
        unrounded = _inverted(whole / step) ** 2 * step
        least, most = (pick.reduceat(code, cuts) * (model.levels - 1) for pick in (np.minimum, np.maximum))
        # Sorted by their noise, bins of one mean differ in variance: only together do they bound it.
        middle = (least + most) / 2
        near = (np.abs(middle - middle[:, None]) < 1.0) * count
        together = _inverted((near @ whole) / (near @ step))
        undithered = (most - least < 1.0) & (together < _DITHERED)
        bound[undithered] = (np.maximum(together, _HIDDEN) ** 2 * step)[undithered]
    ceiling = float(bound[keep].min())
    if np.isinf(bound[keep]).any():
        keep &= np.isinf(bound)
    return _fit(light[keep], unrounded[keep], whole[keep], count[keep], ceiling, model)


def _fit(
    light: np.ndarray,
    unrounded: np.ndarray,
    whole: np.ndarray,
    count: np.ndarray,
    ceiling: float,
    model: NoiseModel,
) -> NoiseModel:
    columns = np.stack([np.maximum(light, 0.0), np.ones_like(light)], axis=1)
    least = 1e-3 * whole.mean() + 1e-30
    expected, gain, floor, scale = np.maximum(whole, least), 0.0, 0.0, np.ones_like(light)
    for _ in range(_ROUNDS):
        scale = np.sqrt(count / 2.0) / expected
        (gain, floor), _ = scipy.optimize.nnls(columns * scale[:, None], unrounded * scale)
        expected = np.maximum(columns @ (gain, floor) + whole - unrounded, least)
    # A floor below its standard error may be as large as that, but not more than all noise of a bin, nor than
    # what whole codes can hide: too little would call the scene changed, too much only weighs the dark less.
    (xx, xw), (_, ww) = (columns.T * scale) @ (columns.T * scale).T
    alone = ww - xw**2 / xx if xx > 0 else ww
    error = alone**-0.5 if alone > 1e-12 * ww else np.inf
    most = min(float((expected + 1.0 / scale).min()), ceiling)
    floor = min(floor if floor > error else floor + error, most)
    electrons = float(1.0 / max(gain, 1.0 / _MOST_ELECTRONS))
    return NoiseModel(electrons, float(np.sqrt(floor)), model.black, model.saturation, model.levels)


def _inverted(variance: np.ndarray) -> np.ndarray:
    """s of V(s), in codes.

    >>> _inverted(np.array([0.0, 1.0 + 1 / 12, 100.0 + 1 / 12])).round(3)
    array([ 0.,  1., 10.])
    """
    far = np.sqrt(np.maximum(variance - 1 / 12, 0.0))
    return np.where(variance < _VARIANCES[-1], np.interp(variance, _VARIANCES, _SPREADS), far)
