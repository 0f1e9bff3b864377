# SPDX-License-Identifier: BSD-3-Clause
"""Quality of the single-view approximation: bounces of glossy scenes by one camera.

T = P S F Q (eq. 28) is taken for S' F', with F' = P F Q diagonal and S' = T F'^-1, and bounce k of
a picture for (I - S'^-1)^k F' l_in, where the light field has P A^k F Q l_in (eq. 29). Those are
computed, and the result of `ltcl.separate` is compared with them, for a dihedral whose left wall
is lit, both walls or the other one alone being glossy. Bounces are found with a direct solver, so
that nothing else is measured. Also: how T itself indicates it (reciprocity, and negative light,
which no bounce has), how fast the plain series l <- l_out - R l settles (the paper: about 20
iterations with gloss), and compensation, which is exact.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import _figures as figures
import ltcl
from _figures import Claim
from _harness import Options, parse_options
from ltcl import Transport
from ltcl.plots.page import COLOURS, FAINT, INK
from ltcl.scenes import GlossyScene, dihedral, glossy
from ltcl.tasks.plausibility import LARGEST_NEGATIVE

ALBEDO = 0.5
PROJECTOR = (2.4, 1.2, 1.2)
# Share of the gloss on each wall.
ROOMS = {"both walls": (1.0, 1.0), "unlit wall": (0.0, 1.0)}
BOUNCES = 3
# Iterations of the plain series after which it counts as not settling.
MAX_ITERATIONS = 100
# Largest share of gloss that the paper's claims are taken to be about.
MODERATE_GLOSS = 0.2
# Exponents of the gloss and their colours.
SHADES: dict[float, str] = {5: COLOURS["direct"], 20: COLOURS["chebyshev"], 60: COLOURS["jacobi"]}


@dataclass(frozen=True, kw_only=True)
class Case:
    """Results of a scene; lists are for the direct light and the bounces after it.

    Attributes
    ----------
    off, off_picture : list of float
        Errors relative to the true bounce and to the picture, F = P F Q.
    off_diagonal : list of float
        Errors relative to the true bounce, F = diag(T).
    negative : list of float
        Share of negative light.
    defect : float
        Defect of reciprocity.
    taken : float
        Share of light that a bounce takes away, as T reports it.
    warned : bool
        Whether the separation warned of section 8.4.
    radius : float
        Spectral radius of R.
    iterations : int or None
        Iterations of the plain series to 1 % of the direct light; None if it does not settle.
    compensation : float
        ||T p - desired|| / ||desired||.
    clipped : float
        Share of pixels clipped in the pattern.
    """

    room: str
    exponent: float
    gloss: float
    off: list[float]
    off_picture: list[float]
    off_diagonal: list[float]
    negative: list[float]
    defect: float
    taken: float
    warned: bool
    radius: float
    iterations: int | None
    compensation: float
    clipped: float


def norms(light: np.ndarray) -> np.ndarray:
    """Norms of pictures (k, h, w)."""
    return np.linalg.norm(light.reshape(len(light), -1), axis=1)


def separate_light(T: Transport, picture: np.ndarray) -> tuple[np.ndarray, bool]:
    """Direct light and bounces, (BOUNCES + 1, h, w), and whether section 8.4 was warned of."""
    separation = ltcl.separate(T, picture, BOUNCES, method="direct")
    light = np.concatenate([separation.direct[None], separation.bounces])
    return light, "section 8.4" in separation.warning


def series_iterations(R: np.ndarray, l_out: np.ndarray, l_d: np.ndarray) -> int | None:
    """Iterations of eq. 20 until the direct light is right to 1 %."""
    limit = 0.01 * np.linalg.norm(l_d)
    l = np.zeros_like(l_d)
    for step in range(1, MAX_ITERATIONS + 1):
        l = l_out - R @ l
        if np.linalg.norm(l - l_d) <= limit:
            return step
    return None


def measure(
    scene: GlossyScene, room: str, exponent: float, gloss: float, device: ltcl.Device
) -> Case:
    n = scene.grid[0]
    F = scene.first_bounce
    pattern = np.zeros(scene.grid)
    pattern[:, :n] = 1.0
    truth = scene.bounces(pattern, BOUNCES)
    truth_norms = norms(truth)

    (matrix,) = scene.matrices()
    T = Transport(matrix, scene.grid, F, device=device)
    picture = T @ pattern
    light, warned = separate_light(T, picture)
    deviations = norms(light - truth)
    negative = -np.minimum(light, 0).sum(axis=(1, 2))
    diagonal_T = Transport(matrix, scene.grid, device=device)
    diagonal_light, _ = separate_light(diagonal_T, picture)

    l_in = pattern.ravel()
    R = matrix / F - np.eye(len(F))
    eigenvalues = np.linalg.eigvals(R)

    random_pattern = np.random.default_rng(0).uniform(0.2, 0.8, scene.grid)
    compensation = ltcl.compensate(T, T @ random_pattern, method="direct")
    return Case(
        room=room,
        exponent=exponent,
        gloss=gloss,
        off=round_all(deviations / truth_norms),
        off_picture=round_all(deviations / np.linalg.norm(picture)),
        off_diagonal=round_all(norms(diagonal_light - truth) / truth_norms),
        negative=round_all(negative / np.abs(light).sum(axis=(1, 2))),
        defect=round_digits(T.reciprocity_defect),
        taken=round_digits(max(T.negative_bounces)),
        warned=warned,
        radius=round_digits(np.abs(eigenvalues).max()),
        iterations=series_iterations(R, matrix @ l_in, F * l_in),
        compensation=round_digits(compensation.error),
        clipped=compensation.clipped,
    )


def round_digits(value: float) -> float:
    """Four digits, as JSON shows them."""
    return float(f"{value:.4g}")


def round_all(values: np.ndarray) -> list[float]:
    return [round_digits(value) for value in values]


def measure_cases(options: Options) -> list[Case]:
    if options.smoke:
        n = 4
        directions = 16
        exponents = [5, 20]
        shares = (0.0, 0.1, 0.2, 0.4)
    else:
        n = 10
        directions = 64
        exponents = list(SHADES)
        shares = (0.0, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8)
    cases = []
    for room, exponent, gloss in itertools.product(ROOMS, exponents, shares):
        wall_gloss = [gloss * share for share in ROOMS[room]]
        scene = glossy(
            dihedral(1),
            n,
            ALBEDO,
            wall_gloss,
            exponent,
            projector=PROJECTOR,
            directions=directions,
        )
        cases.append(measure(scene, room, exponent, gloss, options.device))
    return cases


def claims(cases: Sequence[Case]) -> list[Claim]:
    matte = [case for case in cases if case.gloss == 0]
    moderate = [case for case in cases if 0 < case.gloss <= MODERATE_GLOSS]
    return [
        *exactness_claims(cases, matte),
        first_bounce_claim(moderate),
        decay_claim(moderate),
        iterations_claim(moderate),
        *warning_claims(cases, matte),
        negative_claim(moderate),
    ]


def exactness_claims(cases: Sequence[Case], matte: Sequence[Case]) -> list[Claim]:
    matte_error = figures.values(matte, "off").max()
    direct_error = figures.values(cases, "off")[:, 0].max()
    compensation_error = figures.values(cases, "compensation").max()
    clipped = figures.values(cases, "clipped").max()
    return [
        limit_claim("without gloss all bounces are exact", matte_error, 1e-4),
        limit_claim("the direct light is exact of any gloss, F = PFQ given", direct_error, 1e-3),
        limit_claim("compensation is exact of any gloss", compensation_error, 1e-4),
        limit_claim("none of it is clipped", clipped, 0.0),
    ]


def first_bounce_claim(moderate: Sequence[Case]) -> Claim:
    error = figures.values(moderate, "off")[:, 1].max()
    text = f"bounce 1 is about right at gloss {MODERATE_GLOSS:g}"
    return limit_claim(text, error, 0.3)


def limit_claim(text: str, value: float, most: float) -> Claim:
    return Claim(text, f"{value:.2g}", f"at most {most:g}", value <= most)


def decay_claim(moderate: Sequence[Case]) -> Claim:
    off = figures.values(moderate, "off")
    worse = np.count_nonzero(off[:, 2] > off[:, 1])
    return Claim(
        "later bounces are no worse: specular effects decay (section 8.4)",
        f"bounce 2 is worse in {worse} of {len(moderate)} scenes of gloss up to {MODERATE_GLOSS:g}",
        "none",
        worse == 0,
        differs="(PAFQ)(PFQ)^-1, what the camera sees of a bounce, is squared; "
        "PA^2FQ is something else",
    )


def iterations_claim(moderate: Sequence[Case]) -> Claim:
    steps = []
    for case in moderate:
        if case.exponent <= 20:
            steps.append(MAX_ITERATIONS + 1 if case.iterations is None else case.iterations)
    measured = f"{min(steps)} to {max(steps)} at gloss up to {MODERATE_GLOSS:g}"
    text = "the plain series needs about 20 iterations with gloss"
    return Claim(text, measured, "at most 20", max(steps) <= 20)


def warning_claims(cases: Sequence[Case], matte: Sequence[Case]) -> list[Claim]:
    wrong = [case for case in cases if case.off[1] > 0.1]
    true_warnings = np.count_nonzero(figures.values(wrong, "warned"))
    false_warnings = np.count_nonzero(figures.values(matte, "warned"))
    return [
        Claim(
            "the warning of section 8.4 comes where bounce 1 is off by more than 10%",
            f"in {true_warnings} of {len(wrong)} scenes",
            "all",
            true_warnings == len(wrong),
        ),
        Claim(
            "and not without gloss",
            f"in {false_warnings} of {len(matte)} scenes",
            "none",
            false_warnings == 0,
        ),
    ]


def negative_claim(moderate: Sequence[Case]) -> Claim:
    negative = figures.values(moderate, "negative")[:, 1]
    ratios = negative / figures.values(moderate, "off")[:, 1]
    least = ratios.min()
    most = ratios.max()
    return Claim(
        "negative light in bounce 1 tells how far it is off",
        f"it is {least:.2f} to {most:.2f} times the error, at gloss up to {MODERATE_GLOSS:g}",
        "0.5 to 1.5",
        least > 0.5 and most < 1.5,
    )


def draw(cases: Sequence[Case]) -> Figure:
    figure = figures.page(
        810,
        "Glossy scenes: what one camera and one projector can tell",
        "A dihedral of albedo 0.5, left wall lit. "
        "Solid: both walls glossy; dashed: only the unlit one.",
        "Errors are those of separated bounces against $P A^k F Q$ "
        "of the full light field (eq. 29).",
    )
    left, right = 80, 560
    above, below = 150, 490
    size = (410, 240)
    draw_bounce(figure, (left, above, *size), cases, 1)
    draw_bounce(figure, (right, above, *size), cases, 2)
    draw_indicators(figure, (left, below, *size), cases)
    draw_iterations(figure, (right, below, *size), cases)
    return figure


def draw_bounce(figure: Figure, box: figures.Box, cases: Sequence[Case], k: int) -> None:
    title = f"Bounce {k} of the separation"
    axes = figures.graph(figure, box, title, "share of gloss", "relative error")
    draw_curves(axes, cases, lambda case: case.off[k])
    axes.set_ylim(3e-3, 30)
    axes.axhline(1, color=FAINT, lw=1, ls=":")
    figures.legend(axes, 9, loc="lower right")


def draw_indicators(figure: Figure, box: figures.Box, cases: Sequence[Case]) -> None:
    """Signs of gloss in T: its reciprocity defect and the light that a bounce takes away."""
    title = "Reciprocity defect \u25cf, light a bounce takes away \u25bc"
    axes = figures.graph(figure, box, title, "share of gloss", "share", "linear")
    axes.set_ylim(0, 0.4)
    draw_curves(axes, cases, lambda case: case.defect)
    draw_curves(axes, cases, lambda case: case.taken, marker="v", lw=1, alpha=0.7)
    axes.axhline(LARGEST_NEGATIVE, color=INK, lw=1, ls=":")
    style = {"color": INK, "fontsize": 9, "ha": "right", "va": "bottom"}
    axes.text(0.79, LARGEST_NEGATIVE, "warning above", **style)


def draw_iterations(figure: Figure, box: figures.Box, cases: Sequence[Case]) -> None:
    def iterations(case: Case) -> float:
        return np.nan if case.iterations is None else case.iterations

    title = "Plain series: iterations to 1 % of the direct light"
    axes = figures.graph(figure, box, title, "share of gloss", "iterations", "linear")
    draw_curves(axes, cases, iterations)
    axes.set_ylim(0, 30)
    axes.axhline(20, color=INK, lw=1, ls=":")
    axes.text(0.02, 20.4, "the paper's glossy scene", color=INK, fontsize=9)
    axes.text(0.02, 28, "curves end where it diverges", color=FAINT, fontsize=9)


def draw_curves(
    axes: Axes, cases: Sequence[Case], value: Callable[[Case], float], **style: Any
) -> None:
    """A curve over gloss for each room and exponent."""
    exponents = sorted({case.exponent for case in cases})
    pairs = itertools.product(zip(ROOMS, ("-", "--"), strict=True), exponents)
    for (room, line), exponent in pairs:
        shares = []
        values = []
        for case in cases:
            if case.room == room and case.exponent == exponent:
                shares.append(case.gloss)
                values.append(value(case))
        look = {"marker": "o", "lw": 2, "ms": 4, "color": SHADES[exponent], "ls": line}
        if line == "-":
            look["label"] = f"exponent {exponent:g}"
        axes.plot(shares, values, **look | style)
    axes.set_xlim(0, 0.8)


def main() -> None:
    options = parse_options(__doc__)
    # The warning is among the results.
    logging.getLogger("ltcl").setLevel(logging.ERROR)
    cases = measure_cases(options)
    facts = {}
    for case in cases:
        name = f"{case.room}, exponent {case.exponent:g}, gloss {case.gloss:g}"
        facts[name] = asdict(case)
    title = "The single-view approximation (eq. 28, 29)"
    figures.conclude(options, title, claims(cases), facts, lambda: draw(cases))


if __name__ == "__main__":
    main()
