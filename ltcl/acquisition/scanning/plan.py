# SPDX-License-Identifier: BSD-3-Clause
"""What a scan takes and gives, said before the first photograph: photographs, time, disk, signal over noise.

Of N pixels, direct light d, indirect light g of all pixels together, ambient light a, all in radiance, an
entry of T off its diagonal is about l = g / N. One photograph of radiance L and t seconds has the variance
V(L) = variance(L t) / t^2 of the noise model, several are merged as 1 / V = sum_k 1 / V_k. So entries have

    pixel      V(l + a);  V(d + a) on the diagonal
    hadamard   2 / m V(m l + a) in batches of n pixels, m = (n + 1) / 2 of them lit at a time;
               2 / m (V(d + m l + a) + V(m l + a)) / 2 in the batch of the camera pixel's own light

and where photons of l make the noise the second is twice the first; where reading, rounding or ambient light
do, it is 2 / m of it. A picture T p of even random light p in [0, 1] sums a row up. Rows are made to add up
to white, the noisiest entries most, so that of the variances v of a row

    e^2 = (sum v - sum v^2 / sum v) / 3 / (d + g)^2

is left, relative to T p. An adaptive scan has about K = 3 log4 N cells with V(g / K + a), for all of p, and
half of its threshold that is spread too smoothly. To each comes `_REST` that the calibration leaves. `choose`
takes the smallest, and the adaptive scan where it takes fewer photographs at about the same; or where there
are so many pixels that only it ends in time.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from ltcl import checks
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.radiometry import NoiseModel
from ltcl.acquisition.scanning import adaptive, columns
from ltcl.acquisition.scanning.block import Blocks
from ltcl.acquisition.scanning.cells import Cells

STRATEGIES = ("adaptive", "pixel", "block", "hadamard")
MANY = 2048  # pixels from which one at a time, or as many patterns, take too long
THRESHOLD = 0.004  # of what a camera pixel sees, that a cell is divided for
_INDIRECT = 0.25  # of what a camera pixel sees under white, unless more is known
_REST = 0.002  # of T p: response and white
_ABOUT = 1.5  # times the smallest error: as good
_BYTES = 12  # of an entry: value, place, variance


@dataclass(frozen=True)
class Light:
    """What a scene is taken to send to the camera: radiance, in linear sensor values a second.

    Attributes
    ----------
    direct, indirect, ambient : float
        Of a pixel of its own light; of that of all other pixels together; without the projector.
    """

    direct: float = 0.5
    indirect: float = 0.2
    ambient: float = 0.01


@dataclass(frozen=True)
class Plan:
    """Of one strategy.

    Attributes
    ----------
    strategy : str
    grid : (h, w)
        Of the transport.
    patterns, photographs : int
        Without those of the calibration; of an adaptive scan what a scene like `Light` needs at most.
    seconds : float
        Of exposure, and of what the set-up takes for each photograph besides.
    disk : int
        Bytes at most.
    snr_direct, snr_indirect : float
        Signal over noise of an entry on the diagonal and of one beside it.
    error : float
        e, relative, of T p; 1 at most, as where every exposure saturates.
    why : str

    Examples
    --------
    >>> found = plans((64, 64), (0.5, 8.0))
    >>> found["pixel"].patterns, found["adaptive"].photographs < found["pixel"].photographs / 4
    (4160, True)
    """

    strategy: str
    grid: tuple[int, int]
    patterns: int
    photographs: int
    seconds: float
    disk: int
    snr_direct: float
    snr_indirect: float
    error: float
    why: str

    def to_json(self) -> str:
        """One line of JSON."""
        return json.dumps(asdict(self))

    def __str__(self) -> str:
        h, w = self.grid
        return (
            f"{self.strategy}: {self.photographs} photographs of {self.patterns} patterns for {h} x {w} "
            f"pixels, {duration(self.seconds)}, {checks.size(self.disk)} at most; signal over noise "
            f"{self.snr_direct:.3g} (direct), {self.snr_indirect:.2g} (a weak entry); a picture T p is off "
            f"by {100 * self.error:.2g} %; {self.why}"
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
) -> dict[str, Plan]:
    """A plan for every strategy.

    Parameters
    ----------
    grid : (h, w)
        Of the projector.
    exposures : sequence of float
        Seconds of the photographs of each pattern.
    noise, light
        Of camera and scene: guesses before there is a photograph, `measured` after the calibration.
    channels, block, order, threshold
        As in `ltcl.acquire`.
    overhead : float
        Seconds that each photograph takes beside its exposure.
    """
    noise, light = noise or NoiseModel(), light or Light()
    run = _Run(tuple(exposures), noise, light, channels, overhead, threshold)
    coarse, whys = Blocks(grid, min(block, max(grid))).grid, {"adaptive": "cells divided where it tells"}
    sizes = {"adaptive": (grid, _cells(grid, light, threshold), 1)}
    for name, pixels in (("pixel", grid), ("block", coarse), ("hadamard", grid)):
        code = columns.code_of(name, pixels, order)
        lit = code.size if name == "hadamard" else 1
        sizes[name] = (pixels, columns.patterns(code, pixels[0] * pixels[1]), lit)
        whys[name] = f"{code.size} pixels a batch" + (", and their sum" if lit == 1 else "")
    return {name: run.plan(name, *sizes[name], whys[name]) for name in STRATEGIES}


def measured(told: Calibration) -> Light:
    """What the calibration tells of the scene; how much of it is indirect it does not tell.

    An indirect part of a quarter is taken: of a white corner with an albedo of one half.
    """
    white, dark = (part.value[part.valid] for part in (told.white, told.ambient))
    lit = float(np.median(white[white > 0.1 * white.max(initial=0.0)])) if white.size else Light().direct
    ambient = max(float(np.median(dark)), 0.0) if dark.size else 0.0
    return Light((1.0 - _INDIRECT) * lit, _INDIRECT * lit, ambient)


def choose(given: dict[str, Plan]) -> tuple[str, str]:
    """The strategy that "auto" takes, and why.

    >>> light, photons, reading = Light(ambient=0.0), NoiseModel(2000.0, 0.0), NoiseModel(1e6, 0.01)
    >>> [choose(plans((12, 12), (1.0,), noise, light))[0] for noise in (photons, reading)]
    ['pixel', 'hadamard']
    """
    names = ("pixel", "hadamard", "adaptive")
    h, w = given["pixel"].grid
    if h * w > MANY:
        return "adaptive", f"{h * w} pixels are more than {MANY}"
    errors = {name: given[name].error for name in names}
    best = min(names[:2], key=errors.__getitem__)
    quick = given["adaptive"].photographs < given[best].photographs
    chosen = "adaptive" if quick and errors["adaptive"] <= _ABOUT * errors[best] else best
    each = ", ".join(f"{name} {100 * errors[name]:.2g} %" for name in names)
    fewer = "fewer" if quick else "no fewer"
    return chosen, f"a picture T p is off by: {each}; adaptive takes {fewer} photographs at most"


def duration(seconds: float) -> str:
    """Time as people read it.

    >>> duration(42.0), duration(5000.0)
    ('42 s', '1 h 23 min')
    """
    minutes = round(seconds / 60.0)
    if minutes < 2:
        return f"{seconds:.0f} s"
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min"


@dataclass(frozen=True)
class _Run:
    exposures: tuple[float, ...]
    noise: NoiseModel
    light: Light
    channels: int
    overhead: float
    threshold: float

    def plan(self, name: str, grid: tuple[int, int], patterns: int, order: int, why: str) -> Plan:
        n, most, light = grid[0] * grid[1], len(self.exposures), self.light
        # A block is as bright on its own pixels as one pixel, and sends that much more to the others.
        own, weak = self._entries(n, order)
        whole = self._cells(n) if name == "adaptive" else _balanced((own, order), (weak, n - order)) / 3.0
        lit = light.direct + light.indirect
        return Plan(
            name,
            grid,
            patterns,
            most * patterns,
            patterns * (sum(self.exposures) + most * self.overhead),
            self._disk(name, n, patterns),
            light.direct / math.sqrt(own),
            light.indirect / n / math.sqrt(weak),
            min(math.hypot(math.sqrt(whole) / lit, _REST), 1.0),
            why,
        )

    def _entries(self, n: int, order: int) -> tuple[float, float]:
        """Variance of an entry in the batch of the camera pixel's own light, and in others."""
        if order == 1:
            return self.variance(self.light.direct), self.variance(self.light.indirect / n)
        on = (order + 1) / 2
        dim, bright = (
            self.variance(part + on * self.light.indirect / n) for part in (0.0, self.light.direct)
        )
        return (dim + bright) / on, 2.0 / on * dim

    def _cells(self, n: int) -> float:
        """e^2 (d + g)^2 of an adaptive scan."""
        cells = max(1.0, 3.0 * math.log(n, 4))
        lost = self.threshold / 2 * (self.light.direct + self.light.indirect)
        return cells * self.variance(self.light.indirect / cells) + lost**2

    def variance(self, radiance: float) -> float:
        """Of one merged picture, at this radiance and the ambient one."""
        t = np.array(self.exposures)
        x = (radiance + self.light.ambient) * t
        usable = x < self.noise.saturation
        if not usable.any():
            return math.inf
        return float(1.0 / np.sum(t[usable] ** 2 / self.noise.variance(x[usable])))

    def _disk(self, name: str, n: int, patterns: int) -> int:
        # Columns are there twice while they are turned; an adaptive scan keeps its pictures until it ends.
        entries = n * patterns if name == "adaptive" else 2 * n * n
        return self.channels * _BYTES * entries


def _balanced(*parts: tuple[float, int]) -> float:
    """sum v - sum v^2 / sum v of (v, count)s.

    >>> _balanced((100.0, 1), (1.0, 2)).__round__(2), _balanced((math.inf, 1), (1.0, 2))
    (3.94, inf)
    """
    whole = sum(v * count for v, count in parts)
    return whole - sum(v * v * count for v, count in parts) / whole if math.isfinite(whole) else math.inf


def _cells(grid: tuple[int, int], light: Light, threshold: float) -> int:
    """Patterns of an adaptive scan: no pixel asks for more cells than have its threshold each."""
    cells = Cells(grid)
    share = light.indirect / (light.direct + light.indirect)
    active = 1.0 + share / max(threshold, 1e-9)
    found = sum(4 * min(math.prod(size), active) for size in cells.sizes[1:])
    return min(math.ceil(found), adaptive.most_patterns(cells))
