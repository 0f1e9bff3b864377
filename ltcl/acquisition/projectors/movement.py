# SPDX-License-Identifier: BSD-3-Clause
"""Did the camera move between two scans? Blocks of the first projector, photographed again, say so.

Both photographs have one exposure. The affine map between them is that of the largest correlation
(Evangelidis and Psarakis 2008, OpenCV's `findTransformECC`), which does not mind a lamp that has
faded; a shift of many pixels is found first, by phase correlation. The movement is the largest
distance by which it moves a pixel of the lit area.

Known limit: a first projector that was moved looks the same as a camera that was.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from ltcl.errors import AcquisitionError

# Largest movement in camera pixels; that of a clean scan is below a tenth of it.
MAX_MOVEMENT = 0.25
# Blocks along the shorter side of the pattern.
BLOCKS = 12
# Pixels of the photographs that are compared, at most.
MAX_COMPARED_PIXELS = 1 << 20
# Share of the brightest light from which on a pixel is lit, and correlation below which the
# photographs are not of the same pattern.
LIT_SHARE = 0.1
MIN_CORRELATION = 0.7
ROUNDS = 200
PRECISION = 1e-6
# Standard deviation of the filter that takes out noise, in pixels.
SMOOTHING = 5


class CameraMoved(AcquisitionError):
    """The camera, or the first projector, is not where it was."""


def blocks(grid: tuple[int, int]) -> np.ndarray:
    """Codes (h, w) of blocks that are on or off at random, `BLOCKS` along the shorter side."""
    height, width = grid
    side = max(min(grid) // BLOCKS, 1)
    random = np.random.default_rng(0)
    coarse = random.random((-(-height // side), -(-width // side))) < 0.5
    return np.kron(coarse, np.ones((side, side)))[:height, :width].astype(np.float32)


def find_movement(before: np.ndarray, after: np.ndarray) -> float:
    """Distance in pixels by which a photograph (H, W[, 3]) has moved; infinite if it is another.

    >>> picture = cv2.GaussianBlur(np.random.default_rng(0).random((60, 90)), (0, 0), 3)
    >>> bool(abs(find_movement(picture[:, 2:], picture[:, :-2]) - 2.0) < 0.05)
    True
    """
    step = math.ceil(math.sqrt(before.shape[0] * before.shape[1] / MAX_COMPARED_PIXELS))
    old = _reduced(before, step)
    new = _reduced(after, step)
    lit = (old > LIT_SHARE * np.quantile(old, 0.99)).astype(np.uint8)
    lit = cv2.dilate(lit, np.ones((5, 5), np.uint8))
    (right, down), _ = cv2.phaseCorrelate(old.astype(np.float64), new.astype(np.float64))
    first = np.array([[1.0, 0.0, right], [0.0, 1.0, down]], np.float32)
    candidates = []
    for start in (np.eye(2, 3, dtype=np.float32), first):
        correlation, warp = _aligned(old, new, start, lit)
        candidates.append((correlation, _largest_distance(warp, lit)))
    correlation, distance = max(candidates)
    if correlation < MIN_CORRELATION:
        return math.inf
    return step * distance


def _reduced(photograph: np.ndarray, step: int) -> np.ndarray:
    """A photograph in grey, with `step` times fewer pixels along each side."""
    grey = photograph if photograph.ndim == 2 else photograph.mean(axis=2)
    grey = grey.astype(np.float32)
    if step == 1:
        return grey
    height, width = grey.shape
    return cv2.resize(grey, (width // step, height // step), interpolation=cv2.INTER_AREA)


def _aligned(
    old: np.ndarray, new: np.ndarray, start: np.ndarray, lit: np.ndarray
) -> tuple[float, np.ndarray]:
    """The correlation of two pictures after an affine map, and the map."""
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, ROUNDS, PRECISION)
    try:
        return cv2.findTransformECC(old, new, start.copy(), cv2.MOTION_AFFINE, stop, lit, SMOOTHING)
    except cv2.error:
        # It found no way from there.
        return -1.0, start


def _largest_distance(warp: np.ndarray, lit: np.ndarray) -> float:
    """The largest distance by which a map moves a lit pixel."""
    row, column = np.nonzero(lit)
    places = np.stack([column, row, np.ones_like(row)]).astype(np.float64)
    moved = warp.astype(np.float64) @ places - places[:2]
    return float(np.hypot(*moved).max())


def check_camera(before: np.ndarray, after: np.ndarray, between: str) -> float:
    """The movement in camera pixels; CameraMoved if it is too large.

    `between` says between which scans it lies.
    """
    movement = find_movement(before, after)
    if movement <= MAX_MOVEMENT:
        return movement
    distance = "so far that it cannot be told"
    if math.isfinite(movement):
        distance = f"by {movement:.2g} camera pixels"
    raise CameraMoved(
        f"the camera or the first projector moved {distance} {between}; at most {MAX_MOVEMENT:g} "
        "may be"
    )
