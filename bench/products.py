# SPDX-License-Identifier: BSD-3-Clause
"""A product with the R of a smooth scene, in every format: error against bytes against time.

A corner of albedo 0.8 on a grid of 96 x 192, N = 18432: light from everywhere arrives everywhere, so that R
has no zeros but those within rounding. Kept are the largest numbers of R itself, of its rows in db2
wavelets (the paper's), and of db2 wavelets on both sides; the errors are those of R l for a picture l, in
float64. Others multiply the thresholded matrix at 1 %, each with its own sparse rows in float32, and the
dense one. Ours is timed with vectors on the device, as inside a solve; where both sides are in wavelets a
solve runs on coefficients, so that a product there is of the core alone: both figures are given.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse

import _figures as figures
from _harness import Options, Row, Triad, options, report, seconds
from _peers import missing, sparse_products
from ltcl import plots
from ltcl.compression.coefficients import Coefficients, coefficients
from ltcl.compression.sources import source
from ltcl.operators import CSR, Compressed, Operator, Tiles, Wavelet
from ltcl.scenes import dihedral, landscape

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ALBEDO, ERROR = 0.8, 0.01
ERRORS = (0.1, 0.03, ERROR, 0.003)
FORMATS = {
    "pixels": "thresholded rows",
    "rows": "rows in db2",
    "both": "db2 on both sides",
}
COLOURS = {"pixels": "#ffb347", "rows": "#7fd77f", "both": "#5cc8ff"}
OURS_TARGET, SCIPY_TARGET = 15.0, 30.0


@dataclass(frozen=True)
class Problem:
    """R (N, N), a picture, and R times it."""

    R: np.ndarray
    grid: tuple[int, int]
    x: np.ndarray
    y: np.ndarray

    def error(self, product: np.ndarray) -> float:
        """Relative, of a product with `x`."""
        return float(np.linalg.norm(product - self.y) / np.linalg.norm(self.y))


@dataclass(frozen=True)
class Point:
    """One format at one error: its operator, as made for pixels, and the error it has."""

    format: str
    operator: Operator
    core: Operator
    error: float
    kept: float

    @property
    def name(self) -> str:
        """What the plot calls it."""
        return f"{self.format} {type(self.core).__name__}"


def problem(smoke: bool) -> Problem:
    """The corner under a landscape."""
    scene = dihedral(8 if smoke else 96, albedo=ALBEDO)
    (T,) = scene.matrices()
    T /= scene.first_bounce
    T[np.diag_indices_from(T)] -= 1.0
    R = T.astype(np.float32)
    x = landscape(*scene.grid).mean(axis=2).reshape(-1).astype(np.float32)
    return Problem(R, scene.grid, x, T @ x.astype(np.float64))


def bisect(error: Callable[[float], float], wanted: float, high: float) -> float:
    """About the largest threshold whose error is at most `wanted`; `high` drops everything."""
    low = high * 2.0**-40
    for _ in range(18):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if error(middle) <= wanted else (low, middle)
    return low


def thresholded(R: np.ndarray, threshold: float) -> Any:
    """Entries of at least `threshold` as sparse rows, a block of rows at a time."""
    blocks = [R[start : start + 1024] for start in range(0, len(R), 1024)]
    parts = [scipy.sparse.csr_array(np.where(np.abs(block) >= threshold, block, 0)) for block in blocks]
    return scipy.sparse.vstack(parts, format="csr")


def of_pixels(given: Options, at: Problem, wanted: float) -> tuple[Point, Any]:
    """Sparse rows of R itself, and the same on the host."""

    def product(threshold: float) -> np.ndarray:
        parts = []
        for start in range(0, len(at.R), 1024):
            block = at.R[start : start + 1024]
            parts.append(np.where(np.abs(block) >= threshold, block, 0) @ at.x)
        return np.concatenate(parts)

    threshold = bisect(lambda t: at.error(product(t)), wanted, float(at.R.max()))
    A = thresholded(at.R, threshold)
    core = CSR(given.device, A)
    return Point("pixels", core, core, at.error(A @ at.x), A.nnz / len(at.R)), A


def of_wavelets(given: Options, at: Problem, found: Coefficients, wanted: float, both: bool) -> list[Point]:
    """Sparse rows of coefficients, and tiles of 16 bits at least as good as another tenth of the error."""
    W = Wavelet(given.device, at.grid, "db2")
    out = W if both else None

    def operator(core: Operator) -> Compressed:
        return Compressed(core, out, W)

    def error(threshold: float) -> float:
        return at.error(operator(CSR(given.device, found.above(threshold).core)).matvec(at.x))

    highest = float(np.abs(found.core.data).max())
    kept = found.above(bisect(error, wanted, highest)).core
    cores: list[Operator] = [CSR(given.device, kept), Tiles(given.device, kept, 1, "bfloat16")]
    form = "both" if both else "rows"
    return [
        Point(form, operator(core), core, at.error(operator(core).matvec(at.x)), kept.nnz / len(at.R))
        for core in cores
    ]


def gathered(given: Options, at: Problem, both: bool) -> Coefficients:
    """Coefficients down to where they hardly matter."""
    W = Wavelet(given.device, at.grid, "db2")
    size = float(np.linalg.norm(at.R.ravel()))

    def transform(x: np.ndarray) -> np.ndarray:
        return W.apply(W.device.upload(x)).get()

    return coefficients(source("R", at.R), transform if both else None, transform, drop=1e-3 * size)


def action(given: Options, A: Operator, x: np.ndarray) -> Callable[[], None]:
    """A product on the device, waited for."""
    on_device = given.device.upload(x)
    out = A.apply(on_device)

    def run() -> None:
        A.apply(on_device, out)
        given.device.finish()

    return run


def timed(given: Options, at: Problem, points: list[Point], A: Any, triad: Triad) -> dict[str, float]:
    """Milliseconds of everything, in turn."""
    actions: dict[str, Callable[[], object]] = {"triad": triad, "dense numpy": lambda: at.R @ at.x}
    actions |= {f"peer {name}": run for name, run in sparse_products(A, at.x).items()}
    for number, point in enumerate(points):
        actions[f"pixels {number}"] = action(given, point.operator, at.x)
        if point.core is not point.operator:
            coefficients_of_x = np.resize(at.x, point.core.shape[1])
            actions[f"core {number}"] = action(given, point.core, coefficients_of_x)
    return {name: 1e3 * spent for name, spent in seconds(actions).items()}


def compare(points: list[Point], A: Any, ms: dict[str, float]) -> list[Row]:
    """What the targets are about: ours at 1 %, beside every other way to the same error."""
    at_one = [(n, p) for n, p in enumerate(points) if p.format == "both" and p.error <= 1.05 * ERROR]
    number, best = min(at_one, key=lambda pair: ms[f"core {pair[0]}"])
    ours = {"with transforms": ms[f"pixels {number}"], "in a solve": ms[f"core {number}"]}
    csr = ms[f"pixels {ERRORS.index(ERROR)}"]  # points begin with those of pixels
    rows = []
    for how, mine in ours.items():
        others = {"our own sparse rows": (csr, OURS_TARGET), "scipy": (ms["peer scipy"], SCIPY_TARGET)}
        others |= {
            name.removeprefix("peer "): (spent, None)
            for name, spent in ms.items()
            if name.startswith(("peer", "dense")) and name != "peer scipy"
        }
        for name, (theirs, target) in others.items():
            rows.append(Row(f"1 % of R l, {how}", name, theirs, mine, "ms", theirs / mine, target))
    theirs, mine = A.nnz * 8 + 4 * len(A.indptr), best.operator.nbytes
    rows.append(Row("bytes at 1 %", "thresholded rows of any peer", theirs, mine, "B", theirs / mine, 1.0))
    return rows


def draw(points: list[Point], ms: dict[str, float], A: Any) -> Figure:
    """Error over bytes, and error over time."""
    figure = figures.page(
        510,
        "What a product with a smooth R takes",
        "Thresholding drops the far field, which is weak at every place and strong together; wavelets on",
        "both sides keep it in a few numbers. Dashed: with a transform at each end; a solve does without.",
    )
    lefts, width = figures.columns(2, gap=60)
    first = figures.graph(figure, (lefts[0] + 50, 150, width - 50, 230), "Memory", "bytes", "relative error")
    second = figures.graph(
        figure, (lefts[1] + 50, 150, width - 50, 230), "Time", "milliseconds", "relative error"
    )
    for name in dict.fromkeys(point.name for point in points):
        mine = [(n, point) for n, point in enumerate(points) if point.name == name]
        form = mine[0][1].format
        style = {"color": COLOURS[form], "lw": 2, "marker": "o" if name.endswith("CSR") else "s", "ms": 4}
        errors = [point.error for _, point in mine]
        label = f"{FORMATS[form]}, {'sparse rows' if name.endswith('CSR') else '16 bits'}"
        first.loglog([point.operator.nbytes for _, point in mine], errors, label=label, **style)
        kind = "core" if form == "both" else "pixels"
        second.loglog([ms[f"{kind} {n}"] for n, _ in mine], errors, **style)
        if form == "both":
            second.loglog([ms[f"pixels {n}"] for n, _ in mine], errors, ls="--", **style)
    for (name, spent), marker in zip(
        [(name, spent) for name, spent in ms.items() if name.startswith("peer")], "v^<>", strict=False
    ):
        second.plot(spent, ERROR, marker, color="#ff7f9f", label=name.removeprefix("peer "), ms=7)
    second.plot(ms["dense numpy"], points[0].error / 30, "D", color="#ff7f9f", label="NumPy, dense")
    for axes in (first, second):
        axes.minorticks_off()
    handles = [axes.get_legend_handles_labels() for axes in (first, second)]
    figure.legend(
        handles[0][0] + handles[1][0],
        handles[0][1] + handles[1][1],
        loc="lower center",
        ncols=4,
        frameon=False,
        labelcolor="linecolor",
        fontsize=9,
    )
    return figure


def main() -> None:
    """Run it."""
    given = options(__doc__ or "")
    at, triad = problem(given.smoke), Triad(given.device, given.smoke)
    points, A = [], None
    for wanted in ERRORS:
        point, host = of_pixels(given, at, wanted)
        A = host if wanted == ERROR else A
        points.append(point)
    for both in (False, True):
        found = gathered(given, at, both)
        for wanted in ERRORS:
            points += of_wavelets(given, at, found, wanted, both)
    ms = timed(given, at, points, A, triad)
    facts: dict[str, Any] = {
        "pixels": len(at.R),
        "triad, GB/s": triad.nbytes / ms["triad"] / 1e6,
        **{
            f"{point.name}, error {point.error:.2g}": f"{point.kept:.4g} a row, "
            f"{point.operator.nbytes / 1e6:.4g} MB, {ms[f'pixels {n}']:.4g} ms, "
            f"core {ms.get(f'core {n}', ms[f'pixels {n}']):.4g} ms"
            for n, point in enumerate(points)
        },
        "not installed": ", ".join(missing()) or "none",
    }
    plot, given = given.plot, Options(given.smoke, given.json, None, given.device)
    report(given, "Products with a smooth R", compare(points, A, ms), facts)
    if plot is not None:
        plot.parent.mkdir(parents=True, exist_ok=True)
        plots.save(draw(points, ms, A), plot)


if __name__ == "__main__":
    main()
