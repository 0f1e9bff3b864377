# SPDX-License-Identifier: BSD-3-Clause
"""A product with the R of a smooth scene, in every format: error against bytes against time.

A corner of albedo 0.8 on a grid of 96 x 192, N = 18432: light from everywhere arrives everywhere,
so that R has no zeros but those within rounding. Kept are the largest numbers of R itself, of its
rows in db2 wavelets (the paper's), and of db2 wavelets on both sides; the errors are those of R l
for a picture l, in float64. Others multiply the thresholded matrix at 1 %, each with its own sparse
rows in float32, and the dense one. Ours is timed with vectors on the device, as inside a solve;
where both sides are in wavelets a solve runs on the coefficients that are active, so that a product
there is of the core alone: both figures are options.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import _figures as figures
from _coefficients import ROWS, analysis, keep_largest, note, relative_error
from _corner import interreflection
from _harness import Options, Row, milliseconds, parse_options, product, report, triad
from _peers import missing, sparse_products
from ltcl.operators import CSR, Compressed, Operator, Tiles, Wavelet, restrict_to_support
from ltcl.plots.page import INK
from ltcl.scenes import landscape
from ltcl.tasks.compression.coefficients import coefficients
from ltcl.tasks.compression.sources import source

ALBEDO = 0.8
# The error that the targets are about, and all errors of the curves.
TARGET_ERROR = 0.01
ERRORS = (0.1, 0.03, TARGET_ERROR, 0.003)
# Share of an error for dropped numbers; the rest is for rounding to 16 bits.
DROPPED_SHARE = 0.99
# Share of R in the Frobenius norm below which no coefficient matters for these errors.
DROP_RTOL = 1e-3
FORMATS = {"pixels": "sparse rows of R", "rows": "its rows in db2", "both": "both sides in db2"}
COLOURS = {"pixels": "#ffb347", "rows": "#7fd77f", "both": "#5cc8ff"}
PEER_COLOUR = "#ff7f9f"
# Times faster than each competitor.
TARGETS = {"our own sparse rows": 15.0, "scipy": 30.0}


@dataclass(frozen=True, kw_only=True)
class Problem:
    """R (N, N) float32, a picture x, and y = R x in float64."""

    R: np.ndarray
    grid: tuple[int, int]
    x: np.ndarray
    y: np.ndarray


@dataclass(frozen=True, kw_only=True)
class Form:
    """Numbers of R in one format, `matrix`, and y = matrix @ x in it for the picture."""

    name: str
    matrix: Any
    out: Wavelet | None
    into: Wavelet | None
    x: np.ndarray
    y: np.ndarray

    def operators(self, options: Options, numbers: Any) -> tuple[Operator, Operator]:
        """The core and the operator on pictures: sparse rows, or tiles of 16 bits in a basis."""
        if self.into is None:
            rows = CSR(options.device, numbers)
            return rows, rows
        basis: Any = self.into
        if self.out is not None:
            numbers, basis = restrict_to_support(numbers, basis)
        core = Tiles(options.device, numbers, 8, "float16")
        return core, Compressed(core, basis if self.out else None, basis)


@dataclass(frozen=True, kw_only=True)
class Point:
    """Figures of a format at one error.

    `kept` are numbers a row, `pixels` the milliseconds of a product, `core` those of its core.
    """

    form: str
    target_error: float
    error: float
    kept: float
    nbytes: int
    pixels: float
    core: float


def problem(smoke: bool) -> Problem:
    n = 8 if smoke else 96
    note(f"R of {2 * n * n} pixels")
    R = interreflection(n, ALBEDO, note)
    x = landscape(n, 2 * n).mean(axis=2).reshape(-1).astype(np.float32)
    blocks = []
    for start in range(0, len(R), ROWS):
        rows = R[start : start + ROWS].astype(np.float64)
        blocks.append(rows @ x)
    return Problem(R=R, grid=(n, 2 * n), x=x, y=np.concatenate(blocks))


def forms(options: Options, scene: Problem) -> list[Form]:
    """R in all formats, to far more numbers than any error needs."""
    W = Wavelet(options.device, scene.grid, "db2")
    transform = analysis(W)
    drop = DROP_RTOL * float(np.linalg.norm(scene.R.ravel()))

    note(FORMATS["pixels"])
    pixels = Form(name="pixels", matrix=scene.R, out=None, into=None, x=scene.x, y=scene.y)
    note(FORMATS["rows"])
    rows_of_R = source("R", scene.R)
    row_core = coefficients(rows_of_R, None, transform, drop=drop).core
    x = W.matvec(scene.x)
    rows = Form(name="rows", matrix=row_core, out=None, into=W, x=x, y=scene.y)
    note(FORMATS["both"])
    rows_of_R = source("R", scene.R)
    core = coefficients(rows_of_R, transform, transform, drop=drop).core
    both = Form(name="both", matrix=core, out=W, into=W, x=x, y=W.matvec(scene.y))
    return [pixels, rows, both]


def measure(
    options: Options,
    scene: Problem,
    formats: list[Form],
    target_error: float,
    peers: dict[str, Callable[[], object]],
) -> tuple[list[Point], dict[str, float]]:
    """All formats at one error, and milliseconds of peers.

    Peers are those of `peers`, and sparse products of others at the error of the targets.
    """
    note(f"error {target_error:.1%}")
    actions = dict(peers)
    operators = {}
    kept = {}
    for form in formats:
        drop_error = DROPPED_SHARE * target_error
        numbers = keep_largest(form.matrix, form.x, form.y, drop_error)
        kept[form.name] = numbers.nnz / len(scene.x)
        operators[form.name] = form.operators(options, numbers)
        if form.name == "pixels" and peers:
            actions |= sparse_products(numbers, scene.x)
    peer_names = list(actions)
    for name, (core, A) in operators.items():
        core_x = np.resize(scene.x, core.shape[1])
        actions[f"ours, {name}"] = product(A, scene.x)
        actions[f"core, {name}"] = product(core, core_x)
    ms = milliseconds(actions)
    points = []
    for name, (_, A) in operators.items():
        point = Point(
            form=name,
            target_error=target_error,
            error=relative_error(A.matvec(scene.x), scene.y),
            kept=kept[name],
            nbytes=A.nbytes,
            pixels=ms[f"ours, {name}"],
            core=ms[f"core, {name}"],
        )
        points.append(point)
    return points, {name: ms[name] for name in peer_names}


def compare(scene: Problem, sparse: Point, best: Point, ms: dict[str, float]) -> list[Row]:
    """Ours at 1 %, beside every other way to the same error."""
    others = {"our own sparse rows": sparse.pixels} | ms
    rows = []
    settings = {"with transforms": best.pixels, "in a solve": best.core}
    for setting, ours in settings.items():
        question = f"1 % of R l, {setting}"
        for name, theirs in others.items():
            target = TARGETS.get(name)
            rows.append(Row.from_times(question, name, theirs, ours, "ms", target))
    sizes = {
        "thresholded rows of any peer": sparse.nbytes,
        "dense numpy": scene.R.nbytes,
    }
    for name, size in sizes.items():
        rows.append(Row.from_times("bytes at 1 %", name, size, best.nbytes, "B", 1.0))
    return rows


def draw(
    scene: Problem, points: list[Point], sparse: Point, best: Point, ms: dict[str, float]
) -> Figure:
    figure = figures.page(
        470,
        "What a product with a smooth R takes",
        "Thresholding drops the far field, which is weak at every place "
        "and strong together; wavelets on",
        "both sides keep it in a few numbers.",
        "Dashed: with a transform at each end, which solves do without.",
    )
    lefts, width = figures.columns(2, gap=50)
    left, right = ((start + 50, 168, width - 50, 210) for start in lefts)
    ylabel = "relative error of R l"
    memory = figures.graph(figure, left, "Memory", "megabytes", ylabel)
    time = figures.graph(figure, right, "Time", "milliseconds", "")
    for form in COLOURS:
        points_of_form = [point for point in points if point.form == form]
        draw_form(memory, time, form, points_of_form)
    draw_peers(time, ms)
    fewer = f"{sparse.nbytes / best.nbytes:.0f} times less"
    pair = (sparse.nbytes / 1e6, best.nbytes / 1e6)
    draw_gain(memory, scene.R.nbytes / 1e6, pair, fewer)
    in_solve = sparse.pixels / best.core
    with_transforms = sparse.pixels / best.pixels
    faster = f"{in_solve:.0f} times less,\n{with_transforms:.0f} with transforms"
    draw_gain(time, ms["dense numpy"], (sparse.pixels, best.core), faster)
    style = {"frameon": False, "labelcolor": "linecolor", "fontsize": 9.5}
    figure.legend(loc="lower center", ncols=6, **style)
    return figure


def draw_form(memory: Axes, time: Axes, form: str, points: list[Point]) -> None:
    """Curves of one format: error over memory, and over time."""
    errors = []
    megabytes = []
    pixel_ms = []
    core_ms = []
    for point in points:
        errors.append(point.error)
        megabytes.append(point.nbytes / 1e6)
        pixel_ms.append(point.pixels)
        core_ms.append(point.core)
    style = {"color": COLOURS[form], "marker": "o", "ms": 4, "lw": 2}
    memory.loglog(megabytes, errors, **style)
    if form == "both":
        time.loglog(pixel_ms, errors, ls="--", **style)
        time.loglog(core_ms, errors, **style)
    else:
        time.loglog(pixel_ms, errors, ls="-", **style)
    name = FORMATS[form].replace("rows ", "rows\n").replace("sides ", "sides\n")
    label = {"color": COLOURS[form], "ha": "center", "fontsize": 9}
    memory.text(megabytes[0], 1.15 * errors[0], name, **label)


def draw_peers(time: Axes, ms: dict[str, float]) -> None:
    peers = [name for name in ms if name != "dense numpy"]
    for name, marker in zip(peers, "v^<>", strict=False):
        style = {"color": PEER_COLOUR, "ms": 7, "zorder": 4, "ls": "none"}
        time.plot(ms[name], TARGET_ERROR, marker, label=name, **style)
    label = "NumPy, dense: no error"
    time.plot([], [], ":", color=PEER_COLOUR, lw=1, label=label)


def draw_gain(axes: Axes, dense: float, pair: tuple[float, float], text: str) -> None:
    """Mark the gain of ours over others at 1 %, and the dense product."""
    theirs, ours = pair
    bottom = min(ERRORS) / 1.3
    axes.vlines(dense, bottom, max(ERRORS), color=PEER_COLOUR, lw=1, ls=":")
    arrow = {"arrowstyle": "->", "color": INK, "shrinkA": 4, "shrinkB": 4}
    ends = ((ours, TARGET_ERROR), (theirs, TARGET_ERROR))
    axes.annotate("", *ends, arrowprops=arrow)
    middle = (ours * theirs**2) ** (1 / 3)
    style = {"color": INK, "fontsize": 9, "ha": "center", "va": "bottom"}
    axes.text(middle, TARGET_ERROR * 1.1, text, **style)
    axes.set_ylim(bottom, max(ERRORS) * 3)
    axes.set_yticks(ERRORS, [f"{100 * error:.2g} %" for error in ERRORS])
    axes.minorticks_off()


def point_facts(points: list[Point]) -> dict[str, str]:
    facts = {}
    for point in points:
        name = f"{FORMATS[point.form]}, error {point.error:.2%}"
        times = f"{point.pixels:.4g} ms, core {point.core:.4g} ms"
        facts[name] = f"{point.kept:.4g} a row, {point.nbytes / 1e6:.4g} MB, {times}"
    return facts


def main() -> None:
    options = parse_options(__doc__)
    scene = problem(options.smoke)
    memory, nbytes = triad(options.device, options.smoke)
    peers = {"triad": memory, "dense numpy": lambda: scene.R @ scene.x}
    formats = forms(options, scene)
    points: list[Point] = []
    ms: dict[str, float] = {}
    for error in ERRORS:
        timed_peers = peers if error == TARGET_ERROR else {}
        error_points, peer_ms = measure(options, scene, formats, error, timed_peers)
        points += error_points
        ms |= peer_ms
    bandwidth = nbytes / ms.pop("triad") / 1e6
    facts: dict[str, Any] = {"pixels": len(scene.x), "triad, GB/s": bandwidth}
    facts |= point_facts(points)
    facts["not installed"] = ", ".join(missing()) or "none"
    at_target = [point for point in points if point.target_error == TARGET_ERROR]
    (sparse,) = [point for point in at_target if point.form == "pixels"]
    (best,) = [point for point in at_target if point.form == "both"]
    rows = compare(scene, sparse, best, ms)
    title = "Products with a smooth R"
    report(options, title, rows, facts, lambda: draw(scene, points, sparse, best, ms))


if __name__ == "__main__":
    main()
