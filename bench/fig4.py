# SPDX-License-Identifier: BSD-3-Clause
"""Figure 4: what each term of the inverse series does to a picture of a closed box (eq. 10, 12, 13).

A closed diffuse box with a red, a green and four neutral walls, under light that is constant on each wall.
l^(n) = (I - R + R^2 - ... + (-R)^n) l_out leads from the picture l_out to the direct light l_d.

Claims of the paper: the terms alternate in sign; the picture bleeds red and green, which odd terms answer
in cyan and magenta; the bleeding cancels; n terms remove the bounces up to n; the sums converge to l_d.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

import _boxes as boxes
import _figures as figures
from _boxes import FLOOR, NEUTRAL
from _figures import Claim
from _harness import options
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


def bleeding(scene: Scene, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How much redder the floor is beside the red wall, and how much greener beside the green one.

    Mean over the nearest patches of (..., 3, N), less that of the other colours, relative to its size.
    """
    n = scene.grid[0]
    floor = values.reshape(*values.shape[:-1], n, 6, n)[..., FLOOR, :]
    red, green = floor[..., 0].mean(axis=-1), floor[..., -1].mean(axis=-1)

    def excess(colour: np.ndarray, own: int, other: int) -> np.ndarray:
        return (colour[..., own] - (colour[..., other] + colour[..., 2]) / 2) / np.abs(colour).mean(axis=-1)

    return excess(red, 0, 1), excess(green, 1, 0)


def cast(scene: Scene, values: np.ndarray) -> float:
    """Largest difference between the colours of a patch on the neutral walls, relative to their mean."""
    n = scene.grid[0]
    neutral = values.reshape(3, n, 6, n)[:, :, list(NEUTRAL)]
    return float((np.ptp(neutral, axis=0) / neutral.mean(axis=0)).max())


def contents(n: int, bounces: int) -> np.ndarray:
    """How often A^j l_d is in n terms on l_out: eq. 12 times I + A + A^2 + ..., so 0 for 1 <= j <= n."""
    return np.cumsum(bounce_coefficients(n, bounces))


def bounce_error(found: Series) -> float:
    """Largest relative difference of sums of 1 .. ORDERS terms from `contents` of A^j l_d in float64."""
    bounces = [found.l_d]
    for _ in range(99):
        bounces.append(boxes.bounce(found.scene, bounces[-1]))
    expected = [np.tensordot(contents(n, 99), bounces, 1) for n in range(1, ORDERS + 1)]
    off = np.linalg.norm(found.sums[1 : ORDERS + 1] - expected, axis=(1, 2))
    return float(off.max() / np.linalg.norm(found.l_d))


def claims(found: Series) -> list[Claim]:
    """What the paper says of the figure."""
    alternate = (-1.0) ** np.arange(11)
    right = np.mean(np.sign(found.terms[:11]) == alternate[:, None, None])
    red, green = bleeding(found.scene, found.terms[:11])
    before, after = cast(found.scene, found.sums[0]), cast(found.scene, found.sums[-1])
    off, errors = bounce_error(found), found.errors
    absent = not any(contents(n, n)[1:].any() for n in range(1, ORDERS + 1))
    closer = int(np.argmin(np.diff(errors[:21]) < 0)) or 20
    return [
        Claim("terms alternate in sign", f"in {right:.0%} of values of 11 terms", "100%", bool(right == 1)),
        Claim(
            "the picture bleeds red; odd terms turn it to cyan, even ones to red",
            "beside the red wall, red over green and blue: " + _percent(red),
            "+ - + - ...",
            bool((red * alternate > 0).all()),
        ),
        Claim(
            "the picture bleeds green; odd terms turn it to magenta, even ones to green",
            "beside the green wall, green over red and blue: " + _percent(green),
            "+ - + - ...",
            bool((green * alternate > 0).all()),
        ),
        Claim(
            "in the end no colour bleeds",
            f"colour cast of neutral walls {before:.0%}, after {TERMS} terms {after:.1g}",
            "below 1e-3",
            after < 1e-3 < before,
        ),
        Claim(
            "n terms remove the bounces 1 .. n (eq. 12, 13)",
            f"coefficients {'' if absent else 'not '}0; sums off their expansion in A by {off:.1g}",
            "0; below 1e-5",
            absent and off < 1e-5,
        ),
        Claim(
            "the series converges to the direct light",
            f"error {errors[0]:.2g}, after {TERMS} terms {errors[-1]:.1g}; each of the first {closer} closer",
            "below 1e-3; 20",
            bool(errors[-1] < 1e-3 and closer == 20),
        ),
    ]


def _percent(values: np.ndarray) -> str:
    return " ".join(f"{value:+.0%}" for value in values[:4]) + " ..."


def draw(found: Series) -> Figure:
    """Sums above, terms below them; then what is left of each bounce, and the error."""
    figure = figures.page(
        860,
        "Figure 4: the inverse series takes the bounces out of a picture",
        "A closed box, seen through its front wall. Above: the picture and n terms of the series, which",
        "swings around the direct light until it settles there. Below: the terms alone; neutral grey is 0.",
    )
    scene = found.scene
    lefts, width = figures.columns(len(SHOWN) + 1)
    gain = 0.9 / np.quantile(found.sums[0], 0.999)
    for left, n in zip(lefts, SHOWN, strict=False):
        label = _after(n) if n else r"picture $l_{out}$"
        image = figures.light(scene, scene.picture(found.sums[n]), gain)
        figures.picture(figure, (left, 130, width), image, label, f"error {found.errors[n]:.2g}")
        scale = 1 / np.quantile(np.abs(found.terms[n]), 0.999)
        power = rf"{'-+'[n % 2 == 0]}R^{n}\,l_{{out}}" if n > 1 else r"-R\,l_{out}" if n else "l_{out}"
        image = figures.signed(scene, scene.picture(found.terms[n]), scale)
        figures.picture(figure, (left, 340, width), image, f"${power}$", f"shown \u00d7 {scale:.2g}")
    image = figures.light(scene, scene.picture(found.l_d), gain)
    figures.picture(figure, (lefts[-1], 130, width), image, r"direct light $l_d$", "the truth")
    note = "Even terms are light\nthat bled: red, green.\nOdd ones take light\naway: cyan, magenta."
    label_at(figure, lefts[-1], 350, note, size=10, color=FAINT, linespacing=1.5)
    draw_contents(figure)
    axes = figures.graph(
        figure, (640, 580, 330, 220), "Error of the sum, each colour", "terms n", "relative error"
    )
    for name, colour, channel in (("green", "#8bd17c", 1), ("red", "#ff5d5d", 0), ("blue", "#5c9cff", 2)):
        off = np.linalg.norm(found.sums[:, channel] - found.l_d[channel], axis=1)
        axes.plot(
            off / np.linalg.norm(found.l_d[channel]),
            color=colour,
            lw=2,
            label=name,
            ls="--" if channel == 0 else "-",
        )
    axes.legend(frameon=False, labelcolor="linecolor", fontsize=10)
    axes.set_xlim(0, TERMS)
    return figure


def _after(n: int) -> str:
    return f"+ {n} term{'s' * (n > 1)}"


def draw_contents(figure: Figure) -> None:
    """The table of `contents`: which bounces n terms leave."""
    table = np.array([contents(n, BOUNCES) for n in range(ORDERS + 1)])
    axes = axes_at(figure, (130, 580, 430, 220))
    label_at(
        figure,
        30,
        572,
        "How often each bounce of light is in the sum",
        size=11,
        fontweight="bold",
        va="bottom",
    )
    axes.imshow(np.arcsinh(table), cmap="RdBu_r", vmin=-6, vmax=6, aspect="auto")
    for (n, j), value in np.ndenumerate(table):
        axes.text(
            j, n, str(value), ha="center", va="center", fontsize=10, color="#15171b" if value else "#b9bdc4"
        )
    axes.set_xticks(range(BOUNCES + 1), ["direct", *map(str, range(1, BOUNCES + 1))], color=INK, fontsize=9.5)
    names = ["picture", *map(_after, range(1, ORDERS + 1))]
    axes.set_yticks(range(ORDERS + 1), names, color=INK, fontsize=9.5)
    axes.tick_params(length=0)
    axes.set_xlabel("bounce", color=FAINT, fontsize=10)


def main() -> None:
    given = options(__doc__ or "")
    scene, l_d = boxes.coloured_box(4 if given.smoke else 16)
    T = scene.transport(first_bounce=scene.first_bounce, device=given.device)
    l_out = boxes.all_bounces(scene, l_d)
    series = np.stack([boxes.terms(S, l, TERMS) for S, l in zip(T.systems, l_out, strict=True)], axis=1)
    found = Series(scene, l_d, series, np.cumsum(series, axis=0))
    facts = {
        "patches": l_d.shape[1],
        "largest albedo": float(scene.albedo.max()),
        "relative error after n terms": [float(f"{error:.3g}") for error in found.errors],
    }
    figures.conclude(
        given, "Figure 4: terms of the inverse series", claims(found), facts, lambda: draw(found)
    )


if __name__ == "__main__":
    main()
