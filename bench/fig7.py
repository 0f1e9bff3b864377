# SPDX-License-Identifier: BSD-3-Clause
"""Figure 7: time to find the direct light l_d of a picture l_out, over the resolution N.

A white corner of two walls, N = 128 to 131072, of albedo 0.8: rho(R) is about 0.4 there, and the
plain series converges. Four ways, the first also by the BLAS of NumPy, each to an error of at most
1 % against the truth:

    series      S^-1 = I - R + R^2 - ... as a matrix (eq. 10), then times l_out    N^3
    iteration   l_d <- l_out - R l_d with all numbers of R (eq. 20)                N^2
    rows        the same with the rows of R in db2 wavelets, the paper's           N W
    both        the same with both sides of R in db2, on coefficients throughout   N W

The last two keep the largest numbers that 0.7 % need, in 16 bits each. The time is that from the
picture on the host to l_d on the host, once R is in the form that the method needs. Dense R is
(I - A)^-1 - I by factorization (`_corner.py`). Both compressed forms come from C of R = W^T C W,
which eq. 21 makes on coefficients from rows of A that stream by, as in `resolution131k.py`; rows in
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
from matplotlib.axes import Axes
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

# Patches along a wall: N = 2 n^2.
SIZES = (8, 12, 16, 22, 32, 46, 64, 90, 128, 182, 256)
SMOKE_SIZES = (2, 4, 8)
ALBEDO = 0.8
ERROR = 1e-2
# Share of the error that compression may take; the iteration has the rest.
COMPRESSION_ERROR = 0.7e-2
TOLERANCES = 0.5 ** np.arange(1, 12, 0.5)

# The largest N of the two dense methods.
MAX_SERIES_PIXELS = 4232
MAX_DENSE_PIXELS = 32768
# Arrays of N x N float32 that the host holds at once on the way to dense R.
DENSE_ARRAYS = 4

# A method whose first run takes more seconds than this is timed by that run alone.
MAX_REPEATED_SECONDS = 3.0
REPEATS = 15

# Numbers of A below this are dropped, and of R, before it is thresholded for a picture.
THRESHOLD = 1e-4
FINE_RTOL = 5e-4
# Wavelets a row from which the largest are chosen.
MAX_ROW_WAVELETS = 128
BLOCK_BYTES = 1 << 28

# A slope is fitted to times above this many launch floors, and to at least this many points.
FLOOR_RATIO = 5.0
MIN_SLOPE_POINTS = 3
# Smaller pictures have too few wavelets for a claim about their number.
MIN_WAVELET_PIXELS = 2000
# Points up or down, where two times would be written upon each other.
LABEL_OFFSETS = {"rows": 5, "both": -5}


@dataclass(frozen=True)
class Method:
    """Label and look of a method, and the range of its slope, which is free for a peer."""

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
    """A corner, a picture of it, (N,) float32, and the direct light behind it, (N,) float64."""

    rows: Bounce
    l_out: np.ndarray
    l_d: np.ndarray

    @property
    def pixels(self) -> int:
        """N."""
        return len(self.l_out)


@dataclass(frozen=True, kw_only=True)
class Way:
    """A method ready to run, and figures of its first run; `kept` are numbers of R a row."""

    run: Callable[[], np.ndarray]
    error: float
    first: float
    products: int
    nbytes: int
    kept: float


def problem(n: int) -> Problem:
    rows = Bounce(n, ALBEDO)
    grey = landscape(*rows.grid).mean(axis=2).reshape(-1)
    l_out = 0.05 + 0.4 * grey
    return Problem(rows, l_out, l_out - rows.matmat(l_out))


def iteration_way(S: IdentityPlus, corner: Problem, kept: float) -> Way:
    """The iteration, with the loosest tolerance whose error is small enough."""

    def solve(rtol: float) -> ltcl.Solution:
        return ltcl.solve(S, corner.l_out, "jacobi", rtol=rtol)

    rtol = loosest_tolerance(lambda rtol: relative_error(solve(rtol).x, corner.l_d))
    solution = solve(rtol)
    return Way(
        run=lambda: solve(rtol).x,
        error=relative_error(solution.x, corner.l_d),
        first=solution.seconds,
        products=solution.products,
        nbytes=S.nbytes,
        kept=kept,
    )


def loosest_tolerance(error: Callable[[float], float]) -> float:
    """The first of TOLERANCES whose error is small enough, or the last."""
    for rtol in map(float, TOLERANCES):
        if error(rtol) <= ERROR:
            return rtol
    return float(TOLERANCES[-1])


def numpy_series(S: IdentityPlus, steps: int) -> np.ndarray:
    """The series by the products of NumPy's BLAS."""
    negative_R = -S.R.to_dense().astype(np.float32)
    term = negative_R
    total = np.eye(len(term), dtype=np.float32) + term
    for _ in range(steps - 1):
        term = term @ negative_R
        total += term
    return total


def matrix_way(inverse: Callable[[int], np.ndarray], corner: Problem, iteration: Way) -> Way:
    """The series, of as many terms as the iteration has steps: their sums are the same."""
    steps = iteration.products - 1

    def run() -> np.ndarray:
        return inverse(steps) @ corner.l_out.astype(np.float32)

    start = time.perf_counter()
    l_d = run()
    first = time.perf_counter() - start
    return Way(
        run=run,
        error=relative_error(l_d, corner.l_d),
        first=first,
        products=steps,
        nbytes=iteration.nbytes,
        kept=iteration.kept,
    )


def row_coefficients(W: Wavelet, C: Any) -> Any:
    """R W^T = W^T C, one column of C after the other."""
    columns = source("C", scipy.sparse.csr_array(C.T), BLOCK_BYTES)

    def synthesis(coarse: np.ndarray) -> np.ndarray:
        return W.apply_transpose(W.device.upload(coarse)).get()

    drop = FINE_RTOL * float(np.linalg.norm(C.data))
    most = MAX_ROW_WAVELETS * C.shape[0]
    rows = coefficients(columns, None, synthesis, drop=drop, most=most)
    return scipy.sparse.csr_array(rows.core.T)


def wavelet_way(corner: Problem, W: Wavelet, C: Any, both: bool) -> Way:
    """The fewest numbers that will do, in 16 bits, and the iteration with these."""

    def system(core: Any, V: Any) -> IdentityPlus:
        return IdentityPlus(Compressed(core, V if both else None, V))

    def error(core: Any) -> float:
        S = system(CSR(W.device, core), W)
        solution = ltcl.solve(S, corner.l_out, "jacobi", rtol=COMPRESSION_ERROR / 10)
        return relative_error(solution.x, corner.l_d)

    core = keep_fewest(C, error, COMPRESSION_ERROR)
    V: Any = W
    if both:
        core, V = restrict_to_support(core, W)
    S = system(Tiles(W.device, core, 1, "float16"), V)
    return iteration_way(S, corner, core.nnz / corner.pixels)


@dataclass(frozen=True)
class Point:
    """Time of a method at one N."""

    method: str
    pixels: int
    seconds: float
    way: Way


def ways(options: Options, corner: Problem) -> dict[str, Way]:
    """Every method that goes so far, ready to run."""
    return dense_ways(options, corner) | compressed_ways(options, corner)


def dense_ways(options: Options, corner: Problem) -> dict[str, Way]:
    """The iteration and the series with all numbers of R, if memory is left for these."""
    n = corner.pixels
    # Pixels of dense R for which the host has memory.
    most = (checks.host_memory() / (4 * DENSE_ARRAYS)) ** 0.5
    if n > min(MAX_DENSE_PIXELS, most):
        return {}
    R = interreflection(corner.rows.n, ALBEDO, lambda text: note(f"N = {n}: {text.strip()}"))
    S = IdentityPlus(Dense(options.device, R))
    iteration = iteration_way(S, corner, n)
    dense = {"iteration": iteration}
    if n <= min(MAX_SERIES_PIXELS, most):
        dense["series"] = matrix_way(
            lambda steps: matrix_series(S, steps=steps).x, corner, iteration
        )
        dense["peer"] = matrix_way(lambda steps: numpy_series(S, steps), corner, iteration)
    return dense


def compressed_ways(options: Options, corner: Problem) -> dict[str, Way]:
    """The iteration with R in wavelets, on both sides and in its rows."""
    W = Wavelet(options.device, corner.rows.grid, "db2")
    transform = analysis(W)
    blocks = source("A", corner.rows, BLOCK_BYTES)
    A = coefficients(blocks, transform, transform, THRESHOLD, first=THRESHOLD / 4)
    # C of R = W^T C W, far finer than needed.
    C = -invert_coefficients(-A.core, rtol=FINE_RTOL).D
    return {
        "both": wavelet_way(corner, W, C, both=True),
        "rows": wavelet_way(corner, W, row_coefficients(W, C), both=False),
    }


def measure(options: Options, n: int) -> list[Point]:
    """All methods at one N, timed in turn."""
    start = time.perf_counter()
    corner = problem(n)
    methods = ways(options, corner)
    pixels = corner.pixels
    times = {}
    actions: dict[str, Callable[[], object]] = {}
    for name, way in methods.items():
        times[name] = way.first
        if way.first <= MAX_REPEATED_SECONDS:
            actions[name] = way.run
    times |= seconds(actions, REPEATS)
    points = []
    for name, way in methods.items():
        ms = 1e3 * times[name]
        note(f"N = {pixels}, {name}: {ms:.4g} ms, error {way.error:.2%}, {way.kept:.4g} a row")
        points.append(Point(name, pixels, times[name], way))
    note(f"N = {pixels}: {time.perf_counter() - start:.3g} s in all")
    return points


def select_method(points: list[Point], name: str) -> list[Point]:
    """The points of one method, by rising N."""
    return [point for point in points if point.method == name]


def curve(points: list[Point], name: str) -> tuple[np.ndarray, np.ndarray]:
    """N and seconds of one method, by rising N."""
    pixels = []
    times = []
    for point in select_method(points, name):
        pixels.append(point.pixels)
        times.append(point.seconds)
    return np.array(pixels), np.array(times)


@dataclass(frozen=True, kw_only=True)
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


def law(pixels: np.ndarray, times: np.ndarray) -> Law:
    """The slope of log time over log N above the launch floor.

    The floor is the least time at any N: small solves are launches and checks, whose time varies.
    Points count from where all take at least five times as long, and the last three in any case;
    the slope is 0 where the floor is one of these.
    """
    floor = float(times.min())
    (small,) = np.nonzero(times < FLOOR_RATIO * floor)
    first = min(int(small[-1]) + 1, len(pixels) - MIN_SLOPE_POINTS)
    pixels = pixels[first:]
    above = times[first:] - floor
    slope = 0.0
    factor = 0.0
    if above.min() > 0.0:
        slope, log_factor = np.polyfit(np.log(pixels), np.log(above), 1)
        factor = np.exp(log_factor)
    return Law(
        floor=floor,
        factor=float(factor),
        slope=float(slope),
        start=int(pixels[0]),
        count=len(pixels),
    )


def slowdown(points: list[Point], slow: str, fast: str) -> tuple[int, float]:
    """The largest N that both methods reach, and how many times longer one takes there."""
    slow_times = dict(zip(*curve(points, slow), strict=True))
    fast_times = dict(zip(*curve(points, fast), strict=True))
    last = max(slow_times.keys() & fast_times.keys())
    return int(last), float(slow_times[last] / fast_times[last])


def method_facts(method: Method, points: list[Point]) -> dict[str, list[float]]:
    """Columns of the record, which `recorded` reads."""
    columns: dict[str, list[float]] = {
        "N": [],
        "ms": [],
        "error": [],
        "products": [],
        "numbers a row": [],
        "MB": [],
    }
    for point in points:
        way = point.way
        columns["N"].append(point.pixels)
        columns["ms"].append(float(f"{1e3 * point.seconds:.4g}"))
        columns["error"].append(float(f"{way.error:.3g}"))
        columns["products"].append(way.products)
        columns["numbers a row"].append(float(f"{way.kept:.4g}"))
        columns["MB"].append(float(f"{way.nbytes / 1e6:.4g}"))
    return {f"{method.label}, {name}": values for name, values in columns.items()}


def recorded(facts: dict[str, Any]) -> list[Point]:
    """The points of a record."""
    points = []
    for name, method in METHODS.items():
        for k, n in enumerate(facts[f"{method.label}, N"]):
            seconds = facts[f"{method.label}, ms"][k] / 1e3
            way = Way(
                run=lambda: np.zeros(0),
                error=facts[f"{method.label}, error"][k],
                first=seconds,
                products=facts[f"{method.label}, products"][k],
                nbytes=round(1e6 * facts[f"{method.label}, MB"][k]),
                kept=facts[f"{method.label}, numbers a row"][k],
            )
            points.append(Point(name, n, seconds, way))
    return points


def all_laws(points: list[Point]) -> dict[str, Law]:
    """The laws of every method but the peer."""
    laws = {}
    for name in METHODS:
        if name != "peer":
            laws[name] = law(*curve(points, name))
    return laws


def claims(points: list[Point], laws: dict[str, Law]) -> list[Claim]:
    listed = [error_claim(points)]
    if not laws:
        return listed
    for name, fitted in laws.items():
        listed.append(slope_claim(METHODS[name], fitted))
    listed.append(slowdown_claim(points))
    listed.append(wavelet_claim(points))
    return listed


def error_claim(points: list[Point]) -> Claim:
    errors = [point.way.error for point in points]
    measured = f"{min(errors):.2%} to {max(errors):.2%}"
    limit = f"at most {ERROR:.0%}"
    text = "all methods run to 1 % error"
    return Claim(text, measured, limit, max(errors) <= ERROR)


def slope_claim(method: Method, fitted: Law) -> Claim:
    low, high = method.slopes
    sizes = f"{fitted.count} sizes from N = {fitted.start} on"
    is_due = low <= fitted.slope <= high
    measured = f"{fitted.slope:.2f}, of {sizes}"
    return Claim(f"{method.label}: slope", measured, f"{low} to {high}", is_due)


def slowdown_claim(points: list[Point]) -> Claim:
    n, ratio = slowdown(points, "series", "iteration")
    _, peer_ratio = slowdown(points, "peer", "iteration")
    text = "three orders of magnitude from series to iteration"
    measured = f"{ratio:.0f} times at N = {n}; {peer_ratio:.0f} where NumPy makes it"
    return Claim(text, measured, "at least 500", ratio >= 500.0)


def wavelet_claim(points: list[Point]) -> Claim:
    kept = {}
    for point in select_method(points, "rows"):
        if point.pixels >= MIN_WAVELET_PIXELS:
            kept[point.pixels] = point.way.kept
    least = min(kept.values())
    most = max(kept.values())
    measured = f"{least:.3g} to {most:.3g} from N = {min(kept)} to {max(kept)}"
    text = "wavelets a row are insensitive to N"
    return Claim(text, measured, "at most twice as many", most <= 2.0 * least)


def draw(points: list[Point], laws: dict[str, Law]) -> Figure:
    figure = figures.page(
        600,
        "Figure 7: what the direct light takes, to 1 %",
        "A corner of N pixels, each of which lights half of the others. "
        "A method starts with R in its own",
        "form, and ends with the same error against the truth. "
        "Dotted: launch floor and a power of N.",
    )
    box = (85, 150, 880, 375)
    xlabel = "resolution of light transport, N"
    axes = figures.graph(figure, box, "Time", xlabel, "seconds")
    axes.set_xscale("log")
    for name, method in METHODS.items():
        pixels, times = curve(points, name)
        label = method.label
        if name in laws:
            label += f": slope {laws[name].slope:.2f}"
            fitted = np.geomspace(laws[name].start, pixels[-1])
            axes.plot(fitted, laws[name](fitted), ":", color=method.colour, lw=1.5)
        style = {"color": method.colour, "lw": 2, "ms": 5}
        axes.plot(pixels, times, "o" + method.line, label=label, **style)
        offset = LABEL_OFFSETS.get(name, 0)
        label_end(axes, method, (pixels[-1], times[-1]), offset)
    axes.minorticks_off()
    axes.margins(x=0.1)
    figures.legend(axes, 10.5, loc="upper left")
    return figure


def label_end(axes: Axes, method: Method, end: tuple[float, float], offset: int) -> None:
    """Write the time at the largest N beside its point."""
    duration = end[1]
    text = f"{1e3 * duration:.3g} ms" if duration < 1.0 else f"{duration:.3g} s"
    axes.annotate(
        text,
        end,
        color=method.colour,
        fontsize=10,
        xytext=(8, offset),
        textcoords="offset points",
        va="center",
    )


def main() -> None:
    options = parse_options(__doc__)
    points = []
    for n in SMOKE_SIZES if options.smoke else SIZES:
        points += measure(options, n)
    laws: dict[str, Law] = {}
    if not options.smoke:
        laws = all_laws(points)
    facts: dict[str, Any] = {"albedo": ALBEDO}
    for name, method in METHODS.items():
        facts |= method_facts(method, select_method(points, name))
    pairs = (
        ("series", "iteration"),
        ("peer", "iteration"),
        ("iteration", "rows"),
        ("iteration", "both"),
        ("rows", "both"),
    )
    for slow, fast in pairs:
        n, ratio = slowdown(points, slow, fast)
        facts[f"{METHODS[slow].label} over {METHODS[fast].label} at N = {n}"] = ratio
    title = "Figure 7: resolution"
    figures.conclude(options, title, claims(points, laws), facts, lambda: draw(points, laws))


if __name__ == "__main__":
    main()
