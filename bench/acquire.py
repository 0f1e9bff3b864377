# SPDX-License-Identifier: BSD-3-Clause
"""A transport measured from photographs alone, beside the true one: its errors and its cost.

A corner of 64 x 64 projector pixels, each wall 64 x 32, has a known exact transport. A virtual
camera photographs it: a response that the software is not told, a black offset of 0.4 %, ambient
light, photon and read noise, 8 or 12 bits. Then the measured T is used, and compared in the
camera's own unit of light (its last code; nothing else fixes it, so one scale a channel is not
counted as an error):

    T p             of patterns that no scan has seen
    compensated     a picture that is shown with the computed pattern
    bounces 1 to 3  of a picture, against their `std`, which is known without the truth: root mean
                    squares
    far light       the sum of the light that a pixel gets from beyond its tile of n / 8 pixels and
                    the tiles around it

An adaptive scan has to need a fifth of the photographs of one pixel at a time at most. Smaller
corners give photographs and time against the number of pixels, beside the forecast of the plan.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import scipy.linalg
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

import _figures as figures
import ltcl
from _coefficients import relative_error
from _figures import Claim
from _harness import parse_options
from ltcl import Transport
from ltcl.acquisition import Report, VirtualRig, acquire
from ltcl.device import Device
from ltcl.store import BlockStore

ALBEDO = 0.6
# Response and bits of each camera.
CAMERAS = {"srgb, 8 bits": ("srgb", 8), "film, 12 bits": ("film", 12)}
STRATEGIES = ("adaptive", "hadamard", "pixel")
# Albedo of each channel, and the light of projector channels (columns) in camera channels.
COLOURS = (0.7, 0.5, 0.3)
MIXING = [[0.9, 0.15, 0.0], [0.05, 0.8, 0.1], [0.0, 0.2, 0.9]]
# Tiles along a side, for far light.
TILES = 8
# Largest relative errors, error over standard deviation, and least decibels.
MAX_ERROR = 0.02
MAX_DEVIATIONS = 2
MIN_DECIBELS = 30
# Name and colour of the strategies' curves, and width, as one lies below another.
LINES = {
    "adaptive": ("adaptive", "#c0392b", 1.5),
    "hadamard": ("S-matrices", "#2a7f9e", 4),
    "pixel": ("one at a time", "#e0b34c", 1.5),
}


@dataclass(frozen=True, kw_only=True)
class Scan:
    """An acquisition: photographs and seconds of exposure, planned and taken, and errors of T.

    `seconds` is the time it ran. `row_sum_error` is that of the picture under white, and
    `sum_deviation` that of the columns beside white before they were made to add up to it.
    `far_error` is the error of far light row by row, `far_total_error` that of its sum, which noise
    hardly changes. `bounce_errors` are the errors over `std` of bounces 0 to 3, `share_within` is
    the share within 3 deviations.
    """

    name: str
    strategy: str
    pixels: int
    planned: int
    photographs: int
    planned_exposure: float
    exposure: float
    seconds: float
    pattern_error: float
    row_sum_error: float
    sum_deviation: float
    far_error: float
    far_total_error: float
    decibels: float
    bounce_errors: list[float]
    share_within: float


@cache
def corner(n: int, albedo: float = ALBEDO) -> np.ndarray:
    """T of two walls of n x n / 2 pixels, from exact form factors of squares joined in pairs."""
    G = np.asarray(ltcl.scenes.dihedral(n).form_factors, np.float64)
    pairs = G.reshape(n, n, 2, n, n, 2).sum(axis=5).mean(axis=2)
    absorbed = np.eye(n * n) - albedo * pairs.reshape(n * n, n * n)
    return albedo * np.linalg.inv(absorbed)


def held_patterns(n: int) -> np.ndarray:
    """Noise, stripes and smooth patterns that no scan shows, (N, 6)."""
    rng = np.random.default_rng(11)
    y, x = np.mgrid[:n, :n] / n
    patterns = [
        rng.random((n, n)),
        rng.random((n, n)),
        np.sin(60 * x + 20 * y) > 0,
        x * (1 - y),
        0.5 + 0.5 * np.sin(9 * x),
        (x - 0.3) ** 2 + y**2 < 0.1,
    ]
    return np.stack(patterns).astype(np.float64).reshape(6, -1).T


class Truth:
    """T of each channel in float64, and its products with patterns (N, k, channels)."""

    def __init__(self, matrices: Sequence[np.ndarray], mixing: Any = None) -> None:
        self.matrices = list(matrices)
        self.mixing = mixing
        self.channels = len(self.matrices)
        self.n = round(len(matrices[0]) ** 0.5)

    def pictures(self, patterns: np.ndarray) -> np.ndarray:
        """Pictures of patterns, (N, k, channels)."""
        light = patterns
        if self.mixing is not None:
            light = patterns @ np.transpose(self.mixing)
        products = [T @ light[..., channel] for channel, T in enumerate(self.matrices)]
        return np.stack(products, axis=-1)

    def bounces(self, image: np.ndarray, count: int) -> np.ndarray:
        """Bounces b_0, b_1, ... (eq. 27) of a picture (N, channels); the first is diag(T)'s."""
        channels = []
        for channel, T in enumerate(self.matrices):
            factors = scipy.linalg.lu_factor(T)
            F = np.diag(T)
            remaining = image[:, channel]
            bounces = []
            for _ in range(count + 1):
                bounce = F * scipy.linalg.lu_solve(factors, remaining)
                remaining = remaining - bounce
                bounces.append(bounce)
            channels.append(bounces)
        return np.moveaxis(np.array(channels), 0, -1)


def measured_pictures(T: Transport, patterns: np.ndarray) -> np.ndarray:
    """Pictures (N, k, channels) of a measured T."""
    N, k, channels = patterns.shape
    frames = np.moveaxis(patterns, 1, 0).astype(np.float32)
    frames = frames.reshape(k, *T.grid, channels)
    if channels == 1:
        frames = frames[..., 0]
    pictures = np.asarray(T @ frames, np.float64)
    return np.moveaxis(pictures.reshape(k, N, channels), 0, 1)


def run_scan(truth: Truth, camera: str, strategy: str, device: Device, name: str) -> Scan:
    """Measure T from photographs, and compare it with the truth."""
    response, bits = CAMERAS[camera]
    matrices: Any = truth.matrices
    if truth.channels == 1:
        (matrices,) = truth.matrices
    rig = VirtualRig(
        matrices,
        (truth.n, truth.n),
        mixing=truth.mixing,
        response=response,
        bits=bits,
        ambient=0.01,
        seed=2,
    )
    with TemporaryDirectory() as folder:
        path = Path(folder) / "T.zarr"
        start = time.perf_counter()
        T = acquire(rig, geometry="aligned", strategy=strategy, store=path, device=device)
        seconds = time.perf_counter() - start
        report = Report.of(path)
        plan = BlockStore.open(path).attributes["plan"]
        judge = Judge(T, truth)
        far_error, far_total_error = judge.far_errors()
        bounce_errors, share_within = judge.bounce_errors()
        return Scan(
            name=name,
            strategy=strategy,
            pixels=truth.n**2,
            planned=plan["photographs"],
            photographs=report.photographs,
            planned_exposure=plan["seconds"],
            exposure=report.patterns * sum(report.exposures),
            seconds=seconds,
            pattern_error=judge.pattern_error(),
            row_sum_error=judge.row_sum_error(),
            sum_deviation=report.sum_deviation,
            far_error=far_error,
            far_total_error=far_total_error,
            decibels=judge.compensation_decibels(),
            bounce_errors=bounce_errors,
            share_within=share_within,
        )


class Judge:
    """Errors of a measured T in the camera's unit of light, `unit` in each channel."""

    def __init__(self, T: Transport, truth: Truth) -> None:
        self.T = T
        self.truth = truth
        self.channels = truth.channels
        white = np.ones((truth.n**2, 1, self.channels))
        self._white = measured_pictures(T, white)[:, 0]
        self._true_white = truth.pictures(white)[:, 0]
        products = np.sum(self._white * self._true_white, axis=0)
        self.unit = products / np.sum(self._white**2, axis=0)

    def row_sum_error(self) -> float:
        """Largest relative error of a row sum."""
        ratios = self.unit * self._white / self._true_white
        return float(np.max(np.abs(ratios - 1)))

    def pattern_error(self) -> float:
        """Relative error of T p of held patterns."""
        patterns = self._grey(held_patterns(self.truth.n))
        ours = self.unit * measured_pictures(self.T, patterns)
        return relative_error(ours, self.truth.pictures(patterns))

    def far_errors(self) -> tuple[float, float]:
        """Relative error of the light from far tiles: row by row, and of all rows together."""
        n = self.truth.n
        place = np.arange(n) // (n // TILES)
        tile = (place[:, None] * TILES + place).ravel()[:, None]
        tiles = np.arange(TILES**2)
        patterns = self._grey(tile == tiles)
        row, column = np.divmod(tile, TILES)
        other_row, other_column = np.divmod(tiles, TILES)
        row_distance = abs(row - other_row)
        distance = np.maximum(row_distance, abs(column - other_column))
        is_far = (distance > 1)[..., None]
        measured = self.unit * measured_pictures(self.T, patterns)
        ours = np.sum(is_far * measured, axis=1)
        exact = np.sum(is_far * self.truth.pictures(patterns), axis=1)
        total_errors = np.abs(ours.sum(axis=0) / exact.sum(axis=0) - 1)
        return relative_error(ours, exact), float(np.max(total_errors))

    def bounce_errors(self) -> tuple[list[float], float]:
        """Root mean square errors over their deviations, of bounces 0 to 3; share within three."""
        pattern = self._grey(held_patterns(self.truth.n)[:, 4:5])
        image = self.truth.pictures(pattern)[:, 0]
        picture = image.reshape(*self.T.grid, self.channels).astype(np.float32)
        if self.channels == 1:
            picture = picture[..., 0]
        separation = ltcl.separate(self.T, picture, bounces=3, rtol=1e-4)
        ours = self._all_bounces(separation)
        deviation = self._all_bounces(separation.std)
        error = ours - self.truth.bounces(image, 3)
        mean_square = np.mean(error**2, axis=(1, 2))
        variance = np.mean(deviation.astype(np.float64) ** 2, axis=(1, 2))
        ratios = np.sqrt(mean_square / variance)
        shares_within = np.mean(np.abs(error) < 3 * deviation, axis=(1, 2))
        return ratios.tolist(), float(np.min(shares_within))

    def _grey(self, patterns: np.ndarray) -> np.ndarray:
        """Patterns (N, k) in each channel, (N, k, channels)."""
        return np.repeat(patterns[..., None], self.channels, axis=-1)

    def _all_bounces(self, separation: Any) -> np.ndarray:
        """Direct light and bounces, (4, N, channels)."""
        stacked = np.concatenate([separation.direct[None], separation.bounces])
        return stacked.reshape(4, -1, self.channels)

    def compensation_decibels(self) -> float:
        """Peak signal over noise of a compensated picture under the true transport."""
        h, w = self.T.grid
        y, x = np.mgrid[:h, :w] / h
        level = 0.25 if self.channels == 1 else 0.1
        waves = 1 + 0.4 * np.sin(7 * x + 4 * y)
        desired = level * waves[..., None] * np.ones(self.channels)
        target = (desired / self.unit).astype(np.float32)
        if self.channels == 1:
            target = target[..., 0]
        pattern = ltcl.compensate(self.T, target, rtol=1e-3).pattern
        light = np.asarray(pattern, np.float64)
        picture = self.truth.pictures(light.reshape(-1, 1, self.channels))[:, 0]
        error = picture - desired.reshape(-1, self.channels)
        return float(10 * np.log10(desired.max() ** 2 / np.mean(error**2)))


def claims(scans: list[Scan], costs: list[Scan], largest: int) -> list[Claim]:
    """Check costs, those of `largest` pixels first, and the errors of all scans."""
    photographs = {}
    for cost in costs:
        if cost.pixels == largest:
            photographs[cost.strategy] = cost.photographs
    adaptive = photographs["adaptive"]
    by_pixel = photographs["pixel"]
    fifth = Claim(
        text="an adaptive scan takes a fifth of the photographs of one pixel at a time",
        measured=f"{adaptive} of {by_pixel}",
        wanted="at most 1 / 5",
        holds=5 * adaptive <= by_pixel,
    )
    planned_photographs = figures.values(costs, "planned")
    over_plan = (figures.values(costs, "photographs") / planned_photographs).max()
    planned = Claim(
        text="photographs over what the plan said, at most",
        measured=f"{over_plan:.3f}",
        wanted="at most 1",
        holds=over_plan <= 1,
    )
    result = [fifth, planned]
    for scan in scans:
        result += scan_claims(scan)
    return result


def scan_claims(scan: Scan) -> list[Claim]:
    """Check the errors of one scan."""
    compensated = Claim(
        text=f"{scan.name}: compensated",
        measured=f"{scan.decibels:.1f} dB",
        wanted="at least 30",
        holds=scan.decibels >= MIN_DECIBELS,
    )
    later = scan.bounce_errors[1:]
    ratios = ", ".join(f"{ratio:.2f}" for ratio in later)
    bounces = Claim(
        text=f"{scan.name}: bounces 1 to 3, error over std",
        measured=f"{ratios}; {scan.share_within:.1%} within 3 deviations",
        wanted="at most 2",
        holds=max(later) <= MAX_DEVIATIONS,
    )
    return [
        error_claim(f"{scan.name}: T p of held patterns", scan.pattern_error),
        error_claim(f"{scan.name}: row sum furthest off", scan.row_sum_error),
        error_claim(f"{scan.name}: far light, all", scan.far_total_error, " off"),
        compensated,
        bounces,
    ]


def error_claim(text: str, error: float, suffix: str = "") -> Claim:
    return Claim(text, f"{error:.2%}{suffix}", "at most 2 %", error <= MAX_ERROR)


def collect_facts(scans: list[Scan], costs: list[Scan], pixels: int) -> dict[str, Any]:
    """Facts of all scans, and photographs over the plan."""
    facts: dict[str, Any] = {"pixels": pixels}
    for scan in scans:
        facts[f"{scan.name}, seconds"] = scan.seconds
        facts[f"{scan.name}, photographs"] = scan.photographs
        facts[f"{scan.name}, far light row by row"] = scan.far_error
        facts[f"{scan.name}, direct part, error over std"] = scan.bounce_errors[0]
        if scan.strategy != "adaptive":
            name = f"{scan.name}, columns beside white before they added up to it"
            facts[name] = scan.sum_deviation
    for cost in costs:
        name = f"{cost.strategy}, {cost.pixels} pixels, photographs over plan"
        facts[name] = cost.photographs / cost.planned
    return facts


def draw(costs: list[Scan]) -> Figure:
    """Draw photographs, exposure and computing time over the number of pixels."""
    figure = figures.page(
        440,
        "What it takes to measure a transport",
        "A corner of n x n pixels, a camera of 12 bits. Dashed: what plans said.",
    )
    box = (70, 140, 260, 230)
    photographs = figures.graph(figure, box, "photographs", "pixels", "")
    plot_costs(photographs, costs, "photographs", "planned")
    figures.legend(photographs, 9.5, figures.FAINT)
    box = (390, 140, 260, 230)
    exposure = figures.graph(figure, box, "hours of exposure", "pixels", "")
    plot_costs(exposure, costs, "exposure", "planned_exposure", unit=3600)
    box = (710, 140, 260, 230)
    seconds = figures.graph(figure, box, "seconds of computing", "pixels", "")
    plot_costs(seconds, costs, "seconds")
    return figure


def plot_costs(
    axes: Axes, costs: list[Scan], quantity: str, planned: str | None = None, unit: float = 1
) -> None:
    """Plot a field of the scans by strategy, and the planned one dashed."""
    sides = sorted({round(cost.pixels**0.5) for cost in costs})
    for strategy, (label, colour, width) in LINES.items():
        pixels = []
        values = []
        planned_values = []
        for cost in costs:
            if cost.strategy != strategy:
                continue
            pixels.append(cost.pixels)
            values.append(getattr(cost, quantity) / unit)
            if planned is not None:
                planned_values.append(getattr(cost, planned) / unit)
        style = {"ms": 4, "lw": width, "color": colour, "label": label}
        axes.plot(pixels, values, "o-", **style)
        if planned is not None:
            axes.plot(pixels, planned_values, "--", lw=1, color=colour)
    axes.set_xscale("log")
    squares = np.array(sides) ** 2
    axes.set_xticks(squares, [f"{n}\u00b2" for n in sides])
    decades = LogLocator(subs=(1.0, 2.0, 5.0), numticks=20)
    axes.yaxis.set_major_locator(decades)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
    axes.minorticks_off()


def main() -> None:
    """Run the bench."""
    options = parse_options(__doc__)
    sides = [16, 24, 32, 48, 64]
    cameras = list(CAMERAS)
    colour_side = 32
    if options.smoke:
        sides = [6, 8]
        cameras = cameras[-1:]
        colour_side = 6
    run = partial(run_scan, device=options.device)
    largest = sides[-1]
    truth = Truth([corner(largest)])
    scans = []
    for camera, strategy in itertools.product(cameras, STRATEGIES):
        scans.append(run(truth, camera, strategy, name=f"{strategy}, {camera}"))
    costs = []
    for n, strategy in itertools.product(sides[:-1], STRATEGIES):
        smaller = Truth([corner(n)])
        costs.append(run(smaller, "film, 12 bits", strategy, name=f"{strategy}, {n}"))
    costs += [scan for scan in scans if "film" in scan.name]
    matrices = [corner(colour_side, albedo) for albedo in COLOURS]
    coloured = Truth(matrices, MIXING)
    for strategy in STRATEGIES[:2]:
        scans.append(run(coloured, "srgb, 8 bits", strategy, name=f"{strategy}, colours"))
    facts = collect_facts(scans, costs, largest**2)
    checked = claims(scans, costs, largest**2)
    if options.smoke:
        # So few pixels show that it runs, not how few photographs a larger scene takes.
        checked = checked[1:2]
    draw_costs = partial(draw, costs)
    figures.conclude(options, "A transport from photographs", checked, facts, draw_costs)


if __name__ == "__main__":
    main()
