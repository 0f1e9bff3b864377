# SPDX-License-Identifier: BSD-3-Clause
"""Pictures in and out: read on a grid; written as EXR, and for the eye as labelled PNG, with a report.

What is written for the eye is enlarged to at least 512 pixels across, each pixel a square. All
pictures of a run share one exposure, so that they can be compared: what they show is the linear
picture times `exposure`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageOps

from ltcl.cli.command import Context
from ltcl.errors import InputError
from ltcl.files import fill_folder, locked, replace_file
from ltcl.tasks import report

_WIDTH = 512  # pixels of a picture for the eye, at least
_MARGIN, _TEXT = 8, 18  # of contact sheets and labels, in pixels
_PAPER, _INK = (21, 23, 27), (241, 239, 234)
_ORANGE, _BLUE = np.array([1.0, 0.55, 0.0]), np.array([0.1, 0.45, 1.0])  # in sRGB
_VISIBLE = 0.5 / 255  # of white: the smallest difference that is marked


@contextmanager
def fill(out: Path, text: dict[str, Any]) -> Iterator[Path]:
    """`fill_folder`, with a report `text`, named after its command, of all files; one run at a time."""
    with locked(out, wait=False), fill_folder(out) as folder:
        yield folder
        name, files = (
            f"{text['command']}.json",
            [file for file in folder.rglob("*") if file.is_file()],
        )
        text["files"] = [*sorted(file.relative_to(folder).as_posix() for file in files), name]
        report.write(folder / name, text)


def read(
    context: Context,
    path: Path,
    grid: tuple[int, int],
    whose: str,
    setup: Any = None,
    upright: bool = True,
) -> np.ndarray:
    """A linear picture on a `grid`, float32 (h, w[, 3]), by --encoding and --resize.

    Integers are codes for the projector of a `setup`, where there is one and no other encoding is
    asked for. Photographs, not `upright`, keep the camera's pixels. InputError where the size is
    another.
    """
    from ltcl import images

    encoding = context.options["encoding"]
    is_code = setup is not None and encoding == "auto" and images.read_codes(path).dtype.kind == "u"
    picture = images.read(path, encoding="linear" if is_code else encoding, upright=upright)
    if context.options["resize"]:
        picture = images.resize(picture, grid)
    elif picture.shape[:2] != grid:
        (h, w), (height, width) = picture.shape[:2], grid
        size = f"has {h} x {w} pixels, but {whose} has {height} x {width}"
        raise InputError(f"{path}: {size}; --resize scales the picture")
    return setup.light(picture) if setup is not None and is_code else picture


def read_all(
    context: Context, paths: Sequence[Path], *place: Any, **settings: Any
) -> dict[str, np.ndarray]:
    """All pictures, as `read` does, by names for their results: stems, longer where an earlier one has it."""
    named: dict[str, np.ndarray] = {}
    for path in paths:
        name = path.stem
        while name.lower() in map(str.lower, named):  # some file systems ignore case
            name += "_2"
        named[name] = read(context, path, *place, **settings)
    return named


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


def shades(picture: np.ndarray, factor: float) -> np.ndarray:
    """A linear picture times `factor` in sRGB, (h, w, 3) in [0, 1]."""
    from ltcl import images

    codes = images.to_srgb(np.clip(picture * np.float32(factor), 0.0, 1.0))
    return codes if codes.ndim == 3 else np.stack([codes] * 3, axis=-1)


def mark(codes: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """sRGB values in grey, and over it orange where light is `missing`, blue where there is too much."""
    grey = 0.15 + 0.55 * codes.mean(axis=-1, keepdims=True)
    missing = missing.reshape(*codes.shape[:2], -1)
    largest = np.argmax(np.abs(missing), axis=-1)[..., None]  # the colour that deviates most
    missing = np.take_along_axis(missing, largest, axis=-1)
    share = np.where(
        np.abs(missing) > _VISIBLE, np.clip(0.4 + 2.0 * np.abs(missing), 0.0, 1.0), 0.0
    )
    return (1 - share) * grey + share * np.where(missing > 0, _ORANGE, _BLUE)


def panel(picture: np.ndarray, label: str, factor: float | None = None) -> Any:
    """A linear picture times `factor`, or sRGB values, as one of Pillow: enlarged, with its label above."""
    codes = picture if factor is None else shades(picture, factor)
    image = Image.fromarray(np.rint(255 * codes).astype(np.uint8))
    image = ImageOps.scale(image, -(-_WIDTH // image.width), Image.Resampling.NEAREST)
    sheet = ImageOps.expand(image, (0, 2 * _TEXT, 0, 0), _PAPER)
    place, font = (_MARGIN, _TEXT // 2), ImageFont.load_default(_TEXT)
    ImageDraw.Draw(sheet).text(place, label, fill=_INK, font=font)
    return sheet


def amplified(picture: np.ndarray, name: str, factor: float) -> tuple[float, Any]:
    """The panel of a picture times a power of two, at which it is seen best; that factor is on its label."""
    times = 2 ** int(np.log2(max(exposure(picture) / factor, 1.0)))
    return times, panel(picture, f"{name}, {times} times as bright", factor * times)


def deviation(
    folder: Path, name: str, std: np.ndarray, factor: float
) -> tuple[dict[str, str], Any]:
    """Files of standard deviations, and their panel, amplified."""
    _, shown = amplified(std, f"{name.split('/')[-1]}_std", factor)
    return write(folder, f"{name}_std", std, shown), shown


def contact_sheet(rows: Sequence[Sequence[Any]]) -> Any:
    """Panels in rows, as one picture."""
    widths = [sum(each.width + _MARGIN for each in row) for row in rows]
    heights = [max(each.height for each in row) + _MARGIN for row in rows]
    sheet = Image.new("RGB", (max(widths) + _MARGIN, sum(heights) + _MARGIN), _PAPER)
    for number, row in enumerate(rows):
        left, top = _MARGIN, _MARGIN + sum(heights[:number])
        for each in row:
            sheet.paste(each, (left, top))
            left += each.width + _MARGIN
    return sheet


def write_first_bounces(
    place: Path | None, lights: Mapping[str, tuple[np.ndarray, tuple[int, int]]]
) -> None:
    """First bounces (N,) or (3, N) on their grids as one PNG; pixels where one is 0 are orange."""
    rows = []
    for name, (F, grid) in lights.items() if place is not None else ():
        dark = np.any(np.atleast_2d(F) <= 0.0, axis=0)
        codes = mark(shades(F.T.reshape(*grid, *F.shape[:-1]), exposure(F)), 1.0 * dark)
        rows.append(
            [panel(codes, f"{name}: {np.count_nonzero(dark)} of {dark.size} pixels are dark")]
        )
    if place is not None and rows:
        with replace_file(place) as temporary:
            contact_sheet(rows).save(temporary, "PNG")
