# SPDX-License-Identifier: BSD-3-Clause
"""Figure 7: what it takes to find the direct light l_d of a picture l_out, over the resolution N.

A white corner of two walls, N = 128 to 131072, of albedo 0.8: rho(R) is about 0.4 there, and the
plain series converges. Four ways, the first also by the BLAS of NumPy, each to an error of at most
1 % against the truth:

    series      S^-1 = I - R + R^2 - ... as a matrix (eq. 10), then times l_out    N^3
    iteration   l_d <- l_out - R l_d with all numbers of R (eq. 20)                N^2
    rows        the same with the rows of R in db2 wavelets, the paper's           N W
    both        the same with both sides of R in db2, on coefficients throughout   N W

The last two keep the largest numbers that 0.7 % need, in 16 bits each. Timed is all from the
picture on the host to l_d on the host, once R is in the form that the method wants. Dense R is (I -
A)^-1 - I by factorization (`_corner.py`). Both compressed forms come from C of R = W^T C W, which
eq. 21 makes on coefficients from rows of A that stream by, as in `resolution131k.py`; rows in
wavelets are R W^T = W^T C. Each method goes as far as memory, and some minutes, allow. The truth
needs no inverse: l_d = l_out - A l_out, A by exact rows.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
from matplotlib.figure import Figure

import _figures as figures
import ltcl
from _coefficients import analysis, keep_fewest, note, relative_error
from _corner import Bounce, interreflection
from _figures import Claim
from _harness import Options, parse_options, seconds
from ltcl import checks
from ltcl.operators import CSR, Compressed, Dense, IdentityPlus, Tiles, Wavelet, restrict_to_support
from ltcl.scenes import landscape
from ltcl.solvers import matrix_series
from ltcl.tasks.compression import invert_coefficients
from ltcl.tasks.compression.coefficients import coefficients
from ltcl.tasks.compression.sources import source

SIZES, SMOKE = (
    (8, 12, 16, 22, 32, 46, 64, 90, 128, 182, 256),
    (2, 4, 8),
)  # patches along a wall, N = 2 n^2
SERIES, DENSE, SQUARES = 4232, 32768, 4  # the largest N; arrays of N x N float32 on the way
PATIENCE, REPEATS = 3.0, 15  # s: what takes longer runs once
ABOVE, LEAST = 5.0, 3  # times the launch floor: where a slope begins; of so many points at least
MANY = 2000  # pixels from which on W is judged: few have few wavelets
APART = {"rows": 5, "both": -5}  # points, between times that are written beside each other
ALBEDO, ERROR = 0.8, 1e-2
DROPPED = 0.7e-2  # of the error, what compression may take; the iteration has the rest
TOLERANCES = 0.5 ** np.arange(1, 12, 0.5)
THRESHOLD, FINE = 1e-4, 5e-4  # of numbers of A; of R before it is thresholded
MOST = 128  # wavelets a row from which the largest are chosen
MEMORY = 1 << 28  # bytes of a block


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
class Problem:
    """A corner, a picture of it, (N,) float32, and the direct light that makes it, (N,) float64."""

    rows: Bounce
    l_out: np.ndarray
    l_d: np.ndarray


@dataclass(frozen=True)
class Way:
    """A method that is ready to run, and figures of its first run; `kept` are numbers of R a row."""

    run: Callable[[], np.ndarray]
    error: float
    first: float
    products: int
    nbytes: int
    kept: float


def problem(n: int) -> Problem:
    rows = Bounce(n, ALBEDO)
    l_out = 0.05 + 0.4 * landscape(*rows.grid).mean(axis=2).reshape(-1)
    return Problem(rows, l_out, l_out - rows.matmat(l_out))


def by_steps(S: IdentityPlus, at: Problem, kept: float) -> Way:
    """The iteration, with the loosest tolerance whose error is small enough."""

    def solve(rtol: float) -> ltcl.Solution:
        return ltcl.solve(S, at.l_out, "jacobi", rtol=rtol)

    enough = (t for t in TOLERANCES if relative_error(solve(t).x, at.l_d) <= ERROR)
    rtol = float(next(enough, TOLERANCES[-1]))
    s = solve(rtol)
    return Way(
        lambda: solve(rtol).x, relative_error(s.x, at.l_d), s.seconds, s.products, S.nbytes, kept
    )


def by_numpy(S: IdentityPlus, steps: int) -> np.ndarray:
    """The series by the products of NumPy's BLAS."""
    less = -S.R.to_dense().astype(np.float32)
    term, total = less, np.eye(len(less), dtype=np.float32) + less
    for _ in range(steps - 1):
        term = term @ less
        total += term
    return total


def by_matrices(inverse: Callable[[int], np.ndarray], at: Problem, like: Way) -> Way:
    """The series, of as many terms as the iteration has steps: their sums are the same."""

    def run() -> np.ndarray:
        return inverse(like.products - 1) @ at.l_out.astype(np.float32)

    start = time.perf_counter()
    l_d = run()
    spent = time.perf_counter() - start
    return Way(run, relative_error(l_d, at.l_d), spent, like.products - 1, like.nbytes, like.kept)


def of_rows(given: Options, at: Problem, C: Any) -> Any:
    """R W^T = W^T C, one column of C after the other."""
    W = Wavelet(given.device, at.rows.grid, "db2")
    columns = source("C", scipy.sparse.csr_array(C.T), MEMORY)
    drop, most = FINE * float(np.linalg.norm(C.data)), MOST * C.shape[0]
    synthesis = lambda a: W.apply_transpose(given.device.upload(a)).get()  # noqa: E731
    return scipy.sparse.csr_array(
        coefficients(columns, None, synthesis, drop=drop, most=most).core.T
    )


def by_wavelets(given: Options, at: Problem, C: Any, both: bool) -> Way:
    """The fewest numbers that will do, in 16 bits, and the iteration with these."""
    W = Wavelet(given.device, at.rows.grid, "db2")

    def system(core: Any, V: Any = W) -> IdentityPlus:
        return IdentityPlus(Compressed(core, V if both else None, V))

    def error(core: Any) -> float:
        S = system(CSR(given.device, core))
        return relative_error(ltcl.solve(S, at.l_out, "jacobi", rtol=DROPPED / 10).x, at.l_d)

    kept = keep_fewest(C, error, DROPPED)
    core, V = restrict_to_support(kept, W) if both else (kept, W)
    return by_steps(
        system(Tiles(given.device, core, 1, "float16"), V), at, core.nnz / len(at.l_out)
    )


@dataclass(frozen=True)
class Point:
    """One method at one N."""

    method: str
    pixels: int
    seconds: float
    way: Way


def ways(given: Options, at: Problem) -> dict[str, Way]:
    """Every method that goes so far, ready to run."""
    found, n = {}, len(at.l_out)
    most = (
        checks.host_memory() / (4 * SQUARES)
    ) ** 0.5  # pixels of dense R for which memory is left
    if n <= min(DENSE, most):
        R = interreflection(at.rows.n, ALBEDO, lambda said: note(f"N = {n}: {said.strip()}"))
        S = IdentityPlus(Dense(given.device, R))
        iteration = found["iteration"] = by_steps(S, at, n)
        if n <= min(SERIES, most):
            found["series"] = by_matrices(
                lambda steps: matrix_series(S, steps=steps).x, at, iteration
            )
            found["peer"] = by_matrices(lambda steps: by_numpy(S, steps), at, iteration)
    transform = analysis(Wavelet(given.device, at.rows.grid, "db2"))
    A = coefficients(
        source("A", at.rows, MEMORY), transform, transform, THRESHOLD, first=THRESHOLD / 4
    )
    both = -invert_coefficients(
        -A.core, rtol=FINE
    ).D  # C of R = W^T C W in db2, far finer than needed
    found["both"] = by_wavelets(given, at, both, True)
    found["rows"] = by_wavelets(given, at, of_rows(given, at, both), False)
    return found


def measure(given: Options, n: int) -> list[Point]:
    """All methods at one N, timed in turn."""
    start = time.perf_counter()
    at = problem(n)
    found, pixels = ways(given, at), len(at.l_out)
    quick: dict[str, Callable[[], object]] = {
        k: way.run for k, way in found.items() if way.first <= PATIENCE
    }
    spent = {name: way.first for name, way in found.items()} | seconds(quick, REPEATS)
    for name, way in found.items():
        ms = f"{1e3 * spent[name]:.4g} ms"
        note(f"N = {pixels}, {name}: {ms}, error {way.error:.2%}, {way.kept:.4g} a row")
    note(f"N = {pixels}: {time.perf_counter() - start:.3g} s in all")
    return [Point(name, pixels, spent[name], way) for name, way in found.items()]


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

    The floor is the least time at any N: small solves are launches and checks, whose time varies.
    Points count from where all take at least five times as long, and the last three in any case;
    the slope is 0 where the floor is one of these.
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
    last = max(
        (p for p in points if p.method == slow and p.pixels in found), key=lambda p: p.pixels
    )
    return last.pixels, last.seconds / found[last.pixels]


def recorded(facts: dict[str, Any]) -> list[Point]:
    """The points of a record."""
    points = []
    for name, method in METHODS.items():
        of = (
            facts[f"{method.label}, {what}"]
            for what in ("N", "ms", "error", "products", "MB", "numbers a row")
        )
        for n, ms, error, products, size, kept in zip(*of, strict=True):
            way = Way(lambda: np.zeros(0), error, ms / 1e3, products, round(1e6 * size), kept)
            points.append(Point(name, n, ms / 1e3, way))
    return points


def all_laws(points: list[Point]) -> dict[str, Law]:
    """Those of every method but the peer."""
    return {name: law(*curve(points, name)) for name in METHODS if name != "peer"}


def claims(points: list[Point], laws: dict[str, Law]) -> list[Claim]:
    errors = [p.way.error for p in points]
    least, most = min(errors), max(errors)
    limit = f"at most {ERROR:.0%}"
    listed = [
        Claim("all methods run to 1 % error", f"{least:.2%} to {most:.2%}", limit, most <= ERROR)
    ]
    if not laws:
        return listed
    for name, found in laws.items():
        text, (low, high) = f"{METHODS[name].label}: slope", METHODS[name].slopes
        measured = f"{found.slope:.2f}, of {found.count} sizes from N = {found.start} on"
        listed.append(Claim(text, measured, f"{low} to {high}", low <= found.slope <= high))
    (_, of_peer), (at, ratio) = (slowdown(points, slow, "iteration") for slow in ("peer", "series"))
    orders = "three orders of magnitude from series to iteration"
    times = f"{ratio:.0f} times at N = {at}; {of_peer:.0f} where NumPy makes it"
    kept = {p.pixels: p.way.kept for p in points if p.method == "rows" and p.pixels >= MANY}
    fewest, most = min(kept.values()), max(kept.values())
    counts = f"{fewest:.3g} to {most:.3g} from N = {min(kept)} to {max(kept)}"
    insensitive = "wavelets a row are insensitive to N"
    return [
        *listed,
        Claim(orders, times, "at least 500", ratio >= 500.0),
        Claim(insensitive, counts, "at most twice as many", most <= 2.0 * fewest),
    ]


def draw(points: list[Point], laws: dict[str, Law]) -> Figure:
    figure = figures.page(
        600,
        "Figure 7: what the direct light takes, to 1 %",
        "A corner of N pixels, each of which lights half of the others. A method starts with R in its own",
        "form, and ends with the same error against the truth. Dotted: launch floor and a power of N.",
    )
    axes = figures.graph(
        figure, (85, 150, 880, 375), "Time", "resolution of light transport, N", "seconds"
    )
    axes.set_xscale("log")
    for name, method in METHODS.items():
        pixels, spent = curve(points, name)
        label = method.label
        if name in laws:
            label += f": slope {laws[name].slope:.2f}"
            at = np.geomspace(laws[name].start, pixels[-1])
            axes.plot(at, laws[name](at), ":", color=method.colour, lw=1.5)
        axes.plot(pixels, spent, "o" + method.line, color=method.colour, lw=2, ms=5, label=label)
        duration = f"{1e3 * spent[-1]:.3g} ms" if spent[-1] < 1.0 else f"{spent[-1]:.3g} s"
        place: Any = {
            "xytext": (8, APART.get(name, 0)),
            "textcoords": "offset points",
            "va": "center",
        }
        axes.annotate(duration, (pixels[-1], spent[-1]), color=method.colour, fontsize=10, **place)
    axes.minorticks_off()
    axes.margins(x=0.1)
    axes.legend(frameon=False, labelcolor="linecolor", fontsize=10.5, loc="upper left")
    return figure


def main() -> None:
    given = parse_options(__doc__ or "")
    points = [p for n in (SMOKE if given.smoke else SIZES) for p in measure(given, n)]
    laws = {} if given.smoke else all_laws(points)
    facts: dict[str, Any] = {"albedo": ALBEDO}
    for name, method in METHODS.items():
        mine = [p for p in points if p.method == name]
        facts |= {
            f"{method.label}, N": [p.pixels for p in mine],
            f"{method.label}, ms": [float(f"{1e3 * p.seconds:.4g}") for p in mine],
            f"{method.label}, error": [float(f"{p.way.error:.3g}") for p in mine],
            f"{method.label}, products": [p.way.products for p in mine],
            f"{method.label}, numbers a row": [float(f"{p.way.kept:.4g}") for p in mine],
            f"{method.label}, MB": [float(f"{p.way.nbytes / 1e6:.4g}") for p in mine],
        }
    slower = {
        "iteration": ("series", "peer"),
        "rows": ("iteration",),
        "both": ("iteration", "rows"),
    }
    for slow, fast in ((slow, fast) for fast, some in slower.items() for slow in some):
        at, ratio = slowdown(points, slow, fast)
        facts[f"{METHODS[slow].label} over {METHODS[fast].label} at N = {at}"] = ratio
    figures.conclude(
        given, "Figure 7: resolution", claims(points, laws), facts, lambda: draw(points, laws)
    )


if __name__ == "__main__":
    main()
