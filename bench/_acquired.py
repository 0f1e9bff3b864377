# SPDX-License-Identifier: BSD-3-Clause
"""What acquisitions of different sizes cost, and how that is drawn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

import _figures as figures

_NAMES = {"adaptive": "adaptive", "hadamard": "S-matrices", "pixel": "one at a time"}
_COLOURS = {"adaptive": "#c0392b", "hadamard": "#2a7f9e", "pixel": "#e0b34c"}


@dataclass(frozen=True)
class Cost:
    """Of one acquisition: photographs and seconds of exposure, as planned and as taken; seconds it ran."""

    strategy: str
    pixels: int
    planned: int
    photographs: int
    planned_exposure: float
    exposure: float
    seconds: float


def draw(costs: list[Cost]) -> Figure:
    """Photographs, time of exposure and time of computing against pixels; dashed what plans said."""
    figure = figures.page(
        440,
        "What it takes to measure a transport",
        "A corner of n x n pixels, a camera of 12 bits. Dashed: what plans said.",
    )
    parts: list[tuple[str, Callable[[Cost], float], Callable[[Cost], float] | None]] = [
        ("photographs", lambda one: one.photographs, lambda one: one.planned),
        ("hours of exposure", lambda one: one.exposure / 3600, lambda one: one.planned_exposure / 3600),
        ("seconds of computing", lambda one: one.seconds, None),
    ]
    for place, (title, taken, planned) in enumerate(parts):
        axes = figures.graph(figure, (70 + 320 * place, 140, 260, 230), title, "pixels", "")
        for strategy in _NAMES:
            _line(axes, [one for one in costs if one.strategy == strategy], taken, planned)
        sides = sorted({round(one.pixels**0.5) for one in costs})
        axes.set_xscale("log")
        axes.set_xticks([n * n for n in sides], [f"{n}\u00b2" for n in sides])
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
        axes.minorticks_off()
        if place == 0:
            axes.legend(frameon=False, labelcolor=figures.FAINT, fontsize=9.5)
    return figure


def _line(
    axes: Axes, costs: list[Cost], taken: Callable[[Cost], float], planned: Callable[[Cost], float] | None
) -> None:
    strategy, pixels = costs[0].strategy, [one.pixels for one in costs]
    colour = _COLOURS[strategy]
    width = 4 if strategy == "hadamard" else 1.5  # it lies below another line
    taken_of = [taken(one) for one in costs]
    axes.plot(pixels, taken_of, "o-", ms=4, lw=width, color=colour, label=_NAMES[strategy])
    if planned is not None:
        axes.plot(pixels, [planned(one) for one in costs], "--", lw=1, color=colour)
