# SPDX-License-Identifier: BSD-3-Clause
"""Photographs, time, disk space and errors of a scan, before its first photograph.

For N pixels with direct light d, indirect light g of all pixels together and ambient light a (radiance), an
entry of T off its diagonal is about l = g / N. A photograph of radiance L and t seconds has the variance
V(L) = variance(L t) / t^2 of the noise model; several are merged as 1 / V = sum_k 1 / V_k. Entries have

    pixel      V(l + a);  V(d + a) on the diagonal
    hadamard   2 / m V(m l + a) in batches of n pixels, m = (n + 1) / 2 of them lit at a time;
               2 / m (V(d + m l + a) + V(m l + a)) / 2 in the batch of the camera pixel's own light

Hadamard doubles the variance where photons of l make the noise, and divides it by m / 2 where reading,
rounding or ambient light do. A picture T p of random light p in [0, 1] sums a row up; rows are corrected to
the sum that white shows, the noisiest entries most, so that of the variances v of a row

    e^2 = (sum v - sum v^2 / sum v) / 3 / (d + g)^2

is left, relative to T p. An adaptive scan has about K = 3 log4 N cells with V(g / K + a) for all of p, and
spreads half of its threshold too smoothly. `_SYSTEMATIC` is what the calibration adds to each.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltcl.acquisition.calibrate import photographs
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.radiometry import NoiseModel
from ltcl.acquisition.scanning import adaptive, codes
from ltcl.acquisition.scanning.cells import Blocks, Cells

STRATEGIES = ("adaptive", "pixel", "block", "hadamard")
MANY = 2048  # pixels from which one at a time, or as many patterns, take too long
THRESHOLD = 0.004  # of what a camera pixel sees, for which a cell is divided
_INDIRECT = 0.25  # of what a camera pixel sees under white, unless it is measured: a white corner
_SYSTEMATIC = 0.002  # relative error of T p by response and white
_SIMILAR = 1.5  # times the smallest error: fewer photographs count more
_BYTES = 12  # of an entry: value, index, variance


@dataclass(frozen=True)
class Light:
    """Radiance of a scene, in linear sensor values a second.

    Of a pixel: `direct` from its own light, `indirect` from all others together, `ambient` without projector.
    """

    direct: float = 0.5
    indirect: float = 0.2
    ambient: float = 0.01


@dataclass(frozen=True, repr=False)
class Plan:
    """Of one strategy.

    Attributes
    ----------
    strategy, why : str
    grid : (h, w)
        Of the transport.
    patterns, calibration, photographs : int
        Patterns of the scan (of an adaptive one at most); photographs of the calibration; all of them.
    seconds, disk : float, int
        Of all exposures with overhead; bytes at most.
    snr_direct, snr_indirect, error : float
        Signal over noise of an entry on the diagonal and of one off it; e of T p, 1 at most.

    Examples
    --------
    >>> found = plans((64, 64), (0.5, 8.0))
    >>> found["pixel"].patterns, found["adaptive"].photographs < found["pixel"].photographs / 4
    (4160, True)
    """

    strategy: str
    grid: tuple[int, int]
    patterns: int
    calibration: int
    photographs: int
    seconds: float
    disk: int
    snr_direct: float
    snr_indirect: float
    error: float
    why: str

    def __repr__(self) -> str:
        h, w = self.grid
        return (
            f"<ltcl Plan {self.strategy}: {self.photographs} photographs, {self.calibration} to calibrate, "
            f"{h} x {w} pixels, {duration(self.seconds)}, error of T p {100 * self.error:.2g} %>"
        )


def plans(
    grid: tuple[int, int],
    exposures: Sequence[float],
    noise: NoiseModel | None = None,
    light: Light | None = None,
    *,
    channels: int = 1,
    block: int = 2,
    order: int = 63,
    threshold: float = THRESHOLD,
    overhead: float = 0.0,
    calibration: int | None = None,
) -> dict[str, Plan]:
    """A plan for every strategy.

    Parameters
    ----------
    grid : (h, w)
        Of the projector.
    exposures : sequence of float
        Seconds of the photographs of each pattern, ascending.
    noise, light
        Guesses before there is a photograph, `measured` after the calibration.
    channels, block, order, threshold
        As in `ltcl.acquire`.
    overhead : float
        Seconds of each photograph besides its exposure.
    calibration : int, optional
        Its photographs; by default as many as `acquisition.calibrate` expects.
    """
    noise, light = noise or NoiseModel(), light or Light()
    times, white = np.array(exposures, np.float64), light.direct + light.indirect
    count = photographs(grid, channels=channels) if calibration is None else calibration
    before = count * (float(np.sqrt(times[0] * times[-1])) + overhead)

    def variance(radiance: float) -> float:
        x = (radiance + light.ambient) * times
        t, x = times[x < noise.saturation], x[x < noise.saturation]
        return float(1.0 / np.sum(t**2 / noise.variance(x))) if t.size else math.inf

    made = {}
    for name in STRATEGIES:
        pixels = Blocks(grid, min(block, max(grid))).grid if name == "block" else grid
        n = pixels[0] * pixels[1]
        weak = light.indirect / n
        own, other = variance(light.direct), variance(weak)
        # Columns are stored twice while they are transposed; an adaptive scan keeps its pictures to the end.
        if name == "adaptive":
            patterns, why = (
                _cells(grid, light, threshold),
                "cells divided where camera pixels see much of them",
            )
            entries, K = n * patterns, max(1.0, 3.0 * math.log(n, 4))
            square = K * variance(light.indirect / K) + (threshold / 2 * white) ** 2
        else:
            code = codes.code_of(name, pixels, order)
            patterns, why = codes.patterns(code, n), f"{code.size} pixels a batch"
            entries, size = 2 * n * n, 1
            if name == "hadamard":
                size, m = code.size, (code.size + 1) / 2
                other = 2.0 / m * variance(m * weak)
                own = (other + 2.0 / m * variance(light.direct + m * weak)) / 2
            square = _row_variance((own, size), (other, n - size)) / 3.0
        made[name] = Plan(
            name,
            pixels,
            patterns,
            count,
            count + len(times) * patterns,
            before + patterns * (float(times.sum()) + len(times) * overhead),
            channels * _BYTES * entries,
            light.direct / math.sqrt(own),
            weak / math.sqrt(other),
            min(math.hypot(math.sqrt(square) / white, _SYSTEMATIC), 1.0),
            why,
        )
    return made


def measured(calibration: Calibration) -> Light:
    """The light of a measured scene; which part of it is indirect is taken as a quarter."""
    white, dark = (part.value[part.valid] for part in (calibration.white, calibration.ambient))
    lit = float(np.median(white[white > 0.1 * white.max(initial=0.0)])) if white.size else Light().direct
    ambient = max(float(np.median(dark)), 0.0) if dark.size else 0.0
    return Light((1.0 - _INDIRECT) * lit, _INDIRECT * lit, ambient)


def choose(plans: dict[str, Plan]) -> tuple[str, str]:
    """The strategy of "auto", and why: adaptive for many pixels, or with fewer photographs at similar error.

    >>> light, photons, reading = Light(ambient=0.0), NoiseModel(2000.0, 0.0), NoiseModel(1e6, 0.01)
    >>> [choose(plans((12, 12), (1.0,), noise, light))[0] for noise in (photons, reading)]
    ['pixel', 'hadamard']
    """
    h, w = plans["pixel"].grid
    if h * w > MANY:
        return "adaptive", f"{h * w} pixels are more than {MANY}"
    errors = {name: plans[name].error for name in ("pixel", "hadamard", "adaptive")}
    best = min(("pixel", "hadamard"), key=errors.__getitem__)
    fewer = plans["adaptive"].photographs < plans[best].photographs
    each = ", ".join(f"{name} {100 * error:.2g} %" for name, error in errors.items())
    why = f"relative error of a picture T p: {each}; adaptive takes {'' if fewer else 'no '}fewer photographs"
    return ("adaptive" if fewer and errors["adaptive"] <= _SIMILAR * errors[best] else best), why


def duration(seconds: float) -> str:
    """Time for people.

    >>> duration(42.0), duration(5000.0)
    ('42 s', '1 h 23 min')
    """
    minutes = round(seconds / 60.0)
    if minutes < 2:
        return f"{seconds:.0f} s"
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min"


def _row_variance(*parts: tuple[float, int]) -> float:
    """sum v - sum v^2 / sum v of (v, count)s.

    >>> _row_variance((100.0, 1), (1.0, 2)).__round__(2), _row_variance((math.inf, 1), (1.0, 2))
    (3.94, inf)
    """
    whole = sum(v * count for v, count in parts)
    return whole - sum(v * v * count for v, count in parts) / whole if math.isfinite(whole) else math.inf


def _cells(grid: tuple[int, int], light: Light, threshold: float) -> int:
    """Patterns of an adaptive scan: a pixel asks at most for as many cells as have its threshold each."""
    cells, share = Cells(grid), light.indirect / (light.direct + light.indirect)
    active = 1.0 + share / max(threshold, 1e-9)
    most = sum(4 * min(math.prod(size), active) for size in cells.sizes[1:])
    return min(math.ceil(most), adaptive.most_patterns(cells))
