# SPDX-License-Identifier: BSD-3-Clause
"""Deviations, denoising and `rtol="noise"` of path-traced transports, by other measurements.

Mitsuba traces (`scenes.tracing`) a corner, a box, and a box with blocks ten times each. Twice, one
is judged by the mean of eight others, whose own errors are subtracted from all ratios; with the
noise that T itself shows, and with that of the tenth. Deviations over errors: root mean squares
over pixels, under white. Errors denoised and compressed, over those before: of ten patterns of each
kind, and of bounces of one of each. Also reported, as no measurement mends it: the deviation of the
bounces of one view, by its `first_bounce`, from those traced; and for these and a coloured corner
the error of each bounce beside the changes that T itself shows, by the choice of the first bounce
and by pixels of twice the size, with the verdict on it.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import _figures as figures
import ltcl
from _coefficients import norms
from _figures import Claim
from _harness import parse_options
from denoise import QUANTITIES, patterns
from ltcl import Transport
from scenes import tracing

sys.path.append(str(Path(__file__).resolve().parents[1]))
from tests.transport.noise.measured import measure, noise_of, truth

GRID = (32, 32)
# As many paths an entry of T as in compression.py.
PATHS = 2560
SEEDS = 10
# Measurements that are judged by others.
JUDGED = 2
# Share of the truth's own errors in the variance of those against it.
TRUTH_VARIANCE = 1.0 / (SEEDS - 1)
PARTS = ("direct", "bounce 1", "bounce 2", "bounce 3", "pattern", "appearance")
SCENES = ("corner", "box", "blocks")
# The scene with colours, which is traced fewer times.
COLOURED = "coloured"
COLOURED_SEEDS = 4
# Errors of bounces over the changes that T shows, at most.
MAX_OVER_SHOWN = 1.5
# Bounces that are more wrong must not be called good without reserve.
GOOD_BOUNCE = 0.05


@dataclass(frozen=True)
class Limits:
    """Names of ratios, and the range in which they must be."""

    names: Sequence[str]
    least: float
    most: float

    def claim(self, text: str, values: np.ndarray) -> Claim:
        """Judge ratios of several measurements, (measurements, names)."""
        cells = []
        for name, column in zip(self.names, values.T, strict=True):
            cells.append(f"{name} {column.min():.2f} to {column.max():.2f}")
        is_within = (self.least <= values) & (values <= self.most)
        limits = f"{self.least:g} to {self.most:g}"
        return Claim(text, ", ".join(cells), limits, bool(is_within.all()))


DEVIATION_LIMITS = Limits(PARTS, 0.75, 1.33)
DENOISED_LIMITS = Limits(QUANTITIES, 0.0, 1.0)
COMPRESSED_LIMITS = Limits(QUANTITIES[:3], 0.0, 1.1)


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """Ratios of one measurement, relative errors of T, and bytes a row."""

    deviations: np.ndarray
    denoised: np.ndarray
    compressed: np.ndarray
    errors: np.ndarray
    row_nbytes: float


def trace_seeds(scene: str, seeds: int) -> list[np.ndarray]:
    """Measurements of T by bounces."""
    return [tracing.trace(scene, GRID, PATHS, seed) for seed in range(1, seeds + 1)]


def traced_measurements(traced: list[np.ndarray]) -> tuple[list[Transport], dict[str, float]]:
    """All measurements, and how far the bounces of their mean are from those traced."""
    mean = np.mean(traced, axis=0, dtype=np.float64)
    bounces = mean.sum(axis=2).reshape(-1, *GRID)[:4]
    deviations = {}
    for first_bounce in ("diagonal", "exact"):
        T = Transport(mean.sum(axis=0), GRID, first_bounce=first_bounce)
        separation = ltcl.separate(T, T @ np.ones(GRID), 3, rtol=1e-5)
        off = norms(separation_light(separation) - bounces) / norms(bounces[:1])
        deviations[first_bounce] = float(off.max())
    transports = [Transport(T.sum(axis=0), GRID) for T in traced]
    return transports, deviations


@dataclass(frozen=True, kw_only=True)
class JudgedBounces:
    """Bounces 1 to 3 of one measurement: relative errors, the changes T shows, and its verdict."""

    scene: str
    first_bounce: str
    errors: np.ndarray
    shown: np.ndarray
    is_good: bool
    text: str
    warning: str

    @property
    def is_true(self) -> bool:
        """False if a bounce that is more than 5 % off is called good without reserve and change."""
        if not self.is_good or self.errors.max() <= GOOD_BOUNCE:
            return True
        has_reserve = "lit, matt surfaces" in self.text and bool(self.warning)
        return has_reserve and bool(self.shown.max() > GOOD_BOUNCE)

    def __str__(self) -> str:
        errors = ", ".join(map("{:.1%}".format, self.errors))
        shown = ", ".join(map("{:.1%}".format, self.shown))
        return f"off {errors}; T shows {shown}; {self.text}"


def judge_bounces(scene: str, traced: list[np.ndarray], first_bounce: str) -> JudgedBounces:
    """Judge bounces of the first measurement by those of the mean of all."""
    bounces = np.mean(traced, axis=0, dtype=np.float64).sum(axis=-1)
    matrix = traced[0].sum(axis=0)
    shape = GRID
    if matrix.ndim == 3:
        bounces = np.moveaxis(bounces, 1, -1)
        matrix = list(matrix)
        shape = (*GRID, 3)
    T = Transport(matrix, GRID, first_bounce=first_bounce)
    separation = ltcl.separate(T, T @ np.ones(shape), 3, rtol=1e-5)
    true = bounces[1:4].reshape(separation.bounces.shape)
    errors = norms(list(separation.bounces - true)) / norms(list(true))
    judged = ltcl.analyze(T).verdict
    return JudgedBounces(
        scene=scene,
        first_bounce=first_bounce,
        errors=errors,
        shown=np.add(T.bounce_spread, T.resolution_spread),
        is_good=bool(judged.bounces),
        text=judged.text,
        warning=separation.warning,
    )


def bounce_claims(judged: list[JudgedBounces]) -> list[Claim]:
    """No wrong word on bounces, and errors not far from what T shows."""
    true = sum(one.is_true for one in judged)
    claims = [
        Claim(
            text="verdicts that call no bounce good without reserve, and a change, that is 5 % off",
            measured=f"{true} of {len(judged)}",
            wanted="all",
            holds=true == len(judged),
        )
    ]
    for scene in (*SCENES, COLOURED):
        ratios = [one.errors.max() / one.shown.max() for one in judged if one.scene == scene]
        claims.append(
            Claim(
                text=f"{scene}: largest error of a bounce over the largest change that T shows",
                measured=", ".join(map("{:.2f}".format, ratios)),
                wanted=f"at most {MAX_OVER_SHOWN:g}",
                holds=max(ratios) <= MAX_OVER_SHOWN,
            )
        )
    return claims


def simulated_measurements() -> list[Transport]:
    """Measurements for --smoke, which need no Mitsuba."""
    T = truth("corner", 6)
    noise = noise_of(T, 1e-3)
    return [measure(T, noise, seed, known=False) for seed in range(4)]


def separation_light(separation: Any) -> np.ndarray:
    """Direct light and bounces of a separation, or of its deviations."""
    return np.stack([separation.direct, *separation.bounces])


def deviation_ratios(T: Transport, true: Transport) -> np.ndarray:
    """`.std` over errors of `PARTS`, under white."""
    white = true @ np.ones(true.grid)
    separation = ltcl.separate(T, white, 3, rtol=1e-5)
    exact = ltcl.separate(true, white, 3, rtol=1e-5)
    compensation = ltcl.compensate(T, white, bounds=(-99.0, 99.0), rtol=1e-5)
    pattern_error = compensation.pattern - 1.0
    appearance_error = compensation.appearance - true @ compensation.pattern
    light_errors = separation_light(separation) - separation_light(exact)
    deviations = [*separation_light(separation.std)]
    deviations += [compensation.std.pattern, compensation.std.appearance]
    return norms(deviations) / norms([*light_errors, pattern_error, appearance_error])


def quantities(T: Transport, images: np.ndarray) -> list[np.ndarray]:
    """`QUANTITIES` of T: T p of ten patterns of each kind; bounces of `images`."""
    relit = [T @ kind for kind in patterns(T.grid)]
    return [*relit, *ltcl.separate(T, images, 3).bounces]


def relative_errors(T: Transport, true: Transport) -> np.ndarray:
    """Relative errors of `QUANTITIES`; bounces are of pictures of one pattern of each kind."""
    images = true @ np.stack([kind[0] for kind in patterns(T.grid)])
    exact = quantities(true, images)
    deviations = map(np.subtract, quantities(T, images), exact)
    return norms(deviations) / norms(exact)


def judge(T: Transport, true: Transport) -> Judgement:
    compressed = ltcl.compress(T, "noise")
    errors = relative_errors(T, true)

    def error_ratio(better: Transport) -> np.ndarray:
        squares = (relative_errors(better, true) / errors) ** 2
        own_squares = np.maximum(squares - TRUTH_VARIANCE, 0.0)
        return np.sqrt(own_squares / (1.0 - TRUTH_VARIANCE))

    nbytes = compressed.compression.channels[0].nbytes
    return Judgement(
        deviations=deviation_ratios(T, true) / (1.0 - TRUTH_VARIANCE) ** 0.5,
        denoised=error_ratio(ltcl.denoise(T)),
        compressed=error_ratio(compressed)[: len(COMPRESSED_LIMITS.names)],
        errors=errors,
        row_nbytes=nbytes / len(T.first_bounce),
    )


def judge_scene(measured: list[Transport]) -> dict[str, list[Judgement]]:
    """Judge some measurements, by the noise model they are options."""
    alone = []
    with_second = []
    for k in range(JUDGED):
        first, second, *others = measured[k:] + measured[:k]
        matrix = first.to_numpy()
        mean = np.mean([T.to_numpy() for T in others], axis=0)
        true = Transport(mean, first.grid)
        alone.append(judge(Transport(matrix, first.grid), true))
        twice = Transport(matrix, first.grid, noise=second)
        with_second.append(judge(twice, true))
    return {"noise by T alone": alone, "noise by two measurements": with_second}


def way_claims(name: str, judgements: list[Judgement]) -> list[Claim]:
    deviations = figures.values(judgements, "deviations")
    denoised = figures.values(judgements, "denoised")
    compressed = figures.values(judgements, "compressed")
    return [
        DEVIATION_LIMITS.claim(f"{name}: deviations over errors", deviations),
        DENOISED_LIMITS.claim(f"{name}: denoised", denoised),
        COMPRESSED_LIMITS.claim(f"{name}: compressed", compressed),
    ]


def list_errors(judgements: list[Judgement]) -> str:
    """Largest relative errors of T, by the quantity."""
    largest = figures.values(judgements, "errors").max(axis=0)
    return ", ".join(map("{} {:.2%}".format, QUANTITIES, largest))


def main() -> None:
    """Judge each scene, or say why not."""
    options = parse_options(__doc__)
    facts: dict[str, Any] = {}
    if options.smoke:
        facts["path-traced"] = "not measured: --smoke"
    else:
        reason = tracing.unavailable()
        if reason:
            raise SystemExit(f"not measured: {reason}")
    # A noisy T warns.
    logging.getLogger("ltcl").setLevel(logging.ERROR)
    claims: list[Claim] = []
    judged_bounces: list[JudgedBounces] = []
    is_halved: list[bool] = []
    for scene in ("simulated",) if options.smoke else SCENES:
        if options.smoke:
            measured = simulated_measurements()
            off = {}
        else:
            traced = trace_seeds(scene, SEEDS)
            measured, off = traced_measurements(traced)
            for first_bounce in ("diagonal", "exact"):
                judged_bounces.append(judge_bounces(scene, traced, first_bounce))
        facts[f"{scene}: bounces of one view, off"] = off
        for way, judgements in judge_scene(measured).items():
            name = f"{scene}, {way}"
            facts[f"{scene}: relative errors"] = list_errors(judgements)
            row_nbytes = figures.values(judgements, "row_nbytes")
            facts[f"{name}: bytes a row"] = float(row_nbytes.max())
            for judgement in judgements:
                is_halved.extend(judgement.denoised <= 0.5)
            claims += way_claims(name, judgements)
    halved = f"{sum(is_halved)} of {len(is_halved)}"
    text = "denoised: at most half is left"
    claims.append(Claim(text, halved, "all", all(is_halved)))
    if options.smoke:
        claims = []
    else:
        traced = trace_seeds(COLOURED, COLOURED_SEEDS)
        for first_bounce in ("diagonal", "exact"):
            judged_bounces.append(judge_bounces(COLOURED, traced, first_bounce))
        for one in judged_bounces:
            facts[f"{one.scene}, first bounce {one.first_bounce}: bounces"] = str(one)
        claims += bounce_claims(judged_bounces)
    figures.conclude(options, "Path-traced transports", claims, facts, Figure)


if __name__ == "__main__":
    main()
