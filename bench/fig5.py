# SPDX-License-Identifier: BSD-3-Clause
"""Figure 5: how fast the inverse series converges, and where it does not (eq. 10, 14, 16, 20).

Claims of the paper: (a) the same oscillation near a corner, an edge and a centre; (b) below albedo
1/2 the error follows the bound of eq. 16 up to a constant; (c) in a closed box albedo 0.45
converges in a few iterations, close to 0.5 slowly, 0.51 diverges; (d) at albedo 0.62 a closed box
diverges, five sides are very slow, fewer are fast. Ours beside it: Chebyshev's iteration converges
in all of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import _boxes as boxes
import _figures as figures
import ltcl
from _boxes import FLOOR, RTOL, Race, race
from _figures import Claim
from _harness import parse_options
from ltcl.plots.page import FAINT, INK
from ltcl.scenes import box
from ltcl.solvers import matrix_series
from ltcl.theory import inverse_error_bound

BELOW_HALF, ORDERS = (0.2, 0.3, 0.4, 0.45), 10
ALBEDOS, SIDES, OPEN_ALBEDO = (0.2, 0.3, 0.4, 0.45, 0.49, 0.51), (6, 5, 4, 3, 2, 1), 0.62
STEPS = 40  # drawn
BOUNDS = {
    m: np.array([inverse_error_bound(m, k) for k in range(1, ORDERS + 1)]) for m in BELOW_HALF
}
ROUNDING = 1e-4  # of a norm: above, float32 products matter little
SHADES = ("#8bd17c", "#5cc8ff", "#c792ea", "#ffd166", "#ffb347", "#ff5d5d")


def swings(n: int, device: ltcl.Device) -> dict[str, np.ndarray]:
    """Sums of 0 .. ORDERS terms over the truth, red light, at three patches of the floor of figure 4."""
    scene, l_d = boxes.coloured_box(n)
    systems = scene.transport(first_bounce=scene.first_bounce, device=device).systems[:1]
    series = boxes.terms(systems, boxes.all_bounces(scene, l_d)[:1], ORDERS)[:, 0]
    floor = (np.cumsum(series, axis=0) / l_d[0]).reshape(-1, n, 6, n)[:, :, FLOOR]
    return {
        "corner": floor[:, 0, 0],
        "edge": floor[:, n // 2, 0],
        "centre": floor[:, n // 2, n // 2],
    }


def norms(n: int, albedo: float, device: ltcl.Device) -> np.ndarray:
    """||S^-1 - S_k^-1||, the largest singular value, of a closed box for k = 1 .. ORDERS (eq. 16)."""
    scene = box(n, albedo=albedo)
    exact = np.eye(6 * n * n) - albedo * scene.form_factors
    (S,) = scene.transport(first_bounce=scene.first_bounce, device=device).systems
    return np.array(
        [np.linalg.norm(matrix_series(S, steps=k).x - exact, 2) for k in range(1, ORDERS + 1)]
    )


@dataclass(frozen=True)
class Found:
    """All that the figure shows: (a), (b), (c), (d), and five sides at an albedo below their limit."""

    swings: dict[str, np.ndarray]
    norms: dict[float, np.ndarray]
    closed: dict[float, Race]
    opened: dict[Any, Race]
    below: Race

    @property
    def races(self) -> list[Race]:
        """Every box that was raced in."""
        return [*self.closed.values(), *self.opened.values(), self.below]


def measure(n: int, device: ltcl.Device) -> Found:
    """All boxes, n x n patches a wall; norms of those of half as many."""
    name = f"side(s), albedo {OPEN_ALBEDO}"
    closed = {m: race(f"closed, albedo {m}", n, 6, m, device) for m in ALBEDOS}
    opened = {sides: race(f"{sides} {name}", n, sides, OPEN_ALBEDO, device) for sides in SIDES}
    below, of_series = race("5 sides, albedo 0.6", n, 5, 0.6, device), swings(n, device)
    return Found(
        of_series, {m: norms(n // 2, m, device) for m in BELOW_HALF}, closed, opened, below
    )


def claims(found: Found) -> list[Claim]:
    signs = np.array([np.sign(swing[:9] - 1) for swing in found.swings.values()])
    left = {name: abs(swing[8] - 1) / abs(swing[4] - 1) for name, swing in found.swings.items()}
    is_alike = (signs == (-1.0) ** np.arange(9)).all() and max(left.values()) < 1.1 * min(
        left.values()
    )
    parts = "4 terms more leave " + ", ".join(f"{part:.2f} ({name})" for name, part in left.items())
    large = {m: norm > ROUNDING for m, norm in found.norms.items()}
    ratios = {m: (norm / BOUNDS[m])[large[m]] for m, norm in found.norms.items()}
    worst = max(float(ratio.max(initial=0)) for ratio in ratios.values())
    off = max(np.abs(ratio / (1 - 2 * m) - 1).max(initial=0) for m, ratio in ratios.items())
    closed, opened, few = found.closed, found.opened, found.closed[0.45]
    late = max(
        abs(r.steps() - math.log(RTOL) / math.log(r.rho)) for m, r in closed.items() if m < 0.5
    )
    fewer = [opened[sides].steps() for sides in SIDES[2:]]
    faster = f"4, 3, 2, 1 sides: 1 % in {', '.join(map(str, fewer))}"
    falls = fewer == sorted(set(fewer), reverse=True) and fewer[0] <= 20
    most, error = max(r.chebyshev.products for r in found.races), max(r.error for r in found.races)
    products = f"to 1e-5 in at most {most} products, {error:.1g} off the truth"
    converged = all(r.chebyshev.converged for r in found.races) and error < 1e-4
    alike = "(a) alike at a corner, an edge and the centre: above, below, above ..."
    constant, factor = "(b) it follows eq. 16 up to a constant", f"1 - 2m for all n, to {off:.1g}"
    quick = "(c) albedo 0.45 converges in a few iterations"
    shared = "light that all walls share shrinks by m / (1 - m) = 0.82 an iteration: 1 % takes 23"
    limit = (
        "its form factors have the eigenvalue 0.82, not the 4/5 of one patch a wall: the limit is albedo "
        "0.61, and at 0.62 it diverges very slowly"
    )

    def slow(text: str, race: Race, name: str = "", differs: str = "") -> Claim:
        return Claim(text, name + race.outcome, "over 50", 50 < race.steps() < math.inf, differs)

    return [
        Claim(alike, parts, "signs alternate; within 10 %", is_alike),
        Claim(
            "(b) the error stays below eq. 16", f"at most {worst:.3f} of the bound", "1", worst <= 1
        ),
        Claim(constant, factor, "0.01", off < 0.01),
        Claim(quick, few.outcome, "1 % in at most 10", few.steps() <= 10, shared),
        Claim(
            "(c) the rate is m / (1 - m)",
            f"1 % at most {late:.1f} iterations off it",
            "1",
            late <= 1,
        ),
        slow("(c) near 0.5 slowly", closed[0.49], "0.49: "),
        Claim("(c) 0.51 diverges", closed[0.51].outcome, "diverges", closed[0.51].diverged),
        Claim("(d) 6 sides diverge", opened[6].outcome, "diverges", opened[6].diverged),
        slow("(d) 5 sides converge very slowly", opened[5], differs=limit),
        slow("(d) so they do below that limit", found.below, "0.60: "),
        Claim(
            "(d) fewer sides converge fast, the faster the fewer",
            faster,
            "falling, at most 20",
            falls,
        ),
        Claim("ours: Chebyshev converges in all of them", products, "below 1e-4", converged),
    ]


def draw(found: Found) -> Figure:
    figure = figures.page(
        900,
        "Figure 5: when the inverse series converges, and where it does not",
        "Undoing the bounces in a box of diffuse walls. The paper's iteration needs albedos below 1/2, or an",
        "open box. Chebyshev's undoes the very same boxes in about 10 steps, whatever the albedo.",
    )
    left, right, above, below, size = 85, 580, 145, 540, (370, 290)
    title, ylabel = "(a) The series swings alike everywhere", "sum / direct light"
    axes = figures.graph(figure, (left, above, *size), title, "terms n", ylabel, "linear")
    axes.axhline(1, color=FAINT, lw=1, ls=":")
    for (name, swing), shade in zip(found.swings.items(), SHADES, strict=False):
        axes.plot(swing, "o-", color=shade, lw=2, ms=5, label=f"{name} of the floor")
    axes.legend(frameon=False, labelcolor="linecolor", fontsize=10)
    title, ylabel = "(b) Error of the series in a closed box", r"$\Vert S^{-1} - S_n^{-1} \Vert$"
    axes, n = (
        figures.graph(figure, (right, above, *size), title, "terms n", ylabel),
        range(1, ORDERS + 1),
    )
    for (m, norm), shade in zip(found.norms.items(), SHADES, strict=False):
        axes.plot(n, BOUNDS[m], color=shade, lw=1.5, ls=":")
        shown = np.where(norm > ROUNDING, norm, np.nan)
        axes.plot(n, shown, "o", color=shade, ms=5, label=f"albedo {m:g}")
    axes.plot([], [], color=INK, lw=1.5, ls=":", label="bound, eq. 16")
    axes.legend(frameon=False, labelcolor=INK, fontsize=10)
    titles = "(c) Closed box, albedo 0.2 to 0.51", f"(d) Albedo {OPEN_ALBEDO}, box of 6 to 1 sides"
    for place, title, races in zip(
        (left, right), titles, (found.closed, found.opened), strict=True
    ):
        axes = figures.graph(figure, (place, below, *size), title, "iteration", "relative residual")
        draw_races(axes, races)
    return figure


def draw_races(axes: Axes, races: Mapping[float, Race]) -> None:
    """Residuals of both iterations; the paper's carry their name where they leave the graph."""
    low, high = 1e-5, 100.0
    axes.set_xlim(0, STEPS)
    axes.set_ylim(low, high)
    for (name, found), shade in zip(races.items(), SHADES, strict=True):
        y = np.maximum(
            found.jacobi.residuals[: STEPS + 1], low / 10
        )  # the last one of one wall is 0
        last = int(np.argmax((y <= low) | (y >= high))) or len(y) - 1
        axes.plot(found.chebyshev.residuals, color=INK, lw=1.2, ls=(0, (3, 2)))
        axes.plot(y[: last + 1], color=shade, lw=2)
        said = f" {name:g}{' diverges' * found.diverged}"
        where = "top" if y[last] >= high else "center" if last == STEPS else "bottom"
        height = float(np.clip(1.3 * y[last], 1.3 * low, high))
        axes.text(last, height, said, color=shade, fontsize=10, fontweight="bold", va=where)
    axes.plot([], [], color=FAINT, lw=2, label="the paper's iteration")
    axes.plot([], [], color=INK, lw=1.2, ls=(0, (3, 2)), label="Chebyshev's, all six")
    axes.legend(frameon=False, labelcolor="linecolor", fontsize=10, loc="upper right")


def main() -> None:
    given = parse_options(__doc__ or "")
    found = measure(4 if given.smoke else 16, given.device)
    facts = {
        r.name: f"{r.outcome}; Chebyshev 1e-5 in {r.chebyshev.products} products"
        for r in found.races
    }
    figures.conclude(given, "Figure 5: convergence", claims(found), facts, lambda: draw(found))


if __name__ == "__main__":
    main()
