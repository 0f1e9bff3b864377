# SPDX-License-Identifier: BSD-3-Clause
"""Figures: pictures under their names, the convergence of solves, the results of an analysis."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError, InputTypeError
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
from ltcl.tasks.analysis import Analysis, ChannelAnalysis

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Residuals below are drawn at this level: products in float32 end above it.
LOWEST_RESIDUAL = 1e-8
DASHES = (0, (4, 4))
SHORT_DASHES = (0, (2, 2))


def convergence(
    solutions: Mapping[str, Solution] | Solution, rtol: float, title: str = "Convergence"
) -> Figure:
    """Relative residual of several solves of one system against the products they took.

    They are named, or one is given alone. Solve with ``throw=False``, so that a divergence shows as
    well. A direct solve becomes a level line. InputError if there is nothing to draw, or rtol is
    outside (0, 1).

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
    axes = figure.add_axes((0.09, 0.13, 0.73, 0.72))
    if isinstance(solutions, Solution):
        solutions = {solutions.method: solutions}
    _check_named("solutions", solutions, Solution)
    _draw_convergence(axes, solutions, rtol)
    return figure


def analysis(analyses: Mapping[str, Analysis] | Analysis) -> Figure:
    """Bounds on rho(R) of every transport by name, per channel, and its forecast per method.

    One may be given without a name. On the left is the interval that holds rho(R), with the 1
    beyond which the paper's series diverges; on the right are the products of each method, where
    there is a forecast. InputError if there is nothing to draw.

    Examples
    --------
    >>> import ltcl
    >>> T = ltcl.scenes.box(3, albedo=0.8).transport()
    >>> figure = analysis({"room": ltcl.analyze(T)})
    >>> [axes.get_title("left") for axes in figure.axes]
    ['spectral radius of R', 'products to 1 %']
    """
    if isinstance(analyses, Analysis):
        analyses = {"T": analyses}
    _check_named("analyses", analyses, Analysis)
    channels = _named_channels(analyses)
    first_analysis = next(iter(analyses.values()))
    figure = figure_of(1300, 330 + 46 * len(channels))
    heading(figure, 34, 26, "Before solving", 17)
    left = figure.add_axes((0.16, 0.2, 0.33, 0.58))
    right = figure.add_axes((0.58, 0.2, 0.38, 0.58))
    _dress(left, "rho(R), between its bounds", "spectral radius of R")
    tolerance = f"{100 * first_analysis.rtol:g} %"
    _dress(right, "products with S, sweeps of Gauss-Seidel", f"products to {tolerance}")
    _draw_radii(left, channels)
    _draw_products(right, list(channels.values()))
    return figure


def _check_named(name: str, values: Any, kind: type) -> None:
    """Refuse anything but a dictionary with values of a kind."""
    _check_mapping(name, values)
    if not values:
        raise InputError(f"{name} is empty; there must be at least one to draw")
    for key, value in values.items():
        if not isinstance(value, kind):
            problem = f"{name}[{key!r}] is a {type(value).__name__}"
            raise InputTypeError(f"{problem}; it must be a {kind.__name__}")


def _check_mapping(name: str, values: Any) -> None:
    if not isinstance(values, Mapping):
        problem = f"{name} is a {type(values).__name__}"
        raise InputTypeError(f"{problem}; it must be a dictionary by names")


def _named_channels(analyses: Mapping[str, Analysis]) -> dict[str, ChannelAnalysis]:
    """The channels of all transports, by the names of these and of their colours."""
    channels = {}
    for name, transport in analyses.items():
        if len(transport.channels) == 1:
            channels[name] = transport.channels[0]
            continue
        for colour, channel in zip(("red", "green", "blue"), transport.channels, strict=True):
            channels[f"{name} {colour}"] = channel
    return channels


def _draw_radii(axes: Axes, channels: Mapping[str, ChannelAnalysis]) -> None:
    """The interval of the spectral radius of each channel, with its certificate."""
    radii = [channel.spectral_radius for channel in channels.values()]
    limit = 1.6 * max(1.0, *radii)
    for row, channel in enumerate(channels.values()):
        lower, upper = channel.spectral_radius_bounds
        if not math.isfinite(upper):
            upper = channel.spectral_radius
        axes.barh(row, upper - lower, 0.2, lower, color=COLOURS["chebyshev"], alpha=0.6)
        axes.plot([channel.spectral_radius], [row], "|", color=INK, ms=16, mew=2)
        certificate = channel.spectral_radius_certificate
        axes.text(limit, row, certificate, color=FAINT, fontsize=9, ha="right", va="center")
    axes.axvline(1.0, color=COLOURS["jacobi"], lw=1.2, ls=DASHES)
    axes.set(xlim=(0, limit), ylim=(len(channels) - 0.4, -0.6))
    axes.set_yticks(range(len(channels)), list(channels))


def _draw_products(axes: Axes, channels: list[ChannelAnalysis]) -> None:
    """A bar for each method and channel, as long as its forecast of products."""
    methods = list(channels[0].products)
    colours = _colours(methods)
    height = 0.8 / len(channels)
    font_size = float(np.clip(60 * height, 6, 11))
    for row, channel in enumerate(channels):
        for place, name in enumerate(methods):
            products = channel.products[name]
            y = place - 0.4 + (row + 0.5) * height
            length = np.nan_to_num(products, posinf=0.0)
            bar = axes.barh(y, length, 0.85 * height, color=colours[name])
            label = f"  {_forecast(products)}"
            axes.bar_label(bar, [label], color=FAINT, fontsize=font_size)
    axes.margins(x=0.25)
    axes.set_ylim(len(methods) - 0.4, -0.6)
    axes.set_yticks(range(len(methods)), methods)


def _forecast(products: float) -> str:
    """A forecast of products in words: infinite where the method diverges, NaN where unknown."""
    if math.isfinite(products):
        return f"{products:g}"
    return "diverges" if products > 0 else "no forecast"


def pictures(
    *rows: Mapping[str, Any], title: str = "", subtitle: str = "", width: int = 1000
) -> Figure:
    r"""Linear pictures in rows, each row as wide as the page, under their names.

    A picture is (h, w) or (h, w, 3), cut off beyond 0 and 1; black is the page, as beside the walls
    of a view. Small ones are enlarged, each pixel a square. A second line of a name is a note, in
    small letters. InputError if there is no picture, or one has another shape.

    Examples
    --------
    >>> import ltcl
    >>> scene = ltcl.scenes.dihedral(4)
    >>> seen = scene.view(scene.transport() @ np.full(scene.grid, 0.5), size=64)
    >>> figure = pictures({"seen": seen, "too bright\nthree times": 3 * seen}, title="A corner")
    >>> [text.get_text() for text in figure.texts if text.get_text()]
    ['A corner', 'seen', 'too bright', 'three times']
    """
    for row in rows:
        _check_mapping("rows", row)
    rows = tuple(row for row in rows if row)
    width = checks.count("width", width, least=100)
    if not rows:
        raise InputError("rows hold no picture; there must be at least one to draw")
    page = _Page(width)
    top = page.below_heading(title, subtitle)
    placed: list[_PlacedPicture] = []
    for row in rows:
        checked = {name: as_picture(name, image) for name, image in row.items()}
        in_row = page.place_row(checked, top)
        top = max(picture.bottom for picture in in_row) + 16 * page.scale
        placed += in_row

    figure = figure_of(width, math.ceil(top))
    page.draw_heading(figure, title, subtitle)
    for picture in placed:
        picture.draw(figure)
    return figure


class _Page:
    """Margins and sizes of a page of pictures, in pixels."""

    def __init__(self, width: int) -> None:
        self.width = width
        self.scale = max(width / 1000, 0.85)  # of text
        self.margin = round(0.025 * width)
        self.gap = round(0.016 * width)

    def below_heading(self, title: str, subtitle: str) -> float:
        """Top of the first row."""
        top = 26.0
        if title:
            top += 34
        if subtitle:
            top += 24 * (subtitle.count("\n") + 1)
        return top * self.scale

    def draw_heading(self, figure: Figure, title: str, subtitle: str) -> None:
        """Title and subtitle."""
        heading(figure, self.margin, 18 * self.scale, title, 17 * self.scale)
        top = self.scale * (52 if title else 18)
        label_at(figure, self.margin, top, subtitle, size=11 * self.scale, color=FAINT)

    def place_row(self, row: Mapping[str, np.ndarray], top: float) -> list[_PlacedPicture]:
        """Pictures side by side, as wide as the page, their names above."""
        room = self.width - 2 * self.margin - (len(row) - 1) * self.gap
        side = room / len(row)
        text_scale = self.scale * float(np.clip(side / 300, 0.8, 1.15))
        has_notes = any("\n" in name for name in row)
        name_height = text_scale * (42 if has_notes else 24)
        placed = []
        for place, (name, image) in enumerate(row.items()):
            placed.append(
                _PlacedPicture(
                    name=name,
                    image=image,
                    text_scale=text_scale,
                    name_top=top,
                    left=self.margin + place * (side + self.gap),
                    top=top + name_height,
                    width=side,
                )
            )
        return placed


@dataclass(frozen=True, kw_only=True, eq=False)
class _PlacedPicture:
    """A picture with its name, at a place on the page."""

    name: str
    image: np.ndarray
    text_scale: float
    name_top: float
    left: float
    top: float
    width: float

    @property
    def height(self) -> float:
        return self.width * self.image.shape[0] / self.image.shape[1]

    @property
    def bottom(self) -> float:
        return self.top + self.height

    def draw(self, figure: Figure) -> None:
        """Draw the name, its note and the picture."""
        size = self.text_scale
        label, _, note = self.name.partition("\n")
        heading(figure, self.left, self.name_top, label, 12 * size)
        note_top = self.name_top + 21 * size
        label_at(figure, self.left, note_top, note, size=10.5 * size, color=FAINT)
        _draw_picture(figure, (self.left, self.top, self.width, self.height), self.image)


def _draw_picture(
    figure: Figure, box: tuple[float, float, float, float], image: np.ndarray
) -> None:
    """Draw a linear picture; what is black becomes the page."""
    # Agg does not resample whole pixels.
    left, top, w, h = (max(round(side), 1) for side in box)
    is_black = (np.atleast_3d(image) == 0).all(axis=-1)
    black = resize(is_black.astype(np.float32), (h, w)) > 0.999
    enlargement = w // image.shape[1]
    if enlargement:  # to more than is drawn: squares with sharp edges
        image = image.repeat(enlargement + 1, axis=0).repeat(enlargement + 1, axis=1)
    light = np.clip(resize(image, (h, w)), 0, 1)
    codes = np.broadcast_to(np.atleast_3d(to_srgb(light)), (h, w, 3))
    paper = np.array([int(PAPER[start : start + 2], 16) / 255 for start in (1, 3, 5)])
    codes = np.where(black[..., None], paper, codes)
    codes = np.rint(255 * codes).astype(np.uint8)
    axes = axes_at(figure, (left, top, w, h))
    axes.imshow(codes, interpolation="none", aspect="auto")
    axes.axis("off")


def _draw_convergence(axes: Axes, solutions: Mapping[str, Solution], rtol: float) -> None:
    """A line for each solve, and the tolerance."""
    from matplotlib.ticker import LogLocator, MaxNLocator

    checks.number("rtol", rtol, above=0.0, below=1.0)
    _dress(axes, "products with S")
    axes.set_ylabel("relative residual", color=FAINT, fontsize=12, labelpad=6)
    most_products = max(1, *(solution.products for solution in solutions.values()))
    colours = _colours(solutions)
    lowest = rtol
    highest = 1.0
    for name, solution in solutions.items():
        products, residuals = _convergence_line(solution, most_products)
        lowest = min(lowest, float(residuals.min()))
        highest = max(highest, float(residuals.max()))
        label = name
        if solution.residual < LOWEST_RESIDUAL:
            label = f"{name} \u2193"
        style: Any = "-"
        if name == "neumann":
            # Neumann runs on top of Jacobi, which must stay visible.
            style = SHORT_DASHES
        axes.plot(
            products, residuals, color=colours[name], lw=2.6, ls=style, clip_on=False, label=label
        )
    axes.plot([0, most_products], [rtol, rtol], color=FAINT, lw=1.2, ls=DASHES, label="tolerance")
    axes.set(yscale="log", xlim=(0, most_products), ylim=(lowest / 2, 2 * highest))
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


def _convergence_line(solution: Solution, most_products: int) -> tuple[np.ndarray, np.ndarray]:
    """Products and residuals of one solve; a direct solve is a level line."""
    if solution.method == "direct":
        products = np.array([0, most_products])
        residuals = np.full(2, solution.residual)
    else:
        residuals = np.array(solution.residuals)
        residuals = residuals[np.isfinite(residuals)]
        if residuals.size == 0:
            residuals = np.ones(1)
        products = np.linspace(0, max(solution.products, 1), len(residuals))
    return products, np.maximum(residuals, LOWEST_RESIDUAL)


def _dress(axes: Axes, label: str, title: str = "") -> None:
    """Colours and labels of axes on the dark page."""
    axes.set_facecolor(PAPER)
    axes.set_xlabel(label, color=FAINT, fontsize=12, labelpad=6)
    axes.grid(color=GRID, lw=1, axis="x")
    axes.set_axisbelow(True)
    axes.tick_params(colors=FAINT, labelsize=11, length=0, pad=7)
    axes.spines[:].set_visible(False)
    if title:
        axes.set_title(title, color=INK, fontsize=13, loc="left", fontweight="bold")


def _colours(names: Iterable[str]) -> dict[str, str]:
    """A colour for each name: those of well-known methods, others in turn."""
    colours = {}
    others = 0
    for name in names:
        if name in COLOURS:
            colours[name] = COLOURS[name]
        else:
            colours[name] = OTHERS[others % len(OTHERS)]
            others += 1
    return colours
