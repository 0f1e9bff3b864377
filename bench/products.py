# SPDX-License-Identifier: BSD-3-Clause
"""A product with the R of a smooth scene, in every format: error against bytes against time.

A corner of albedo 0.8 on a grid of 96 x 192, N = 18432: light from everywhere arrives everywhere,
so that R has no zeros but those within rounding. Kept are the largest numbers of R itself, of its
rows in db2 wavelets (the paper's), and of db2 wavelets on both sides; the errors are those of R l
for a picture l, in float64. Others multiply the thresholded matrix at 1 %, each with its own sparse
rows in float32, and the dense one. Ours is timed with vectors on the device, as inside a solve;
where both sides are in wavelets a solve runs on the coefficients that are active, so that a product
there is of the core alone: both figures are given.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import _figures as figures
from _coefficients import ROWS, analysis, keep_largest, note, relative_error
from _corner import interreflection
from _harness import Options, Row, parse_options, product, report, seconds, triad
from _peers import missing, sparse_products
from ltcl.operators import CSR, Compressed, Operator, Tiles, Wavelet, restrict_to_support
from ltcl.plots.page import INK
from ltcl.scenes import landscape
from ltcl.tasks.compression.coefficients import coefficients
from ltcl.tasks.compression.sources import source

ALBEDO, ERROR = 0.8, 0.01
ERRORS = (0.1, 0.03, ERROR, 0.003)
AIM = 0.99  # of an error, for what is left out; the rest is for rounding to 16 bits
DROP = 1e-3  # of R in the Frobenius norm: coefficients that no error here needs
FORMATS = {"pixels": "sparse rows of R", "rows": "its rows in db2", "both": "both sides in db2"}
COLOURS = {"pixels": "#ffb347", "rows": "#7fd77f", "both": "#5cc8ff"}
OTHERS = "#ff7f9f"
OURS_TARGET, SCIPY_TARGET = 15.0, 30.0


Problem = namedtuple(
    "Problem", "R grid x y"
)  # R (N, N) float32, a picture, and R times it in float64


@dataclass(frozen=True)
class Form:
    """Numbers of R in one format, `matrix`, and y = matrix @ x in it for the picture."""

    name: str
    matrix: Any
    out: Wavelet | None
    into: Wavelet | None
    x: np.ndarray
    y: np.ndarray

    def operators(self, given: Options, numbers: Any) -> tuple[Operator, Operator]:
        """(core, operator on pictures) of some numbers: sparse rows, or tiles of 16 bits in a basis."""
        if self.into is None:
            core = CSR(given.device, numbers)
            return core, core
        numbers, basis = (
            (numbers, self.into) if self.out is None else restrict_to_support(numbers, self.into)
        )
        core = Tiles(given.device, numbers, 8, "float16")
        return core, Compressed(core, basis if self.out else None, basis)


@dataclass(frozen=True)
class Point:
    """One format at one error: numbers kept a row, bytes, milliseconds of a product and of its core alone."""

    form: str
    wanted: float
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
    y = [R[start : start + ROWS].astype(np.float64) @ x for start in range(0, len(R), ROWS)]
    return Problem(R, (n, 2 * n), x, np.concatenate(y))


def forms(given: Options, at: Problem) -> list[Form]:
    W = Wavelet(given.device, at.grid, "db2")
    transform, drop = analysis(W), DROP * float(np.linalg.norm(at.R.ravel()))
    found = []
    for name, out, into in (("pixels", None, None), ("rows", None, W), ("both", W, W)):
        note(FORMATS[name])
        matrix: Any = at.R
        if into is not None:
            matrix = coefficients(source("R", at.R), out and transform, transform, drop=drop).core
        x, y = (v if V is None else V.matvec(v) for V, v in ((into, at.x), (out, at.y)))
        found.append(Form(name, matrix, out, into, x, y))
    return found


def measure(
    given: Options, at: Problem, found: list[Form], wanted: float, memory: Callable[[], None]
) -> tuple[list[Point], dict[str, float]]:
    """All formats at one error; where it is that of the targets, milliseconds of everything else too."""
    note(f"error {wanted:.1%}")
    numbers = {form.name: keep_largest(form.matrix, form.x, form.y, AIM * wanted) for form in found}
    ways = [(form.name, *form.operators(given, numbers[form.name])) for form in found]
    actions: dict[str, Callable[[], object]] = {}
    if wanted == ERROR:
        actions = {"triad": memory, "dense numpy": lambda: at.R @ at.x}
        actions |= sparse_products(numbers["pixels"], at.x)
    others = list(actions)
    for form, core, A in ways:
        actions[f"ours, {form}"] = product(A, at.x)
        actions[f"core, {form}"] = product(core, np.resize(at.x, core.shape[1]))
    ms = {name: 1e3 * spent for name, spent in seconds(actions).items()}
    points = []
    for form, _, A in ways:
        error, kept = relative_error(A.matvec(at.x), at.y), numbers[form].nnz / len(at.x)
        points.append(
            Point(form, wanted, error, kept, A.nbytes, ms[f"ours, {form}"], ms[f"core, {form}"])
        )
    return points, {name: ms[name] for name in others}


def compare(at: Problem, sparse: Point, best: Point, ms: dict[str, float]) -> list[Row]:
    """What the targets are about: ours at 1 %, beside every other way to the same error."""
    targets = {"our own sparse rows": OURS_TARGET, "scipy": SCIPY_TARGET}
    others = {"our own sparse rows": sparse.pixels} | ms
    rows = []
    for how, ours in (("with transforms", best.pixels), ("in a solve", best.core)):
        for name, theirs in others.items():
            rows.append(
                Row.from_times(f"1 % of R l, {how}", name, theirs, ours, "ms", targets.get(name))
            )
    for name, size in (
        ("thresholded rows of any peer", sparse.nbytes),
        ("dense numpy", at.R.nbytes),
    ):
        rows.append(Row.from_times("bytes at 1 %", name, size, best.nbytes, "B", 1.0))
    return rows


def draw(
    at: Problem, points: list[Point], sparse: Point, best: Point, ms: dict[str, float]
) -> Figure:
    figure = figures.page(
        470,
        "What a product with a smooth R takes",
        "Thresholding drops the far field, which is weak at every place and strong together; wavelets on",
        "both sides keep it in a few numbers.",
        "Dashed: with a transform at each end, which solves do without.",
    )
    lefts, width = figures.columns(2, gap=50)
    boxes = [(left + 50, 168, width - 50, 210) for left in lefts]
    memory = figures.graph(figure, boxes[0], "Memory", "megabytes", "relative error of R l")
    time = figures.graph(figure, boxes[1], "Time", "milliseconds", "")
    for form, colour in COLOURS.items():
        mine = [point for point in points if point.form == form]
        errors, style = (
            [point.error for point in mine],
            {"color": colour, "marker": "o", "ms": 4, "lw": 2},
        )
        memory.loglog([point.nbytes / 1e6 for point in mine], errors, **style)
        time.loglog(
            [point.pixels for point in mine], errors, ls="--" if form == "both" else "-", **style
        )
        if form == "both":
            time.loglog([point.core for point in mine], errors, **style)
        name = FORMATS[form].replace("rows ", "rows\n").replace("sides ", "sides\n")
        memory.text(
            mine[0].nbytes / 1e6, 1.15 * errors[0], name, color=colour, ha="center", fontsize=9
        )
    peers = [(name, spent) for name, spent in ms.items() if name != "dense numpy"]
    for (name, spent), marker in zip(peers, "v^<>", strict=False):
        time.plot(spent, ERROR, marker, color=OTHERS, label=name, ms=7, zorder=4, ls="none")
    time.plot([], [], ":", color=OTHERS, lw=1, label="NumPy, dense: no error")
    fewer, faster = f"{sparse.nbytes / best.nbytes:.0f}", f"{sparse.pixels / best.core:.0f}"
    across(
        memory, at.R.nbytes / 1e6, (sparse.nbytes / 1e6, best.nbytes / 1e6), f"{fewer} times less"
    )
    text = f"{faster} times less,\n{sparse.pixels / best.pixels:.0f} with transforms"
    across(time, ms["dense numpy"], (sparse.pixels, best.core), text)
    figure.legend(loc="lower center", ncols=6, frameon=False, labelcolor="linecolor", fontsize=9.5)
    return figure


def across(axes: Axes, dense: float, pair: tuple[float, float], text: str) -> None:
    """How much less ours takes at 1 % than others, and where the dense product stands."""
    theirs, ours = pair
    axes.vlines(dense, min(ERRORS) / 1.3, max(ERRORS), color=OTHERS, lw=1, ls=":")
    arrow = {"arrowstyle": "->", "color": INK, "shrinkA": 4, "shrinkB": 4}
    axes.annotate("", (ours, ERROR), (theirs, ERROR), arrowprops=arrow)
    place = (ours * theirs**2) ** (1 / 3), ERROR * 1.1
    axes.text(*place, text, color=INK, fontsize=9, ha="center", va="bottom")
    axes.set_ylim(min(ERRORS) / 1.3, max(ERRORS) * 3)
    axes.set_yticks(ERRORS, [f"{100 * error:.2g} %" for error in ERRORS])
    axes.minorticks_off()


def main() -> None:
    given = parse_options(__doc__ or "")
    at, (memory, nbytes) = problem(given.smoke), triad(given.device, given.smoke)
    found, points, ms = forms(given, at), list[Point](), dict[str, float]()
    for wanted in ERRORS:
        more, others = measure(given, at, found, wanted, memory)
        points, ms = points + more, ms | others
    facts: dict[str, Any] = {"pixels": len(at.x), "triad, GB/s": nbytes / ms.pop("triad") / 1e6}
    for p in points:
        times = f"{p.pixels:.4g} ms, core {p.core:.4g} ms"
        size = f"{p.kept:.4g} a row, {p.nbytes / 1e6:.4g} MB, {times}"
        facts[f"{FORMATS[p.form]}, error {p.error:.2%}"] = size
    facts["not installed"] = ", ".join(missing()) or "none"
    # At 1 %: sparse rows of R, and ours that a solve runs on.
    sparse, best = (p for p in points if p.wanted == ERROR and p.form != "rows")
    rows, title = compare(at, sparse, best, ms), "Products with a smooth R"
    report(given, title, rows, facts, lambda: draw(at, points, sparse, best, ms))


if __name__ == "__main__":
    main()
