# SPDX-License-Identifier: BSD-3-Clause
"""Parts of all plots: the dark page, its colours, text and axes in pixels, and saving."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from ltcl import checks
from ltcl.errors import InputError
from ltcl.files import replace_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ltcl.plots.shown_figure import ShownFigure

DPI = 100
PAPER = "#15171b"
INK = "#f1efea"
FAINT = "#9aa1ab"
GRID = "#2b2f36"
COLOURS = {"chebyshev": "#5cc8ff", "jacobi": "#ff5d5d", "neumann": "#ffb347", "direct": "#8bd17c"}
OTHERS = ("#c792ea", "#f78fb3", "#7fdbca", "#d6deeb", "#ffd866", "#9fb4ff", "#e0a37a", "#b5e853")


def save(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure in a format of matplotlib; an earlier file is replaced whole or not at all."""
    known = figure.canvas.get_supported_filetypes()
    extension = os.path.splitext(path)[1].lstrip(".").lower()
    if extension not in known:
        formats = ", ".join(sorted(known))
        raise InputError(f"{path}: extension is {extension!r}; plots are saved as {formats}")
    with replace_file(path) as temporary:
        figure.savefig(temporary, dpi=DPI, facecolor=figure.get_facecolor())


def figure_of(width: int, height: int) -> ShownFigure:
    """An empty page of so many pixels, drawn by Agg."""
    checks.load_extra("matplotlib", "plots", "a plot")
    from ltcl.plots.shown_figure import ShownFigure

    return ShownFigure(width, height, DPI, PAPER)


def label_at(figure: Figure, x: float, y: float, text: str, *, size: float, **style: Any) -> None:
    """Draw text whose top is `y` pixels below the figure's top; a point has 1.4 pixels."""
    width, height = figure.get_size_inches() * DPI
    style = {"va": "top", "color": INK, **style}
    figure.text(x / width, 1 - y / height, text, fontsize=size, **style)


def heading(figure: Figure, x: float, y: float, text: str, size: float) -> None:
    """Bold text whose top is `y` pixels below the top of the figure."""
    label_at(figure, x, y, text, size=size, fontweight="bold")


def axes_at(figure: Figure, box: tuple[float, float, float, float]) -> Axes:
    """Axes in pixels: left, top, width, height, from the top left corner of the figure."""
    width, height = figure.get_size_inches() * DPI
    left, top, w, h = box
    return figure.add_axes((left / width, 1 - (top + h) / height, w / width, h / height))
