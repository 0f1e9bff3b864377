# SPDX-License-Identifier: BSD-3-Clause
"""Faults of photographs in a scan by hand: are they refused, and is the right photograph named.

Scenes of five kinds are scanned from a list of photographs, as a person does it, by three cameras
at random places. In each scan one thing goes wrong at a photograph drawn at random: two are
exchanged, one is repeated, one is missing and the rest move up, a light of 1 to 10 % of white is on
in one, the camera moves, one is exposed for a third of a stop more, or photographs from there on
are JPEG of quality 70.

A fault counts if it changes T p by more than 1 %, relative to the same scan without it, noise
included; in a sketch, which states the error of T p, if it changes that by more than this as well.
All that count must be refused before their batch is kept, and 95 % of the refusals must
name the photograph, or the one that it was exchanged with, or one of the JPEGs (the first may be
dark, and not changed by it), among at most 4. A sketch that leaves out a picture has refused it. No
scan without a fault may be refused.

`--scans N`: instead, N sketches of random corners, walls and blocks of 192 to 648 pixels by random
cameras, each without a fault, with a light on in one photograph, and with another fault, in the
photographs after the set-up. The error that those without a fault state must hold in 95 %.
"""

from __future__ import annotations

import logging
import math
import multiprocessing
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.progress import track

import _figures as figures
import ltcl
from _coefficients import norms, relative_error
from _faults import JPEG, KINDS, LIGHT_ON, REPEATED, Person, Setup, named_photographs
from _figures import Claim
from _harness import parse_options
from _random_sketches import dense_matrix, random_camera, random_scene
from ltcl import scenes
from ltcl.acquisition import Report, acquire
from ltcl.acquisition.scanning.picture_log import BATCH_SIZE
from ltcl.acquisition.scanning.sketch import count_patterns, count_stripes, like_nature
from ltcl.errors import AcquisitionError, ScanRefused

# Projector pixels along a wall.
N = 8
CAMERAS: dict[str, dict[str, Any]] = {
    "8 bits": {"response": "srgb", "bits": 8},
    "12 bits": {"response": "film", "bits": 12},
    "noisy": {"response": "srgb", "bits": 8, "gain": 2000.0, "read": 0.002},
}
STRATEGIES = ("pixel", "hadamard", "adaptive", "sketch")
SCENES = ("corner", "bright corner", "painted", "box", "occluded")
# Scans with faults, and scans without.
FAULTS = 100
CLEAN = 200
# Relative change of T p from which a fault counts.
HARM = 0.01
# Share of the refusals that must name the right photograph.
NAMED_SHARE = 0.95
# Share of sketches whose error must be within what they state, and the pictures that tell.
BOUND_SHARE = 0.95
NATURE_PICTURES = 4
PROCESSES = 2

# One device for each process.
open_device_once = cache(ltcl.open_device)


def walls(name: str) -> scenes.Scene:
    """A scene by its name."""
    if name == "corner":
        return scenes.dihedral(N, albedo=0.6)
    if name == "bright corner":
        return scenes.dihedral(N, albedo=0.9)
    if name == "painted":
        return scenes.trihedral(N, albedo=[[0.9], [0.3], [0.6]])
    block = None
    if name == "occluded":
        block = scenes.Block((0.3, 0.3, 0.2), (0.3, 0.3, 0.3))
    return scenes.box(N, 3, albedo=0.7, occluder=block)


@cache
def true_transport(name: str) -> tuple[np.ndarray, tuple[int, int]]:
    """T of a scene in float64, and its grid."""
    T = walls(name).transport()
    dense = dense_matrix(T)
    paint = np.ones(len(dense))
    if name == "painted":
        paint = np.random.default_rng(5).uniform(0.3, 1.0, len(dense))
    return paint[:, None] * dense, T.grid


@dataclass(frozen=True, kw_only=True)
class Scanned:
    """A scan: T p of some patterns (patterns, N), known pixels (N,), and number of photographs.

    `left_out` is the warning of a sketch that a picture was left out; `error` is that of T p for
    pictures like nature, `stated` what it says of this, and `bound` what it says that it is below.
    """

    pictures: np.ndarray
    is_known: np.ndarray
    photographs: int
    left_out: str = ""
    error: float = np.nan
    stated: float = 0.0
    bound: float = np.nan


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """A scan: `change` of T p by the fault, and whether it was refused by the right number.

    A sketch that leaves the picture out has refused that. `stated` is the error of T p that the
    sketch without a fault states; `scanned` is a scan that was kept.
    """

    kind: str | None
    scan: str
    at: int = 0
    photographs: int = 0
    change: float = 0.0
    stated: float = 0.0
    refused: bool = False
    named: bool = False
    message: str = ""
    scanned: Scanned | None = None

    @property
    def where(self) -> str:
        """Scan and photograph."""
        return f"{self.scan}, photograph {self.at} of {self.photographs}"


def run_scan(setup: Setup, kind: str | None = None, at: int = 0) -> Scanned:
    """Scan with a fault, if any; one setup is one scan, to the noise."""
    rig = Person(setup, kind, at)
    geometry = "aligned" if setup.is_aligned else "graycode"
    warnings = Warnings()
    with TemporaryDirectory() as folder, warnings:
        path = Path(folder) / "T.zarr"
        T = acquire(
            rig,
            strategy=setup.strategy,
            geometry=geometry,
            store=path,
            device=open_device_once(),
        )
        patterns = held_patterns(T.grid)
        pictures = np.asarray(T @ patterns, np.float64)
        scanned = Scanned(
            pictures=pictures.reshape(len(patterns), -1),
            is_known=~np.asarray(T.masked).ravel(),
            photographs=rig.number,
            left_out=warnings.left_out,
        )
        if setup.strategy != "sketch":
            return scanned
        report = Report.of(path)
        return replace(
            scanned,
            error=nature_error(T, setup.T),
            stated=report.judged_error,
            bound=report.judged_bound,
        )


class Warnings(logging.Handler):
    """The warning of a sketch that a picture is left out."""

    left_out = ""

    def emit(self, record: logging.LogRecord) -> None:
        """Take a record of ltcl."""
        message = record.getMessage()
        if "is left out" in message:
            self.left_out = message

    def __enter__(self) -> None:
        logging.getLogger("ltcl").addHandler(self)

    def __exit__(self, *error: object) -> None:
        logging.getLogger("ltcl").removeHandler(self)


def nature_error(T: ltcl.Transport, truth: np.ndarray) -> float:
    """Relative error of T p for pictures like nature, in the camera's unit, root mean square."""
    random = np.random.default_rng(17)
    patterns = []
    for _ in range(NATURE_PICTURES):
        noise = like_nature(T.grid, random)
        patterns.append((noise - noise.min()) / np.ptp(noise))
    lit = np.stack([np.ones(T.grid), *patterns]).astype(np.float32)
    measured = np.asarray(T @ lit, np.float64).reshape(len(lit), -1)
    exact = lit.reshape(len(lit), -1) @ truth.T
    is_known = ~np.asarray(T.masked).ravel()
    measured = measured[:, is_known]
    exact = exact[:, is_known]
    unit = (measured[0] @ exact[0]) / (measured[0] @ measured[0])
    errors = norms(unit * measured[1:] - exact[1:]) / norms(exact[1:])
    return float(np.sqrt(np.mean(errors**2)))


def held_patterns(grid: tuple[int, int]) -> np.ndarray:
    """Patterns that no scan shows, (4, h, w)."""
    h, w = grid
    y, x = np.mgrid[:h, :w] / max(h, w)
    rng = np.random.default_rng(3)
    patterns = [
        rng.random(grid),
        rng.random(grid) < 0.5,
        0.5 + 0.5 * np.sin(9 * x + 5 * y),
        x > y,
    ]
    return np.stack(patterns).astype(np.float32)


def listed_setup(number: int) -> Setup:
    """The scan of a number, in turn of all scenes, cameras and strategies."""
    scene = SCENES[number % 5]
    camera = list(CAMERAS)[number // 5 % 3]
    strategy = STRATEGIES[(number // 15 + number) % len(STRATEGIES)]
    T, grid = true_transport(scene)
    return Setup(
        name=f"{scene} {camera} {strategy}",
        T=T,
        grid=grid,
        camera=CAMERAS[camera],
        strategy=strategy,
        seed=number,
    )


def random_setup(number: int) -> Setup:
    """A sketch of a random scene by a random camera; every second one is aligned."""
    name, T, grid = random_scene(number)
    is_aligned = number % 2 == 0
    place = "aligned" if is_aligned else "oblique"
    # After each batch comes a photograph of blocks; those of Gray code come before the scan.
    patterns = count_patterns(grid)
    if not is_aligned:
        patterns -= count_stripes(grid)
    return Setup(
        name=f"{number}: {name}, {place}",
        T=T,
        grid=grid,
        camera=random_camera(number),
        strategy="sketch",
        seed=number,
        is_aligned=is_aligned,
        own_photographs=patterns + math.ceil(patterns / BATCH_SIZE),
    )


Job = tuple[Callable[[int], Setup], int, Sequence[str]]


def run(job: Job) -> list[Outcome]:
    """Scan without a fault, and with one of each kind, in a process of its own."""
    make_setup, number, kinds = job
    setup = make_setup(number)
    name = setup.name
    try:
        clean = run_scan(setup)
    except AcquisitionError as error:
        message = str(error)
        return [Outcome(kind=None, scan=name, refused=True, message=message)]
    photographs = clean.photographs
    outcomes = [
        Outcome(
            kind=None,
            scan=name,
            photographs=photographs,
            refused=bool(clean.left_out),
            message=clean.left_out,
            scanned=clean,
        )
    ]
    for kind in kinds:
        random = np.random.default_rng((number, KINDS.index(kind)))
        at = setup.draw_photograph(random, photographs)
        try:
            scanned = run_scan(setup, kind, at)
        except AcquisitionError as error:
            # A ScanRefused comes at the end, after batches were kept; that of a sketch must.
            is_early = setup.strategy == "sketch" or not isinstance(error, ScanRefused)
            outcomes.append(refusal(str(error), is_early, kind, name, at, photographs))
            continue
        columns = clean.is_known & scanned.is_known
        change = relative_error(scanned.pictures[:, columns].T, clean.pictures[:, columns].T)
        if scanned.left_out:
            outcome = refusal(scanned.left_out, True, kind, name, at, photographs)
            outcomes.append(replace(outcome, change=change, scanned=scanned))
            continue
        outcomes.append(
            Outcome(
                kind=kind,
                scan=name,
                at=at,
                photographs=photographs,
                change=change,
                stated=clean.stated,
                scanned=scanned,
            )
        )
    return outcomes


def refusal(
    message: str, is_early: bool, kind: str, scan: str, at: int, photographs: int
) -> Outcome:
    """Outcome of a scan that was refused, in time or too late, by the right photograph or not."""
    first = at
    last = at + 1
    if kind == REPEATED:
        first = at - 1
    if kind == JPEG:
        last = photographs
    numbers = named_photographs(message)
    is_named = not numbers.isdisjoint(range(first, last + 1))
    return Outcome(
        kind=kind,
        scan=scan,
        at=at,
        photographs=photographs,
        change=np.nan,
        refused=is_early,
        named=is_early and is_named,
        message=message,
    )


class KindSummary:
    """Outcomes of one kind of fault: `missed` ones that count, and `misnamed` refusals."""

    def __init__(self, kind: str, outcomes: Sequence[Outcome]) -> None:
        self.kind = kind
        self.outcomes = [outcome for outcome in outcomes if outcome.kind == kind]
        self.refused = [outcome for outcome in self.outcomes if outcome.refused]
        self.misnamed = [outcome for outcome in self.refused if not outcome.named]
        self.missed: list[Outcome] = []
        for outcome in self.outcomes:
            # A late refusal has no change, which is a miss as well.
            is_harmless = outcome.change <= max(HARM, outcome.stated)
            if not outcome.refused and not is_harmless:
                self.missed.append(outcome)
        self.named = len(self.refused) - len(self.misnamed)

    def none_kept(self) -> Claim:
        """No fault that counts is kept."""
        return Claim(
            text=f"{self.kind}: kept, T p moved by over 1 %, and the error that is stated",
            measured=f"{len(self.missed)} of {len(self.outcomes)}",
            wanted="0",
            holds=not self.missed,
        )

    def are_named(self) -> Claim:
        """Refusals name the photograph."""
        refused = len(self.refused)
        return Claim(
            text=f"{self.kind}: refused and named",
            measured=f"{self.named} of {refused}",
            wanted="95 %",
            holds=self.named >= NAMED_SHARE * refused,
        )

    def facts(self) -> dict[str, list[str]]:
        """Faults that were kept or misnamed."""
        kept = [f"{outcome.where}: {outcome.change:.1%}" for outcome in self.missed]
        misnamed = [f"{outcome.where}: {outcome.message}" for outcome in self.misnamed]
        prefix = f"{self.kind}, "
        return {prefix + "kept": kept, prefix + "another named": misnamed}

    def shares(self) -> tuple[float, float]:
        """Shares of all faults that were refused, and named."""
        count = len(self.outcomes)
        return len(self.refused) / count, self.named / count


def run_all(jobs: Sequence[Job]) -> list[Outcome]:
    """Run jobs in processes, with a bar on a terminal."""
    outcomes = []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(PROCESSES, context) as pool:
        results = pool.map(run, jobs)
        is_quiet = not sys.stderr.isatty()
        for result in track(results, "scans", total=len(jobs), disable=is_quiet):
            outcomes += result
    return outcomes


def listed_jobs(smoke: bool) -> list[Job]:
    """Scans in turn of all scenes, cameras and strategies, half of them with each kind of fault."""
    if smoke:
        return [(listed_setup, 0, KINDS[:1])]
    jobs: list[Job] = []
    for number in range(CLEAN):
        jobs.append((listed_setup, number, KINDS if number < FAULTS else ()))
    return jobs


def random_jobs(scans: int) -> list[Job]:
    """Sketches of random scenes, each without a fault, with a light on, and with another fault."""
    others = [kind for kind in KINDS if kind != LIGHT_ON]
    return [
        (random_setup, number, (LIGHT_ON, others[number % len(others)])) for number in range(scans)
    ]


def bound_claim(clean: Sequence[Outcome], facts: dict[str, Any]) -> Claim:
    """The error that sketches state holds."""
    kept = [outcome for outcome in clean if outcome.scanned is not None]
    beyond = []
    for outcome in kept:
        scanned = outcome.scanned
        if scanned is not None and not scanned.error <= scanned.bound:
            beyond.append(f"{outcome.scan}: {scanned.error:.2%}, at most {scanned.bound:.2%}")
    facts["error beyond what is stated"] = beyond
    return Claim(
        text="sketches without a fault, T p of pictures like nature within the error stated",
        measured=f"{len(kept) - len(beyond)} of {len(kept)}",
        wanted="95 %",
        holds=len(beyond) <= (1.0 - BOUND_SHARE) * len(kept),
    )


def within_stated(outcomes: Sequence[Outcome]) -> list[str]:
    """Changes of T p by over 1 % that sketches kept, within the error that they state."""
    moved = []
    for outcome in outcomes:
        if not outcome.refused and HARM < outcome.change <= outcome.stated:
            moved.append(f"{outcome.where}: {outcome.change:.1%} of {outcome.stated:.1%}")
    return moved


def left_out_facts(outcomes: Sequence[Outcome]) -> list[str]:
    """Changes of T p by over 1 % in sketches that left a picture out."""
    moved = []
    for outcome in outcomes:
        scanned = outcome.scanned
        if outcome.kind and scanned is not None and scanned.left_out and outcome.change > HARM:
            moved.append(f"{outcome.where}: {outcome.change:.1%}, at most {scanned.bound:.1%}")
    return moved


def main() -> None:
    """Run the bench."""
    scans = {"type": int, "metavar": "N", "help": "N sketches of random small scenes instead"}
    options = parse_options(__doc__, {"scans": scans})
    is_random = options.arguments.scans is not None
    jobs = random_jobs(options.arguments.scans) if is_random else listed_jobs(options.smoke)
    kinds = [kind for kind in KINDS if any(kind in job[2] for job in jobs)]
    outcomes = run_all(jobs)
    facts: dict[str, Any] = {"scans": len(outcomes)}
    if not is_random:
        facts |= {"cameras": ", ".join(CAMERAS), "scenes": ", ".join(SCENES)}
    claims = []
    shares = {}
    for kind in kinds:
        summary = KindSummary(kind, outcomes)
        claims.append(summary.none_kept())
        if is_random:
            # Of few faults each, in short set-ups, some are named by what they do to others.
            facts[f"{kind}, refused and named"] = f"{summary.named} of {len(summary.refused)}"
        else:
            claims.append(summary.are_named())
        facts |= summary.facts()
        shares[kind] = summary.shares()
    clean = [outcome for outcome in outcomes if outcome.kind is None]
    wrong = [outcome for outcome in clean if outcome.refused]
    facts["refused without a fault"] = [f"{one.scan}: {one.message}" for one in wrong]
    facts["left out, T p moved by over 1 %"] = left_out_facts(outcomes)
    facts["kept, T p moved by over 1 % within the error that is stated"] = within_stated(outcomes)
    none_refused = Claim(
        text="scans without a fault, refused or with a picture left out",
        measured=f"{len(wrong)} of {len(clean)}",
        wanted="0",
        holds=not wrong,
    )
    claims.append(none_refused)
    if is_random:
        claims.append(bound_claim(clean, facts))
    # Empty lists say nothing.
    facts = {name: value for name, value in facts.items() if value}
    draw_shares = partial(draw, shares)
    title = "Faults in sketches of random scenes" if is_random else "Faults of photographs"
    figures.conclude(options, title, claims, facts, draw_shares)


def draw(shares: dict[str, tuple[float, float]]) -> Figure:
    """Draw the shares of faults that were refused, and named, by kind."""
    figure = Figure(figsize=(9, 4), dpi=120, layout="constrained")
    axes = figure.subplots()
    heights = range(len(shares))
    refused, named = zip(*shares.values(), strict=True)
    axes.barh(heights, refused, color="#c9d7e8", label="refused")
    axes.barh(heights, named, color="#3b6ea5", label="and named")
    axes.set_yticks(heights, list(shares))
    axes.set_xlabel("of all faults, harmless ones included")
    axes.legend()
    return figure


if __name__ == "__main__":
    main()
