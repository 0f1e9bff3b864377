# SPDX-License-Identifier: BSD-3-Clause
"""For sphinx-gallery: every figure that a block of an example leaves in a variable, drawn without pyplot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from weakref import WeakSet

from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst

_shown: WeakSet[Figure] = WeakSet()


def scrape(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Save the new figures of a block; return the lines that show them, with their titles for the blind."""
    paths, titles = [], []
    for value in [*block_vars["example_globals"].values()]:
        if isinstance(value, Figure) and value not in _shown:
            _shown.add(value)
            paths.append(next(block_vars["image_path_iterator"]))
            titles += [text.get_text() for text in value.texts if "$" not in text.get_text()][:4]
            value.savefig(paths[-1], facecolor=value.get_facecolor())
    return figure_rst(paths, gallery_conf["src_dir"], ", ".join(filter(None, titles)).replace("\n", " "))


def _get_sg_image_scraper() -> Callable[..., str]:
    return scrape
