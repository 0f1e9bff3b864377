# SPDX-License-Identifier: BSD-3-Clause
"""Pixels whose coordinate does not fit their neighbours' are dropped.

On a surface coordinates run evenly, so a pixel is close to the median of its 5 x 5 neighbourhood, however
steep the run: by symmetry the centre of a plane is its median. What the neighbours themselves differ by
(their median absolute deviation) says how far off a pixel may be at folds and borders.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from ltcl.acquisition.geometry.decoded import Axis

SIZE = 5
FAR = np.float32(1e9)


def consistent(value: np.ndarray, valid: np.ndarray, *, slack: float = 1.0) -> np.ndarray:
    """Which of the valid pixels (H, W) agree with their neighbours.

    A pixel may be `slack` projector pixels and twice the median deviation away from the median, and has
    three valid neighbours (fewer only where the picture is that small).

    >>> x = np.add.outer(np.zeros(7), 3.0 * np.arange(7))
    >>> x[3, 3] = 40.0
    >>> good = consistent(x, np.ones((7, 7), bool))
    >>> bool(good[3, 3]), int(good.sum())
    (False, 48)
    """
    off, allowed, pixels = _compare(value, valid, value)
    return valid & (pixels > min(3, value.size - 1)) & (off <= slack + allowed)


def confirmed(axis: Axis, place: np.ndarray) -> Axis:
    """`axis`, and the faint numbers `place` (H, W) of undecided pixels that five decided neighbours confirm.

    On an edge of the finest of narrow stripes every bit is faint; what they tell is off by one at most, and
    where that leads out of the range of the neighbours, stripes seem to end where none does.
    """
    decided = axis.width <= 2.0
    off, _, neighbours = _compare(axis.value, decided, place.astype(np.float32))
    near = ~decided & np.isfinite(axis.width) & (neighbours >= 5) & (off <= 1.0)
    around = np.ones((SIZE, SIZE), np.uint8)
    near &= place >= np.floor(cv2.erode(np.where(decided, axis.value, FAR), around))
    near &= place <= np.ceil(cv2.dilate(np.where(decided, axis.value, -FAR), around))
    value = np.where(near, place, axis.value).astype(np.float32)
    return replace(axis, value=value, width=np.where(near, np.float32(2.0), axis.width))


def _compare(value: np.ndarray, valid: np.ndarray, tried: np.ndarray) -> tuple[np.ndarray, ...]:
    """Distance of `tried` from the median of the valid, twice their median deviation, and their number."""
    middle = _median(value, valid)
    # Invalid pixels count as half very near and half very far: they leave the median where it is.
    spread = _median(np.abs(value - middle), valid, low=0.0)
    size, border = (SIZE, SIZE), cv2.BORDER_CONSTANT
    count = cv2.boxFilter(valid.view(np.uint8), -1, size, normalize=False, borderType=border)
    return np.abs(tried - middle), 2.0 * np.minimum(spread, FAR / 4), count


def _median(value: np.ndarray, valid: np.ndarray, low: float = -float(FAR)) -> np.ndarray:
    """Of the valid pixels of each neighbourhood, within one rank."""
    filled = np.full(value.shape, FAR)
    filled[::2, 1::2] = filled[1::2, ::2] = low
    np.copyto(filled, value, "same_kind", where=valid)
    return cv2.medianBlur(filled, SIZE)
