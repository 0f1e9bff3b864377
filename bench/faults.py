# SPDX-License-Identifier: BSD-3-Clause
"""Faults of photographs in a scan by hand: whether they are refused, and the right photograph named.

Scenes of five kinds are scanned from a list of photographs, as a person does it, by three cameras
at random places. In each scan one thing goes wrong at a photograph drawn at random: two are
exchanged, one is repeated, one is missing and the rest move up, a light of 1 to 10 % of white is on
in one, the camera moves, one is exposed for a third of a stop more, or photographs from there on
are JPEG of quality 70.

A fault counts where it moves T p by more than 1 %, relative to the same scan without it, noise
included. All that count must be refused before their batch is kept, and 95 % of the refusals must
name the photograph, or the one that it was exchanged with, or one of the JPEGs (the first may be
dark, and not changed by it), among at most 4. Of scans without a fault none may be refused.
"""

from __future__ import annotations

import multiprocessing
import re
import sys
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
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

N, SIZE = 8, 3.0  # projector pixels along a wall; camera pixels to one
CAMERAS: dict[str, dict[str, Any]] = {
    "8 bits": {"response": "srgb", "bits": 8},
    "12 bits": {"response": "film", "bits": 12},
    "noisy": {"response": "srgb", "bits": 8, "gain": 2000.0, "read": 0.002},
}
KINDS = (
    "two exchanged", "one repeated", "one missing", "light on in one", "moved 0.5 pixels", "moved 2 pixels",
    "a third of a stop", "JPEG from one on",
)  # fmt: skip
STRATEGIES = ("pixel", "hadamard", "adaptive")
SCENES = ("corner", "bright corner", "painted", "box", "occluded")
FAULTS, CLEAN = 100, 200
VIEWS = 10
HARM = 0.01
PROCESSES = 2
opened = cache(ltcl.open_device)  # of each process


@cache
def scene(name: str) -> tuple[np.ndarray, tuple[int, int]]:
    """T in float64 and its grid."""
    block = scenes.Block((0.3, 0.3, 0.2), (0.3, 0.3, 0.3))
    walls = {
        "corner": lambda: scenes.dihedral(N, albedo=0.6),
        "bright corner": lambda: scenes.dihedral(N, albedo=0.9),
        "painted": lambda: scenes.trihedral(N, albedo=[[0.9], [0.3], [0.6]]),
        "box": lambda: scenes.box(N, 3, albedo=0.7),
        "occluded": lambda: scenes.box(N, 3, albedo=0.7, occluder=block),
    }[name]()
    T = walls.transport()
    n = T.shape[1]
    dense = np.asarray(T @ np.eye(n).reshape(n, *T.grid), np.float64).reshape(n, n).T
    paint = np.random.default_rng(5).uniform(0.3, 1.0, n) if name == "painted" else np.ones(n)
    return paint[:, None] * dense, T.grid


@cache
def view(
    grid: tuple[int, int], seed: int, shift: float
) -> tuple[tuple[int, int], scipy.sparse.csr_array]:
    """A camera at a random place, shifted by some of its pixels."""
    rng = np.random.default_rng(seed)
    offset, angle, direction = (
        rng.uniform(-0.5, 0.5, 2),
        rng.uniform(-0.05, 0.05),
        rng.uniform(0, 2 * np.pi),
    )
    shape = (int(1.2 * SIZE * grid[0]), int(1.2 * SIZE * grid[1]))
    c, s = np.cos(angle) / SIZE, np.sin(angle) / SIZE

    def place(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a = u - shape[1] / 2 + shift * np.cos(direction)
        b = v - shape[0] / 2 + shift * np.sin(direction)
        return c * a + s * b + (grid[1] - 1) / 2 + offset[0], c * b - s * a + (
            grid[0] - 1
        ) / 2 + offset[1]

    return shape, camera_map(place, shape, grid)


class Person:
    """A rig whose photographs come from a list, with a fault at number `at`."""

    keeps_photographs = True

    def __init__(self, name: str, camera: str, seed: int, kind: str | None, at: int) -> None:
        T, self.projector_grid = scene(name)
        self.channels, self.kind, self.at, self.number = 1, kind, at, 0
        self._list: deque[tuple[np.ndarray, float]] = deque()
        self._last: np.ndarray | None = None
        h, w = self.projector_grid
        y, x = np.mgrid[:h, :w] / max(h, w)
        lamp = T.sum(axis=1) * (0.6 + 0.8 * x + 0.3 * y).ravel()
        added = (
            lamp * np.random.default_rng(seed).uniform(0.01, 0.1)
            if kind == "light on in one"
            else 0.0
        )
        shift = float(kind.split()[1]) if kind and kind.startswith("moved") else 0.0
        rigs = []
        for moved, light in ((0.0, 0.01), (shift, 0.01 + added)):
            shape, C = view((h, w), seed % VIEWS, moved)
            place: dict[str, Any] = {"camera_grid": shape, "camera_map": C, "ambient": light}
            rigs.append(VirtualRig(T, (h, w), seed=seed, **place, **CAMERAS[camera]))
        self._rig, self._faulty_rig = rigs
        self.bits = self._rig.bits

    def prepare(self, shots: Iterable[tuple[Any, float]]) -> None:
        """Put shots at the end of the list, unless they are on it."""
        listed = Counter((codes.tobytes(), seconds) for codes, seconds in self._list)
        for codes, seconds in shots:
            key = np.asarray(codes).tobytes(), seconds
            listed[key] -= 1
            if listed[key] < 0:
                self._list.append((codes, seconds))

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        """The next photograph."""
        self.number += 1
        if self._list and self._list[0][1] == seconds and np.array_equal(self._list[0][0], codes):
            self._list.popleft()
        n, at, kind, rig, shot = self.number, self.at, self.kind or "", self._rig, (codes, seconds)
        following = self._list[0] if self._list else shot
        if kind == "one repeated" and n == at and self._last is not None:
            return self._last
        if kind == "two exchanged" and n == at:
            self._put_off, shot = shot, following
        elif kind == "two exchanged" and n == at + 1:
            shot = self._put_off
        elif kind == "one missing" and n >= at:
            shot = following
        elif kind == "a third of a stop" and n == at:
            shot = codes, seconds * 2.0 ** (1 / 3)
        elif (kind.startswith("moved") and n >= at) or (kind == "light on in one" and n == at):
            rig = self._faulty_rig
        image = rig.photograph(*shot)
        if kind == "JPEG from one on" and n >= at:
            shift, quality = (self.bits or 8) - 8, [cv2.IMWRITE_JPEG_QUALITY, 70]
            _, data = cv2.imencode(".jpg", (image >> shift).astype(np.uint8), quality)
            image = (
                np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)).astype(image.dtype) << shift
            )
        self._last = image
        return image


@dataclass(frozen=True)
class Outcome:
    """One scan: `change` of T p by the fault, `kept` batches of it, `named` the right photograph."""

    kind: str | None
    scan: str
    at: int
    count: int
    change: float
    refused: bool
    named: bool
    text: str

    @property
    def where(self) -> str:
        """Scan and photograph."""
        return f"{self.scan}, photograph {self.at} of {self.count}"


def acquired(
    number: int, kind: str | None = None, at: int = 0
) -> tuple[np.ndarray, np.ndarray, int]:
    """T p of some patterns, which pixels are known, photographs; one number is one scan, to the noise."""
    name, camera, strategy = names(number)
    rig = Person(name, camera, number, kind, at)
    with TemporaryDirectory() as folder:
        T = acquire(rig, strategy=strategy, store=Path(folder) / "T.zarr", device=opened())
        y, x = np.mgrid[: T.grid[0], : T.grid[1]] / max(T.grid)
        rng = np.random.default_rng(3)
        P = [rng.random(T.grid), rng.random(T.grid) < 0.5, 0.5 + 0.5 * np.sin(9 * x + 5 * y), x > y]
        shown = np.asarray(T @ np.stack(P).astype(np.float32), np.float64).reshape(len(P), -1)
        return shown, ~np.asarray(T.masked).ravel(), rig.number


def names(k: int) -> tuple[str, str, str]:
    """Scene, camera and strategy of a scan."""
    return SCENES[k % 5], list(CAMERAS)[k // 5 % 3], STRATEGIES[(k // 15 + k) % 3]


def numbers(text: str) -> set[int]:
    """Numbers of photographs in a message, of ranges that are of at most 4."""
    result: set[int] = set()
    for first, last in re.findall(
        r"photographs? (\d+)(?: \([^)]*\))?(?: to (?:photograph )?(\d+))?", text
    ):
        stop = int(last or first)
        result |= set(range(int(first), stop + 1)) if stop - int(first) < 4 else set()
    return result


def run(job: tuple[int, Sequence[str]]) -> list[Outcome]:
    """A scan without a fault, and with one of each kind, in a process of its own."""
    scan, kinds = job
    name = " ".join(names(scan))
    try:
        clean, known, count = acquired(scan)
    except AcquisitionError as error:
        return [Outcome(None, name, 0, 0, 0.0, True, False, str(error))]
    results = [Outcome(None, name, 0, count, 0.0, False, False, "")]
    for kind in kinds:
        at = int(np.random.default_rng((scan, KINDS.index(kind))).integers(2, count - 1))
        try:
            shown, seen, _ = acquired(scan, kind, at)
        except AcquisitionError as error:
            early = not isinstance(error, ScanRefused)  # before anything was kept
            first = at - 1 if kind == "one repeated" else at
            last = count if kind.startswith("JPEG") else at + 1
            named = early and any(first <= number <= last for number in numbers(str(error)))
            results.append(Outcome(kind, name, at, count, np.nan, early, named, str(error)))
            continue
        change = relative_error(shown[:, known & seen].T, clean[:, known & seen].T)
        results.append(Outcome(kind, name, at, count, change, False, False, ""))
    return results


def main() -> None:
    given = parse_options(__doc__ or "")
    kinds, faults, clean = (KINDS[:1], 1, 1) if given.smoke else (KINDS, FAULTS, CLEAN)
    jobs = [(k, kinds if k < faults else ()) for k in range(clean)]
    with ProcessPoolExecutor(PROCESSES, multiprocessing.get_context("spawn")) as pool:
        results = pool.map(run, jobs)
        followed = track(results, "scans", total=len(jobs), disable=not sys.stderr.isatty())
        outcomes = [one for several in followed for one in several]
    facts: dict[str, Any] = {"scans": len(outcomes)}
    facts |= {"cameras": ", ".join(CAMERAS), "scenes": ", ".join(SCENES)}
    claims, shares = [], {}
    for kind in kinds:
        some = [one for one in outcomes if one.kind == kind]
        refused = [one for one in some if one.refused]
        missed = [one for one in some if not one.refused and not one.change <= HARM]
        wrong = [one for one in refused if not one.named]
        named, count = len(refused) - len(wrong), len(refused)
        lost = f"{len(missed)} of {len(some)}"
        claims.append(Claim(f"{kind}: kept, T p moved by over 1 %", lost, "0", not missed))
        is_named = named >= 0.95 * count
        claims.append(Claim(f"{kind}: refused and named", f"{named} of {count}", "95 %", is_named))
        shares[kind] = count / len(some), named / len(some)
        facts[f"{kind}, kept"] = [f"{o.where}: {o.change:.1%}" for o in missed]
        facts[f"{kind}, another named"] = [f"{o.where}: {o.text}" for o in wrong]
    wrong = [one for one in outcomes if one.kind is None and one.refused]
    claims.append(
        Claim("scans without a fault, refused", f"{len(wrong)} of {clean}", "0", not wrong)
    )
    facts |= {"refused without a fault": [f"{o.scan}: {o.text}" for o in wrong]}
    facts = {name: value for name, value in facts.items() if value}
    figures.conclude(given, "Faults of photographs", claims, facts, lambda: draw(shares))


def draw(shares: dict[str, tuple[float, float]]) -> Figure:
    figure = Figure(figsize=(9, 4), dpi=120, layout="constrained")
    axes, places = figure.subplots(), range(len(shares))
    refused, named = zip(*shares.values(), strict=True)
    axes.barh(places, refused, color="#c9d7e8", label="refused")
    axes.barh(places, named, color="#3b6ea5", label="and named")
    axes.set_yticks(places, list(shares))
    axes.set_xlabel("of all faults, harmless ones included")
    axes.legend()
    return figure


if __name__ == "__main__":
    main()
