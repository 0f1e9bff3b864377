# SPDX-License-Identifier: BSD-3-Clause
"""What the benches of the paper's figures share: claims that are checked, and the page they are drawn on.

A claim of the paper is measured on every run, and one that fails ends the bench with exit status 1.
Where exact transport disagrees with the paper the claim says why in `differs`; it must then not
hold, so that the remark cannot outlive its reason.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
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

Box = tuple[
    float, float, float, float
]  # left, top, width and height in pixels, from the top left corner
WIDTH, MARGIN, SIZE = 1000, 30, 400  # pixels of the page, and of a view


@dataclass(frozen=True)
class Claim:
    """One sentence about a figure, what was measured, and what it had to be.

    `differs` is for a claim of the paper that exact measurement does not bear out: why it does not.
    """

    text: str
    measured: str
    wanted: str
    holds: bool
    differs: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "holds", bool(self.holds)
        )  # comparisons of arrays give NumPy's own

    @property
    def passed(self) -> bool:
        """Whether the measurement is as expected: the claim holds, or is known to differ and does."""
        return self.holds != bool(self.differs)

    @property
    def verdict(self) -> str:
        """What the table says."""
        if self.differs:
            return (
                f"DIFFERS: {self.differs}"
                if self.passed
                else "FAILS: holds, though it is said to differ"
            )
        return "holds" if self.passed else "FAILS"


def conclude(
    given: Options,
    title: str,
    claims: Sequence[Claim],
    facts: dict[str, Any],
    draw: Callable[[], Figure],
) -> None:
    """Publish the claims, and exit with 1 if one is not as expected."""
    table = Table("claim", "measured", "wanted", "verdict", show_lines=True)
    for claim in claims:
        table.add_row(claim.text, claim.measured, claim.wanted, claim.verdict)
    listed = [{**dataclasses.asdict(claim), "verdict": claim.verdict} for claim in claims]
    publish(given, title, facts, table, {"claims": listed}, draw)
    if not all(claim.passed for claim in claims):
        raise SystemExit(1)


def page(height: int, title: str, *subtitle: str) -> Figure:
    """A page with a title and a few lines below it; 80 pixels, and 22 more for each further line."""
    figure = figure_of(WIDTH, height)
    heading(figure, MARGIN, 20, title, 17)
    for place, line in enumerate(subtitle):
        label_at(figure, MARGIN, 52 + 22 * place, line, size=11, color=FAINT)
    return figure


def columns(count: int, gap: int = 14) -> tuple[list[float], float]:
    """Left edges and common width of so many pictures side by side."""
    width = (WIDTH - 2 * MARGIN - (count - 1) * gap) / count
    return [MARGIN + place * (width + gap) for place in range(count)], width


def picture(
    figure: Figure, place: tuple[float, float, float], image: np.ndarray, label: str, note: str = ""
) -> None:
    """Draw an image (h, w, 3), sRGB in [0, 1], with a label of 20 pixels above and a note below."""
    left, top, width = place  # in pixels
    height = width * image.shape[0] / image.shape[1]
    label_at(figure, left, top - 6, label, size=10.5, fontweight="bold", va="bottom")
    axes = axes_at(figure, (left, top, width, height))
    axes.imshow(image, interpolation="antialiased", aspect="auto")
    axes.axis("off")
    label_at(figure, left, top + height + 5, note, size=9.5, color=FAINT, linespacing=1.35)


def pictures(figure: Figure, top: float, shown: Sequence[tuple[Any, ...]], gap: int = 14) -> None:
    """Draw (image, label) or (image, label, note) side by side."""
    lefts, width = columns(len(shown), gap)
    for left, (image, *text) in zip(lefts, shown, strict=True):
        picture(figure, (left, top, width), image, *text)


def graph(
    figure: Figure, box: Box, title: str, xlabel: str, ylabel: str, scale: str = "log"
) -> Axes:
    """Axes for curves, in the colours of the page; the title stands 26 pixels above the box."""
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


def light(scene: Scene, values: np.ndarray, gain: float = 1.0) -> np.ndarray:
    """Linear light on the walls as the viewer sees it, sRGB on the page's colour; negative light is black."""
    return _on_page(scene, to_srgb(np.clip(gain * _view(scene, values), 0, 1)))


def signed(scene: Scene, values: np.ndarray, gain: float = 1.0) -> np.ndarray:
    """Positive and negative light around neutral grey, which is 0: each colour for itself."""
    return _on_page(scene, np.clip(0.5 + 0.5 * gain * _view(scene, values), 0, 1))


def _view(scene: Scene, values: np.ndarray) -> np.ndarray:
    image = scene.view(values, SIZE, supersample=2)
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=-1)


@functools.cache
def _coverage(scene: Scene) -> np.ndarray:
    """Share of each pixel of a view that walls fill."""
    return scene.view(np.ones(scene.grid), SIZE, supersample=2)


def _on_page(scene: Scene, image: np.ndarray) -> np.ndarray:
    coverage = _coverage(scene)[..., None]
    paper = from_srgb(np.array([int(PAPER[i : i + 2], 16) / 255 for i in (1, 3, 5)]))
    return np.clip(to_srgb(from_srgb(image) * coverage + paper * (1 - coverage)), 0, 1)
