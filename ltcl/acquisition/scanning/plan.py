# SPDX-License-Identifier: BSD-3-Clause
"""Photographs, time, disk space and errors of a scan, before its first photograph.

For N pixels with direct light d, indirect light g of all pixels together and ambient light a
(radiance), an entry of T off its diagonal is about l = g / N. A photograph of radiance L and t
seconds has the variance V(L) = variance(L t) / t^2 of the noise model; several are merged as
1 / V = sum_k 1 / V_k. Entries have

    pixel      V(l + a);  V(d + a) on the diagonal
    hadamard   2 / m V(m l + a) in batches of n pixels, m = (n + 1) / 2 of them lit at a time;
               2 / m (V(d + m l + a) + V(m l + a)) / 2 in the batch of the camera pixel's own light

A picture T p of random light p in [0, 1] sums a row up, which is corrected to the sum that white
shows. Of the variances v of a row e^2 = (sum v - sum v^2 / sum v) / 3 / (d + g)^2 is left, relative
to T p. A scan by cells has about K = 3 log4 N of them with V(g / K + a) for all of p, and half its
threshold is spread. A scan of direct light leaves all of g out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta

import numpy as np

from ltcl.acquisition.calibrate import expected_photographs
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.estimation.neighbours import OFFSETS
from ltcl.acquisition.estimation.windows import functions_of_row, numbers_of_row
from ltcl.acquisition.geometry.blocks import Blocks
from ltcl.acquisition.radiance import valid_values
from ltcl.acquisition.radiometry import NoiseModel
from ltcl.acquisition.scanning import adaptive, columns, direct, sketch
from ltcl.acquisition.scanning.picture_log import BATCH_SIZE
from ltcl.acquisition.settings import STRATEGIES, ScanSettings

# Pixels from which one at a time, or as many patterns, take too long.
MAX_SINGLE_PIXELS = 2048
# Pixels from which "auto" makes no sketch, whose pictures are all in memory.
MAX_SKETCHED_PIXELS = 1 << 18
# Indirect share of a camera pixel's light under white, unless it is measured: a white corner.
INDIRECT_SHARE = 0.25
# Relative error of T p by the calibration: response and white.
CALIBRATION_ERROR = 0.002
# Relative error of T p by light that varies faster than the functions of a sketch do.
SKETCH_ERROR = 0.008
# Error relative to the smallest one, up to which fewer photographs count more.
MAX_ERROR_RATIO = 1.5
# Bytes of an entry: value, index, variance.
ENTRY_BYTES = 12
# Camera pixels count as lit above this share of the brightest under white.
LIT_SHARE = 0.1


@dataclass(frozen=True)
class Light:
    """Linear sensor values a second of a pixel.

    `direct` from its own light, `indirect` from all other pixels together, `ambient` without the
    projector.
    """

    direct: float = 0.5
    indirect: float = 0.2
    ambient: float = 0.01


@dataclass(frozen=True, repr=False)
class Plan:
    """Plan of one strategy.

    Attributes
    ----------
    strategy : str
    grid : tuple of int
        Pixels (h, w) of T.
    patterns : int
        Patterns of the scan, for "adaptive" and "direct" at most.
    calibration : int
        Photographs of the calibration.
    photographs : int
        Photographs of all, those of the calibration included.
    seconds : float
        Time of all, with overhead.
    disk : int
        Bytes on the disk, at most.
    error : float
        Relative error of T p by noise, 1 at most.
    computing : float, optional
        Time of computing besides, in seconds; None if the size of the camera is not known.
    """

    strategy: str
    grid: tuple[int, int]
    patterns: int
    calibration: int
    photographs: int
    seconds: float
    disk: int
    error: float
    computing: float | None = None

    def __repr__(self) -> str:
        h, w = self.grid
        time = timedelta(seconds=round(self.seconds))
        return (
            f"<ltcl Plan {self.strategy}: {h} x {w} pixels, {self.photographs} photographs, "
            f"{time}, error of T p {self.error:.2%}>"
        )


@dataclass(frozen=True, kw_only=True)
class _Outlook:
    """Patterns of a scan in batches of a size, its stored entries, and the variance of T p.

    `known` of the patterns are photographed by the calibration.
    """

    patterns: int
    known: int = 0
    batches: int
    entries: int
    variance: float


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
    stripes: int | None = None,
    frames: int = ScanSettings.frames,
    aligned: bool = False,
    by_hand: bool = False,
    fixed_exposures: bool = False,
    megapixels: float | None = None,
    pace: float | None = None,
) -> dict[str, Plan]:
    """Plan a scan with every strategy.

    Each pattern is photographed at all exposures, and each batch of patterns ends with one more
    photograph (`acquisition.anchor`).

    Parameters
    ----------
    grid : tuple of int
        Pixels (h, w) of the projector.
    exposures : sequence of float
        Seconds, ascending.
    noise, light : NoiseModel, Light, optional
        Of the camera and of the scene; None: guessed, as before the calibration.
    channels, block, order, threshold
        As in `ltcl.acquire`.
    overhead : float
        Seconds of each photograph besides its exposure.
    calibration : int, optional
        Photographs of the calibration; None: as many as expected.
    stripes : int, optional
        Photographs of it that are pictures of a sketch as well; None: as many as expected.
    frames, aligned, by_hand
        What the number of these depends on, as in `calibrate.expected_photographs`.
    fixed_exposures : bool
        Strategies of few patterns take all exposures, too; else the first one alone.
    megapixels : float, optional
        Pixels of the camera in millions; None: not known.
    pace : float, optional
        Seconds of computing for each photograph and megapixel (`scanning.pace`); None: not known.

    Examples
    --------
    >>> strategies = plans((64, 64), (0.5, 8.0))
    >>> strategies["pixel"].patterns, strategies["adaptive"].patterns < 1000
    (4160, True)
    """
    if noise is None:
        noise = NoiseModel()
    if light is None:
        light = Light()
    all_times = np.array(exposures)
    result = {}
    for strategy in STRATEGIES:
        pixels = grid
        sparing = is_sparing(strategy, grid)
        times = all_times
        if sparing and not fixed_exposures:
            times = all_times[:1]
        merged = _MergedNoise(noise, light.ambient, times)
        setup = calibration
        if setup is None:
            setup = expected_photographs(
                grid,
                channels,
                frames,
                aligned=aligned,
                by_hand=by_hand,
                sparing=sparing,
                direct=strategy == "direct",
            )
        if strategy == "block":
            pixels = Blocks(grid, min(block, max(grid))).grid
        if strategy == "sketch":
            known = stripes
            if known is None:
                is_shown = not aligned and len(times) == 1
                known = sketch.count_stripes(grid) if is_shown else 0
            outlook = _sketch_outlook(grid, merged, light, known)
        elif strategy == "direct":
            outlook = _direct_outlook(grid, merged, light)
        elif strategy == "adaptive":
            outlook = _adaptive_outlook(grid, threshold, merged, light)
        else:
            code = columns.choose_code(strategy, pixels, order)
            outlook = _column_outlook(code, math.prod(pixels), merged, light)
        taken = outlook.patterns - outlook.known
        photographs = setup + len(times) * taken + outlook.batches
        # The calibration's exposures are about the geometric mean of those of the scan.
        calibration_seconds = setup * math.sqrt(times[0] * times[-1])
        scan_seconds = taken * times.sum()
        computing = None
        if megapixels is not None and pace is not None:
            computing = photographs * megapixels * pace
        seconds = calibration_seconds + scan_seconds + outlook.batches * times[0]
        result[strategy] = Plan(
            strategy=strategy,
            grid=pixels,
            patterns=outlook.patterns,
            calibration=setup,
            photographs=photographs,
            seconds=float(seconds + photographs * overhead),
            disk=channels * ENTRY_BYTES * outlook.entries,
            error=_relative_error(outlook.variance, light),
            computing=computing,
        )
    return result


class _MergedNoise:
    """Variance of a radiance that several exposures are merged to."""

    def __init__(self, noise: NoiseModel, ambient: float, times: np.ndarray) -> None:
        self.noise = noise
        self.ambient = ambient
        self.times = times

    def variance(self, radiance: float) -> float:
        """Variance of light with the ambient light; infinite if every exposure saturates."""
        linear = (radiance + self.ambient) * self.times
        usable = linear < self.noise.saturation
        if not usable.any():
            return math.inf
        precision = self.times[usable] ** 2 / self.noise.variance(linear[usable])
        return float(1.0 / np.sum(precision))


def _sketch_outlook(
    grid: tuple[int, int], merged: _MergedNoise, light: Light, known: int
) -> _Outlook:
    """A sketch, each of whose pictures has half of the light; what it cannot resolve is guessed."""
    patterns = sketch.count_patterns(grid)
    white = light.direct + light.indirect
    functions = functions_of_row(grid)
    noise = functions / patterns * merged.variance(0.5 * white)
    return _Outlook(
        patterns=patterns,
        known=known,
        batches=-(-(patterns - known) // BATCH_SIZE),
        entries=math.prod(grid) * (patterns + numbers_of_row(grid)),
        variance=noise + (SKETCH_ERROR * white) ** 2,
    )


def _direct_outlook(grid: tuple[int, int], merged: _MergedNoise, light: Light) -> _Outlook:
    """A scan of direct light, each of whose pictures has half of the light."""
    patterns = direct.SHIFTS + direct.JUDGES
    neighbours = len(OFFSETS)
    half = 0.5 * (light.direct + light.indirect)
    noise = neighbours / direct.SHIFTS * merged.variance(half)
    return _Outlook(
        patterns=patterns,
        batches=-(-patterns // BATCH_SIZE),
        entries=math.prod(grid) * (patterns + neighbours),
        variance=noise + light.indirect**2,
    )


def _adaptive_outlook(
    grid: tuple[int, int], threshold: float, merged: _MergedNoise, light: Light
) -> _Outlook:
    """A scan by cells, whose pictures are kept to the end."""
    pixels = math.prod(grid)
    white = light.direct + light.indirect
    cells = adaptive.Cells(grid)
    # A camera pixel divides at most as many cells as have its threshold each.
    active = 1.0 + light.indirect / white / max(threshold, 1e-9)
    divided = np.minimum(np.diff(cells.offsets)[1:], active)
    patterns = min(math.ceil(sum(4 * divided)), adaptive.most_patterns(cells))
    terms = max(1.0, 3.0 * math.log(pixels, 4))
    noise = terms * merged.variance(light.indirect / terms)
    return _Outlook(
        patterns=patterns,
        batches=-(-patterns // BATCH_SIZE),
        entries=pixels * patterns,
        variance=noise + (threshold / 2 * white) ** 2,
    )


def _column_outlook(
    code: columns.Code, pixels: int, merged: _MergedNoise, light: Light
) -> _Outlook:
    """A scan by columns, which are stored twice while they are transposed."""
    direct = light.direct
    if isinstance(code, columns.Hadamard):
        bright_entries = code.size
        lit = (code.size + 1) / 2
        lit_light = lit * light.indirect / pixels
        dark_variance = 2.0 / lit * merged.variance(lit_light)
        lit_variance = 2.0 / lit * merged.variance(direct + lit_light)
        bright_variance = (dark_variance + lit_variance) / 2
    else:
        bright_entries = 1
        bright_variance = merged.variance(direct)
        dark_variance = merged.variance(light.indirect / pixels)
    dark_entries = pixels - bright_entries
    total = bright_entries * bright_variance + dark_entries * dark_variance
    squares = bright_entries * bright_variance**2 + dark_entries * dark_variance**2
    return _Outlook(
        patterns=columns.count_patterns(code, pixels),
        batches=-(-pixels // code.size),
        entries=2 * pixels * pixels,
        variance=(total - squares / total) / 3.0,
    )


def _relative_error(variance: float, light: Light) -> float:
    """Relative error of T p, 1 at most."""
    if not math.isfinite(variance):
        return 1.0
    noise = math.sqrt(max(variance, 0.0)) / (light.direct + light.indirect)
    return min(math.hypot(noise, CALIBRATION_ERROR), 1.0)


def measured(calibration: Calibration) -> Light:
    """Light of a measured scene; a quarter of it is taken as indirect."""
    white = valid_values(calibration.white)
    dark = valid_values(calibration.ambient)
    lit = Light.direct
    if white.size:
        is_lit = white > LIT_SHARE * white.max(initial=0.0)
        lit = float(np.median(white[is_lit]))
    ambient = 0.0
    if dark.size:
        ambient = max(float(np.median(dark)), 0.0)
    return Light(
        direct=(1.0 - INDIRECT_SHARE) * lit, indirect=INDIRECT_SHARE * lit, ambient=ambient
    )


def is_sketched(strategy: str, grid: tuple[int, int]) -> bool:
    """True if a scan is a sketch; "auto" makes one of many pixels, but not too many."""
    if strategy == "auto":
        return MAX_SINGLE_PIXELS < math.prod(grid) <= MAX_SKETCHED_PIXELS
    return strategy == "sketch"


def is_sparing(strategy: str, grid: tuple[int, int]) -> bool:
    """True if a scan takes few patterns, half lit, after a calibration of few photographs."""
    return strategy == "direct" or is_sketched(strategy, grid)


def choose(plans: dict[str, Plan]) -> tuple[str, str]:
    """The strategy of "auto", and why.

    A sketch for many pixels, adaptive for even more, or if it takes fewer photographs at a similar
    error.
    """
    h, w = plans["pixel"].grid
    if is_sketched("auto", (h, w)):
        return "sketch", f"{h * w} pixels are more than {MAX_SINGLE_PIXELS}"
    if h * w > MAX_SKETCHED_PIXELS:
        return "adaptive", f"{h * w} pixels are more than {MAX_SKETCHED_PIXELS}"
    errors = {name: plans[name].error for name in ("pixel", "hadamard", "adaptive")}
    best = "hadamard" if errors["hadamard"] < errors["pixel"] else "pixel"
    takes_fewer = plans["adaptive"].photographs < plans[best].photographs
    is_similar = errors["adaptive"] <= MAX_ERROR_RATIO * errors[best]
    listed = ", ".join(f"{name} {100 * error:.2g} %" for name, error in errors.items())
    difference = "fewer" if takes_fewer else "no fewer"
    reason = f"relative error of a picture T p: {listed}; adaptive takes {difference} photographs"
    if takes_fewer and is_similar:
        return "adaptive", reason
    return best, reason
