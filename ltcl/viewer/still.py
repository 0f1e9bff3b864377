# SPDX-License-Identifier: BSD-3-Clause
"""`draw_still`: a picture of the Probe view as it begins, for where no page can run."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from ltcl.errors import LtclError
from ltcl.images import resize, to_srgb

# Pixels: the longer side of each of the two pictures, the space around them, the height of titles.
SIDE = 320
SPACE = 14
TITLE_HEIGHT = 22
# Share of pixels that are darker than white, as on the page: direct light is far brighter.
SCENE_SHARE = 0.99
PROBE_SHARE = 0.95
RING_RADIUS = 7
# Colours of the page.
GROUND = "#121212"
TEXT = "#e8e8e8"
ACCENT = "#ffb347"


def draw_still(scene: Any) -> bytes:
    """Return a PNG: the lit scene, or the pattern, with a ring; and what the ring's pixel lights.

    It is empty if the transport gives no picture.
    """
    T = scene.T
    center = [T.grid[0] // 2, T.grid[1] // 2]
    try:
        lit = scene.relight()[1]["picture" if T.is_square else "pattern"]
        column = scene.column(center)[1]["picture"]
    except LtclError:
        return b""
    left = _picture(lit, SCENE_SHARE)
    right = _picture(column, PROBE_SHARE)
    width = left.width + right.width + 3 * SPACE
    height = max(left.height, right.height) + TITLE_HEIGHT + 2 * SPACE
    sheet = Image.new("RGB", (width, height), GROUND)
    draw = ImageDraw.Draw(sheet)
    top = SPACE + TITLE_HEIGHT
    second = left.width + 2 * SPACE
    sheet.paste(left, (SPACE, top))
    sheet.paste(right, (second, top))
    draw.text((SPACE, SPACE), "Projector", TEXT)
    draw.text((second, SPACE), "Camera: what the ring's pixel lights", TEXT)
    row = top + (center[0] + 0.5) / T.grid[0] * left.height
    column_of_ring = SPACE + (center[1] + 0.5) / T.grid[1] * left.width
    draw.circle((column_of_ring, row), RING_RADIUS, outline=ACCENT, width=2)
    file = io.BytesIO()
    sheet.save(file, "PNG", optimize=True)
    return file.getvalue()


def _picture(light: np.ndarray, share: float) -> Image.Image:
    """Return light as a picture of at most `SIDE` pixels, small ones in squares."""
    h, w = light.shape[:2]
    if max(h, w) > SIDE:
        scale = SIDE / max(h, w)
        light = resize(light, (max(1, round(h * scale)), max(1, round(w * scale))))
    brightest = light if light.ndim == 2 else light.max(axis=2)
    white = float(np.quantile(brightest, share)) or float(brightest.max()) or 1.0
    codes = np.rint(255 * to_srgb(np.clip(light / white, 0, 1))).astype(np.uint8)
    picture = Image.fromarray(codes).convert("RGB")
    times = max(1, SIDE // max(picture.size))
    return picture.resize((picture.width * times, picture.height * times), Image.Resampling.NEAREST)
