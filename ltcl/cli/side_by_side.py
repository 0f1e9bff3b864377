# SPDX-License-Identifier: BSD-3-Clause
"""Virtual projectors side by side before a scene, for `ltcl simulate --projectors`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

# Overlap of neighbours, of the width of each.
OVERLAP = 1.0 / 3.0
# By how much of the scene projectors light beyond its border.
MARGIN = 0.04
# Standard deviation of the blur of a projector pixel, in pixels.
BLUR = 0.45
# Height and width of a projector, at least: fewer pixels are too few for a scan.
MIN_PIXELS = 8
# Brightness of projectors, repeated.
BRIGHTNESS = (0.8, 1.0, 0.9)
MIN_WEIGHT = 1e-3
NAMES_OF_TWO = ("left", "right")


@dataclass(frozen=True, kw_only=True)
class VirtualProjector:
    """A projector of `grid` pixels on the columns of a scene from `left` to `right`, 0 to 1."""

    name: str
    grid: tuple[int, int]
    left: float
    right: float
    brightness: float

    def direct(self, scene_grid: tuple[int, int]) -> scipy.sparse.csr_array:
        """The part of each projector pixel in the direct light of patches, (M, N)."""
        height, width = scene_grid
        rows = _weights(height, (-MARGIN, 1.0 + MARGIN), self.grid[0])
        columns = _weights(width, (self.left, self.right), self.grid[1])
        product = scipy.sparse.kron(scipy.sparse.csr_array(rows), scipy.sparse.csr_array(columns))
        return scipy.sparse.csr_array(self.brightness * product)


def _weights(patches: int, span: tuple[float, float], pixels: int) -> np.ndarray:
    """Weights (patches, pixels) along one side."""
    begin, end = span
    place = (np.arange(patches) + 0.5) / patches
    at = (place - begin) / (end - begin) * pixels - 0.5
    blurred = np.exp(-0.5 * np.square((at[:, None] - np.arange(pixels)) / BLUR))
    blurred /= BLUR * np.sqrt(2.0 * np.pi)
    return np.where(blurred > MIN_WEIGHT, blurred, 0.0)


def side_by_side(count: int, scene_grid: tuple[int, int]) -> list[VirtualProjector]:
    """Projectors from left to right, whose pixels are about as large as patches, or smaller.

    >>> [p.grid for p in side_by_side(2, (16, 32))]
    [(17, 21), (17, 21)]
    """
    height, width = scene_grid
    size = (1.0 + 2.0 * MARGIN) / (count - (count - 1) * OVERLAP)
    rows = round((1.0 + 2.0 * MARGIN) * height)
    columns = round(size * width)
    grid = (max(rows, MIN_PIXELS), max(columns, MIN_PIXELS))
    projectors = []
    for number in range(count):
        left = number * size * (1.0 - OVERLAP) - MARGIN
        name = NAMES_OF_TWO[number] if count == 2 else f"projector{number + 1}"
        projectors.append(
            VirtualProjector(
                name=name,
                grid=grid,
                left=left,
                right=left + size,
                brightness=BRIGHTNESS[number % len(BRIGHTNESS)],
            )
        )
    return projectors
