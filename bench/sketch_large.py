# SPDX-License-Identifier: BSD-3-Clause
"""A sketch of many pixels: photographs, errors, time and memory.

A virtual camera of 12 bits photographs a corner in three colours with texture of pixels
(`_corner.TexturedCorner`), by default of 256 x 512 pixels, whose light bounces exactly; of
1080 x 1920 light bounces between cells of 8 x 8 pixels, and is interpolated. All photographs count.
T p is compared with the truth for pictures of each kind (`sketch.pictures`), and a picture like
nature is compensated and shown with the true T. Memory is what the process takes more while T is
estimated than before; pictures stand in a temporary file.

With `--megapixels` a larger camera looks at the corner (`_large_camera`), Gray code shows where its
pixels look, and memory is what the process takes more at any time of the scan, from the first
photograph on.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import psutil
from matplotlib.figure import Figure

import _figures as figures
import ltcl
from _corner import textured_transport
from _figures import Claim
from _harness import Options, parse_options
from _large_camera import LargeCameraRig
from ltcl.acquisition import Report, acquire
from sketch import (
    MAX_ERRORS,
    CountingRig,
    budget_claims,
    compensated_error,
    errors_of,
    shown,
    unit,
)

ARGUMENTS: dict[str, dict[str, Any]] = {
    "grid": {
        "choices": ("256x512", "1080x1920"),
        "default": "256x512",
        "help": "pixels of the projector",
    },
    "megapixels": {
        "type": float,
        "default": None,
        "help": "pixels of a larger camera, in millions; without it those of the projector",
    },
}
# Pixels of a side of the cells between which light bounces.
STEPS = {"256x512": 1, "1080x1920": 8}
SMOKE_GRID = "72x144"
MAX_PHOTOGRAPHS = 150
# Seconds and bytes of the estimate, and bytes of T, of 256 x 512 pixels.
MAX_SECONDS = 30.0
MAX_ESTIMATE_BYTES = 200e6
MAX_BYTES = 60e6
# Seconds and bytes for 1920 x 1080.
MAX_COMPENSATE_SECONDS = 1.0
MAX_LARGE_BYTES = 2e9


class EstimateCost:
    """Seconds from the last picture on, and the memory that the process takes more meanwhile.

    With `of_whole_scan` memory is that from the first photograph on.
    """

    def __init__(self, of_whole_scan: bool = False) -> None:
        self._of_whole_scan = of_whole_scan
        self.seconds = 0.0
        self.bytes = 0
        self._process = psutil.Process()
        self._before = self._own_memory()
        self._start = time.perf_counter()
        self._is_estimating = False
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def progress(self, step: str, done: int, total: int) -> None:
        """Begin anew with each picture, until T is estimated."""
        self._is_estimating = self._is_estimating or step == "fit"
        if self._is_estimating:
            return
        self._start = time.perf_counter()
        if not self._of_whole_scan:
            self._before = self._own_memory()
            self.bytes = 0

    def stop(self) -> None:
        """Note the end of the estimate."""
        self.seconds = time.perf_counter() - self._start
        self._is_over.set()
        self._thread.join()

    def _own_memory(self) -> int:
        """Bytes of the process that are no files."""
        memory = self._process.memory_info()
        return memory.rss - memory.shared

    def _watch(self) -> None:
        while not self._is_over.wait(0.02):
            self.bytes = max(self.bytes, self._own_memory() - self._before)


@dataclass(frozen=True, kw_only=True)
class LargeSketch:
    """A sketch of many pixels, its costs and its errors."""

    grid: tuple[int, int]
    photographs: int
    cost: EstimateCost
    nbytes: int
    disk_bytes: int
    errors: dict[str, float]
    compensated: float
    compensate_seconds: float
    frames_a_second: float
    frames_a_second_of_half: float
    judged: float
    bound: float


def make_rig(truth: ltcl.Transport, megapixels: float | None) -> CountingRig | LargeCameraRig:
    """The camera before the corner."""
    if megapixels is not None:
        return LargeCameraRig(truth, megapixels)
    return CountingRig(truth, truth.grid, response="linear", bits=12, ambient=0.01, seed=2)


def run(
    grid: tuple[int, int], step: int, megapixels: float | None, options: Options
) -> LargeSketch:
    """Scan a corner of these pixels, and compare T with the truth."""
    truth = textured_transport(grid, step, options.device)
    rig = make_rig(truth, megapixels)
    cost = EstimateCost(of_whole_scan=megapixels is not None)
    with TemporaryDirectory() as folder:
        store = Path(folder) / "T.zarr"
        T = acquire(
            rig,
            geometry="aligned" if megapixels is None else "graycode",
            strategy="sketch",
            store=store,
            progress=cost.progress,
            device=options.device,
        )
        cost.stop()
        report = Report.of(store)
        scale = unit(T, truth)
        errors = errors_of(lambda pattern: scale * shown(T, pattern), truth)
        compensated = compensated_error(T, truth, scale)
        target = np.full((*grid, 3), 0.2, np.float32)
        start = time.perf_counter()
        ltcl.compensate(T, target, rtol=1e-3)
        compensate_seconds = time.perf_counter() - start
        return LargeSketch(
            grid=grid,
            photographs=rig.count,
            cost=cost,
            nbytes=T.nbytes,
            disk_bytes=sum(file.stat().st_size for file in store.rglob("*") if file.is_file()),
            errors=errors,
            compensated=compensated,
            compensate_seconds=compensate_seconds,
            frames_a_second=prepared_rate(T),
            frames_a_second_of_half=prepared_rate(T, bounces_every=2),
            judged=report.judged_error,
            bound=report.judged_bound,
        )


def prepared_rate(T: ltcl.Transport, bounces_every: int = 1) -> float:
    """Frames of a prepared compensation a second, one by one, to 1 %.

    The light of bounces is computed of every so many frames, over which a frame is averaged.
    """
    frame = np.full((*T.camera_grid, 3), 100, np.uint8)
    rtol = max(1e-2, T.error)
    with ltcl.Compensator(T, clamp=True, rtol=rtol, bounces_every=bounces_every) as compensator:
        for _ in range(bounces_every):
            compensator(frame)
        times = []
        for _ in range(5 * bounces_every):
            start = time.perf_counter()
            compensator(frame)
            times.append(time.perf_counter() - start)
    periods = np.reshape(times, (5, bounces_every)).mean(axis=1)
    return 1.0 / float(np.median(periods))


def claims(result: LargeSketch, is_large: bool) -> list[Claim]:
    """Check a sketch."""
    errors = result.errors | {"compensated": result.compensated}
    checked = budget_claims("", result.photographs, MAX_PHOTOGRAPHS, errors)
    if is_large:
        amounts = [
            ("memory", result.cost.bytes / 1e6, MAX_LARGE_BYTES / 1e6, "MB"),
            ("compensate", result.compensate_seconds, MAX_COMPENSATE_SECONDS, "s"),
        ]
    else:
        amounts = [
            ("seconds until T is there", result.cost.seconds, MAX_SECONDS, "s"),
            (
                "memory while T is estimated",
                result.cost.bytes / 1e6,
                MAX_ESTIMATE_BYTES / 1e6,
                "MB",
            ),
            ("T", result.nbytes / 1e6, MAX_BYTES / 1e6, "MB"),
        ]
    for text, amount, most, name in amounts:
        checked.append(
            Claim(
                text=text,
                measured=f"{amount:.4g} {name}",
                wanted=f"at most {most:.4g} {name}",
                holds=amount <= most,
            )
        )
    return checked


def draw(result: LargeSketch) -> Figure:
    """Draw the errors of each kind of picture beside their limits."""
    height, width = result.grid
    figure = figures.page(
        420,
        f"A sketch of {height} x {width} pixels in colour",
        f"{result.photographs} photographs; errors of T p, and their limits (dashes).",
    )
    axes = figures.graph(figure, (80, 120, 820, 250), "error of T p, %", "", "", "linear")
    kinds = list(result.errors)
    axes.bar(kinds, [100 * result.errors[kind] for kind in kinds], width=0.5)
    for place, kind in enumerate(kinds):
        axes.hlines(100 * MAX_ERRORS[kind], place - 0.35, place + 0.35, figures.FAINT, "--")
    return figure


def main() -> None:
    """Run the bench."""
    options = parse_options(__doc__, ARGUMENTS)
    name = SMOKE_GRID if options.smoke else options.arguments.grid
    height, width = map(int, name.split("x"))
    megapixels = options.arguments.megapixels
    result = run((height, width), STEPS.get(name, 1), megapixels, options)
    facts = {
        "grid": name,
        "megapixels of the camera": megapixels,
        "seconds until T is there": result.cost.seconds,
        "memory while T is estimated, MB": result.cost.bytes / 1e6,
        "T, MB": result.nbytes / 1e6,
        "T on disk, MB": result.disk_bytes / 1e6,
        "compensate, s": result.compensate_seconds,
        "prepared frames a second": result.frames_a_second,
        "the same with bounces of every second frame": result.frames_a_second_of_half,
        "error that is stated": result.judged,
        "bound that is stated": result.bound,
    }
    checked = claims(result, is_large=name == "1080x1920")
    if options.smoke:
        checked = []
    figures.conclude(options, "A sketch of many pixels", checked, facts, partial(draw, result))


if __name__ == "__main__":
    main()
