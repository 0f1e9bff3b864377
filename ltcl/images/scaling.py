# SPDX-License-Identifier: BSD-3-Clause
"""Pictures on another pixel grid: area average where they shrink, linear interpolation where they grow.

Neither filter has negative weights, so no result leaves the range of the input: a dark pixel cannot turn
negative, as it may under a cubic filter. Shrinking by area also keeps the mean radiance.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ltcl import checks
from ltcl.images.pictures import as_picture


def resize(image: ArrayLike, grid: tuple[int, int]) -> np.ndarray:
    """Resample a linear picture to `grid` pixels.

    Parameters
    ----------
    image
        (h, w) or (h, w, 3), linear radiance.
    grid
        The wanted (h, w).

    Returns
    -------
    np.ndarray
        float32, `grid` or `grid + (3,)`; values stay within the range of `image`.

    Raises
    ------
    InputError
        Another shape, NaN or infinite values, or a grid that is not two positive integers.

    Examples
    --------
    >>> resize(np.array([[0.0, 1.0], [2.0, 3.0]]), (1, 1))
    array([[1.5]], dtype=float32)
    """
    picture = as_picture("image", image)
    h, w = checks.grid("grid", grid)
    # One axis at a time: OpenCV averages areas only where no axis grows; one may grow as the other shrinks.
    picture = _resize_axis(picture, (h, picture.shape[1]), shrinks=h < picture.shape[0])
    return _resize_axis(picture, (h, w), shrinks=w < picture.shape[1])


def _resize_axis(picture: np.ndarray, grid: tuple[int, int], *, shrinks: bool) -> np.ndarray:
    if picture.shape[:2] == grid:
        return picture
    h, w = grid
    return cv2.resize(picture, (w, h), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
