# SPDX-License-Identifier: BSD-3-Clause
"""Faults of photographs in a scan by hand: are they refused, and is the right photograph named.

Scenes of five kinds are scanned from a list of photographs, as a person does it, by three cameras
at random places. In each scan one thing goes wrong at a photograph drawn at random: two are
exchanged, one is repeated, one is missing and the rest move up, a light of 1 to 10 % of white is on
in one, the camera moves, one is exposed for a third of a stop more, or photographs from there on
are JPEG of quality 70.

A fault counts if it changes T p by more than 1 %, relative to the same scan without it, noise
included. All that count must be refused before their batch is kept, and 95 % of the refusals must
name the photograph, or the one that it was exchanged with, or one of the JPEGs (the first may be
dark, and not changed by it), among at most 4. No scan without a fault may be refused.
"""

from __future__ import annotations

import multiprocessing
import re
import sys
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import scipy.sparse
from matplotlib.figure import Figure
from rich.progress import track

import _figures as figures
import ltcl
from _coefficients import relative_error
from _figures import Claim
from _harness import parse_options
from ltcl import scenes
from ltcl.acquisition import VirtualRig, acquire, camera_map
from ltcl.errors import AcquisitionError, ScanRefused

# Projector pixels along a wall, and camera pixels to one.
N = 8
SIZE = 3.0
CAMERAS: dict[str, dict[str, Any]] = {
    "8 bits": {"response": "srgb", "bits": 8},
    "12 bits": {"response": "film", "bits": 12},
    "noisy": {"response": "srgb", "bits": 8, "gain": 2000.0, "read": 0.002},
}
EXCHANGED = "two exchanged"
REPEATED = "one repeated"
MISSING = "one missing"
LIGHT_ON = "light on in one"
OVEREXPOSED = "a third of a stop"
JPEG = "JPEG from one on"
# Shift of the camera in its pixels.
MOVES = {"moved 0.5 pixels": 0.5, "moved 2 pixels": 2.0}
KINDS = (EXCHANGED, REPEATED, MISSING, LIGHT_ON, *MOVES, OVEREXPOSED, JPEG)
STRATEGIES = ("pixel", "hadamard", "adaptive")
SCENES = ("corner", "bright corner", "painted", "box", "occluded")
# Scans with faults, and scans without.
FAULTS = 100
CLEAN = 200
# Different places of the cameras.
VIEWS = 10
# Relative change of T p from which a fault counts.
HARM = 0.01
# Share of the refusals that must name the right photograph, and most photographs in a range.
NAMED_SHARE = 0.95
MAX_RANGE = 4
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
    n = T.shape[1]
    frames = np.eye(n).reshape(n, *T.grid)
    dense = np.asarray(T @ frames, np.float64).reshape(n, n).T
    paint = np.ones(n)
    if name == "painted":
        paint = np.random.default_rng(5).uniform(0.3, 1.0, n)
    return paint[:, None] * dense, T.grid


@cache
def view(
    grid: tuple[int, int], seed: int, shift: float
) -> tuple[tuple[int, int], scipy.sparse.csr_array]:
    """A camera at a random place, shifted by `shift` of its pixels: its grid and its map."""
    h, w = grid
    rng = np.random.default_rng(seed)
    dx, dy = rng.uniform(-0.5, 0.5, 2)
    angle = rng.uniform(-0.05, 0.05)
    direction = rng.uniform(0, 2 * np.pi)
    shape = (int(1.2 * SIZE * h), int(1.2 * SIZE * w))
    c = np.cos(angle) / SIZE
    s = np.sin(angle) / SIZE

    def place(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a = u - shape[1] / 2 + shift * np.cos(direction)
        b = v - shape[0] / 2 + shift * np.sin(direction)
        x = c * a + s * b + (w - 1) / 2 + dx
        y = c * b - s * a + (h - 1) / 2 + dy
        return x, y

    return shape, camera_map(place, shape, grid)


Shot = tuple[np.ndarray, float]


class Person:
    """A rig whose photographs come from a list, with a fault at number `at`."""

    keeps_photographs = True

    def __init__(self, name: str, camera: str, seed: int, kind: str | None, at: int) -> None:
        T, self.projector_grid = true_transport(name)
        self.channels = 1
        self.kind = kind
        self.at = at
        self.number = 0
        self._list: deque[Shot] = deque()
        self._postponed: Shot | None = None
        self._last: np.ndarray | None = None
        self._rig = self._make_rig(T, camera, seed, shift=0.0, ambient=0.01)
        ambient: Any = 0.01
        if kind == LIGHT_ON:
            strength = np.random.default_rng(seed).uniform(0.01, 0.1)
            ambient = 0.01 + self._lamp(T) * strength
        shift = 0.0
        if kind is not None:
            shift = MOVES.get(kind, 0.0)
        self._faulty_rig = self._make_rig(T, camera, seed, shift, ambient)
        self.bits = self._rig.bits

    def _make_rig(
        self, T: np.ndarray, camera: str, seed: int, shift: float, ambient: Any
    ) -> VirtualRig:
        shape, C = view(self.projector_grid, seed % VIEWS, shift)
        return VirtualRig(
            T,
            self.projector_grid,
            seed=seed,
            camera_grid=shape,
            camera_map=C,
            ambient=ambient,
            **CAMERAS[camera],
        )

    def _lamp(self, T: np.ndarray) -> np.ndarray:
        """Light of a lamp in the room, (N,), brighter on the right."""
        h, w = self.projector_grid
        y, x = np.mgrid[:h, :w] / max(h, w)
        return T.sum(axis=1) * (0.6 + 0.8 * x + 0.3 * y).ravel()

    def prepare(self, shots: Iterable[tuple[Any, float]]) -> None:
        """Put shots at the end of the list, unless they are on it."""
        listed = Counter((codes.tobytes(), seconds) for codes, seconds in self._list)
        for codes, seconds in shots:
            key = (np.asarray(codes).tobytes(), seconds)
            listed[key] -= 1
            if listed[key] < 0:
                self._list.append((codes, seconds))

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        """Take the next photograph."""
        self.number += 1
        if self._is_next(codes, seconds):
            self._list.popleft()
        is_faulty = self.number == self.at
        is_from_fault_on = self.number >= self.at
        if self.kind == REPEATED and is_faulty and self._last is not None:
            return self._last
        rig = self._rig
        if self.kind in MOVES and is_from_fault_on:
            rig = self._faulty_rig
        if self.kind == LIGHT_ON and is_faulty:
            rig = self._faulty_rig
        image = rig.photograph(*self._actual_shot((codes, seconds)))
        if self.kind == JPEG and is_from_fault_on:
            image = self._through_jpeg(image)
        self._last = image
        return image

    def _is_next(self, codes: np.ndarray, seconds: float) -> bool:
        """Whether a shot is the next on the list."""
        if not self._list:
            return False
        next_codes, next_seconds = self._list[0]
        return next_seconds == seconds and np.array_equal(next_codes, codes)

    def _actual_shot(self, shot: Shot) -> Shot:
        """The shot that is taken instead, by the fault."""
        is_faulty = self.number == self.at
        following = shot
        if self._list:
            following = self._list[0]
        if self.kind == EXCHANGED and is_faulty:
            self._postponed = shot
            return following
        if self.kind == EXCHANGED and self.number == self.at + 1 and self._postponed is not None:
            return self._postponed
        if self.kind == MISSING and self.number >= self.at:
            return following
        if self.kind == OVEREXPOSED and is_faulty:
            codes, seconds = shot
            return codes, seconds * 2.0 ** (1 / 3)
        return shot

    def _through_jpeg(self, image: np.ndarray) -> np.ndarray:
        """Store a photograph as JPEG of quality 70, which has 8 bits."""
        dropped_bits = 0
        if self.bits:
            dropped_bits = self.bits - 8
        eight_bits = (image >> dropped_bits).astype(np.uint8)
        _, data = cv2.imencode(".jpg", eight_bits, [cv2.IMWRITE_JPEG_QUALITY, 70])
        decoded = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE))
        return decoded.astype(image.dtype) << dropped_bits


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """A scan: `change` of T p by the fault, and whether it was refused by the right number."""

    kind: str | None
    scan: str
    at: int = 0
    photographs: int = 0
    change: float = 0.0
    refused: bool = False
    named: bool = False
    message: str = ""

    @property
    def where(self) -> str:
        """Scan and photograph."""
        return f"{self.scan}, photograph {self.at} of {self.photographs}"


def run_scan(
    number: int, kind: str | None = None, at: int = 0
) -> tuple[np.ndarray, np.ndarray, int]:
    """Scan with a fault, if any; one number is one scan, to the noise.

    Returns T p of some patterns (patterns, N), the known pixels (N,), and the number of
    photographs.
    """
    name, camera, strategy = scan_names(number)
    rig = Person(name, camera, number, kind, at)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "T.zarr"
        T = acquire(rig, strategy=strategy, store=path, device=open_device_once())
        patterns = held_patterns(T.grid)
        pictures = np.asarray(T @ patterns, np.float64)
        is_known = ~np.asarray(T.masked).ravel()
        return pictures.reshape(len(patterns), -1), is_known, rig.number


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


def scan_names(number: int) -> tuple[str, str, str]:
    """Scene, camera and strategy of a scan."""
    scene = SCENES[number % 5]
    camera = list(CAMERAS)[number // 5 % 3]
    strategy = STRATEGIES[(number // 15 + number) % 3]
    return scene, camera, strategy


def named_photographs(message: str) -> set[int]:
    """Numbers of photographs in a message, single ones and those of short ranges."""
    numbers: set[int] = set()
    pattern = r"photographs? (\d+)(?: \([^)]*\))?(?: to (?:photograph )?(\d+))?"
    for first_text, last_text in re.findall(pattern, message):
        first = int(first_text)
        last = first
        if last_text:
            last = int(last_text)
        if last - first < MAX_RANGE:
            numbers |= set(range(first, last + 1))
    return numbers


def run(job: tuple[int, Sequence[str]]) -> list[Outcome]:
    """Scan without a fault, and with one of each kind, in a process of its own."""
    scan, kinds = job
    name = " ".join(scan_names(scan))
    try:
        clean, is_known, photographs = run_scan(scan)
    except AcquisitionError as error:
        message = str(error)
        return [Outcome(kind=None, scan=name, refused=True, message=message)]
    outcomes = [Outcome(kind=None, scan=name, photographs=photographs)]
    for kind in kinds:
        random = np.random.default_rng((scan, KINDS.index(kind)))
        at = int(random.integers(2, photographs - 1))
        try:
            pictures, is_seen, _ = run_scan(scan, kind, at)
        except AcquisitionError as error:
            outcomes.append(refusal(error, kind, name, at, photographs))
            continue
        columns = is_known & is_seen
        change = relative_error(pictures[:, columns].T, clean[:, columns].T)
        outcomes.append(
            Outcome(kind=kind, scan=name, at=at, photographs=photographs, change=change)
        )
    return outcomes


def refusal(error: AcquisitionError, kind: str, scan: str, at: int, photographs: int) -> Outcome:
    """Outcome of a scan that was refused, in time or too late, by the right photograph or not."""
    first = at
    last = at + 1
    if kind == REPEATED:
        first = at - 1
    if kind == JPEG:
        last = photographs
    # A ScanRefused comes at the end, after batches were kept.
    is_early = not isinstance(error, ScanRefused)
    message = str(error)
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
            is_harmless = outcome.change <= HARM
            if not outcome.refused and not is_harmless:
                self.missed.append(outcome)
        self.named = len(self.refused) - len(self.misnamed)

    def claims(self) -> list[Claim]:
        """No fault that counts is kept, and refusals name the photograph."""
        refused = len(self.refused)
        none_kept = Claim(
            text=f"{self.kind}: kept, T p moved by over 1 %",
            measured=f"{len(self.missed)} of {len(self.outcomes)}",
            wanted="0",
            holds=not self.missed,
        )
        are_named = Claim(
            text=f"{self.kind}: refused and named",
            measured=f"{self.named} of {refused}",
            wanted="95 %",
            holds=self.named >= NAMED_SHARE * refused,
        )
        return [none_kept, are_named]

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


def run_all(jobs: Sequence[tuple[int, Sequence[str]]]) -> list[Outcome]:
    """Run jobs in processes, with a bar on a terminal."""
    outcomes = []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(PROCESSES, context) as pool:
        results = pool.map(run, jobs)
        is_quiet = not sys.stderr.isatty()
        for result in track(results, "scans", total=len(jobs), disable=is_quiet):
            outcomes += result
    return outcomes


def main() -> None:
    """Run the bench."""
    options = parse_options(__doc__)
    kinds = KINDS
    faults = FAULTS
    clean = CLEAN
    if options.smoke:
        kinds = KINDS[:1]
        faults = 1
        clean = 1
    jobs = []
    for number in range(clean):
        jobs.append((number, kinds if number < faults else ()))
    outcomes = run_all(jobs)
    facts: dict[str, Any] = {
        "scans": len(outcomes),
        "cameras": ", ".join(CAMERAS),
        "scenes": ", ".join(SCENES),
    }
    claims = []
    shares = {}
    for kind in kinds:
        summary = KindSummary(kind, outcomes)
        claims += summary.claims()
        facts |= summary.facts()
        shares[kind] = summary.shares()
    wrong = []
    messages = []
    for outcome in outcomes:
        if outcome.kind is None and outcome.refused:
            wrong.append(outcome)
            messages.append(f"{outcome.scan}: {outcome.message}")
    facts["refused without a fault"] = messages
    none_refused = Claim(
        text="scans without a fault, refused",
        measured=f"{len(wrong)} of {clean}",
        wanted="0",
        holds=not wrong,
    )
    claims.append(none_refused)
    # Empty lists say nothing.
    facts = {name: value for name, value in facts.items() if value}
    draw_shares = partial(draw, shares)
    figures.conclude(options, "Faults of photographs", claims, facts, draw_shares)


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
