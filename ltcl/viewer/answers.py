# SPDX-License-Identifier: BSD-3-Clause
"""`Scene`: what the library answers to the page, with one method for each thing that it may ask."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ltcl import __version__, checks, layout
from ltcl.errors import InputError, InputTypeError
from ltcl.images.pictures import to_linear
from ltcl.transport import Transport

Reply = tuple[dict[str, Any], dict[str, np.ndarray]]  # facts and pictures
QUICK = ("column", "row", "relight", "pictures")  # a product at most
LONG = ("bounces", "compensate")


class Scene:
    """T and what is shown of it; methods take what a question holds, and raise InputError for anything else.

    `setup` is the `ltcl.acquisition.Setup` of a measured T. `pattern` (h, w[, 3]) is the light that the
    projector has now.
    """

    def __init__(self, T: Transport, title: str, pictures: Mapping[str, np.ndarray], setup: Any) -> None:
        self.T, self.title, self.setup = T, title, setup
        self.pattern = np.ones(T.grid, np.float32)

    def hello(self) -> dict[str, Any]:
        """What a page has to know of T."""
        T = self.T
        return {
            "title": self.title,
            "grid": T.grid,
            "camera_grid": T.camera_grid,
            "channels": T.channels,
            "square": T.is_square,
            "compressed": T.is_compressed,
            "error": T.error,
            "masked": int(T.masked.sum()),
            "pictures": [],
            "device": T.device.name,
            "version": __version__,
            "scan": False,
            "measured": self.setup is not None,
        }

    def answer(self, do: str, asked: dict[str, Any], callback: Callable[[int, float], None]) -> Reply:
        """The answer to a question by name; `callback` is called between the steps of a solve."""
        method = getattr(self, checks.one_of("do", do, (*QUICK, *LONG)))
        parameters = inspect.signature(method).parameters
        for name in asked:
            if name not in parameters or name == "callback":
                raise InputTypeError(f"{do} has no {name[:40]!r}; it has {', '.join(parameters)}")
        for name, parameter in parameters.items():
            if parameter.default is parameter.empty and name not in asked and name != "callback":
                raise InputTypeError(f"{do} has no {name!r}; it must be there")
        return method(**asked, **({"callback": callback} if "callback" in parameters else {}))

    def column(self, pixel: Any, channel: Any = None) -> Reply:
        """What one projector pixel lights."""
        return {}, {"picture": self.T @ self._unit("pixel", pixel, channel, self.T.grid)}

    def row(self, pixel: Any, channel: Any = None) -> Reply:
        """How much each projector pixel adds to one camera pixel."""
        T = self.T
        unit = self._unit("pixel", pixel, channel, T.camera_grid)
        columns, shape = layout.unpack("pixel", unit, T.camera_grid, T.channels)
        columns = [np.concatenate(columns)] if T.couples else columns
        rows = [A.T.matmat(x) for A, x in zip(T.operators, columns, strict=True)]
        return {}, {"pattern": shape.pack(rows, T.grid)}

    def relight(self, pattern: Any = None) -> Reply:
        """The picture under a pattern, linear light or sRGB codes, which the projector shows from now on."""
        checks.shape("pattern", pattern, self.T.grid, (*self.T.grid, 3))
        light = to_linear(pattern, "auto")
        picture = self.T @ light
        self.pattern = light
        return {}, {"picture": picture}

    def pictures(self) -> Reply:
        """Pictures that targets may be."""
        return {"pictures": []}, {}

    def _unit(self, name: str, pixel: Any, channel: Any, grid: tuple[int, int]) -> np.ndarray:
        if not isinstance(pixel, list) or len(pixel) != 2:
            raise InputError(f"{name} is {checks.shown(pixel)}; it must be [row, column]")
        row, column = (
            checks.count(f"{name}[{k}]", n, least=0, most=size - 1)
            for k, (n, size) in enumerate(zip(pixel, grid, strict=True))
        )
        if channel is None:
            unit = np.zeros(grid, np.float32)
            unit[row, column] = 1.0
            return unit
        unit = np.zeros((*grid, 3), np.float32)
        unit[row, column, checks.count("channel", channel, least=0, most=self.T.channels - 1)] = 1.0
        return unit if self.T.channels == 3 else unit[..., 0]
