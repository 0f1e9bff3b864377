# SPDX-License-Identifier: BSD-3-Clause
"""The demo's contact sheet, drawn by Pillow: the demo needs no Matplotlib, which is an extra."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ltcl import images
from ltcl.files import replace_file

WIDTH = 1600
PAPER = (21, 23, 27)
INK = (241, 239, 234)
FAINT = (154, 161, 171)
# Pixels around the page and between pictures; heights of letters; of a line, in letters.
BORDER = 34
GAP = 20
TITLE_SIZE = 34
TEXT_SIZE = 20
LINE = 1.35


def write_sheet(
    path: Path, rows: Sequence[Mapping[str, np.ndarray]], title: str, subtitle: str
) -> None:
    """Write rows of linear pictures, (h, w, 3), each under its label, below a title."""
    panels = []
    heights = []
    for row in rows:
        row_panels = [_panel(label, picture, len(row)) for label, picture in row.items()]
        panels.append(row_panels)
        heights.append(max(panel.height for panel in row_panels))
    heading = _text(title, TITLE_SIZE, INK)
    remark = _text(subtitle, TEXT_SIZE, FAINT)
    top = BORDER + heading.height + remark.height + GAP
    sheet = Image.new("RGB", (WIDTH, top + sum(heights) + GAP * len(rows) + BORDER), PAPER)
    sheet.paste(heading, (BORDER, BORDER))
    sheet.paste(remark, (BORDER, BORDER + heading.height))
    for row_panels, height in zip(panels, heights, strict=True):
        left = BORDER
        for panel in row_panels:
            # Pictures end at one height, whatever their labels.
            sheet.paste(panel, (left, top + height - panel.height))
            left += panel.width + GAP
        top += height + GAP
    with replace_file(path) as temporary:
        sheet.save(temporary, "PNG")


def _panel(label: str, picture: np.ndarray, columns: int) -> Image.Image:
    """A picture of a row of so many, with its label above, whose first line is bright."""
    first, _, others = label.partition("\n")
    lines = [_text(first, TEXT_SIZE, INK)]
    if others:
        lines.append(_text(others, TEXT_SIZE, FAINT))
    codes = np.rint(255 * images.to_srgb(np.clip(picture, 0.0, 1.0))).astype(np.uint8)
    width = (WIDTH - 2 * BORDER - GAP * (columns - 1)) // columns
    height = round(width * codes.shape[0] / codes.shape[1])
    shown = Image.fromarray(codes).resize((width, height), Image.Resampling.LANCZOS)
    label_height = sum(line.height for line in lines)
    panel = Image.new("RGB", (width, label_height + height), PAPER)
    top = 0
    for image in (*lines, shown):
        panel.paste(image, (0, top))
        top += image.height
    return panel


def _text(text: str, size: int, colour: tuple[int, int, int]) -> Image.Image:
    """Text of one or more lines, in a picture of its own."""
    font = ImageFont.load_default(size)
    lines = text.split("\n")
    width = max(int(font.getlength(line)) for line in lines) + 1
    height = round(LINE * size)
    drawn = Image.new("RGB", (width, height * len(lines)), PAPER)
    pen = ImageDraw.Draw(drawn)
    for number, line in enumerate(lines):
        pen.text((0, number * height), line, fill=colour, font=font)
    return drawn
