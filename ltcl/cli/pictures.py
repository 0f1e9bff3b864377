# SPDX-License-Identifier: BSD-3-Clause
"""Pictures in and out: read on a transport's grid, written exactly as EXR and for the eye as labelled PNG.

What is written for the eye is enlarged to at least 512 pixels across, each pixel a square. All pictures of a
run share one exposure, so that they can be compared: what they show is the linear picture times `exposure`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ltcl.errors import InputError

_WIDTH = 512  # pixels of a picture for the eye, at least
_MARGIN, _TEXT = 8, 18  # of contact sheets and labels, in pixels
_PAPER, _INK = (21, 23, 27), (241, 239, 234)
_ORANGE, _BLUE = np.array([1.0, 0.55, 0.0]), np.array([0.1, 0.45, 1.0])  # in sRGB
_VISIBLE = 0.5 / 255  # of white: the smallest difference that is marked
_DIM = 0.25  # of white: what is darker is shown a second time on a contact sheet, amplified


@dataclass(frozen=True)
class Reader:
    """How picture files become linear pictures on a `grid`: their encoding, and whether they are scaled.

    Integers are codes for the projector of a `setup`, where there is one and nothing else is asked for.
    Photographs, not `upright`, keep the camera's pixels.
    """

    grid: tuple[int, int]
    whose: str
    encoding: Literal["auto", "srgb", "linear"]
    resize: bool
    setup: Any = None
    upright: bool = True

    def read(self, path: Path) -> np.ndarray:
        """The picture in `path`, linear float32, (h, w[, 3]); InputError where its size is another."""
        from ltcl import images

        codes = self.setup and self.encoding == "auto" and images.read_codes(path).dtype.kind == "u"
        picture = images.read(path, encoding="linear" if codes else self.encoding, upright=self.upright)
        if self.resize and picture.shape[:2] != self.grid:
            picture = images.resize(picture, self.grid)
        if picture.shape[:2] != self.grid:
            has, needed = ("{} x {}".format(*size) for size in (picture.shape[:2], self.grid))
            raise InputError(
                f"{path}: has {has} pixels, but {self.whose} has {needed}; --resize scales the picture"
            )
        return self.setup.light(picture) if codes else picture

    def read_all(self, paths: Sequence[Path]) -> dict[str, np.ndarray]:
        """All pictures by the names of their results."""
        return {name: self.read(path) for name, path in names(paths).items()}


def names(paths: Sequence[Path]) -> dict[str, Path]:
    """A name for the results of each file: its stem, with a number where an earlier one has it.

    >>> list(names([Path("sky.png"), Path("sky.exr"), Path("a/sky.exr"), Path("sea.png")]))
    ['sky', 'sky_2', 'sky_3', 'sea']
    """
    named: dict[str, Path] = {}
    for path in paths:
        name, number = path.stem, 1
        while name.lower() in map(str.lower, named):  # some file systems ignore case
            number += 1
            name = f"{path.stem}_{number}"
        named[name] = path
    return named


@contextmanager
def naming(files: Mapping[str, Path | None]) -> Iterator[None]:
    """Put the file in front of a refusal that begins with the name of the argument it was read for."""
    try:
        yield
    except InputError as error:
        if file := files.get(str(error).partition(" ")[0]):
            error.args = (f"{file}: {error}",)
        raise


def exposure(*pictures: np.ndarray) -> float:
    """1 over the brightness of the brightest picture, of which a thousandth of the pixels may be brighter.

    >>> exposure(np.full((4, 4), 0.5), np.zeros((4, 4))), exposure(np.zeros((4, 4)))
    (2.0, 1.0)
    """
    white = max(float(np.quantile(picture, 0.999, method="higher")) for picture in pictures)
    return 1.0 / white if white > 0 else 1.0


def write(folder: Path, name: str, picture: np.ndarray, shown: Any) -> dict[str, str]:
    """Write ``name.exr`` with the values and ``name.png``, a `panel`; their names, for the report."""
    from ltcl import images

    images.write(folder / f"{name}.exr", picture)
    shown.save(folder / f"{name}.png")
    return {"exr": f"{name}.exr", "png": f"{name}.png"}


def write_pattern(folder: Path, name: str, light: np.ndarray, white: float, setup: Any) -> dict[str, str]:
    """Write ``name.exr`` with the light, and ``name.png`` with the codes of the projector, pixel for pixel.

    Codes are those of a measured projector, `setup`; else sRGB, with light `white` as white.
    """
    from ltcl import images

    images.write(folder / f"{name}.exr", light)
    if setup is None:
        images.write(folder / f"{name}.png", light / white)
    else:
        images.write(folder / f"{name}.png", setup.codes(light), encoding="linear")
    return {"exr": f"{name}.exr", "png": f"{name}.png"}


def shades(picture: np.ndarray, factor: float) -> np.ndarray:
    """A linear picture times `factor` in sRGB, (h, w, 3) in [0, 1]."""
    from ltcl import images

    codes = images.to_srgb(np.clip(picture * np.float32(factor), 0.0, 1.0))
    return codes if codes.ndim == 3 else np.stack([codes] * 3, axis=-1)


def mark(codes: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """sRGB values in grey, and over it orange where light is `missing`, blue where there is too much."""
    grey = 0.15 + 0.55 * codes.mean(axis=-1, keepdims=True)
    if missing.ndim == 3:  # of the colour that deviates most
        largest = np.argmax(np.abs(missing), axis=-1)[..., None]
        missing = np.take_along_axis(missing, largest, axis=-1)[..., 0]
    amount = np.abs(missing)[..., None]
    share = np.where(amount > _VISIBLE, np.clip(0.4 + 2.0 * amount, 0.0, 1.0), 0.0)
    return (1 - share) * grey + share * np.where(missing[..., None] > 0, _ORANGE, _BLUE)


def panel(codes: np.ndarray, label: str) -> Any:
    """sRGB values (h, w, 3) in [0, 1] as a picture of Pillow: enlarged, with its label above."""
    from PIL import Image, ImageDraw, ImageFont

    side = -(-_WIDTH // codes.shape[1])
    large = np.rint(255 * codes).astype(np.uint8).repeat(side, axis=0).repeat(side, axis=1)
    sheet = Image.new("RGB", (large.shape[1], large.shape[0] + 2 * _TEXT), _PAPER)
    sheet.paste(Image.fromarray(large), (0, 2 * _TEXT))
    font = ImageFont.load_default(_TEXT)
    ImageDraw.Draw(sheet).text((_MARGIN, _TEXT // 2), label, fill=_INK, font=font)
    return sheet


def contact_sheet(rows: Sequence[Sequence[Any]]) -> Any:
    """Panels in rows, as one picture."""
    from PIL import Image

    widths = [sum(each.width + _MARGIN for each in row) for row in rows]
    heights = [max(each.height for each in row) + _MARGIN for row in rows]
    sheet = Image.new("RGB", (max(widths) + _MARGIN, sum(heights) + _MARGIN), _PAPER)
    for number, row in enumerate(rows):
        left, top = _MARGIN, _MARGIN + sum(heights[:number])
        for each in row:
            sheet.paste(each, (left, top))
            left += each.width + _MARGIN
    return sheet


def amplified(parts: Mapping[str, np.ndarray], factor: float) -> list[Any]:
    """Panels of what is too dark to be seen at this exposure, times powers of two that their labels name."""
    panels = []
    for name, picture in parts.items():
        times = 2 ** int(np.log2(max(exposure(picture) / factor, 1.0)))
        if times * _DIM >= 1:
            panels.append(panel(shades(picture, factor * times), f"{name}, {times} times as bright"))
    return panels
