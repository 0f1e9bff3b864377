# SPDX-License-Identifier: BSD-3-Clause
"""A transport measured from photographs alone, beside the true one: how far off, and what it costs.

A corner of 64 x 64 projector pixels, each wall 64 x 32, of which the exact transport is known. A
virtual camera photographs it: a response that nothing tells the software, a black offset of 0.4 %,
ambient light, photon and read noise, 8 or 12 bits. Then the measured T is used, and compared in the
camera's own unit of light (its last code; nothing else fixes it, so one scale a channel is not
counted as an error):

    T p             of patterns that no scan has seen
    compensated     a picture that is shown with the pattern that T says
    bounces 1 to 3  of a picture, against their `std`, which is known without the truth
    far light       root mean square of the sum that a pixel gets from beyond its tile of n / 8
                    pixels and the tiles around it

An adaptive scan has to need a fifth of the photographs of one pixel at a time at most. Smaller
corners give photographs and time against the number of pixels, beside what the plan said before the
first one.
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
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

import _figures as figures
import ltcl
from _coefficients import relative_error
from _figures import Claim
from _harness import parse_options
from ltcl.acquisition import Report, VirtualRig, acquire
from ltcl.device import Device
from ltcl.store import BlockStore

ALBEDO = 0.6
CAMERAS = {"srgb, 8 bits": ("srgb", 8), "film, 12 bits": ("film", 12)}
STRATEGIES = ("adaptive", "hadamard", "pixel")
COLOURS, MIXING = (0.7, 0.5, 0.3), [[0.9, 0.15, 0.0], [0.05, 0.8, 0.1], [0.0, 0.2, 0.9]]
TILES = 8
# Of the strategies: name and colour of their curves, and width, as one lies below another.
LINES = {
    "adaptive": ("adaptive", "#c0392b", 1.5),
    "hadamard": ("S-matrices", "#2a7f9e", 4),
    "pixel": ("one at a time", "#e0b34c", 1.5),
}


@dataclass(frozen=True)
class Found:
    """One acquisition: photographs and seconds of exposure, as planned and as taken; seconds it ran.

    `bounces`: error over `std` of bounces 0 to 3; `inside`: within 3 deviations. `far` is the error
    of far light row by row, `weak` that of all of it, which noise hardly changes.
    """

    name: str
    strategy: str
    pixels: int
    planned: int
    photographs: int
    planned_exposure: float
    exposure: float
    seconds: float
    held: float
    sums: float
    sum_deviation: float
    far: float
    weak: float
    decibels: float
    bounces: list[float]
    inside: float


@cache
def corner(n: int, albedo: float = ALBEDO) -> np.ndarray:
    """T of two walls of n x n / 2 pixels, from exact form factors of squares put together in pairs."""
    G = np.asarray(ltcl.scenes.dihedral(n).form_factors, np.float64)
    pairs = G.reshape(n, n, 2, n, n, 2).sum(axis=5).mean(axis=2).reshape(n * n, n * n)
    return albedo * np.linalg.inv(np.eye(n * n) - albedo * pairs)


def held(n: int) -> np.ndarray:
    """Noise, stripes and smooth patterns, (N, 6)."""
    rng = np.random.default_rng(11)
    y, x = np.mgrid[:n, :n] / n
    smooth = [x * (1 - y), 0.5 + 0.5 * np.sin(9 * x), (x - 0.3) ** 2 + y**2 < 0.1]
    patterns = [rng.random((n, n)), rng.random((n, n)), np.sin(60 * x + 20 * y) > 0, *smooth]
    return np.stack(patterns).astype(np.float64).reshape(6, -1).T


class Truth:
    """T of each channel in float64, and what becomes of patterns (N, k, channels)."""

    def __init__(self, matrices: Sequence[np.ndarray], mixing: Any = None) -> None:
        self.matrices, self.mixing = list(matrices), mixing
        self.channels, self.n = len(self.matrices), round(len(matrices[0]) ** 0.5)

    def seen(self, P: np.ndarray) -> np.ndarray:
        """The pictures (N, k, channels)."""
        q = P if self.mixing is None else P @ np.transpose(self.mixing)
        return np.stack([T @ q[..., c] for c, T in enumerate(self.matrices)], axis=-1)

    def bounces(self, image: np.ndarray, count: int) -> np.ndarray:
        """b_0, b_1, ... (eq. 27) of a picture (N, channels), whose first bounce is the diagonal of T."""
        found = []
        for c, T in enumerate(self.matrices):
            undone, F, left, chain = scipy.linalg.lu_factor(T), np.diag(T), image[:, c], []
            for _ in range(count + 1):
                chain.append(F * scipy.linalg.lu_solve(undone, left))
                left = left - chain[-1]
            found.append(chain)
        return np.moveaxis(np.array(found), 0, -1)


def shown(T: ltcl.Transport, P: np.ndarray) -> np.ndarray:
    """Pictures (N, k, channels) of a measured T."""
    N, k, channels = P.shape
    frames = np.moveaxis(P, 1, 0).reshape(k, *T.grid, channels).astype(np.float32)
    seen = np.asarray(T @ (frames[..., 0] if channels == 1 else frames), np.float64)
    return np.moveaxis(seen.reshape(k, N, channels), 0, 1)


def measured(truth: Truth, camera: str, strategy: str, device: Device, name: str) -> Found:
    response, bits = CAMERAS[camera]
    grid, T_or = (truth.n, truth.n), truth.matrices if truth.channels == 3 else truth.matrices[0]
    rig = VirtualRig(
        T_or, grid, mixing=truth.mixing, response=response, bits=bits, ambient=0.01, seed=2
    )
    with TemporaryDirectory() as folder:
        path, start = Path(folder) / "T.zarr", time.perf_counter()
        T = acquire(rig, geometry="aligned", strategy=strategy, store=path, device=device)
        seconds, report = time.perf_counter() - start, Report.of(path)
        plan = BlockStore.open(path).attributes["plan"]
        exposures = plan["seconds"], report.patterns * sum(report.exposures)
        white = np.ones((truth.n**2, 1, truth.channels))
        ours, theirs = shown(T, white)[:, 0], truth.seen(white)[:, 0]
        unit = np.sum(ours * theirs, axis=0) / np.sum(ours**2, axis=0)  # of light, of each channel
        sums = float(np.max(np.abs(unit * ours / theirs - 1)))
        P = np.repeat(held(truth.n)[..., None], truth.channels, axis=-1)
        return Found(
            name, strategy, truth.n**2, plan["photographs"], report.photographs, *exposures, seconds,
            relative_error(unit * shown(T, P), truth.seen(P)), sums, report.sum_deviation,
            *far(T, truth, unit), compensated(T, truth, unit), *of_bounces(T, truth),
        )  # fmt: skip


def far(T: ltcl.Transport, truth: Truth, unit: np.ndarray) -> tuple[float, float]:
    """Error of the light from far tiles, relative to that light: row by row, and of all rows together."""
    n, side = truth.n, truth.n // TILES
    tile = ((np.arange(n) // side)[:, None] * TILES + np.arange(n) // side).ravel()[:, None]
    P = np.repeat((tile == np.arange(TILES**2))[..., None], truth.channels, axis=-1)
    (y, x), (v, u) = (np.divmod(part, TILES) for part in (tile, np.arange(TILES**2)))
    beyond = (np.maximum(abs(y - v), abs(x - u)) > 1)[..., None]
    ours, theirs = (np.sum(beyond * seen, axis=1) for seen in (unit * shown(T, P), truth.seen(P)))
    return relative_error(ours, theirs), float(
        np.max(np.abs(ours.sum(axis=0) / theirs.sum(axis=0) - 1))
    )


def of_bounces(T: ltcl.Transport, truth: Truth) -> tuple[list[float], float]:
    """Root mean square errors over their deviations, of bounces 0 to 3; the part within three of them."""
    p = np.repeat(held(truth.n)[:, 4][:, None, None], truth.channels, axis=-1)
    image = truth.seen(p)[:, 0]
    picture = image.reshape(*T.grid, truth.channels).astype(np.float32)
    picture = picture[..., 0] if truth.channels == 1 else picture
    found = ltcl.separate(T, picture, bounces=3, rtol=1e-4)
    ours, deviation = (
        np.concatenate([part.direct[None], part.bounces]).reshape(4, -1, truth.channels)
        for part in (found, found.std)
    )
    error = ours - truth.bounces(image, 3)
    ratios = np.sqrt(
        np.mean(error**2, axis=(1, 2)) / np.mean(deviation.astype(np.float64) ** 2, axis=(1, 2))
    )
    return ratios.tolist(), float(np.min(np.mean(np.abs(error) < 3 * deviation, axis=(1, 2))))


def compensated(T: ltcl.Transport, truth: Truth, unit: np.ndarray) -> float:
    """Peak signal over noise of a compensated picture under the true transport."""
    y, x = np.mgrid[: T.grid[0], : T.grid[1]] / T.grid[0]
    level = 0.25 if truth.channels == 1 else 0.1
    desired = level * (1 + 0.4 * np.sin(7 * x + 4 * y))[..., None] * np.ones(truth.channels)
    wanted = (desired / unit).astype(np.float32)
    pattern = ltcl.compensate(
        T, wanted[..., 0] if truth.channels == 1 else wanted, rtol=1e-3
    ).pattern
    given = np.asarray(pattern, np.float64).reshape(-1, 1, truth.channels)
    error = truth.seen(given)[:, 0] - desired.reshape(-1, truth.channels)
    return float(10 * np.log10(desired.max() ** 2 / np.mean(error**2)))


def claims(found: list[Found], costs: list[Found], largest: int) -> list[Claim]:
    cost = {one.strategy: one.photographs for one in costs if one.pixels == largest}
    over = max(one.photographs / one.planned for one in costs)
    fifth = "an adaptive scan takes a fifth of the photographs of one pixel at a time"
    counts, is_fifth = (
        f"{cost['adaptive']} of {cost['pixel']}",
        5 * cost["adaptive"] <= cost["pixel"],
    )
    listed = [
        Claim(fifth, counts, "at most 1 / 5", is_fifth),
        Claim(
            "photographs over what the plan said, at most", f"{over:.3f}", "at most 1", over <= 1
        ),
    ]
    for one in found:
        ratios = ", ".join(f"{ratio:.2f}" for ratio in one.bounces[1:])
        bounces = f"{one.name}: bounces 1 to 3, error over std"
        inside = f"{one.inside:.1%} within 3 deviations"
        listed += [
            Claim(
                f"{one.name}: T p of held patterns",
                f"{one.held:.2%}",
                "at most 2 %",
                one.held <= 0.02,
            ),
            Claim(
                f"{one.name}: row sum furthest off",
                f"{one.sums:.2%}",
                "at most 2 %",
                one.sums <= 0.02,
            ),
            Claim(
                f"{one.name}: far light, all",
                f"{one.weak:.2%} off",
                "at most 2 %",
                one.weak <= 0.02,
            ),
            Claim(
                f"{one.name}: compensated",
                f"{one.decibels:.1f} dB",
                "at least 30",
                one.decibels >= 30,
            ),
            Claim(bounces, f"{ratios}; {inside}", "at most 2", max(one.bounces[1:]) <= 2),
        ]
    return listed


def draw(costs: list[Found]) -> Figure:
    figure = figures.page(
        440,
        "What it takes to measure a transport",
        "A corner of n x n pixels, a camera of 12 bits. Dashed: what plans said.",
    )
    quantities = [
        ("photographs", 1, "photographs", "planned"),
        ("hours of exposure", 3600, "exposure", "planned_exposure"),
        ("seconds of computing", 1, "seconds", None),
    ]
    for place, (title, unit, taken, planned) in enumerate(quantities):
        axes = figures.graph(figure, (70 + 320 * place, 140, 260, 230), title, "pixels", "")
        for strategy, (label, colour, width) in LINES.items():
            some = [cost for cost in costs if cost.strategy == strategy]
            pixels = [cost.pixels for cost in some]
            values = [getattr(cost, taken) / unit for cost in some]
            axes.plot(pixels, values, "o-", ms=4, lw=width, color=colour, label=label)
            if planned is not None:
                values = [getattr(cost, planned) / unit for cost in some]
                axes.plot(pixels, values, "--", lw=1, color=colour)
        sides = sorted({round(cost.pixels**0.5) for cost in costs})
        axes.set_xscale("log")
        axes.set_xticks([n * n for n in sides], [f"{n}\u00b2" for n in sides])
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
        axes.minorticks_off()
        if place == 0:
            axes.legend(frameon=False, labelcolor=figures.FAINT, fontsize=9.5)
    return figure


def main() -> None:
    given = parse_options(__doc__ or "")
    sides = [6, 8] if given.smoke else [16, 24, 32, 48, 64]
    run = partial(measured, device=given.device)
    truth, cameras = Truth([corner(sides[-1])]), list(CAMERAS)[-1:] if given.smoke else CAMERAS
    found = [run(truth, camera, k, name=f"{k}, {camera}") for camera in cameras for k in STRATEGIES]
    costs = []
    for n, k in itertools.product(sides[:-1], STRATEGIES):
        costs.append(run(Truth([corner(n)]), "film, 12 bits", k, name=f"{k}, {n}"))
    costs += [one for one in found if "film" in one.name]
    colour = Truth([corner(6 if given.smoke else 32, albedo) for albedo in COLOURS], MIXING)
    found += [run(colour, "srgb, 8 bits", k, name=f"{k}, colours") for k in STRATEGIES[:2]]
    facts: dict[str, Any] = {"pixels": sides[-1] ** 2}
    for one in found:
        facts[f"{one.name}, seconds"] = one.seconds
        facts[f"{one.name}, photographs"] = one.photographs
        facts[f"{one.name}, far light row by row"] = one.far
        facts[f"{one.name}, direct part, error over std"] = one.bounces[0]
        if one.strategy != "adaptive":
            facts[f"{one.name}, columns beside white before they added up to it"] = (
                one.sum_deviation
            )
    for cost in costs:
        name = f"{cost.strategy}, {cost.pixels} pixels, photographs over plan"
        facts[name] = cost.photographs / cost.planned
    listed = claims(found, costs, sides[-1] ** 2)
    if given.smoke:  # so few pixels show that it runs, not how few photographs a larger one takes
        listed = listed[1:2]
    figures.conclude(given, "A transport from photographs", listed, facts, partial(draw, costs))


if __name__ == "__main__":
    main()
