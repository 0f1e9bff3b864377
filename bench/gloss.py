# SPDX-License-Identifier: BSD-3-Clause
"""How good the single-view approximation is: bounces of glossy scenes as one camera and one projector tell.

T = P S F Q (eq. 28) is taken for S' F', with F' = P F Q diagonal and S' = T F'^-1, and bounce k of
a picture for (I - S'^-1)^k F' l_in, where the light field has P A^k F Q l_in (eq. 29). Those are
computed, and what `ltcl.separate` finds is compared with them, for a dihedral of which the left
wall is lit, both walls or the other one alone being glossy. Bounces are found with a direct solver,
so that nothing else is measured. Also: what T itself says about it (reciprocity, and negative
light, which no bounce has), how fast the plain series l <- l_out - R l settles (the paper: about 20
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
from ltcl.plots.page import COLOURS, FAINT, INK
from ltcl.scenes import GlossyScene, dihedral, glossy
from ltcl.tasks.plausibility import LARGEST_NEGATIVE

ALBEDO, PROJECTOR = 0.5, (2.4, 1.2, 1.2)
ROOMS = {"both walls": (1.0, 1.0), "unlit wall": (0.0, 1.0)}  # share of the gloss on each wall
BOUNCES, STEPS = 3, 100
MODERATE = 0.2  # share of gloss up to which the paper's word is taken to be meant
SHADES: dict[float, str] = {5: COLOURS["direct"], 20: COLOURS["chebyshev"], 60: COLOURS["jacobi"]}


@dataclass(frozen=True)
class Case:
    """One scene, and what was found; lists are for the direct light and the bounces after it."""

    room: str
    exponent: float
    gloss: float
    off: list[float]  # relative to the true bounce, F = P F Q
    off_picture: list[float]  # the same errors relative to the picture
    off_diagonal: list[float]  # relative to the true bounce, F = diag(T)
    negative: list[float]  # share of negative light
    defect: float  # of reciprocity
    taken: float  # share of light that a bounce takes away, as T has it
    warned: bool
    radius: float  # spectral radius of R
    iterations: int | None  # of the plain series to 1 % of the direct light; None: does not settle
    compensation: float  # ||T p - desired|| / ||desired||
    clipped: float


def norms(light: np.ndarray) -> np.ndarray:
    """Of pictures (k, h, w)."""
    return np.linalg.norm(light.reshape(len(light), -1), axis=1)


def separated(T: ltcl.Transport, picture: np.ndarray) -> tuple[np.ndarray, bool]:
    """Direct light and bounces, (BOUNCES + 1, h, w), and whether section 8.4 was warned of."""
    found = ltcl.separate(T, picture, BOUNCES, method="direct")
    return np.concatenate([found.direct[None], found.bounces]), bool(found.warning)


def settles(T: np.ndarray, F: np.ndarray, l_in: np.ndarray) -> tuple[float, int | None]:
    """Spectral radius of R, and iterations of eq. 20 until the direct light is right to 1 %."""
    R, l_out, l_d = T / F - np.eye(len(F)), T @ l_in, F * l_in
    radius, l = float(np.abs(np.linalg.eigvals(R)).max()), np.zeros_like(l_d)
    for step in range(1, STEPS + 1):
        l = l_out - R @ l
        if np.linalg.norm(l - l_d) <= 0.01 * np.linalg.norm(l_d):
            return radius, step
    return radius, None


def measure(
    scene: GlossyScene, room: str, exponent: float, gloss: float, device: ltcl.Device
) -> Case:
    n, F = scene.grid[0], scene.first_bounce
    pattern = np.zeros(scene.grid)
    pattern[:, :n] = 1.0
    truth = scene.bounces(pattern, BOUNCES)
    (matrix,) = scene.matrices()
    T = ltcl.Transport(matrix, scene.grid, F, device=device)
    picture = T @ pattern
    found, warned = separated(T, picture)
    by_diagonal, _ = separated(ltcl.Transport(matrix, scene.grid, device=device), picture)
    error, size = norms(found - truth), norms(truth)
    negative = -np.minimum(found, 0).sum(axis=(1, 2)) / np.abs(found).sum(axis=(1, 2))
    errors = (
        error / size,
        error / np.linalg.norm(picture),
        norms(by_diagonal - truth) / size,
        negative,
    )
    reported = T.reciprocity_defect, max(T.negative_bounces)
    desired = T @ np.random.default_rng(0).uniform(0.2, 0.8, scene.grid)
    compensation = ltcl.compensate(T, desired, method="direct")
    radius, iterations = settles(matrix, F, pattern.ravel())
    rounded = [_digits(value) for value in (*errors, *reported)]
    last = [warned, _digits(radius), iterations, _digits(compensation.error), compensation.clipped]
    return Case(room, exponent, gloss, *rounded + last)


def _digits(values: Any) -> Any:
    """Four digits of a number, or of each in an array, as JSON shows them."""
    return [_digits(value) for value in values] if np.ndim(values) else float(f"{values:.4g}")


def cases(given: Options) -> list[Case]:
    n, directions = (4, 16) if given.smoke else (10, 64)
    shares = (0.0, 0.1, 0.2, 0.4) if given.smoke else (0.0, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8)
    found, place = [], {"projector": PROJECTOR, "directions": directions}
    for room, exponent in itertools.product(ROOMS, (5, 20) if given.smoke else tuple(SHADES)):
        for gloss in shares:
            walls = [gloss * share for share in ROOMS[room]]
            scene = glossy(dihedral(1), n, ALBEDO, walls, exponent, **place)
            found.append(measure(scene, room, exponent, gloss, given.device))
    return found


def claims(found: Sequence[Case]) -> list[Claim]:
    matte = [case for case in found if case.gloss == 0]
    shiny = [case for case in found if 0 < case.gloss <= MODERATE]
    later = sum(case.off[2] > case.off[1] for case in shiny)
    worse = f"bounce 2 is worse in {later} of {len(shiny)} scenes of gloss up to {MODERATE:g}"
    squared = (
        "(PAFQ)(PFQ)^-1, what the camera sees of a bounce, is squared; PA^2FQ is something else"
    )
    steps = [STEPS + 1 if c.iterations is None else c.iterations for c in shiny if c.exponent <= 20]
    taken = f"{min(steps)} to {max(steps)} at gloss up to {MODERATE:g}"
    wrong = [case for case in found if case.off[1] > 0.1]
    told, false = (sum(case.warned for case in some) for some in (wrong, matte))
    warning = "the warning of section 8.4 comes where bounce 1 is off by more than 10%"
    ratio = [case.negative[1] / case.off[1] for case in shiny]
    negative = (
        f"it is {min(ratio):.2f} to {max(ratio):.2f} times the error, at gloss up to {MODERATE:g}"
    )
    tells = min(ratio) > 0.5 and max(ratio) < 1.5
    decay = "later bounces are no worse: specular effects decay (section 8.4)"
    return [
        _below("without gloss all bounces are exact", max(max(case.off) for case in matte), 1e-4),
        _below(
            "the direct light is exact of any gloss, F = PFQ given",
            max(c.off[0] for c in found),
            1e-3,
        ),
        _below(
            "compensation is exact of any gloss", max(case.compensation for case in found), 1e-4
        ),
        _below("none of it is clipped", max(case.clipped for case in found), 0.0),
        _below(f"bounce 1 is about right at gloss {MODERATE:g}", max(c.off[1] for c in shiny), 0.3),
        Claim(decay, worse, "none", later == 0, differs=squared),
        Claim(
            "the plain series needs about 20 iterations with gloss",
            taken,
            "at most 20",
            max(steps) <= 20,
        ),
        Claim(warning, f"in {told} of {len(wrong)} scenes", "all", told == len(wrong)),
        Claim("and not without gloss", f"in {false} of {len(matte)} scenes", "none", not false),
        Claim("negative light in bounce 1 tells how far it is off", negative, "0.5 to 1.5", tells),
    ]


def _below(text: str, value: float, most: float) -> Claim:
    return Claim(text, f"{value:.2g}", f"at most {most:g}", value <= most)


def draw(found: Sequence[Case]) -> Figure:
    figure = figures.page(
        810,
        "Glossy scenes: what one camera and one projector can tell",
        "A dihedral of albedo 0.5, left wall lit. Solid: both walls glossy; dashed: only the unlit one.",
        "Errors are those of separated bounces against $P A^k F Q$ of the full light field (eq. 29).",
    )
    size, (left, right), (above, below) = (410, 240), (80, 560), (150, 490)
    xlabel, dotted = "share of gloss", {"color": INK, "lw": 1, "ls": ":"}
    for k, place in ((1, left), (2, right)):
        box, title = (place, above, *size), f"Bounce {k} of the separation"
        axes = figures.graph(figure, box, title, xlabel, "relative error")
        _curves(axes, found, lambda case, k=k: case.off[k])
        axes.set_ylim(3e-3, 30)
        axes.axhline(1, color=FAINT, lw=1, ls=":")
        axes.legend(frameon=False, labelcolor="linecolor", fontsize=9, loc="lower right")
    title = "Reciprocity defect \u25cf, light a bounce takes away \u25bc"
    axes = figures.graph(figure, (left, below, *size), title, xlabel, "share", "linear")
    axes.set_ylim(0, 0.4)
    _curves(axes, found, lambda case: case.defect)
    _curves(axes, found, lambda case: case.taken, marker="v", lw=1, alpha=0.7)
    axes.axhline(LARGEST_NEGATIVE, **dotted)
    axes.text(
        0.79, LARGEST_NEGATIVE, "warning above", color=INK, fontsize=9, ha="right", va="bottom"
    )
    title = "Plain series: iterations to 1 % of the direct light"
    axes = figures.graph(figure, (right, below, *size), title, xlabel, "iterations", "linear")
    _curves(axes, found, lambda case: np.nan if case.iterations is None else case.iterations)
    axes.set_ylim(0, 30)
    axes.axhline(20, **dotted)
    axes.text(0.02, 20.4, "the paper's glossy scene", color=INK, fontsize=9)
    axes.text(0.02, 28, "curves end where it diverges", color=FAINT, fontsize=9)
    return figure


def _curves(
    axes: Axes, found: Sequence[Case], value: Callable[[Case], float], **style: Any
) -> None:
    for room, line in zip(ROOMS, ("-", "--"), strict=True):
        for exponent in sorted({case.exponent for case in found}):
            some = [case for case in found if (case.room, case.exponent) == (room, exponent)]
            label = f"exponent {exponent:g}" if line == "-" else None
            look = {"marker": "o", "lw": 2, "ms": 4, "color": SHADES[exponent], "ls": line} | style
            axes.plot(
                [case.gloss for case in some], [value(case) for case in some], label=label, **look
            )
    axes.set_xlim(0, 0.8)


def main() -> None:
    given = parse_options(__doc__ or "")
    logging.getLogger("ltcl").setLevel(logging.ERROR)  # the warning is among what is measured
    found = cases(given)
    facts = {f"{c.room}, exponent {c.exponent:g}, gloss {c.gloss:g}": asdict(c) for c in found}
    title = "The single-view approximation (eq. 28, 29)"
    figures.conclude(given, title, claims(found), facts, lambda: draw(found))


if __name__ == "__main__":
    main()
