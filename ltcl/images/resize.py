# SPDX-License-Identifier: BSD-3-Clause
"""Pictures on another pixel grid: area average where they shrink, linear interpolation where they grow.

Neither filter has negative weights: no result leaves the range of the input.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ltcl import checks
from ltcl.images.io import as_picture


def resize(image: ArrayLike, grid: tuple[int, int]) -> np.ndarray:
    """Resample a linear picture, (h, w) or (h, w, 3), to `grid` pixels, float32.

    InputError for another shape, NaN or infinite values, or a grid that is not two positive integers.

    >>> resize(np.array([[0.0, 1.0], [2.0, 3.0]]), (1, 1))
    array([[1.5]], dtype=float32)
    """
    picture = as_picture("image", image)
    h, w = checks.grid("grid", grid)
    # One axis at a time: OpenCV averages areas only where no axis grows; one may grow as the other shrinks.
    for rows, columns in ((h, picture.shape[1]), (h, w)):
        if picture.shape[:2] != (rows, columns):
            shrinks = rows < picture.shape[0] or columns < picture.shape[1]
            filter = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
            picture = cv2.resize(picture, (columns, rows), interpolation=filter)
    return picture
