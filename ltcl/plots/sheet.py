# SPDX-License-Identifier: BSD-3-Clause
"""How solves converge, and the contact sheet of the demo."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ltcl import checks
from ltcl.errors import InputError
from ltcl.images import from_srgb, resize, to_srgb
from ltcl.plots.page import (
    COLOURS,
    FAINT,
    GRID,
    OTHERS,
    PAPER,
    axes_at,
    figure_of,
    heading,
    label_at,
)
from ltcl.solvers import Solution

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LETTER, _LINE = 10, 21  # pixels that a letter and a line of names take
_LOWEST = 1e-8  # of a residual worth drawing: float32 products end above


@dataclass(frozen=True)
class Panel:
    """A picture with a label on its left shoulder and a note on its right.

    `image` is linear, (h, w, 3), or (h, w, 4) with the coverage last; values beyond 0 and 1 are cut off.
    """

    label: str
    note: str
    image: np.ndarray = field(repr=False)


@dataclass(frozen=True)
class Sheet:
    """What `contact_sheet` shows: rows of panels, the middle one with the convergence plot at its end."""

    title: str
    subtitle: str
    large: Sequence[Panel]
    medium: Sequence[Panel]
    small: Sequence[Panel]
    solutions: Mapping[str, Solution]
    rtol: float
    plot_title: str = "Convergence"


def convergence(solutions: Mapping[str, Solution], rtol: float, title: str = "Convergence") -> Figure:
    """Relative residual of several solves of one system against the products they took.

    Parameters
    ----------
    solutions : mapping of name to Solution
        Made with ``throw=False``, so that a divergence shows as well. A direct solve becomes a level line.
    rtol : float
        Drawn as a dashed line.
    title : str

    Returns
    -------
    Figure

    Raises
    ------
    InputError
        No solution, or a tolerance outside (0, 1).

    Examples
    --------
    >>> import ltcl
    >>> S, b = [[1.0, 0.5], [0.5, 1.0]], [1.0, 0.0]
    >>> figure = convergence({m: ltcl.solve(S, b, m) for m in ("jacobi", "richardson")}, rtol=1e-2)
    >>> sorted(text.get_text() for text in figure.axes[0].texts)
    ['jacobi', 'richardson', 'tolerance']
    """
    figure = figure_of(900, 560)
    heading(figure, 34, 26, title, 17)
    _draw_convergence(figure.add_axes((0.09, 0.13, 0.73, 0.72)), solutions, rtol)
    return figure


def contact_sheet(sheet: Sheet, width: int = 1600) -> Figure:
    """All that a demo has to show on one dark page, `width` pixels wide.

    Returns
    -------
    Figure
        Its height follows from the shapes of the panels.
    """
    margin, gap = 40, 26
    inner = width - 2 * margin
    rows = [
        _Row(sheet.large, (inner - 2 * gap) // 3, 164),
        _Row(sheet.medium, round(0.236 * inner), 0),
        _Row(sheet.small, (inner - (len(sheet.small) - 1) * gap) // max(1, len(sheet.small)), 0),
    ]
    tops = [rows[0].top]
    for row in rows[:2]:
        tops.append(tops[-1] + row.height + 74)
    figure = figure_of(width, tops[-1] + rows[-1].height + 30)
    heading(figure, margin, 32, sheet.title, 26)
    label_at(figure, margin, 82, sheet.subtitle, size=15, color=FAINT)
    for row, top in zip(rows, tops, strict=True):
        for place, panel in enumerate(row.panels):
            _draw_panel(figure, panel, margin + place * (row.width + gap), top, row)
    left = margin + len(sheet.medium) * (rows[1].width + gap)
    _draw_plot(figure, sheet, (left, tops[1], width - margin - left, rows[1].height))
    return figure


@dataclass(frozen=True)
class _Row:
    """Panels side by side, `width` pixels each, the first pixel row of their pictures at `top`."""

    panels: Sequence[Panel]
    width: int
    top: int

    @property
    def height(self) -> int:
        shapes = [panel.image.shape for panel in self.panels]
        return round(max((self.width * shape[0] / shape[1] for shape in shapes), default=0))


def _draw_panel(figure: Figure, panel: Panel, left: int, top: int, row: _Row) -> None:
    height = round(row.width * panel.image.shape[0] / panel.image.shape[1])
    size = 17 if row.width > 400 else 13.5
    line = top - 10
    label_at(figure, left, line, panel.label, size=size, fontweight="bold", va="bottom")
    # Pictures rarely fill their corners: the note keeps away from the next panel's label.
    label_at(
        figure,
        left + 0.96 * row.width,
        line,
        panel.note,
        size=size - 1,
        color=FAINT,
        va="bottom",
        ha="right",
    )
    axes = axes_at(figure, (left, top, row.width, height))
    axes.imshow(_display(panel.image, (height, row.width)), interpolation="none", aspect="auto")
    axes.axis("off")


def _display(image: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """8-bit sRGB of a linear picture on `grid` pixels, laid over the colour of the page by its coverage."""
    picture, coverage = (image[..., :3], image[..., 3:]) if image.shape[-1] == 4 else (image, 1.0)
    paper = from_srgb(np.array([int(PAPER[i : i + 2], 16) / 255 for i in (1, 3, 5)]))
    over = np.clip(picture, 0, 1) * coverage + paper * (1.0 - coverage)
    return np.rint(255 * to_srgb(np.clip(resize(over, grid), 0, 1))).astype(np.uint8)


def _draw_plot(figure: Figure, sheet: Sheet, box: tuple[int, int, int, int]) -> None:
    left, top, width, height = box
    label_at(figure, left + 70, top - 10, sheet.plot_title, size=13.5, fontweight="bold", va="bottom")
    axes = axes_at(figure, (left + 70, top, width - 70 - 118, height - 50))
    _draw_convergence(axes, sheet.solutions, sheet.rtol)


def _draw_convergence(axes: Axes, solutions: Mapping[str, Solution], rtol: float) -> None:
    checks.number("rtol", rtol, above=0.0, below=1.0)
    if not solutions:
        raise InputError("solutions is empty; there must be at least one to draw")
    _dress(axes)
    products = max([1, *(solution.products for solution in solutions.values())])
    axes.set_xlim(0, products)
    curves = {name: _curve(solution, products) for name, solution in solutions.items()}
    values = np.concatenate([y for _, y in curves.values()])
    limits = min(float(values.min()), rtol) / 2, max(2.0, 2 * float(values.max()))
    axes.set_ylim(*limits)
    axes.plot([0, products], [rtol, rtol], color=FAINT, lw=1.2, ls=(0, (4, 4)))
    axes.text(0.01 * products, rtol, "tolerance", color=FAINT, fontsize=11, va="bottom")
    others, ends = iter(OTHERS * len(solutions)), []
    for name, (x, y) in curves.items():
        colour = COLOURS.get(name) or next(others)
        # Neumann runs on top of Jacobi, which must stay visible.
        axes.plot(x, y, color=colour, lw=2.6, ls=(0, (2, 2)) if name == "neumann" else "-", clip_on=False)
        label = name if solutions[name].residual >= _LOWEST else f"{name} \u2193"
        ends.append(_End(label, colour, float(x[-1]), float(y[-1])))
    _name_curves(axes, ends, limits)


def _name_curves(axes: Axes, ends: Sequence[_End], limits: tuple[float, float]) -> None:
    """Write each name beside the end of its curve, or near it with a line to it."""
    from matplotlib.patheffects import withStroke

    size, products = axes.get_window_extent(), axes.get_xlim()[1]
    height = _LINE / size.height * float(np.log(limits[1] / limits[0]))
    gap, letter = 0.025 * products, _LETTER / size.width * products
    edge = withStroke(linewidth=3, foreground=PAPER)  # where a name crosses other curves
    for end, y in zip(ends, _apart(ends, limits, letter, height), strict=True):
        if y != end.y:
            axes.plot([end.x, end.x + gap], [end.y, y], color=end.colour, lw=0.8, alpha=0.6, clip_on=False)
        text = axes.text(
            end.x + gap, y, end.name, color=end.colour, fontsize=12, va="center", fontweight="bold"
        )
        text.set_path_effects([edge])


def _dress(axes: Axes) -> None:
    from matplotlib.ticker import LogLocator, MaxNLocator

    axes.set_facecolor(PAPER)
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(10, numticks=8))
    axes.minorticks_off()
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    axes.grid(color=GRID, lw=1)
    axes.tick_params(colors=FAINT, labelsize=11, length=0, pad=7)
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.set_xlabel("products with S", color=FAINT, fontsize=12, labelpad=6)
    axes.set_ylabel("relative residual", color=FAINT, fontsize=12, labelpad=6)


def _curve(solution: Solution, products: int) -> tuple[np.ndarray, np.ndarray]:
    """Products and residuals of a solve; a direct one is a level line across."""
    if solution.method == "direct":
        return np.array([0, products]), np.full(2, max(solution.residual, _LOWEST))
    y = np.array([value for value in solution.residuals if np.isfinite(value)] or [1.0])
    return np.linspace(0, max(solution.products, 1), len(y)), np.maximum(y, _LOWEST)


@dataclass(frozen=True)
class _End:
    """Where a curve ends and its name is written."""

    name: str
    colour: str
    x: float
    y: float


def _apart(ends: Sequence[_End], limits: tuple[float, float], letter: float, height: float) -> list[float]:
    """Heights for the names of curves, each as near to the end of its curve as others leave room for it.

    `letter` is the width of one along x, `height` that of a line, in units of log y. Names that do not meet
    along x may stand at one height.
    """
    low, high = np.log(limits)
    placed: dict[int, float] = {}
    for i in sorted(range(len(ends)), key=lambda i: ends[i].y):
        end, wanted = ends[i], float(np.log(ends[i].y))
        near = [y for j, y in placed.items() if _meet(end, ends[j], letter)]
        places = [wanted, *(y + side * height for y in near for side in (1.0, -1.0))]
        free = [
            y for y in places if all(abs(y - other) >= 0.999 * height for other in near) and low <= y <= high
        ]
        placed[i] = min(free or [wanted], key=lambda y: abs(y - wanted))
    return [
        ends[i].y if placed[i] == np.log(ends[i].y) else float(np.exp(placed[i])) for i in range(len(ends))
    ]


def _meet(one: _End, other: _End, letter: float) -> bool:
    """Whether two names at one height would touch."""
    left, right = sorted((one, other), key=lambda end: end.x)
    return right.x < left.x + letter * (len(left.name) + 1)
