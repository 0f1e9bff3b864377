# SPDX-License-Identifier: BSD-3-Clause
"""Pictures under their names, how solves converge, and what an analysis says."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError
from ltcl.images import resize, to_srgb
from ltcl.images.pictures import as_picture
from ltcl.plots.page import (
    COLOURS,
    FAINT,
    GRID,
    INK,
    OTHERS,
    PAPER,
    axes_at,
    figure_of,
    heading,
    label_at,
)
from ltcl.solvers import Solution
from ltcl.tasks.analysis import Analysis

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LOWEST = 1e-8  # of a residual worth drawing: float32 products end above


def convergence(
    solutions: Mapping[str, Solution], rtol: float, title: str = "Convergence"
) -> Figure:
    """Relative residual of several solves of one system against the products they took.

    Solve with ``throw=False``, so that a divergence shows as well. A direct solve becomes a level
    line. InputError: there is nothing to draw, or rtol is outside (0, 1).

    Examples
    --------
    >>> import ltcl
    >>> S, b = [[1.0, 0.5], [0.5, 1.0]], [1.0, 0.0]
    >>> figure = convergence({m: ltcl.solve(S, b, m) for m in ("jacobi", "richardson")}, rtol=1e-2)
    >>> [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    ['jacobi', 'richardson', 'tolerance']
    """
    figure = figure_of(900, 560)
    heading(figure, 34, 26, title, 17)
    _draw_convergence(figure.add_axes((0.09, 0.13, 0.73, 0.72)), solutions, rtol)
    return figure


def analysis(analyses: Mapping[str, Analysis]) -> Figure:
    """Bounds on rho(R) of every transport by name, per channel, and its forecast per method.

    Left the interval that holds rho(R), with the 1 beyond which the paper's series diverges; right
    the products of each method, where there is a forecast. InputError: there is nothing to draw.

    Examples
    --------
    >>> import ltcl
    >>> T = ltcl.scenes.box(3, albedo=0.8).transport()
    >>> figure = analysis({"room": ltcl.analyze(T)})
    >>> [axes.get_title("left") for axes in figure.axes]
    ['spectral radius of R', 'products to 1 %']
    """
    if not analyses:
        raise InputError("analyses is empty; there must be at least one analysis to draw")
    channels = {
        name + (f" {colour}" if len(transport.channels) == 3 else ""): channel
        for name, transport in analyses.items()
        for colour, channel in zip(("red", "green", "blue"), transport.channels, strict=False)
    }
    figure = figure_of(1300, 330 + 46 * len(channels))
    heading(figure, 34, 26, "Before solving", 17)
    left, right = figure.add_axes((0.16, 0.2, 0.33, 0.58)), figure.add_axes((0.58, 0.2, 0.38, 0.58))
    labels = "rho(R), between its bounds", "products with S, sweeps of Gauss-Seidel"
    titles = "spectral radius of R", f"products to {100 * next(iter(analyses.values())).rtol:g} %"
    for axes, title, label in zip((left, right), titles, labels, strict=True):
        _dress(axes, label)
        axes.set_title(title, color=INK, fontsize=13, loc="left", fontweight="bold")

    limit = 1.6 * max(1.0, *(channel.spectral_radius for channel in channels.values()))
    for row, channel in enumerate(channels.values()):
        lower, upper = channel.spectral_radius_bounds
        upper = upper if math.isfinite(upper) else channel.spectral_radius
        left.barh(row, upper - lower, 0.2, lower, color=COLOURS["chebyshev"], alpha=0.6)
        left.plot([channel.spectral_radius], [row], "|", color=INK, ms=16, mew=2)
        certificate = channel.spectral_radius_certificate
        left.text(limit, row, certificate, color=FAINT, fontsize=9, ha="right", va="center")
    left.axvline(1.0, color=COLOURS["jacobi"], lw=1.2, ls=(0, (4, 4)))
    left.set(xlim=(0, limit), ylim=(len(channels) - 0.4, -0.6))
    left.set_yticks(range(len(channels)), list(channels))

    methods = list(next(iter(channels.values())).products)
    height, colours = 0.8 / len(channels), _colours(methods)
    for row, channel in enumerate(channels.values()):
        for place, name in enumerate(methods):
            n, y = channel.products[name], place - 0.4 + (row + 0.5) * height
            bar = right.barh(y, n if math.isfinite(n) else 0, 0.85 * height, color=colours[name])
            count = f"{n:g}" if math.isfinite(n) else "diverges" if n > 0 else "no forecast"
            size = float(np.clip(60 * height, 6, 11))
            right.bar_label(bar, [f"  {count}"], color=FAINT, fontsize=size)
    right.margins(x=0.25)
    right.set_ylim(len(methods) - 0.4, -0.6)
    right.set_yticks(range(len(methods)), methods)
    return figure


def pictures(
    *rows: Mapping[str, Any], title: str = "", subtitle: str = "", width: int = 1000
) -> Figure:
    r"""Linear pictures in rows, each row as wide as the page, under their names.

    A picture is (h, w) or (h, w, 3), cut off beyond 0 and 1; black is the page, as beside the walls
    of a view. Small ones are enlarged, each pixel a square. A second line of a name is a note, in
    small letters. InputError: there is no picture, or one has another shape.

    Examples
    --------
    >>> import ltcl
    >>> scene = ltcl.scenes.dihedral(4)
    >>> seen = scene.view(scene.transport() @ np.full(scene.grid, 0.5), size=64)
    >>> figure = pictures({"seen": seen, "too bright\nthree times": 3 * seen}, title="A corner")
    >>> [text.get_text() for text in figure.texts if text.get_text()]
    ['A corner', 'seen', 'too bright', 'three times']
    """
    rows = tuple(row for row in rows if row)
    width = checks.count("width", width, least=100)
    if not rows:
        raise InputError("rows hold no picture; there must be at least one to draw")
    shown = [{name: as_picture(name, image) for name, image in row.items()} for row in rows]
    scale = max(width / 1000, 0.85)  # of text
    margin, gap, top, drawn = round(0.025 * width), round(0.016 * width), 20 * scale, []
    top += (
        34 * scale * bool(title) + 24 * scale * (subtitle.count("\n") + bool(subtitle)) + 6 * scale
    )
    for row in shown:
        side = (width - 2 * margin - (len(row) - 1) * gap) / len(row)
        size = scale * float(np.clip(side / 300, 0.8, 1.15))
        label, top = top, top + size * (24 + 18 * any("\n" in name for name in row))
        for place, (name, image) in enumerate(row.items()):
            box = margin + place * (side + gap), top, side, side * image.shape[0] / image.shape[1]
            drawn.append((name, image, size, label, box))
        top = max(box[1] + box[3] for *_, box in drawn) + 16 * scale
    figure = figure_of(width, math.ceil(top))
    heading(figure, margin, 18 * scale, title, 17 * scale)
    label_at(
        figure, margin, (18 + 34 * bool(title)) * scale, subtitle, size=11 * scale, color=FAINT
    )
    for name, image, size, line, box in drawn:
        label, _, note = name.partition("\n")
        heading(figure, box[0], line, label, 12 * size)
        label_at(figure, box[0], line + 21 * size, note, size=10.5 * size, color=FAINT)
        _draw_picture(figure, box, image)
    return figure


def _draw_picture(
    figure: Figure, box: tuple[float, float, float, float], image: np.ndarray
) -> None:
    left, top, w, h = (
        max(round(side), 1) for side in box
    )  # whole pixels, which Agg does not resample
    black = resize((np.atleast_3d(image) == 0).all(axis=-1).astype(np.float32), (h, w)) > 0.999
    if times := w // image.shape[1]:  # enlarged to more than is drawn: squares with sharp edges
        image = image.repeat(times + 1, axis=0).repeat(times + 1, axis=1)
    codes = np.atleast_3d(to_srgb(np.clip(resize(image, (h, w)), 0, 1)))
    codes = np.broadcast_to(codes, (h, w, 3))
    paper = np.array([int(PAPER[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    codes = np.where(black[..., None], paper, codes)
    axes = axes_at(figure, (left, top, w, h))
    axes.imshow(np.rint(255 * codes).astype(np.uint8), interpolation="none", aspect="auto")
    axes.axis("off")


def _draw_convergence(axes: Axes, solutions: Mapping[str, Solution], rtol: float) -> None:
    from matplotlib.ticker import LogLocator, MaxNLocator

    checks.number("rtol", rtol, above=0.0, below=1.0)
    if not solutions:
        raise InputError("solutions is empty; there must be at least one to draw")
    _dress(axes, "products with S")
    axes.set_ylabel("relative residual", color=FAINT, fontsize=12, labelpad=6)
    products = max([1, *(solution.products for solution in solutions.values())])
    colours, lowest, highest = _colours(solutions), rtol, 1.0
    for name, solution in solutions.items():
        y = np.array([value for value in solution.residuals if np.isfinite(value)] or [1.0])
        x = np.linspace(0, max(solution.products, 1), len(y))
        if solution.method == "direct":
            x, y = np.array([0, products]), np.full(2, solution.residual)
        y = np.maximum(y, _LOWEST)
        lowest, highest = min(lowest, float(y.min())), max(highest, float(y.max()))
        label = name if solution.residual >= _LOWEST else f"{name} \u2193"
        # Neumann runs on top of Jacobi, which must stay visible.
        style = (0, (2, 2)) if name == "neumann" else "-"
        axes.plot(x, y, color=colours[name], lw=2.6, ls=style, clip_on=False, label=label)
    axes.plot([0, products], [rtol, rtol], color=FAINT, lw=1.2, ls=(0, (4, 4)), label="tolerance")
    axes.set(yscale="log", xlim=(0, products), ylim=(lowest / 2, 2 * highest))
    axes.grid(color=GRID, lw=1)
    axes.yaxis.set_major_locator(LogLocator(10, numticks=8))
    axes.minorticks_off()
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    axes.legend(
        loc="upper left",
        bbox_to_anchor=(1.0, 1.03),
        frameon=False,
        labelcolor="linecolor",
        fontsize=11,
    )


def _dress(axes: Axes, label: str) -> None:
    axes.set_facecolor(PAPER)
    axes.set_xlabel(label, color=FAINT, fontsize=12, labelpad=6)
    axes.grid(color=GRID, lw=1, axis="x")
    axes.set_axisbelow(True)
    axes.tick_params(colors=FAINT, labelsize=11, length=0, pad=7)
    axes.spines[:].set_visible(False)


def _colours(names: Sequence[str] | Mapping[str, object]) -> dict[str, str]:
    others = iter(OTHERS * (1 + len(names)))
    return {name: COLOURS.get(name) or next(others) for name in names}
