# SPDX-License-Identifier: BSD-3-Clause
"""Figure 4: each term of the inverse series on a picture of a closed box (eq. 10, 12, 13).

A closed diffuse box with a red, a green and four neutral walls, under light that is constant on
each wall. l^(n) = (I - R + R^2 - ... + (-R)^n) l_out leads from the picture l_out to the direct
light l_d.

Claims of the paper: the terms alternate in sign; the picture bleeds red and green, which odd terms
answer in cyan and magenta; the bleeding cancels; n terms remove the bounces up to n; the sums
converge to l_d.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import _boxes as boxes
import _figures as figures
import ltcl
from _boxes import FLOOR, NEUTRAL
from _figures import Claim
from _harness import parse_options
from ltcl.plots.page import FAINT, INK, axes_at, label_at
from ltcl.scenes import Scene
from ltcl.theory import bounce_coefficients

TERMS = 30
SIGN_TERMS = 11
DRAWN_TERMS = (0, 1, 2, 3, 8)
# Rows and columns of the table of bounces, without the first ones.
ORDERS = 5
BOUNCES = 8
# Bounces that the float64 expansion in A goes to: later ones are below rounding.
EXPANSION_BOUNCES = 99
# The relative error must fall at each of these first terms.
FALLING_TERMS = 20


@dataclass(frozen=True, kw_only=True)
class Series:
    """Terms and sums of the series on a picture, (TERMS + 1, 3, N) for n = 0, 1, ..."""

    scene: Scene
    l_d: np.ndarray
    terms: np.ndarray
    sums: np.ndarray

    @property
    def errors(self) -> np.ndarray:
        """Relative error of each sum."""
        deviations = np.linalg.norm(self.sums - self.l_d, axis=(1, 2))
        return deviations / np.linalg.norm(self.l_d)


def measure(n: int, device: ltcl.Device) -> Series:
    """Run the series on the closed box, n x n patches a wall."""
    scene, l_d = boxes.coloured_box(n)
    T = scene.transport(first_bounce=scene.first_bounce, device=device)
    l_out = boxes.all_bounces(scene, l_d)
    terms = boxes.terms(T.systems, l_out, TERMS)
    return Series(scene=scene, l_d=l_d, terms=terms, sums=np.cumsum(terms, axis=0))


def bleeding(scene: Scene, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Excess of red on the floor beside the red wall, and of green beside the green one.

    Mean over the nearest patches of (..., 3, N), less that of the other colours, relative to its
    size.
    """
    n = scene.grid[0]
    floor = values.reshape(*values.shape[:-1], n, 6, n)[..., FLOOR, :]
    beside_red = floor[..., 0].mean(axis=-1)
    beside_green = floor[..., -1].mean(axis=-1)
    return colour_excess(beside_red, 0, 1), colour_excess(beside_green, 1, 0)


def colour_excess(colours: np.ndarray, channel: int, opposite: int) -> np.ndarray:
    """Relative excess of a channel of (..., 3) over the mean of the opposite one and blue."""
    others = (colours[..., opposite] + colours[..., 2]) / 2
    return (colours[..., channel] - others) / np.abs(colours).mean(axis=-1)


def colour_cast(scene: Scene, values: np.ndarray) -> float:
    """Largest relative difference between the colours of a patch on the neutral walls."""
    n = scene.grid[0]
    neutral = values.reshape(3, n, 6, n)[:, :, list(NEUTRAL)]
    spread = np.ptp(neutral, axis=0) / neutral.mean(axis=0)
    return float(spread.max())


def contents(n: int, bounces: int) -> np.ndarray:
    """Multiples of A^j l_d in n terms on l_out: 0 for 1 <= j <= n.

    These are the coefficients of eq. 12 times I + A + A^2 + ...
    """
    return np.cumsum(bounce_coefficients(n, bounces))


def claims(series: Series) -> list[Claim]:
    return [
        alternation_claim(series),
        *bleeding_claims(series),
        colour_claim(series),
        removal_claim(series),
        convergence_claim(series),
    ]


def alternating_signs() -> np.ndarray:
    return (-1.0) ** np.arange(SIGN_TERMS)


def alternation_claim(series: Series) -> Claim:
    signs = np.sign(series.terms[:SIGN_TERMS])
    expected = alternating_signs()[:, None, None]
    share = float(np.mean(signs == expected))
    measured = f"in {share:.0%} of values of {SIGN_TERMS} terms"
    return Claim("terms alternate in sign", measured, "100%", share == 1)


def bleeding_claims(series: Series) -> list[Claim]:
    claims = []
    colours = (("red", "cyan", "green"), ("green", "magenta", "red"))
    excesses = bleeding(series.scene, series.terms[:SIGN_TERMS])
    for names, excess in zip(colours, excesses, strict=True):
        colour, complement, opposite = names
        text = (
            f"the picture bleeds {colour}; odd terms turn it to {complement}, even ones to {colour}"
        )
        first = " ".join(f"{value:+.0%}" for value in excess[:4])
        measured = f"beside the {colour} wall, {colour} over {opposite} and blue: {first} ..."
        alternates = bool((excess * alternating_signs() > 0).all())
        claims.append(Claim(text, measured, "+ - + - ...", alternates))
    return claims


def colour_claim(series: Series) -> Claim:
    before = colour_cast(series.scene, series.sums[0])
    after = colour_cast(series.scene, series.sums[-1])
    text = "in the end no colour bleeds"
    measured = f"colour cast of neutral walls {before:.0%}, after {TERMS} terms {after:.1g}"
    return Claim(text, measured, "below 1e-3", after < 1e-3 < before)


def removal_claim(series: Series) -> Claim:
    """The bounces 1 .. n are in n terms 0 times, by theory and in the measured sums."""
    bounces = [series.l_d]
    for _ in range(EXPANSION_BOUNCES):
        bounces.append(boxes.bounce(series.scene, bounces[-1]))
    expected = []
    is_absent = True
    for n in range(1, ORDERS + 1):
        expected.append(np.tensordot(contents(n, EXPANSION_BOUNCES), bounces, 1))
        if contents(n, n)[1:].any():
            is_absent = False
    sums = series.sums[1 : ORDERS + 1]
    deviations = np.linalg.norm(sums - expected, axis=(1, 2))
    error = deviations.max() / np.linalg.norm(series.l_d)
    prefix = "" if is_absent else "not "
    measured = f"coefficients {prefix}0; sums off their expansion in A by {error:.1g}"
    text = "n terms remove the bounces 1 .. n (eq. 12, 13)"
    return Claim(text, measured, "0; below 1e-5", is_absent and error < 1e-5)


def convergence_claim(series: Series) -> Claim:
    errors = series.errors
    is_closer = np.diff(errors[: FALLING_TERMS + 1]) < 0
    closer = FALLING_TERMS if is_closer.all() else int(np.argmin(is_closer))
    measured = (
        f"error {errors[0]:.2g}, after {TERMS} terms {errors[-1]:.1g}; "
        f"each of the first {closer} closer"
    )
    converges = errors[-1] < 1e-3 and closer == FALLING_TERMS
    text = "the series converges to the direct light"
    return Claim(text, measured, "below 1e-3; 20", converges)


def draw(series: Series) -> Figure:
    figure = figures.page(
        860,
        "Figure 4: the inverse series takes the bounces out of a picture",
        "A closed box, seen through its front wall. "
        "Above: the picture and n terms of the series, which",
        "swings around the direct light until it settles there. "
        "Below: the terms alone; neutral grey is 0.",
    )
    draw_sums(figure, series)
    draw_terms(figure, series)
    draw_contents(figure)
    draw_errors(figure, series)
    return figure


def draw_sums(figure: Figure, series: Series) -> None:
    """The picture, sums of the series, and the direct light, side by side."""
    scene = series.scene
    gain = 0.9 / np.quantile(series.sums[0], 0.999)
    views = []
    for n in DRAWN_TERMS:
        image = figures.light(scene, scene.picture(series.sums[n]), gain)
        label = terms_label(n) if n else r"picture $l_{out}$"
        views.append((image, label, f"error {series.errors[n]:.2g}"))
    image = figures.light(scene, scene.picture(series.l_d), gain)
    views.append((image, r"direct light $l_d$", "the truth"))
    figures.pictures(figure, 130, views)


def draw_terms(figure: Figure, series: Series) -> None:
    """The terms alone, each as bright as it can be shown."""
    scene = series.scene
    lefts, width = figures.columns(len(DRAWN_TERMS) + 1)
    for left, n in zip(lefts, DRAWN_TERMS, strict=False):
        scale = 1 / np.quantile(np.abs(series.terms[n]), 0.999)
        image = figures.signed(scene, scene.picture(series.terms[n]), scale)
        note = f"shown \u00d7 {scale:.2g}"
        formula = f"${term_formula(n)}$"
        figures.picture(figure, (left, 340, width), image, formula, note)
    note = "Even terms are light\nthat bled: red, green.\nOdd ones take light\naway: cyan, magenta."
    label_at(figure, lefts[-1], 350, note, size=10, color=FAINT, linespacing=1.5)


def term_formula(n: int) -> str:
    if n == 0:
        return "l_{out}"
    if n == 1:
        return r"-R\,l_{out}"
    sign = "+" if n % 2 == 0 else "-"
    return rf"{sign}R^{n}\,l_{{out}}"


def terms_label(n: int) -> str:
    return "+ 1 term" if n == 1 else f"+ {n} terms"


def draw_errors(figure: Figure, series: Series) -> None:
    """Error of each sum in each colour."""
    box = (640, 580, 330, 220)
    title = "Error of the sum, each colour"
    axes = figures.graph(figure, box, title, "terms n", "relative error")
    draw_channel_error(axes, series, 1, "green", color="#8bd17c", ls="-")
    draw_channel_error(axes, series, 0, "red", color="#ff5d5d", ls="--")
    draw_channel_error(axes, series, 2, "blue", color="#5c9cff", ls="-")
    figures.legend(axes)
    axes.set_xlim(0, TERMS)


def draw_channel_error(axes: Axes, series: Series, channel: int, name: str, **look: Any) -> None:
    truth = series.l_d[channel]
    deviations = np.linalg.norm(series.sums[:, channel] - truth, axis=1)
    axes.plot(deviations / np.linalg.norm(truth), label=name, lw=2, **look)


def draw_contents(figure: Figure) -> None:
    """The table of `contents`: the bounces that n terms leave."""
    table = np.array([contents(n, BOUNCES) for n in range(ORDERS + 1)])
    title = "How often each bounce of light is in the sum"
    label_at(figure, 30, 572, title, size=11, fontweight="bold", va="bottom")
    axes = axes_at(figure, (130, 580, 430, 220))
    scale = {"vmin": -6, "vmax": 6, "aspect": "auto"}
    axes.imshow(np.arcsinh(table), cmap="RdBu_r", **scale)
    style = {"ha": "center", "va": "center", "fontsize": 10}
    for (n, j), value in np.ndenumerate(table):
        colour = "#15171b" if value else "#b9bdc4"
        axes.text(j, n, str(value), color=colour, **style)
    columns = ["direct", *map(str, range(1, BOUNCES + 1))]
    rows = ["picture", *map(terms_label, range(1, ORDERS + 1))]
    axes.set_xticks(range(BOUNCES + 1), columns, color=INK, fontsize=9.5)
    axes.set_yticks(range(ORDERS + 1), rows, color=INK, fontsize=9.5)
    axes.tick_params(length=0)
    axes.set_xlabel("bounce", color=FAINT, fontsize=10)


def main() -> None:
    options = parse_options(__doc__)
    n = 4 if options.smoke else 16
    series = measure(n, options.device)
    errors = [float(f"{error:.3g}") for error in series.errors]
    facts = {
        "patches": series.l_d.shape[1],
        "largest albedo": float(series.scene.albedo.max()),
        "relative error after n terms": errors,
    }
    title = "Figure 4: terms of the inverse series"
    figures.conclude(options, title, claims(series), facts, lambda: draw(series))


if __name__ == "__main__":
    main()
