# SPDX-License-Identifier: BSD-3-Clause
"""`ShownFigure`: a figure of matplotlib, drawn without pyplot, that notebooks and prompts show."""

from __future__ import annotations

import io
import logging
import sys
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image, ImageShow

_logger = logging.getLogger(__name__)


class ShownFigure(Figure):
    """A figure drawn by Agg: a notebook shows it, and `show` opens it anywhere else."""

    def __init__(self, width: int, height: int, dpi: int, paper: str) -> None:
        super().__init__(figsize=(width / dpi, height / dpi), dpi=dpi, facecolor=paper)
        FigureCanvasAgg(self)

    def __repr__(self) -> str:
        width, height = self.canvas.get_width_height()
        return f"<ltcl figure {width} x {height}: show() opens it, ltcl.plots.save writes it>"

    def _repr_png_(self) -> bytes:
        """Return the picture that notebooks show."""
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", facecolor=self.get_facecolor())
        return buffer.getvalue()

    def show(self, warn: bool = True) -> None:
        """Show the figure in a notebook, or else in the program that opens pictures here.

        If there is no such program, a warning tells so.
        """
        ipython: Any = sys.modules.get("IPython")
        if ipython is not None and hasattr(ipython.get_ipython(), "kernel"):
            ipython.display.display(self)
            return
        with Image.open(io.BytesIO(self._repr_png_())) as picture:
            is_shown = ImageShow.show(picture, "ltcl")
        if warn and not is_shown:
            _logger.warning("no program opens pictures here; ltcl.plots.save writes the figure")
