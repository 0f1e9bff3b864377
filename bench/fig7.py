# SPDX-License-Identifier: BSD-3-Clause
"""Figure 7: what it takes to find the direct light l_d of a picture l_out, over the resolution N.

A white corner of two walls, N = 128 to 131072, of albedo 0.8: rho(R) is about 0.4 there, and the plain series
converges. Four ways, the first also by the BLAS of NumPy, each to an error of at most 1 % against the truth:

    series      S^-1 = I - R + R^2 - ... as a matrix (eq. 10), then times l_out    N^3
    iteration   l_d <- l_out - R l_d with all numbers of R (eq. 20)                N^2
    rows        the same with the rows of R in db2 wavelets, the paper's           N W
    both        the same with both sides of R in db2, on coefficients throughout   N W

The last two keep the largest numbers that 0.7 % need, in 16 bits each. Timed is all from the picture on the
host to l_d on the host, once R is in the form that the method wants (`_ways.py`). Each goes as far as memory,
and some minutes, allow. The truth needs no inverse: l_d = l_out - A l_out, A by exact rows.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import _figures as figures
from _figures import Claim
from _harness import Options, options, seconds
from _ways import (
    ALBEDO,
    ERROR,
    Problem,
    Way,
    by_matrices,
    by_numpy,
    by_steps,
    by_wavelets,
    dense,
    note,
    of_both,
    of_rows,
    problem,
)
from ltcl import checks

SIZES, SMOKE = (8, 12, 16, 22, 32, 46, 64, 90, 128, 182, 256), (2, 4, 8)  # patches along a wall, N = 2 n^2
SERIES, DENSE, SQUARES = 4232, 32768, 4  # the largest N; arrays of N x N float32 on the way
PATIENCE, REPEATS = 3.0, 15  # s: what takes longer runs once
ABOVE, LEAST = 5.0, 3  # times the launch floor: where a slope begins; of so many points at least
MANY = 2000  # pixels from which on W is judged: few have few wavelets
APART = {"rows": 5, "both": -5}  # points, between times that are written beside each other


@dataclass(frozen=True)
class Method:
    """How it is drawn, and between what its slope must be; a peer's is not asked for."""

    label: str
    colour: str
    slopes: tuple[float, float] = (-math.inf, math.inf)
    line: str = "-"


METHODS = {
    "series": Method("series, eq. 10", "#ff7f9f", (2.65, 3.35)),
    "peer": Method("series, by NumPy", "#ff7f9f", line="--"),
    "iteration": Method("iteration, eq. 20", "#ffb347", (1.7, 2.3)),
    "rows": Method("rows of R in db2", "#7fd77f", (0.7, 1.3)),
    "both": Method("db2 on both sides", "#5cc8ff", (0.7, 1.3)),
}


@dataclass(frozen=True)
class Point:
    """One method at one N. `kept` are numbers of R a row."""

    method: str
    pixels: int
    seconds: float
    error: float
    products: int
    nbytes: int
    kept: float


def reaches(pixels: int, farthest: int) -> bool:
    """Whether a method with dense R goes so far: by time, and by the memory that is left."""
    return pixels <= farthest and 4 * SQUARES * pixels**2 <= checks.host_memory()


def ways(given: Options, at: Problem) -> dict[str, Way]:
    """Every method that goes so far, ready to run."""
    found, n = {}, len(at.l_out)
    if reaches(n, DENSE):
        S = dense(given, at)
        iteration = found["iteration"] = by_steps(S, at, n)
        if reaches(n, SERIES):
            found["series"], found["peer"] = by_matrices(S, at, iteration), by_numpy(S, at, iteration)
    both = of_both(given, at)
    found["both"] = by_wavelets(given, at, both, True)
    found["rows"] = by_wavelets(given, at, of_rows(given, at, both), False)
    return found


def measure(given: Options, n: int) -> list[Point]:
    """All methods at one N, timed in turn."""
    start = time.perf_counter()
    at = problem(n)
    found = ways(given, at)
    quick: dict[str, Callable[[], object]] = {
        name: way.run for name, way in found.items() if way.first <= PATIENCE
    }
    spent = {name: way.first for name, way in found.items()} | seconds(quick, REPEATS)
    points = [
        Point(name, len(at.l_out), spent[name], way.error, way.products, way.nbytes, way.kept)
        for name, way in found.items()
    ]
    for p in points:
        note(f"N = {p.pixels}, {p.method}: {1e3 * p.seconds:.4g} ms, error {p.error:.2%}, {p.kept:.4g} a row")
    note(f"N = {len(at.l_out)}: {time.perf_counter() - start:.3g} s in all")
    return points


def curve(points: list[Point], name: str) -> tuple[np.ndarray, np.ndarray]:
    """N and seconds of one method, by rising N."""
    mine = [p for p in points if p.method == name]
    return np.array([p.pixels for p in mine]), np.array([p.seconds for p in mine])


@dataclass(frozen=True)
class Law:
    """seconds = floor + factor N^slope, of those N from `start` on."""

    floor: float
    factor: float
    slope: float
    start: int
    count: int

    def __call__(self, pixels: np.ndarray) -> np.ndarray:
        """Seconds."""
        return self.floor + self.factor * pixels**self.slope


def law(pixels: np.ndarray, spent: np.ndarray) -> Law:
    """The slope of log time over log N above the launch floor.

    The floor is the least time at any N: small solves are launches and checks, whose time varies. Points
    count from where all take at least five times as long, and the last three in any case; the slope is 0
    where the floor is one of these.
    """
    floor = float(spent.min())
    first = min(int(np.flatnonzero(spent < ABOVE * floor)[-1]) + 1, len(pixels) - LEAST)
    pixels, above = pixels[first:], spent[first:] - floor
    if above.min() <= 0.0:
        return Law(floor, 0.0, 0.0, int(pixels[0]), len(pixels))
    slope, factor = np.polyfit(np.log(pixels), np.log(above), 1)
    return Law(floor, float(np.exp(factor)), float(slope), int(pixels[0]), len(pixels))


def slowdown(points: list[Point], slow: str, fast: str) -> tuple[int, float]:
    """The largest N that both methods reach, and how many times longer one takes there."""
    found = {p.pixels: p.seconds for p in points if p.method == fast}
    last = max((p for p in points if p.method == slow and p.pixels in found), key=lambda p: p.pixels)
    return last.pixels, last.seconds / found[last.pixels]


def claims(points: list[Point], laws: dict[str, Law]) -> list[Claim]:
    """Of errors; and of slopes where they are known."""
    errors = [p.error for p in points]
    same = Claim(
        "all methods run to 1 % error",
        f"{min(errors):.2%} to {max(errors):.2%}",
        f"at most {ERROR:.0%}",
        max(errors) <= ERROR,
    )
    return [same, *(_of_growth(points, laws) if laws else [])]


def _of_growth(points: list[Point], laws: dict[str, Law]) -> list[Claim]:
    slopes = []
    for name, found in laws.items():
        low, high = METHODS[name].slopes
        slopes.append(
            Claim(
                f"{METHODS[name].label}: slope",
                f"{found.slope:.2f}, of {found.count} sizes from N = {found.start} on",
                f"{low} to {high}",
                low <= found.slope <= high,
            )
        )
    _, of_peer = slowdown(points, "peer", "iteration")
    at, ratio = slowdown(points, "series", "iteration")
    kept = {p.pixels: p.kept for p in points if p.method == "rows" and p.pixels >= MANY}
    return [
        *slopes,
        Claim(
            "three orders of magnitude from series to iteration",
            f"{ratio:.0f} times at N = {at}; {of_peer:.0f} where NumPy makes it",
            "at least 500",
            ratio >= 500.0,
        ),
        Claim(
            "wavelets a row are insensitive to N",
            f"{min(kept.values()):.3g} to {max(kept.values()):.3g} from N = {min(kept)} to {max(kept)}",
            "at most twice as many",
            max(kept.values()) <= 2.0 * min(kept.values()),
        ),
    ]


def draw(points: list[Point], laws: dict[str, Law]) -> Figure:
    """Time over N, with the fitted laws."""
    figure = figures.page(
        600,
        "Figure 7: what the direct light takes, to 1 %",
        "A corner of N pixels, each of which lights half of the others. A method starts with R in its own",
        "form, and ends with the same error against the truth. Dotted: launch floor and a power of N.",
    )
    axes = figures.graph(figure, (85, 150, 880, 375), "Time", "resolution of light transport, N", "seconds")
    axes.set_xscale("log")
    for name, method in METHODS.items():
        pixels, spent = curve(points, name)
        label = method.label
        if name in laws:
            label += f": slope {laws[name].slope:.2f}"
            at = np.geomspace(laws[name].start, pixels[-1])
            axes.plot(at, laws[name](at), ":", color=method.colour, lw=1.5)
        axes.plot(pixels, spent, "o" + method.line, color=method.colour, lw=2, ms=5, label=label)
        axes.annotate(
            said(spent[-1]),
            (pixels[-1], spent[-1]),
            (8, APART.get(name, 0)),
            textcoords="offset points",
            color=method.colour,
            fontsize=10,
            va="center",
        )
    axes.minorticks_off()
    axes.margins(x=0.1)
    axes.legend(frameon=False, labelcolor="linecolor", fontsize=10.5, loc="upper left")
    return figure


def said(spent: float) -> str:
    """As people read it."""
    return f"{1e3 * spent:.3g} ms" if spent < 1.0 else f"{spent:.3g} s"


def main() -> None:
    given = options(__doc__ or "")
    points = [p for n in (SMOKE if given.smoke else SIZES) for p in measure(given, n)]
    laws = {} if given.smoke else {name: law(*curve(points, name)) for name in METHODS if name != "peer"}
    facts: dict[str, Any] = {"albedo": ALBEDO}
    for name, method in METHODS.items():
        mine = [p for p in points if p.method == name]
        facts |= {
            f"{method.label}, N": [p.pixels for p in mine],
            f"{method.label}, ms": [float(f"{1e3 * p.seconds:.4g}") for p in mine],
            f"{method.label}, error": [float(f"{p.error:.3g}") for p in mine],
            f"{method.label}, products": [p.products for p in mine],
            f"{method.label}, numbers a row": [float(f"{p.kept:.4g}") for p in mine],
            f"{method.label}, MB": [float(f"{p.nbytes / 1e6:.4g}") for p in mine],
        }
    for slow, fast in (
        ("series", "iteration"),
        ("peer", "iteration"),
        ("iteration", "rows"),
        ("iteration", "both"),
        ("rows", "both"),
    ):
        at, ratio = slowdown(points, slow, fast)
        facts[f"{METHODS[slow].label} over {METHODS[fast].label} at N = {at}"] = ratio
    figures.conclude(given, "Figure 7: resolution", claims(points, laws), facts, lambda: draw(points, laws))


if __name__ == "__main__":
    main()
