# SPDX-License-Identifier: BSD-3-Clause
"""Pictures for viewing: labelled PNG, contact sheets, and marks on pixels out of reach.

They are enlarged to at least 512 pixels across, each pixel a square. All pictures of a run share
one exposure, so that they can be compared: they show the linear picture times `exposure`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageOps

from ltcl.cli.reports.parts import PictureFiles
from ltcl.files import replace_file

# Least width of a panel in pixels.
PANEL_WIDTH = 512
# Pixels between panels, and height of a label's text.
MARGIN = 8
TEXT_HEIGHT = 18
PAPER = (21, 23, 27)
INK = (241, 239, 234)
# sRGB colours of pixels that stay too dark, or too bright.
ORANGE = np.array([1.0, 0.55, 0.0])
BLUE = np.array([0.1, 0.45, 1.0])
# Smallest difference that is marked, in units of white: half a code.
VISIBLE_DIFFERENCE = 0.5 / 255
# Share of the brightest pixels that may exceed white.
WHITE_QUANTILE = 0.999


def exposure(*pictures: np.ndarray) -> float:
    """Return 1 over the brightness of the brightest picture.

    A thousandth of its pixels may be brighter.

    >>> exposure(np.full((4, 4), 0.5), np.zeros((4, 4))), exposure(np.zeros((4, 4)))
    (2.0, 1.0)
    """
    white = 0.0
    for picture in pictures:
        brightest = np.quantile(picture, WHITE_QUANTILE, method="higher")
        white = max(white, float(brightest))
    return 1.0 / white if white > 0 else 1.0


def write(folder: Path, name: str, picture: np.ndarray, panel: Image.Image) -> PictureFiles:
    """Write ``name.exr`` with the values and ``name.png``, a panel; return their names."""
    from ltcl import images

    images.write(folder / f"{name}.exr", picture)
    panel.save(folder / f"{name}.png")
    return PictureFiles(exr=f"{name}.exr", png=f"{name}.png")


def to_srgb(picture: np.ndarray, factor: float) -> np.ndarray:
    """Convert a linear picture times `factor` to sRGB, (h, w, 3) in [0, 1]."""
    from ltcl import images

    codes = images.to_srgb(np.clip(picture * np.float32(factor), 0.0, 1.0))
    return codes if codes.ndim == 3 else np.stack([codes] * 3, axis=-1)


def mark(codes: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Show sRGB values in grey, orange where light is `missing`, blue where there is too much."""
    grey = 0.15 + 0.55 * codes.mean(axis=-1, keepdims=True)
    # The colour channel that deviates most decides.
    missing = missing.reshape(*codes.shape[:2], -1)
    largest = np.argmax(np.abs(missing), axis=-1)[..., None]
    missing = np.take_along_axis(missing, largest, axis=-1)
    size = np.abs(missing)
    opacity = np.clip(0.4 + 2.0 * size, 0.0, 1.0)
    opacity = np.where(size > VISIBLE_DIFFERENCE, opacity, 0.0)
    colour = np.where(missing > 0, ORANGE, BLUE)
    return (1 - opacity) * grey + opacity * colour


def linear_panel(picture: np.ndarray, label: str, factor: float) -> Image.Image:
    """Draw a linear picture times `factor`, enlarged, with its label above."""
    return panel(to_srgb(picture, factor), label)


def panel(codes: np.ndarray, label: str) -> Image.Image:
    """Draw sRGB values, enlarged, with their label above."""
    image = Image.fromarray(np.rint(255 * codes).astype(np.uint8))
    # Ceiling of the quotient.
    scale = -(-PANEL_WIDTH // image.width)
    image = ImageOps.scale(image, scale, Image.Resampling.NEAREST)
    sheet = ImageOps.expand(image, (0, 2 * TEXT_HEIGHT, 0, 0), PAPER)
    place = (MARGIN, TEXT_HEIGHT // 2)
    font = ImageFont.load_default(TEXT_HEIGHT)
    ImageDraw.Draw(sheet).text(place, label, fill=INK, font=font)
    return sheet


def amplified_panel(picture: np.ndarray, name: str, factor: float) -> tuple[int, Image.Image]:
    """Draw a picture times a power of two that shows it best; return that power, too."""
    times = 2 ** int(np.log2(max(exposure(picture) / factor, 1.0)))
    label = f"{name}, {times} times as bright"
    return times, linear_panel(picture, label, factor * times)


def write_std(
    folder: Path, name: str, std: np.ndarray, factor: float
) -> tuple[PictureFiles, Image.Image]:
    """Write files of standard deviations; return their names, and their amplified panel."""
    label = f"{name.split('/')[-1]}, std by noise alone"
    _, shown = amplified_panel(std, label, factor)
    return write(folder, f"{name}_std", std, shown), shown


def contact_sheet(rows: Sequence[Sequence[Image.Image]]) -> Image.Image:
    """Arrange panels in rows, as one picture."""
    widths = []
    heights = []
    for row in rows:
        width = 0
        height = 0
        for shown in row:
            width += shown.width + MARGIN
            height = max(height, shown.height + MARGIN)
        widths.append(width)
        heights.append(height)
    size = (max(widths) + MARGIN, sum(heights) + MARGIN)
    sheet = Image.new("RGB", size, PAPER)
    top = MARGIN
    for row, height in zip(rows, heights, strict=True):
        left = MARGIN
        for shown in row:
            sheet.paste(shown, (left, top))
            left += shown.width + MARGIN
        top += height
    return sheet


def write_first_bounces(
    place: Path | None, first_bounces: Mapping[str, tuple[np.ndarray, tuple[int, int]]]
) -> None:
    """Write first bounces (N,) or (3, N) on their grids as one PNG; dark pixels are orange."""
    if place is None or not first_bounces:
        return
    rows = []
    for name, (first_bounce, grid) in first_bounces.items():
        rows.append([_first_bounce_panel(name, first_bounce, grid)])
    with replace_file(place) as temporary:
        contact_sheet(rows).save(temporary, "PNG")


def _first_bounce_panel(name: str, first_bounce: np.ndarray, grid: tuple[int, int]) -> Image.Image:
    is_dark = np.any(np.atleast_2d(first_bounce) <= 0.0, axis=0)
    picture = first_bounce.T.reshape(*grid, *first_bounce.shape[:-1])
    codes = to_srgb(picture, exposure(first_bounce))
    dark_pixels = np.count_nonzero(is_dark)
    label = f"{name}: {dark_pixels} of {is_dark.size} pixels are dark"
    return panel(mark(codes, is_dark.astype(np.float64)), label)
