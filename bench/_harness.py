# SPDX-License-Identifier: BSD-3-Clause
"""What every bench shares: options, timing, the roofline, and the report.

Ratios count: competitors are timed in turn with us, as the speed of a machine drifts. Figures are
medians.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
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

_rest = 0.3  # seconds


@dataclass(frozen=True)
class Options:
    """Command line of a bench."""

    smoke: bool
    json: Path | None
    plot: Path | None
    device: Device
    more: argparse.Namespace = field(default_factory=argparse.Namespace)  # a bench's own arguments


@dataclass(frozen=True)
class Row:
    """One comparison. `ratio` is how many times better ours is; `target` is the least it should be."""

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
        who: str,
        theirs: float,
        ours: float,
        unit: str,
        target: float | None = None,
    ) -> Row:
        """The less, the better."""
        return cls(question, who, theirs, ours, unit, theirs / ours, target)

    @property
    def verdict(self) -> str:
        """Hit, miss by how much, or nothing where there is no target."""
        if self.target is None:
            return ""
        part = self.ratio / self.target
        return "hit" if part >= 1.0 else f"MISS: {part:.1%} of {self.target:.3g}x"


def parse_options(description: str, own: Mapping[str, Mapping[str, Any]] | None = None) -> Options:
    """Parse the command line, with a bench's own arguments, and open the device."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--smoke", action="store_true", help="tiny sizes: does it run")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--plot", type=Path, help="draw what was found into this PNG")
    parser.add_argument("--device", help="as ltcl.open_device takes it")
    for name, settings in (own or {}).items():
        parser.add_argument(f"--{name}", **settings)
    arguments = parser.parse_args()
    if arguments.smoke:
        global _rest
        _rest = 0.0
    device = ltcl.open_device(arguments.device)
    return Options(arguments.smoke, arguments.json, arguments.plot, device, arguments)


def seconds(actions: Mapping[str, Callable[[], object]], repeats: int = 7) -> dict[str, float]:
    """Median seconds of each action, run in turn A B C A B C.

    Before its turn comes a rest, as threads of BLAS and OpenMP spin after their work; then it runs
    until the processor is awake, and once more, which counts: in a solve a product follows a
    product.
    """
    times: dict[str, list[float]] = {name: [] for name in actions}
    for _ in range(repeats):
        for name, action in actions.items():
            time.sleep(_rest)
            warm = time.perf_counter() + _rest / 3
            action()
            while time.perf_counter() < warm:
                action()
            start = time.perf_counter()
            action()
            times[name].append(time.perf_counter() - start)
    return {name: statistics.median(values) for name, values in times.items()}


def product(A: Operator, x: np.ndarray) -> Callable[[], None]:
    """A @ x with vectors on the device, as inside a solve, and waited for."""
    on_device = A.device.upload(x)
    out = A.apply(on_device)

    def run() -> None:
        A.apply(on_device, out)
        A.device.finish()

    return run


def triad(device: Device, smoke: bool, parts: int = 1) -> tuple[Callable[[], None], int]:
    """a b + c over arrays far larger than caches, or a part: what memory gives; bytes as STREAM counts."""
    count = (1 << (16 if smoke else 25)) // parts
    b, c, out = (vectors.fill(device.empty(count), 1.0) for _ in range(3))

    def run() -> None:
        vectors.axpby(2.0, b, 1.0, c, out)
        device.finish()

    return run, 12 * count


def report(
    given: Options,
    title: str,
    rows: list[Row],
    facts: dict[str, Any],
    draw: Callable[[], Any] | None = None,
) -> None:
    """Publish comparisons, by default as bars."""
    table = Table("question", "competitor", "theirs", "ours", "unit", "ratio", "target", "verdict")
    for row in rows:
        target = "" if row.target is None else f"{row.target:.3g}x"
        figures = (f"{row.theirs:.4g}", f"{row.ours:.4g}", row.unit, f"{row.ratio:.2f}x")
        table.add_row(
            row.question, row.competitor, *figures, target, "" if given.smoke else row.verdict
        )
    content = {"rows": [{**asdict(row), "verdict": row.verdict} for row in rows]}
    publish(given, title, facts, table, content, draw or (lambda: _bars(title, rows)))


def publish(
    given: Options,
    title: str,
    facts: dict[str, Any],
    table: Table,
    content: Any,
    draw: Callable[[], Any],
) -> None:
    """Print facts and table; write them with `content`, and draw, where the command line asked for it."""
    console = Console(width=150)
    console.print(f"[bold]{title}[/]\n{given.device.name}, {given.device.driver}")
    for name, value in facts.items():
        console.print(
            f"  {name}: {value:.4g}" if isinstance(value, float) else f"  {name}: {value}"
        )
    if given.smoke:
        console.print("[yellow]--smoke: sizes this small show that it runs, not how fast[/]")
    console.print(table)
    if given.json is not None:
        write_json(given.json, record(given, title, facts) | content)
    if given.plot is not None:
        given.plot.parent.mkdir(parents=True, exist_ok=True)
        plots.save(draw(), given.plot)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a record, making its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def record(given: Options, title: str, facts: dict[str, Any]) -> dict[str, Any]:
    """What every JSON file of a bench opens with: the question, the device and the versions."""
    versions = {"ltcl": ltcl.__version__, "python": platform.python_version()}
    versions |= {"numpy": np.__version__, "scipy": scipy.__version__}
    device = {"device": given.device.name, "driver": given.device.driver}
    return {"title": title, "smoke": given.smoke, **device, "versions": versions, "facts": facts}


def _bars(title: str, rows: list[Row]) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 0.45 * len(rows) + 1.4), dpi=120, layout="constrained")
    axes = figure.subplots()
    places = range(len(rows))[::-1]
    axes.barh(places, [row.ratio for row in rows], color="#3b6ea5", label="measured")
    for place, row in zip(places, rows, strict=True):
        if row.target is not None:
            axes.plot([row.target] * 2, [place - 0.4, place + 0.4], color="#c0392b", lw=2)
    axes.set_yticks(
        places, [f"{row.question}\nagainst {row.competitor}" for row in rows], fontsize=7
    )
    axes.set_xscale("log")
    axes.set_xlabel("times better (red: target)")
    axes.set_title(title, fontsize=10)
    return figure
