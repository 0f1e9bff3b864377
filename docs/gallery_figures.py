# SPDX-License-Identifier: BSD-3-Clause
"""Scraper for sphinx-gallery: saves each figure that a block of an example leaves in a variable.

Figures are drawn without pyplot. Each picture in a figure is saved, too, not to be shown but as a
thumbnail: of a first figure with three pictures `sphinx_gallery_thumbnail_number` is 1 for all of
it and 2 to 4 for these.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from weakref import WeakSet

from matplotlib.figure import Figure
from PIL import Image
from sphinx_gallery.scrapers import figure_rst

from ltcl.plots.shown_figure import ShownFigure

_shown: WeakSet[Figure] = WeakSet()


def _leave_to_the_page(self: ShownFigure, warn: bool = True) -> None:
    """Do nothing: `scrape` saves the figure for the page, and no window is to open."""


ShownFigure.show = _leave_to_the_page


def scrape(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Save the new figures of a block; return lines that show them, with titles for the blind."""
    paths, titles = [], []
    for value in [*block_vars["example_globals"].values()]:
        if isinstance(value, Figure) and value not in _shown:
            _shown.add(value)
            paths.append(next(block_vars["image_path_iterator"]))
            titles += [text.get_text() for text in value.texts if "$" not in text.get_text()][:4]
            value.savefig(paths[-1], facecolor=value.get_facecolor())
            for picture in (each for axes in value.axes for each in axes.images):
                if picture.get_array().ndim == 3:
                    values = picture.to_rgba(picture.get_array(), bytes=True, norm=False)
                    Image.fromarray(values).save(next(block_vars["image_path_iterator"]))
    return figure_rst(
        paths, gallery_conf["src_dir"], ", ".join(filter(None, titles)).replace("\n", " ")
    )


def _get_sg_image_scraper() -> Callable[..., str]:
    return scrape
