# SPDX-License-Identifier: BSD-3-Clause
"""Picture to show on walls: sunset over mountains and a lake, painted by this program.

It asks much of a projector on purpose: saturated blues and oranges, whites, deep blacks and fine
detail.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ltcl import checks, images
from ltcl.scenes.camera import MAX_IMAGE_SIDE

FILE = Path(__file__).with_name("landscape.jpg")
SUN = (0.64, 0.43)
"""Place of the sun, in widths and heights, whatever the shape of the picture."""


def landscape(h: int, w: int) -> np.ndarray:
    """Sunset over mountains and a lake, a colourful target picture.

    Parameters
    ----------
    h, w : int
        Pixels, up to 32766 each. The stored picture has 640 x 1024; of other shapes it is cut
        around the sun.

    Returns
    -------
    ndarray, (h, w, 3), float32
        Linear red, green, blue in [0, 1].

    Raises
    ------
    InputError
        If h or w is not a whole number from 1 to 32766.

    Examples
    --------
    >>> picture = landscape(48, 64)
    >>> picture.shape, picture.dtype
    ((48, 64, 3), dtype('float32'))
    """
    h = checks.count("h", h, most=MAX_IMAGE_SIDE)
    w = checks.count("w", w, most=MAX_IMAGE_SIDE)
    stored = images.read(FILE)
    height, width = stored.shape[:2]
    rows = _around(SUN[1], height, h * width / w)
    columns = _around(SUN[0], width, w * height / h)
    picture = images.resize(stored[rows, columns], (h, w))
    return np.clip(picture, 0, 1).astype(np.float32)


def _around(sun: float, side: int, ideal: float) -> slice:
    """Part of a side, of about the ideal length, in which the sun stands at the same share."""
    size = min(side, max(1, round(ideal)))
    start = round(sun * (side - size))
    return slice(start, start + size)
