# SPDX-License-Identifier: BSD-3-Clause
"""Shared by all benches: command line, timing, memory bandwidth, and the report.

Ratios count: competitors are timed in turn with us, because the speed of a machine drifts. Figures
are medians.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from rich.console import Console
from rich.table import Table

import ltcl
from ltcl import plots
from ltcl.device import Device, vectors
from ltcl.operators import Operator

# Seconds of rest before each timed action, so that spinning threads go to sleep; none at --smoke.
_rest_seconds = 0.3


@dataclass(frozen=True, kw_only=True)
class Options:
    """Command line of a bench."""

    smoke: bool
    json: Path | None
    plot: Path | None
    device: Device
    # All arguments of the command line, with those that only one bench has.
    arguments: argparse.Namespace = field(default_factory=argparse.Namespace)


@dataclass(frozen=True)
class Row:
    """Comparison: `ratio` says how many times better ours is, `target` is its minimum."""

    question: str
    competitor: str
    theirs: float
    ours: float
    unit: str
    ratio: float
    target: float | None = None

    @classmethod
    def from_times(
        cls,
        question: str,
        competitor: str,
        theirs: float,
        ours: float,
        unit: str,
        target: float | None = None,
    ) -> Row:
        """Compare two quantities of which the smaller is the better."""
        return cls(
            question=question,
            competitor=competitor,
            theirs=theirs,
            ours=ours,
            unit=unit,
            ratio=theirs / ours,
            target=target,
        )

    @property
    def verdict(self) -> str:
        """A hit, a miss and its extent, or nothing if there is no target."""
        if self.target is None:
            return ""
        share = self.ratio / self.target
        if share >= 1.0:
            return "hit"
        return f"MISS: {share:.1%} of {self.target:.3g}x"


def parse_options(
    description: str | None, bench_arguments: Mapping[str, Mapping[str, Any]] | None = None
) -> Options:
    """Parse the command line, with a bench's own arguments, and open the device."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--smoke", action="store_true", help="tiny sizes: check that it runs")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--plot", type=Path, help="draw the results into this PNG")
    parser.add_argument("--device", help="device, as ltcl.open_device takes it")
    if bench_arguments is not None:
        for name, settings in bench_arguments.items():
            parser.add_argument(f"--{name}", **settings)
    arguments = parser.parse_args()
    if arguments.smoke:
        global _rest_seconds
        _rest_seconds = 0.0
    return Options(
        smoke=arguments.smoke,
        json=arguments.json,
        plot=arguments.plot,
        device=ltcl.open_device(arguments.device),
        arguments=arguments,
    )


def seconds(actions: Mapping[str, Callable[[], object]], repeats: int = 7) -> dict[str, float]:
    """Median seconds of each action, run in turn A B C A B C.

    A rest comes before each turn, as threads of BLAS and OpenMP spin after their work. Then the
    action runs until the processor is awake, and once more, which counts: in a solve a product
    follows a product.
    """
    times = defaultdict(list)
    for _ in range(repeats):
        for name, action in actions.items():
            time.sleep(_rest_seconds)
            end_of_warming = time.perf_counter() + _rest_seconds / 3
            action()
            while time.perf_counter() < end_of_warming:
                action()
            start = time.perf_counter()
            action()
            times[name].append(time.perf_counter() - start)
    return medians(times)


def milliseconds(actions: Mapping[str, Callable[[], object]], repeats: int = 7) -> dict[str, float]:
    """Median milliseconds of each action, by `seconds`."""
    times = seconds(actions, repeats)
    return {name: 1e3 * spent for name, spent in times.items()}


def medians(samples: Mapping[str, list[float]]) -> dict[str, float]:
    """Median of each list of samples."""
    return {name: statistics.median(values) for name, values in samples.items()}


def product(A: Operator, x: np.ndarray) -> Callable[[], None]:
    """Return an action: A @ x with vectors on the device, as inside a solve, and a wait."""
    x_device = A.device.upload(x)
    out = A.apply(x_device)

    def run() -> None:
        A.apply(x_device, out)
        A.device.finish()

    return run


def triad(device: Device, smoke: bool, parts: int = 1) -> tuple[Callable[[], None], int]:
    """Return the action a b + c over arrays far larger than caches, and its bytes as STREAM counts.

    With `parts` the arrays have that part of the length: the bandwidth for one of several ranks.
    """
    total = 1 << 25
    if smoke:
        total = 1 << 16
    count = total // parts
    b = vectors.fill(device.empty(count), 1.0)
    c = vectors.fill(device.empty(count), 1.0)
    out = vectors.fill(device.empty(count), 1.0)

    def run() -> None:
        vectors.axpby(2.0, b, 1.0, c, out)
        device.finish()

    return run, 12 * count


def report(
    options: Options,
    title: str,
    rows: list[Row],
    facts: dict[str, Any],
    draw: Callable[[], Any] | None = None,
) -> None:
    """Publish comparisons, drawn as bars if there is no `draw`."""
    table = Table("question", "competitor", "theirs", "ours", "unit", "ratio", "target", "verdict")
    for row in rows:
        table.add_row(*_cells(row, options.smoke))
    records = [{**asdict(row), "verdict": row.verdict} for row in rows]
    if draw is None:
        draw = partial(_bars, title, rows)
    publish(options, title, facts, table, {"rows": records}, draw)


def _cells(row: Row, is_smoke: bool) -> list[str]:
    """Cells of a comparison in the table; tiny sizes get no verdict."""
    target = ""
    if row.target is not None:
        target = f"{row.target:.3g}x"
    verdict = row.verdict
    if is_smoke:
        verdict = ""
    return [
        row.question,
        row.competitor,
        f"{row.theirs:.4g}",
        f"{row.ours:.4g}",
        row.unit,
        f"{row.ratio:.2f}x",
        target,
        verdict,
    ]


def publish(
    options: Options,
    title: str,
    facts: dict[str, Any],
    table: Table,
    content: Any,
    draw: Callable[[], Any] | None = None,
) -> None:
    """Print facts and table; write them with `content`, and draw, if the options ask for it.

    A bench without `draw` has no picture.
    """
    console = Console(width=150)
    console.print(f"[bold]{title}[/]\n{options.device.name}, {options.device.driver}")
    for name, value in facts.items():
        text = f"{value:.4g}" if isinstance(value, float) else str(value)
        console.print(f"  {name}: {text}")
    if options.smoke:
        console.print("[yellow]--smoke: sizes this small show that it runs, not how fast[/]")
    console.print(table)
    if options.json is not None:
        write_json(options.json, record(options, title, facts) | content)
    if options.plot is not None and draw is not None:
        options.plot.parent.mkdir(parents=True, exist_ok=True)
        plots.save(draw(), options.plot)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a record and create its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def record(options: Options, title: str, facts: dict[str, Any]) -> dict[str, Any]:
    """Head of every JSON file of a bench: the question, the device, the versions and the facts."""
    versions = {
        "ltcl": ltcl.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
    }
    return {
        "title": title,
        "smoke": options.smoke,
        "device": options.device.name,
        "driver": options.device.driver,
        "versions": versions,
        "facts": facts,
    }


def _bars(title: str, rows: list[Row]) -> Any:
    # Only a drawing needs matplotlib, and some benches measure the memory of this process.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 0.45 * len(rows) + 1.4), dpi=120, layout="constrained")
    axes = figure.subplots()
    heights = range(len(rows))[::-1]
    ratios = [row.ratio for row in rows]
    axes.barh(heights, ratios, color="#3b6ea5", label="measured")
    for height, row in zip(heights, rows, strict=True):
        if row.target is not None:
            ends = [height - 0.4, height + 0.4]
            axes.plot([row.target] * 2, ends, color="#c0392b", lw=2)
    labels = [f"{row.question}\nagainst {row.competitor}" for row in rows]
    axes.set_yticks(heights, labels, fontsize=7)
    axes.set_xscale("log")
    axes.set_xlabel("times better (red: target)")
    axes.set_title(title, fontsize=10)
    return figure
