# SPDX-License-Identifier: BSD-3-Clause
"""What an analysis says: where rho(R) lies, and the products that each method will need."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from ltcl.analysis import Analysis, ChannelAnalysis
from ltcl.errors import InputError
from ltcl.plots.page import COLOURS, FAINT, GRID, INK, OTHERS, PAPER, figure_of, heading

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CHANNELS = {1: ("",), 3: (" red", " green", " blue")}


def analysis(found: Mapping[str, Analysis]) -> Figure:
    """Bounds on rho(R) of every transport and channel, and its forecast per method.

    Parameters
    ----------
    found : mapping of name to Analysis

    Returns
    -------
    Figure
        Left the interval that holds rho(R), with the 1 beyond which the paper's series diverges; right the
        products of each method, where there is a forecast.

    Raises
    ------
    InputError
        Nothing to draw.

    Examples
    --------
    >>> import ltcl
    >>> T = ltcl.scenes.box(3, albedo=0.8).transport()
    >>> figure = analysis({"room": ltcl.analyze(T)})
    >>> [axes.get_title("left") for axes in figure.axes]
    ['spectral radius of R', 'products to 1 %']
    """
    if not found:
        raise InputError("found is empty; there must be at least one analysis to draw")
    channels = {
        f"{name}{colour}": channel
        for name, one in found.items()
        for colour, channel in zip(_CHANNELS[len(one.channels)], one.channels, strict=True)
    }
    figure = figure_of(1300, 330 + 46 * len(channels))
    heading(figure, 34, 26, "Before solving", 17)
    left, right = figure.add_axes((0.16, 0.2, 0.33, 0.58)), figure.add_axes((0.58, 0.2, 0.38, 0.58))
    _dress(left, "spectral radius of R", "rho(R), between its bounds")
    _draw_radii(left, channels)
    tolerance = next(iter(found.values())).rtol
    _dress(right, f"products to {100 * tolerance:g} %", "products with S, sweeps of Gauss-Seidel")
    _draw_products(right, channels)
    return figure


def _dress(axes: Axes, title: str, label: str) -> None:
    axes.set_facecolor(PAPER)
    axes.set_title(title, color=INK, fontsize=13, loc="left", fontweight="bold")
    axes.set_xlabel(label, color=FAINT, fontsize=11)
    axes.grid(color=GRID, lw=1, axis="x")
    axes.set_axisbelow(True)
    axes.tick_params(colors=FAINT, labelsize=11, length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _draw_radii(axes: Axes, channels: Mapping[str, ChannelAnalysis]) -> None:
    colour = COLOURS["chebyshev"]
    limit = 1.6 * max(1.0, *(channel.spectral_radius for channel in channels.values()))
    for row, channel in enumerate(channels.values()):
        lower, upper = channel.spectral_radius_bounds
        upper = upper if math.isfinite(upper) else channel.spectral_radius
        axes.plot([lower, upper], [row, row], color=colour, lw=7, alpha=0.6, solid_capstyle="butt")
        axes.plot([channel.spectral_radius], [row], "|", color=INK, ms=16, mew=2)
        said = channel.spectral_radius_certificate
        axes.text(limit, row, said, color=FAINT, fontsize=9, ha="right", va="center")
    axes.axvline(1.0, color=COLOURS["jacobi"], lw=1.2, ls=(0, (4, 4)))
    axes.set_xlim(0, limit)
    axes.set_ylim(len(channels) - 0.4, -0.6)
    axes.set_yticks(range(len(channels)), list(channels))


def _draw_products(axes: Axes, channels: Mapping[str, ChannelAnalysis]) -> None:
    methods = list(next(iter(channels.values())).products)
    height = 0.8 / len(channels)
    others = iter(OTHERS * len(methods))
    colours = {name: COLOURS.get(name) or next(others) for name in methods}
    counts = [n for channel in channels.values() for n in channel.products.values() if math.isfinite(n)]
    for row, channel in enumerate(channels.values()):
        for place, name in enumerate(methods):
            y = place - 0.4 + (row + 0.5) * height
            n = channel.products[name]
            if math.isfinite(n):
                axes.barh(y, n, 0.85 * height, color=colours[name])
            said = f"{n:g}" if math.isfinite(n) else "diverges" if n > 0 else "no forecast"
            size = float(np.clip(60 * height, 6, 11))
            axes.text(n if math.isfinite(n) else 0, y, f"  {said}", color=FAINT, va="center", fontsize=size)
    axes.set_xlim(0, 1.25 * max(counts, default=1))
    axes.set_ylim(len(methods) - 0.4, -0.6)
    axes.set_yticks(range(len(methods)), methods)
