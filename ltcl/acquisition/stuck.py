# SPDX-License-Identifier: BSD-3-Clause
"""Camera pixels at their last code whatever the projector shows: hot ones, or a lamp in view.

They tell nothing of exposure, response or noise, and must not decide them. A photograph under a black
projector shows which they are. What is measured of a camera as a whole takes the pixels beside them instead;
pictures of the scene keep them, where merging finds no exposure that tells them.
"""

from __future__ import annotations

import numpy as np

_LAST = 0.995  # of full scale
_FEW = 0.1  # of the pixels: more of them, and it is the exposure that is too long


def stuck(black: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels that are saturated in a photograph (H, W[, 3]) under a black projector.

    >>> stuck(np.array([[0.0] * 19 + [1.0]])).sum(), stuck(np.ones((2, 2))).sum()
    (np.int64(1), np.int64(0))
    """
    brightest = black.max(axis=-1) if black.ndim == 3 else black
    found = np.asarray(brightest >= _LAST)
    return found if found.mean() <= _FEW else np.zeros_like(found)


def healed(image: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """The photograph with the pixel before, row by row, in the place of each bad one.

    >>> healed(np.array([[1.0, 9.0, 3.0]]), np.array([[False, True, False]])).tolist()
    [[1.0, 1.0, 3.0]]
    """
    if not bad.any():
        return image
    good = np.flatnonzero(~bad)
    donor = good[np.maximum(np.searchsorted(good, np.arange(bad.size), "right") - 1, 0)]
    return image.reshape(bad.size, -1)[donor].reshape(image.shape)
