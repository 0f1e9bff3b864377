# SPDX-License-Identifier: BSD-3-Clause
"""Figure that shows itself in notebooks, and with ``figure.show()`` at a prompt, without pyplot."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image


class ShownFigure(Figure):
    """A matplotlib `Figure` drawn by Agg."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        FigureCanvasAgg(self)

    def _repr_png_(self) -> bytes:
        """The picture that a notebook shows."""
        png = io.BytesIO()
        self.savefig(png, format="png", dpi=self.dpi, facecolor=self.get_facecolor())
        return png.getvalue()

    def show(self, warn: bool = True) -> None:
        """Open the picture in the system's viewer."""
        canvas = FigureCanvasAgg(self)
        canvas.draw()
        Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB").show()
