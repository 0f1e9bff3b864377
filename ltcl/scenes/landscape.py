# SPDX-License-Identifier: BSD-3-Clause
"""A picture to show on walls: sunset over mountains and a lake, painted by a program of this project.

It asks much of a projector on purpose: saturated blues and oranges, whites, deep blacks and fine
detail.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks, images
from ltcl.scenes.viewer import LONGEST

_FILE = Path(__file__).with_name("landscape.jpg")
SUN = (0.64, 0.43)
"""Where the sun stands, in widths and heights, whatever the shape of the picture."""


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
    h, w = (checks.count(name, side, most=LONGEST) for name, side in (("h", h), ("w", w)))
    stored = images.read(_FILE)
    height, width = stored.shape[:2]
    cut: list[Any] = []
    for side, ideal, sun in ((height, h * width / w, SUN[1]), (width, w * height / h, SUN[0])):
        size = min(side, max(1, round(ideal)))
        start = round(sun * (side - size))
        cut.append(slice(start, start + size))
    return np.clip(images.resize(stored[tuple(cut)], (h, w)), 0, 1).astype(np.float32)
