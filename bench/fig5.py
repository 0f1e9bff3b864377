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

# (a), (b): terms of the series; albedos of (b), where eq. 16 holds.
ORDERS = 10
BOUND_ALBEDOS = (0.2, 0.3, 0.4, 0.45)
# (c): albedos of a closed box.
CLOSED_ALBEDOS = (0.2, 0.3, 0.4, 0.45, 0.49, 0.51)
# (d): sides of a box of one albedo.
SIDES = (6, 5, 4, 3, 2, 1)
OPEN_ALBEDO = 0.62
DRAWN_STEPS = 40
# Norms above this are hardly touched by the rounding of float32 products.
MIN_NORM = 1e-4
SHADES = ("#8bd17c", "#5cc8ff", "#c792ea", "#ffd166", "#ffb347", "#ff5d5d")


def error_bounds(albedo: float) -> np.ndarray:
    """Bounds of eq. 16 for 1 .. ORDERS terms."""
    return np.array([inverse_error_bound(albedo, k) for k in range(1, ORDERS + 1)])


def swings(n: int, device: ltcl.Device) -> dict[str, np.ndarray]:
    """Sums of 0 .. ORDERS terms over the truth, in red light, at three patches of a floor."""
    scene, l_d = boxes.coloured_box(n)
    T = scene.transport(first_bounce=scene.first_bounce, device=device)
    l_out = boxes.all_bounces(scene, l_d)
    terms = boxes.terms(T.systems[:1], l_out[:1], ORDERS)[:, 0]
    sums = np.cumsum(terms, axis=0) / l_d[0]
    floor = sums.reshape(-1, n, 6, n)[:, :, FLOOR]
    return {
        "corner": floor[:, 0, 0],
        "edge": floor[:, n // 2, 0],
        "centre": floor[:, n // 2, n // 2],
    }


def norms(n: int, albedo: float, device: ltcl.Device) -> np.ndarray:
    """Largest singular value of S^-1 - S_k^-1 of a closed box for k = 1 .. ORDERS (eq. 16)."""
    scene = box(n, albedo=albedo)
    exact = np.eye(6 * n * n) - albedo * scene.form_factors
    (S,) = scene.transport(first_bounce=scene.first_bounce, device=device).systems
    deviations = []
    for k in range(1, ORDERS + 1):
        deviation = matrix_series(S, steps=k).x - exact
        deviations.append(np.linalg.norm(deviation, 2))
    return np.array(deviations)


@dataclass(frozen=True, kw_only=True)
class Measurements:
    """Content of (a), (b), (c), (d), and five sides at an albedo below their limit."""

    swings: dict[str, np.ndarray]
    norms: dict[float, np.ndarray]
    closed: dict[float, Race]
    opened: dict[Any, Race]
    below_limit: Race

    @property
    def races(self) -> list[Race]:
        """Every box that was raced in."""
        return [*self.closed.values(), *self.opened.values(), self.below_limit]


def measure(n: int, device: ltcl.Device) -> Measurements:
    """All boxes have n x n patches a wall, those of the norms half as many along it."""
    closed = {}
    for albedo in CLOSED_ALBEDOS:
        name = f"closed, albedo {albedo}"
        closed[albedo] = race(name, n, 6, albedo, device)
    opened = {}
    for sides in SIDES:
        name = f"{sides} side(s), albedo {OPEN_ALBEDO}"
        opened[sides] = race(name, n, sides, OPEN_ALBEDO, device)
    return Measurements(
        swings=swings(n, device),
        norms={albedo: norms(n // 2, albedo, device) for albedo in BOUND_ALBEDOS},
        closed=closed,
        opened=opened,
        below_limit=race("5 sides, albedo 0.6", n, 5, 0.6, device),
    )


def claims(measured: Measurements) -> list[Claim]:
    return [
        swing_claim(measured.swings),
        *bound_claims(measured.norms),
        *closed_claims(measured.closed),
        *open_claims(measured.opened, measured.below_limit),
        chebyshev_claim(measured.races),
    ]


def swing_claim(swings: Mapping[str, np.ndarray]) -> Claim:
    """Signs of the first 8 terms, and the share of the swing that the last 4 of them leave."""
    excesses = np.array(list(swings.values()))[:, :9] - 1
    alternates = (np.sign(excesses) == (-1.0) ** np.arange(9)).all()
    remaining = {}
    for name, swing in swings.items():
        remaining[name] = abs(swing[8] - 1) / abs(swing[4] - 1)
    is_alike = max(remaining.values()) < 1.1 * min(remaining.values())
    shares = ", ".join(f"{share:.2f} ({name})" for name, share in remaining.items())
    return Claim(
        "(a) alike at a corner, an edge and the centre: above, below, above ...",
        f"4 terms more leave {shares}",
        "signs alternate; within 10 %",
        alternates and is_alike,
    )


def bound_claims(norms: Mapping[float, np.ndarray]) -> list[Claim]:
    largest_ratio = 0.0
    deviation = 0.0
    for albedo, norm in norms.items():
        is_large = norm > MIN_NORM
        ratio = (norm / error_bounds(albedo))[is_large]
        factor = ratio / (1 - 2 * albedo)
        largest_ratio = max(largest_ratio, float(ratio.max(initial=0)))
        deviation = max(deviation, np.abs(factor - 1).max(initial=0))
    below = f"at most {largest_ratio:.3f} of the bound"
    constant = f"1 - 2m for all n, to {deviation:.1g}"
    return [
        Claim("(b) the error stays below eq. 16", below, "1", largest_ratio <= 1),
        Claim("(b) it follows eq. 16 up to a constant", constant, "0.01", deviation < 0.01),
    ]


def closed_claims(closed: Mapping[float, Race]) -> list[Claim]:
    few = closed[0.45]
    shared_light = (
        "light that all walls share shrinks by m / (1 - m) = 0.82 an iteration: 1 % takes 23"
    )
    delay = 0.0
    for albedo, box_race in closed.items():
        if albedo < 0.5:
            expected = math.log(RTOL) / math.log(box_race.rho)
            delay = max(delay, abs(box_race.steps() - expected))
    return [
        Claim(
            "(c) albedo 0.45 converges in a few iterations",
            few.outcome,
            "1 % in at most 10",
            few.steps() <= 10,
            shared_light,
        ),
        Claim(
            "(c) the rate is m / (1 - m)",
            f"1 % at most {delay:.1f} iterations off it",
            "1",
            delay <= 1,
        ),
        slow_claim("(c) near 0.5 slowly", closed[0.49], prefix="0.49: "),
        divergence_claim("(c) 0.51 diverges", closed[0.51]),
    ]


def open_claims(opened: Mapping[int, Race], below_limit: Race) -> list[Claim]:
    fewer = [opened[sides].steps() for sides in SIDES[2:]]
    listed = ", ".join(map(str, fewer))
    is_falling = fewer == sorted(set(fewer), reverse=True)
    limit = (
        "its form factors have the eigenvalue 0.82, not the 4/5 "
        "of one patch a wall: the limit is albedo 0.61, "
        "and at 0.62 it diverges very slowly"
    )
    return [
        divergence_claim("(d) 6 sides diverge", opened[6]),
        slow_claim("(d) 5 sides converge very slowly", opened[5], differs=limit),
        slow_claim("(d) so they do below that limit", below_limit, prefix="0.60: "),
        Claim(
            "(d) fewer sides converge fast, the faster the fewer",
            f"4, 3, 2, 1 sides: 1 % in {listed}",
            "falling, at most 20",
            is_falling and fewer[0] <= 20,
        ),
    ]


def slow_claim(text: str, race: Race, prefix: str = "", differs: str = "") -> Claim:
    is_slow = 50 < race.steps() < math.inf
    return Claim(text, prefix + race.outcome, "over 50", is_slow, differs)


def divergence_claim(text: str, race: Race) -> Claim:
    return Claim(text, race.outcome, "diverges", race.diverged)


def chebyshev_claim(races: list[Race]) -> Claim:
    products = 0
    error = 0.0
    has_converged = True
    for box_race in races:
        products = max(products, box_race.chebyshev.products)
        error = max(error, box_race.error)
        if not box_race.chebyshev.converged:
            has_converged = False
    measured = f"to 1e-5 in at most {products} products, {error:.1g} off the truth"
    text = "ours: Chebyshev converges in all of them"
    return Claim(text, measured, "below 1e-4", has_converged and error < 1e-4)


def draw(measured: Measurements) -> Figure:
    figure = figures.page(
        900,
        "Figure 5: when the inverse series converges, and where it does not",
        "Undoing the bounces in a box of diffuse walls. "
        "The paper's iteration needs albedos below 1/2, or an",
        "open box. Chebyshev's undoes the very same boxes in about 10 steps, whatever the albedo.",
    )
    left, right = 85, 580
    above, below = 145, 540
    size = (370, 290)
    draw_swings(figure, (left, above, *size), measured.swings)
    draw_norms(figure, (right, above, *size), measured.norms)
    title = "(c) Closed box, albedo 0.2 to 0.51"
    draw_races(figure, (left, below, *size), title, measured.closed)
    title = f"(d) Albedo {OPEN_ALBEDO}, box of 6 to 1 sides"
    draw_races(figure, (right, below, *size), title, measured.opened)
    return figure


def draw_swings(figure: Figure, box: figures.Box, swings: Mapping[str, np.ndarray]) -> None:
    title = "(a) The series swings alike everywhere"
    ylabel = "sum / direct light"
    axes = figures.graph(figure, box, title, "terms n", ylabel, "linear")
    axes.axhline(1, color=FAINT, lw=1, ls=":")
    for (name, swing), shade in zip(swings.items(), SHADES, strict=False):
        axes.plot(swing, "o-", color=shade, lw=2, ms=5, label=f"{name} of the floor")
    figures.legend(axes)


def draw_norms(figure: Figure, box: figures.Box, norms: Mapping[float, np.ndarray]) -> None:
    title = "(b) Error of the series in a closed box"
    ylabel = r"$\Vert S^{-1} - S_n^{-1} \Vert$"
    axes = figures.graph(figure, box, title, "terms n", ylabel)
    n = range(1, ORDERS + 1)
    for (albedo, norm), shade in zip(norms.items(), SHADES, strict=False):
        axes.plot(n, error_bounds(albedo), color=shade, lw=1.5, ls=":")
        visible = np.where(norm > MIN_NORM, norm, np.nan)
        axes.plot(n, visible, "o", color=shade, ms=5, label=f"albedo {albedo:g}")
    axes.plot([], [], color=INK, lw=1.5, ls=":", label="bound, eq. 16")
    figures.legend(axes, labelcolor=INK)


def draw_races(figure: Figure, box: figures.Box, title: str, races: Mapping[float, Race]) -> None:
    """Residuals of both iterations; the paper's carry their name where they leave the graph."""
    low, high = 1e-5, 100.0
    axes = figures.graph(figure, box, title, "iteration", "relative residual")
    axes.set_xlim(0, DRAWN_STEPS)
    axes.set_ylim(low, high)
    dashed = {"color": INK, "lw": 1.2, "ls": (0, (3, 2))}
    for (name, box_race), shade in zip(races.items(), SHADES, strict=True):
        axes.plot(box_race.chebyshev.residuals, **dashed)
        draw_jacobi(axes, f"{name:g}", box_race, shade)
    axes.plot([], [], color=FAINT, lw=2, label="the paper's iteration")
    axes.plot([], [], label="Chebyshev's, all six", **dashed)
    figures.legend(axes, loc="upper right")


def draw_jacobi(axes: Axes, name: str, box_race: Race, shade: str) -> None:
    low, high = axes.get_ylim()
    # The last residual of one wall is 0.
    residuals = box_race.jacobi.residuals[: DRAWN_STEPS + 1]
    residuals = np.maximum(residuals, low / 10)
    is_outside = (residuals <= low) | (residuals >= high)
    last = len(residuals) - 1
    if is_outside.any():
        last = int(np.argmax(is_outside))
    axes.plot(residuals[: last + 1], color=shade, lw=2)
    end = residuals[last]
    alignment = "bottom"
    if end >= high:
        alignment = "top"
    elif last == DRAWN_STEPS:
        alignment = "center"
    height = float(np.clip(1.3 * end, 1.3 * low, high))
    label = f" {name}"
    if box_race.diverged:
        label += " diverges"
    style = {"fontsize": 10, "fontweight": "bold", "va": alignment}
    axes.text(last, height, label, color=shade, **style)


def main() -> None:
    options = parse_options(__doc__)
    measured = measure(4 if options.smoke else 16, options.device)
    facts = {}
    for box_race in measured.races:
        products = box_race.chebyshev.products
        outcome = f"{box_race.outcome}; Chebyshev 1e-5 in {products} products"
        facts[box_race.name] = outcome
    title = "Figure 5: convergence"
    figures.conclude(options, title, claims(measured), facts, lambda: draw(measured))


if __name__ == "__main__":
    main()
