# SPDX-License-Identifier: BSD-3-Clause
"""The noise of a camera: photons, reading, rounding; and how it is measured from repeated photographs.

    variance = max(x, 0) / electrons + read^2 + (slope / (levels - 1))^2 / 12

x is the linear sensor value above black, 1 at full scale; `slope` is linear value per code where the response
is no straight line. Photon transfer: the variance of a pixel among repeated photographs against their mean is
a straight line, fitted with weights 1 / variance^2 as samples of a variance have them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.optimize

from ltcl import checks
from ltcl.acquisition.radiometry.response import Response
from ltcl.acquisition.radiometry.stack import levels_of, normalised, photographs
from ltcl.errors import InputError

_BINS, _ROUNDS = 64, 10
_MOST_CLIPPED = 0.002  # share of a bin's samples at either end
_MOST_ELECTRONS = 1e9


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
    """Of each pixel: mean, variance, slope of the response, share of clipped shots, freedom. (5, pixels)."""
    codes = np.stack([normalised(shot, levels) for shot in shots])
    linear = response.linear(codes).astype(np.float64)
    mean, variance = linear.mean(axis=0), linear.var(axis=0, ddof=1)
    slope = response.derivative(codes.mean(axis=0))
    clipped = np.mean((linear > saturation) | ((codes <= 0) & (levels > 0)), axis=0)
    parts = (mean, variance, slope, clipped, np.full(mean.shape, len(shots) - 1.0))
    return np.stack([part.ravel() for part in parts])


def _line(rows: np.ndarray, model: NoiseModel) -> NoiseModel:
    """Straight line through variances, averaged in bins of equal mean, weighted as samples of a variance."""
    mean, variance, slope, clipped, freedom = rows[:, np.argsort(rows[0], kind="stable")]
    cuts = np.linspace(0, len(mean), min(_BINS, len(mean)) + 1).astype(int)[:-1]
    count = np.add.reduceat(freedom, cuts)
    excess = variance - model.rounding(slope)
    parts = (mean - model.black, excess, variance, clipped)
    light, found, whole, clipped = (np.add.reduceat(part * freedom, cuts) / count for part in parts)
    # Whole bins go: a pixel chosen by its own noise would bias the variance.
    kept = clipped <= _MOST_CLIPPED
    if not kept.any():
        raise InputError("bursts have no pixels between black and saturation; other exposures are needed")
    light, found, whole, count = light[kept], found[kept], whole[kept], count[kept]
    columns = np.stack([np.maximum(light, 0.0), np.ones_like(light)], axis=1)
    least = 1e-3 * whole.mean() + 1e-30
    expected, gain, floor = np.maximum(whole, least), 0.0, 0.0
    for _ in range(_ROUNDS):
        scale = np.sqrt(count) / expected
        (gain, floor), _ = scipy.optimize.nnls(columns * scale[:, None], found * scale)
        expected = np.maximum(columns @ (gain, floor) + whole - found, least)
    electrons = float(1.0 / max(gain, 1.0 / _MOST_ELECTRONS))
    return NoiseModel(electrons, float(np.sqrt(floor)), model.black, model.saturation, model.levels)
