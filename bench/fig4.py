# SPDX-License-Identifier: BSD-3-Clause
"""Figure 4: what each term of the inverse series does to a picture of a closed box (eq. 10, 12, 13).

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

TERMS, SHOWN, ORDERS, BOUNCES = 30, (0, 1, 2, 3, 8), 5, 8


@dataclass(frozen=True)
class Series:
    """The series on the picture of a scene: terms and their sums, (TERMS + 1, 3, N), for n = 0, 1, ..."""

    scene: Scene
    l_d: np.ndarray
    terms: np.ndarray
    sums: np.ndarray

    @property
    def errors(self) -> np.ndarray:
        """Relative error of each sum."""
        return np.linalg.norm(self.sums - self.l_d, axis=(1, 2)) / np.linalg.norm(self.l_d)


def measure(n: int, device: ltcl.Device) -> Series:
    """The series on the closed box, n x n patches a wall."""
    scene, l_d = boxes.coloured_box(n)
    T = scene.transport(first_bounce=scene.first_bounce, device=device)
    series = boxes.terms(T.systems, boxes.all_bounces(scene, l_d), TERMS)
    return Series(scene, l_d, series, np.cumsum(series, axis=0))


def bleeding(scene: Scene, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How much redder the floor is beside the red wall, and how much greener beside the green one.

    Mean over the nearest patches of (..., 3, N), less that of the other colours, relative to its
    size.
    """
    n = scene.grid[0]
    floor = values.reshape(*values.shape[:-1], n, 6, n)[..., FLOOR, :]
    red, green = floor[..., 0].mean(axis=-1), floor[..., -1].mean(axis=-1)

    def excess(colour: np.ndarray, own: int, other: int) -> np.ndarray:
        return (colour[..., own] - (colour[..., other] + colour[..., 2]) / 2) / np.abs(colour).mean(
            axis=-1
        )

    return excess(red, 0, 1), excess(green, 1, 0)


def cast(scene: Scene, values: np.ndarray) -> float:
    """Largest difference between the colours of a patch on the neutral walls, relative to their mean."""
    n = scene.grid[0]
    neutral = values.reshape(3, n, 6, n)[:, :, list(NEUTRAL)]
    return float((np.ptp(neutral, axis=0) / neutral.mean(axis=0)).max())


def contents(n: int, bounces: int) -> np.ndarray:
    """How often A^j l_d is in n terms on l_out: eq. 12 times I + A + A^2 + ..., so 0 for 1 <= j <= n."""
    return np.cumsum(bounce_coefficients(n, bounces))


def claims(found: Series) -> list[Claim]:
    alternate = (-1.0) ** np.arange(11)
    right = float(np.mean(np.sign(found.terms[:11]) == alternate[:, None, None]))
    before, after = cast(found.scene, found.sums[0]), cast(found.scene, found.sums[-1])
    bounces, errors = [found.l_d], found.errors
    for _ in range(99):
        bounces.append(boxes.bounce(found.scene, bounces[-1]))
    expected = [np.tensordot(contents(n, 99), bounces, 1) for n in range(1, ORDERS + 1)]
    off = np.linalg.norm(found.sums[1 : ORDERS + 1] - expected, axis=(1, 2)).max() / np.linalg.norm(
        found.l_d
    )
    absent = not any(contents(n, n)[1:].any() for n in range(1, ORDERS + 1))
    closer = int(np.argmin(np.diff(errors[:21]) < 0)) or 20
    listed = [
        Claim(
            "terms alternate in sign", f"in {right:.0%} of values of 11 terms", "100%", right == 1
        )
    ]
    names = (("red", "cyan", "green"), ("green", "magenta", "red"))
    for (own, opposite, other), excess in zip(
        names, bleeding(found.scene, found.terms[:11]), strict=True
    ):
        text = f"the picture bleeds {own}; odd terms turn it to {opposite}, even ones to {own}"
        shown = " ".join(f"{value:+.0%}" for value in excess[:4])
        measured = f"beside the {own} wall, {own} over {other} and blue: {shown} ..."
        listed.append(Claim(text, measured, "+ - + - ...", bool((excess * alternate > 0).all())))
    colour = f"colour cast of neutral walls {before:.0%}, after {TERMS} terms {after:.1g}"
    removes = (
        f"coefficients {'' if absent else 'not '}0; sums off their expansion in A by {off:.1g}"
    )
    error = f"error {errors[0]:.2g}, after {TERMS} terms {errors[-1]:.1g}; each of the first {closer} closer"
    removed, converges = absent and off < 1e-5, errors[-1] < 1e-3 and closer == 20
    return [
        *listed,
        Claim("in the end no colour bleeds", colour, "below 1e-3", after < 1e-3 < before),
        Claim("n terms remove the bounces 1 .. n (eq. 12, 13)", removes, "0; below 1e-5", removed),
        Claim("the series converges to the direct light", error, "below 1e-3; 20", converges),
    ]


def draw(found: Series) -> Figure:
    figure = figures.page(
        860,
        "Figure 4: the inverse series takes the bounces out of a picture",
        "A closed box, seen through its front wall. Above: the picture and n terms of the series, which",
        "swings around the direct light until it settles there. Below: the terms alone; neutral grey is 0.",
    )
    scene, gain, sums, terms = found.scene, 0.9 / np.quantile(found.sums[0], 0.999), [], []
    for n in SHOWN:
        image = figures.light(scene, scene.picture(found.sums[n]), gain)
        sums.append(
            (image, _after(n) if n else r"picture $l_{out}$", f"error {found.errors[n]:.2g}")
        )
        scale = 1 / np.quantile(np.abs(found.terms[n]), 0.999)
        power = (
            rf"{'-+'[n % 2 == 0]}R^{n}\,l_{{out}}" if n > 1 else r"-R\,l_{out}" if n else "l_{out}"
        )
        image = figures.signed(scene, scene.picture(found.terms[n]), scale)
        terms.append((image, f"${power}$", f"shown \u00d7 {scale:.2g}"))
    image = figures.light(scene, scene.picture(found.l_d), gain)
    figures.pictures(figure, 130, [*sums, (image, r"direct light $l_d$", "the truth")])
    lefts, width = figures.columns(len(SHOWN) + 1)
    for left, shown in zip(lefts, terms, strict=False):
        figures.picture(figure, (left, 340, width), *shown)
    note = "Even terms are light\nthat bled: red, green.\nOdd ones take light\naway: cyan, magenta."
    label_at(figure, lefts[-1], 350, note, size=10, color=FAINT, linespacing=1.5)
    draw_contents(figure)
    box = (640, 580, 330, 220)
    axes = figures.graph(figure, box, "Error of the sum, each colour", "terms n", "relative error")
    for name, colour, channel in (
        ("green", "#8bd17c", 1),
        ("red", "#ff5d5d", 0),
        ("blue", "#5c9cff", 2),
    ):
        off = np.linalg.norm(found.sums[:, channel] - found.l_d[channel], axis=1)
        look: Any = {"color": colour, "lw": 2, "ls": "-" if channel else "--"}
        axes.plot(off / np.linalg.norm(found.l_d[channel]), label=name, **look)
    axes.legend(frameon=False, labelcolor="linecolor", fontsize=10)
    axes.set_xlim(0, TERMS)
    return figure


def _after(n: int) -> str:
    return f"+ {n} term{'s' * (n > 1)}"


def draw_contents(figure: Figure) -> None:
    """The table of `contents`: which bounces n terms leave."""
    table = np.array([contents(n, BOUNCES) for n in range(ORDERS + 1)])
    axes, bold = axes_at(figure, (130, 580, 430, 220)), {"fontweight": "bold", "va": "bottom"}
    label_at(figure, 30, 572, "How often each bounce of light is in the sum", size=11, **bold)
    axes.imshow(np.arcsinh(table), cmap="RdBu_r", vmin=-6, vmax=6, aspect="auto")
    for (n, j), value in np.ndenumerate(table):
        colour = "#15171b" if value else "#b9bdc4"
        axes.text(j, n, str(value), ha="center", va="center", fontsize=10, color=colour)
    axes.set_xticks(
        range(BOUNCES + 1), ["direct", *map(str, range(1, BOUNCES + 1))], color=INK, fontsize=9.5
    )
    names = ["picture", *map(_after, range(1, ORDERS + 1))]
    axes.set_yticks(range(ORDERS + 1), names, color=INK, fontsize=9.5)
    axes.tick_params(length=0)
    axes.set_xlabel("bounce", color=FAINT, fontsize=10)


def main() -> None:
    given = parse_options(__doc__ or "")
    found = measure(4 if given.smoke else 16, given.device)
    facts = {
        "patches": found.l_d.shape[1],
        "largest albedo": float(found.scene.albedo.max()),
        "relative error after n terms": [float(f"{error:.3g}") for error in found.errors],
    }
    title = "Figure 4: terms of the inverse series"
    figures.conclude(given, title, claims(found), facts, lambda: draw(found))


if __name__ == "__main__":
    main()
