# SPDX-License-Identifier: BSD-3-Clause
"""Pictures in and out: read on a transport's grid, written exactly as EXR and for the eye as PNG."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ltcl.errors import InputError

Grid = tuple[int, int]


@dataclass(frozen=True)
class Reader:
    """How picture files become linear pictures on a `grid`: what they hold, whether to scale them.

    Those of integers are codes for the projector of a `setup`, where there is one and nothing else is said.
    Photographs, not `upright`, keep the camera's pixels.
    """

    grid: Grid
    whose: str
    encoding: Literal["auto", "srgb", "linear"]
    resize: bool
    setup: Any = None
    upright: bool = True

    def read(self, path: Path) -> np.ndarray:
        """The picture in `path`, linear float32, (h, w) or (h, w, 3) on the grid.

        Raises
        ------
        InputError
            It has another size and may not be scaled.
        """
        from ltcl import images

        setup = self.setup if self.encoding == "auto" and self.setup and _holds_integers(path) else None
        encoding = "linear" if setup else self.encoding
        picture = images.read(path, encoding=encoding, upright=self.upright)
        if self.resize and picture.shape[:2] != self.grid:
            picture = images.resize(picture, self.grid)
        if picture.shape[:2] == self.grid:
            return setup.light(picture) if setup else picture
        has, wants = ("{} x {}".format(*size) for size in (picture.shape[:2], self.grid))
        raise InputError(
            f"{path}: is {has} pixels, but {self.whose} has {wants}; give --resize to scale the picture"
        )

    def read_all(self, paths: Sequence[Path]) -> dict[str, np.ndarray]:
        """All pictures by the name that their results get; a bad one is known before the first solve."""
        return {name: self.read(path) for name, path in names(paths).items()}


def _holds_integers(path: Path) -> bool:
    from ltcl import images

    return images.read_codes(path).dtype.kind == "u"


def names(paths: Sequence[Path]) -> dict[str, Path]:
    """A name for the results of each file: its stem; where stems clash its extension, too, then a number.

    >>> list(names([Path("sky.png"), Path("sky.exr"), Path("a/sky.exr"), Path("sea.png")]))
    ['sky_png', 'sky_exr', 'sky_exr_2', 'sea']
    """
    found: dict[str, Path] = {}
    stems = Counter(path.stem.lower() for path in paths)  # some file systems ignore case
    for path in paths:
        whole = stems[path.stem.lower()] > 1
        base = f"{path.stem}_{path.suffix[1:]}" if whole and path.suffix else path.stem
        name, number = base, 1
        while name.lower() in {taken.lower() for taken in found}:
            number += 1
            name = f"{base}_{number}"
        found[name] = path
    return found


def write(
    folder: Path, name: str, picture: np.ndarray, scale: float = 1.0, shown: np.ndarray | None = None
) -> dict[str, Any]:
    """Write ``name.exr`` with the values as they are and ``name.png`` with them, or `shown`, / scale in sRGB.

    Returns
    -------
    dict
        Names and scale, for the report.
    """
    from ltcl import images

    images.write(folder / f"{name}.exr", picture)
    images.write(folder / f"{name}.png", (picture if shown is None else shown) / scale)
    return {"exr": f"{name}.exr", "png": f"{name}.png", "png_scale": scale}


def write_pattern(folder: Path, name: str, light: np.ndarray, white: float, setup: Any) -> dict[str, Any]:
    """As `write`; but where the projector was measured, by `setup`, ``name.png`` has the codes to feed it."""
    from ltcl import images

    if setup is None:
        return write(folder, name, light, white)
    images.write(folder / f"{name}.exr", light)
    images.write(folder / f"{name}.png", setup.codes(light), encoding="linear")
    return {"exr": f"{name}.exr", "png": f"{name}.png", "png_scale": 1.0}


def brightness(picture: np.ndarray) -> float:
    """The value to be shown as white: all but the brightest thousandth stay below; 1 for black pictures."""
    value = float(np.quantile(picture, 0.999, method="higher"))
    return value if value > 0 else 1.0
