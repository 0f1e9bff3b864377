# SPDX-License-Identifier: BSD-3-Clause
"""Shared by the benches of the paper's figures: claims that are checked, and the page of a drawing.

A claim of the paper is measured on every run, and one that fails ends the bench with exit status 1.
Where exact transport disagrees with the paper the claim says why in `differs`; it must then not
hold, so that the remark cannot outlive its reason.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from _harness import Options, publish
from ltcl.images import from_srgb, to_srgb
from ltcl.plots.page import FAINT, GRID, PAPER, axes_at, figure_of, heading, label_at
from ltcl.scenes import Scene

# Left, top, width and height in pixels, from the top left corner.
Box = tuple[float, float, float, float]
# Pixels of the page, of its margin, and of a view of a scene.
WIDTH = 1000
MARGIN = 30
SIZE = 400


@dataclass(frozen=True)
class Claim:
    """A sentence about a figure, the measured value, and the value it had to have.

    `differs` says why exact measurement does not confirm a claim of the paper.
    """

    text: str
    measured: str
    wanted: str
    holds: bool
    differs: str = ""

    def __post_init__(self) -> None:
        # Comparisons of arrays give NumPy's own booleans, which JSON does not know.
        object.__setattr__(self, "holds", bool(self.holds))

    @property
    def passed(self) -> bool:
        """Whether the claim holds, or is known to differ and does."""
        return self.holds != bool(self.differs)

    @property
    def verdict(self) -> str:
        """Result of the check, for the table."""
        if self.differs and self.passed:
            return f"DIFFERS: {self.differs}"
        if self.differs:
            return "FAILS: holds, though it is said to differ"
        return "holds" if self.passed else "FAILS"


def conclude(
    options: Options,
    title: str,
    claims: Sequence[Claim],
    facts: dict[str, Any],
    draw: Callable[[], Figure],
) -> None:
    """Publish the claims, and exit with 1 if one is not as expected."""
    table = Table("claim", "measured", "wanted", "verdict", show_lines=True)
    for claim in claims:
        table.add_row(claim.text, claim.measured, claim.wanted, claim.verdict)
    records = [{**dataclasses.asdict(claim), "verdict": claim.verdict} for claim in claims]
    publish(options, title, facts, table, {"claims": records}, draw)
    if not all(claim.passed for claim in claims):
        raise SystemExit(1)


def values(rows: Iterable[Any], attribute: str) -> np.ndarray:
    """One attribute of all rows, stacked."""
    return np.array([getattr(row, attribute) for row in rows])


def page(height: int, title: str, *subtitle: str) -> Figure:
    """Make a page with a title and lines below it: 80 pixels, and 22 more for each further line."""
    figure = figure_of(WIDTH, height)
    heading(figure, MARGIN, 20, title, 17)
    for number, line in enumerate(subtitle):
        label_at(figure, MARGIN, 52 + 22 * number, line, size=11, color=FAINT)
    return figure


def columns(count: int, gap: int = 14) -> tuple[list[float], float]:
    """Left edges and common width of pictures side by side."""
    width = (WIDTH - 2 * MARGIN - (count - 1) * gap) / count
    lefts = [MARGIN + number * (width + gap) for number in range(count)]
    return lefts, width


def picture(
    figure: Figure, place: tuple[float, float, float], image: np.ndarray, label: str, note: str = ""
) -> None:
    """Draw an image (h, w, 3), sRGB in [0, 1], with a label of 20 pixels above and a note below.

    `place` is left, top and width in pixels.
    """
    left, top, width = place
    height = width * image.shape[0] / image.shape[1]
    style = {"size": 10.5, "fontweight": "bold", "va": "bottom"}
    label_at(figure, left, top - 6, label, **style)
    axes = axes_at(figure, (left, top, width, height))
    axes.imshow(image, interpolation="antialiased", aspect="auto")
    axes.axis("off")
    below = top + height + 5
    label_at(figure, left, below, note, size=9.5, color=FAINT, linespacing=1.35)


def pictures(figure: Figure, top: float, images: Sequence[tuple[Any, ...]], gap: int = 14) -> None:
    """Draw (image, label) or (image, label, note) side by side."""
    lefts, width = columns(len(images), gap)
    for left, (image, *text) in zip(lefts, images, strict=True):
        picture(figure, (left, top, width), image, *text)


def graph(
    figure: Figure, box: Box, title: str, xlabel: str, ylabel: str, scale: str = "log"
) -> Axes:
    """Make axes for curves, in the colours of the page; the title is 26 pixels above the box."""
    axes = axes_at(figure, box)
    axes.set_yscale(scale)
    label_at(figure, box[0], box[1] - 8, title, size=11, fontweight="bold", va="bottom")
    axes.set_facecolor(PAPER)
    axes.grid(color=GRID, lw=1)
    axes.set_axisbelow(True)
    axes.tick_params(colors=FAINT, labelsize=9.5, length=0)
    axes.minorticks_off()
    axes.spines[:].set_visible(False)
    axes.set_xlabel(xlabel, color=FAINT, fontsize=10)
    axes.set_ylabel(ylabel, color=FAINT, fontsize=10)
    return axes


def legend(axes: Axes, size: float = 10, labelcolor: str = "linecolor", **place: Any) -> None:
    """Name the curves, each in its own colour by default."""
    style = {"frameon": False, "fontsize": size, "labelcolor": labelcolor}
    axes.legend(**style, **place)


def light(scene: Scene, values: np.ndarray, gain: float = 1.0) -> np.ndarray:
    """Linear light on the walls as the viewer sees it, sRGB on the page's colour.

    Negative light is black.
    """
    linear = np.clip(gain * _view(scene, values), 0, 1)
    return _on_page(scene, to_srgb(linear))


def signed(scene: Scene, values: np.ndarray, gain: float = 1.0) -> np.ndarray:
    """Positive and negative light around neutral grey, which is 0: each colour for itself."""
    image = np.clip(0.5 + 0.5 * gain * _view(scene, values), 0, 1)
    return _on_page(scene, image)


def _view(scene: Scene, values: np.ndarray) -> np.ndarray:
    image = scene.view(values, SIZE, supersample=2)
    if image.ndim == 3:
        return image
    return np.repeat(image[..., None], 3, axis=-1)


@functools.cache
def _coverage(scene: Scene) -> np.ndarray:
    """Share of each pixel of a view that walls fill."""
    return scene.view(np.ones(scene.grid), SIZE, supersample=2)


def _on_page(scene: Scene, image: np.ndarray) -> np.ndarray:
    """Blend a view, sRGB, with the page where no wall is seen."""
    coverage = _coverage(scene)[..., None]
    paper_codes = [int(PAPER[start : start + 2], 16) / 255 for start in (1, 3, 5)]
    paper = from_srgb(np.array(paper_codes))
    blended = from_srgb(image) * coverage + paper * (1 - coverage)
    return np.clip(to_srgb(blended), 0, 1)
