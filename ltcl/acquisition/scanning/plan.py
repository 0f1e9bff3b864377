# SPDX-License-Identifier: BSD-3-Clause
"""Photographs, time, disk space and errors of a scan, before its first photograph.

For N pixels with direct light d, indirect light g of all pixels together and ambient light a
(radiance), an entry of T off its diagonal is about l = g / N. A photograph of radiance L and t
seconds has the variance V(L) = variance(L t) / t^2 of the noise model; several are merged as 1 / V
= sum_k 1 / V_k. Entries have

    pixel      V(l + a);  V(d + a) on the diagonal
    hadamard   2 / m V(m l + a) in batches of n pixels, m = (n + 1) / 2 of them lit at a time;
               2 / m (V(d + m l + a) + V(m l + a)) / 2 in the batch of the camera pixel's own light

A picture T p of random light p in [0, 1] sums a row up, which is corrected to the sum that white
shows. Of the variances v of a row e^2 = (sum v - sum v^2 / sum v) / 3 / (d + g)^2 is left, relative
to T p. A scan by cells has about K = 3 log4 N of them with V(g / K + a) for all of p, and half its
threshold is spread.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta

import numpy as np

from ltcl.acquisition.calibrate import expected_photographs
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.geometry.blocks import Blocks
from ltcl.acquisition.radiometry import NoiseModel
from ltcl.acquisition.scanning import adaptive, columns
from ltcl.acquisition.settings import STRATEGIES, ScanSettings

_MANY = 2048  # pixels from which one at a time, or as many patterns, take too long
_INDIRECT = 0.25  # of what a camera pixel sees under white, unless it is measured: a white corner
_SYSTEMATIC = 0.002  # relative error of T p by the calibration: response and white
_SIMILAR = 1.5  # times the smallest error: fewer photographs count more
_BYTES = 12  # of an entry: value, index, variance


@dataclass(frozen=True)
class Light:
    """Linear sensor values a second of a pixel: from its own light, all others together, and no projector."""

    direct: float = 0.5
    indirect: float = 0.2
    ambient: float = 0.01


@dataclass(frozen=True, repr=False)
class Plan:
    """Of one strategy, on a `grid` (h, w).

    `patterns` of the scan (of an adaptive one at most); `photographs`, those of the `calibration`
    included; `seconds` of all, with overhead; bytes on `disk` at most; relative `error` of T p by
    noise, 1 at most.
    """

    strategy: str
    grid: tuple[int, int]
    patterns: int
    calibration: int
    photographs: int
    seconds: float
    disk: int
    error: float

    def __repr__(self) -> str:
        (h, w), time = self.grid, timedelta(seconds=round(self.seconds))
        each = f"{h} x {w} pixels, {self.photographs} photographs, {time}, error of T p {self.error:.2%}"
        return f"<ltcl Plan {self.strategy}: {each}>"


def plans(
    grid: tuple[int, int],
    exposures: Sequence[float],
    noise: NoiseModel | None = None,
    light: Light | None = None,
    *,
    channels: int = 1,
    block: int = ScanSettings.block,
    order: int = ScanSettings.order,
    threshold: float = ScanSettings.threshold,
    overhead: float = 0.0,
    calibration: int | None = None,
) -> dict[str, Plan]:
    """A plan for every strategy.

    Each pattern is photographed at all `exposures` (seconds, ascending), each batch of patterns
    ends with one more photograph (`acquisition.anchor`), and each takes `overhead` seconds besides.
    `noise` and `light` are guessed before the calibration, then `measured`; it takes `calibration`
    photographs, by default as `acquisition.calibrate` expects. The others are as in `ltcl.acquire`.

    >>> strategies = plans((64, 64), (0.5, 8.0))
    >>> strategies["pixel"].patterns, strategies["adaptive"].patterns < 1000
    (4160, True)
    """
    noise, light = noise or NoiseModel(), light or Light()
    d, g, white, times = (
        light.direct,
        light.indirect,
        light.direct + light.indirect,
        np.array(exposures),
    )
    before = expected_photographs(grid, channels=channels) if calibration is None else calibration

    def variance(radiance: float) -> float:
        x = (radiance + light.ambient) * times
        t, x = times[x < noise.saturation], x[x < noise.saturation]
        return float(1.0 / np.sum(t**2 / noise.variance(x))) if t.size else math.inf

    result = {}
    for name in STRATEGIES:
        pixels = Blocks(grid, min(block, max(grid))).grid if name == "block" else grid
        n = math.prod(pixels)
        if name == "adaptive":  # its pictures are kept to the end
            # A camera pixel divides at most as many cells as have its threshold each.
            cells, active = adaptive.Cells(grid), 1.0 + g / white / max(threshold, 1e-9)
            patterns = math.ceil(sum(4 * np.minimum(np.diff(cells.offsets)[1:], active)))
            patterns, size = min(patterns, adaptive.most_patterns(cells)), adaptive.AT_ONCE
            entries, K = n * patterns, max(1.0, 3.0 * math.log(n, 4))
            square = K * variance(g / K) + (threshold / 2 * white) ** 2
        else:  # columns are stored twice while they are transposed
            code = columns.code_of(name, pixels, order)
            patterns, size, entries = columns.patterns(code, n), code.size, 2 * n * n
            bright, own, other = 1, variance(d), variance(g / n)
            if name == "hadamard":
                bright, m = size, (size + 1) / 2
                other = 2.0 / m * variance(m * g / n)
                own = (other + 2.0 / m * variance(d + m * g / n)) / 2
            total = bright * own + (n - bright) * other
            square = (total - (bright * own**2 + (n - bright) * other**2) / total) / 3.0
        error = (
            math.hypot(math.sqrt(max(square, 0.0)) / white, _SYSTEMATIC)
            if math.isfinite(square)
            else 1.0
        )
        batches = -(-(patterns if name == "adaptive" else n) // size)
        count = before + len(times) * patterns + batches
        seconds = (
            before * math.sqrt(times[0] * times[-1]) + patterns * times.sum() + batches * times[0]
        )
        seconds, disk = float(seconds + count * overhead), channels * _BYTES * entries
        result[name] = Plan(name, pixels, patterns, before, count, seconds, disk, min(error, 1.0))
    return result


def measured(calibration: Calibration) -> Light:
    """The light of a measured scene; which part of it is indirect is taken as a quarter."""
    white, dark = (light.value[light.valid] for light in (calibration.white, calibration.ambient))
    lit = (
        float(np.median(white[white > 0.1 * white.max(initial=0.0)]))
        if white.size
        else Light().direct
    )
    ambient = max(float(np.median(dark)), 0.0) if dark.size else 0.0
    return Light((1.0 - _INDIRECT) * lit, _INDIRECT * lit, ambient)


def choose(plans: dict[str, Plan]) -> tuple[str, str]:
    """The strategy of "auto", and why: adaptive for many pixels, or of fewer photographs at similar error."""
    h, w = plans["pixel"].grid
    if h * w > _MANY:
        return "adaptive", f"{h * w} pixels are more than {_MANY}"
    errors = {name: plans[name].error for name in ("pixel", "hadamard", "adaptive")}
    best = min(("pixel", "hadamard"), key=errors.__getitem__)
    fewer = plans["adaptive"].photographs < plans[best].photographs
    each = ", ".join(f"{name} {100 * error:.2g} %" for name, error in errors.items())
    why = f"relative error of a picture T p: {each}; adaptive takes {'' if fewer else 'no '}fewer photographs"
    return ("adaptive" if fewer and errors["adaptive"] <= _SIMILAR * errors[best] else best), why
