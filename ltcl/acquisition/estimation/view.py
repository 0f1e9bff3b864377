# SPDX-License-Identifier: BSD-3-Clause
"""The map from camera pixels to the projector's, from pairs of patterns and photographs.

A camera pixel sees the projector pixel whose light changes from pattern to pattern as its own does.
Pictures are smooth, and light from elsewhere too: both sides are compared by what stands out of
their surroundings. The correlation of a pixel is largest at the one that it sees, and a parabola
through its neighbours tells where between them. Neighbouring camera pixels see one surface: the map
is that of planes through them, which also reach to the rim of the picture, where the parabola lacks
a side.
"""

from __future__ import annotations

import numpy as np
import scipy  # its subpackage ndimage is loaded at the first use

from ltcl.acquisition.agreement import standardised
from ltcl.acquisition.estimation.pairs import Pairs
from ltcl.acquisition.geometry import Correspondence
from ltcl.errors import AcquisitionError

# Standard deviation of the surroundings, in projector pixels.
SURROUNDINGS = 2.0
# Correlation from which on a camera pixel is known to see a projector pixel.
LEAST_CORRELATION = 0.5
# Share of the camera pixels that see the projector that must be known.
LEAST_KNOWN_SHARE = 0.5
# A camera pixel sees the projector if its light changes by so much of the largest change.
SEEING_SHARE = 0.1
# Standard deviation of the neighbours that a plane goes through, in projector pixels, the share of
# them that must be known, and by how much a pixel may be off the plane.
PLANE_WIDTH = 1.5
LEAST_PLANE_SHARE = 0.2
MAX_OFF_PLANE = 1.0
# Correlations at once.
CHUNK_NUMBERS = 1 << 25


def find_view(pairs: Pairs) -> Correspondence:
    """The projector pixel that each camera pixel sees.

    AcquisitionError if the pairs do not show it.
    """
    shown = _details(pairs.patterns, pairs.grid, SURROUNDINGS)
    side = np.sqrt(np.prod(pairs.camera_grid) / np.prod(pairs.grid))
    seen = _details(pairs.photographs, pairs.camera_grid, SURROUNDINGS * side)
    change = seen.std(axis=0)
    sees_light = change > SEEING_SHARE * np.quantile(change, 0.99)
    x = np.full(len(change), np.nan)
    y = np.full(len(change), np.nan)
    pixels = np.flatnonzero(sees_light)
    shown = standardised(shown)
    seen = standardised(seen[:, pixels])
    step = max(CHUNK_NUMBERS // shown.shape[1], 1)
    for start in range(0, len(pixels), step):
        chunk = pixels[start : start + step]
        correlation = shown.T @ seen[:, start : start + step] / len(pairs)
        x[chunk], y[chunk] = _peaks(correlation.reshape(*pairs.grid, -1))
    x, y = _on_planes(x, y, pairs.camera_grid, PLANE_WIDTH * side)
    height, width = pairs.grid
    is_inside = (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
    valid = np.isfinite(x) & np.where(np.isfinite(x), is_inside, False)
    known = np.count_nonzero(valid) / max(len(pixels), 1)
    if known < LEAST_KNOWN_SHARE:
        raise AcquisitionError(
            f"the pairs show for only {known:.0%} of the camera pixels which projector pixel they "
            "see; give geometry, or patterns with more detail"
        )
    shape = pairs.camera_grid
    return Correspondence(
        x=x.reshape(shape),
        y=y.reshape(shape),
        valid=valid.reshape(shape),
        grid=pairs.grid,
    )


def _details(pictures: np.ndarray, grid: tuple[int, int], sigma: float) -> np.ndarray:
    """Pictures (frames, pixels, channels), grey, less their surroundings: (frames, pixels)."""
    grey = pictures.mean(axis=2).reshape(-1, *grid)
    surroundings = scipy.ndimage.gaussian_filter(grey, (0.0, sigma, sigma), mode="nearest")
    return (grey - surroundings).reshape(len(grey), -1)


def _peaks(correlation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows of the peaks of correlations (h, w, n), NaN where there is none."""
    h, w, n = correlation.shape
    number = np.arange(n)
    best = correlation.reshape(h * w, n).argmax(axis=0)
    row, column = np.divmod(best, w)
    peak = correlation[row, column, number]

    def offset(before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Place of the top of a parabola, from -1/2 to 1/2."""
        curvature = np.minimum(before + after - 2.0 * peak, -1e-9)
        return np.clip(0.5 * (before - after) / curvature, -0.5, 0.5)

    above = correlation[np.maximum(row - 1, 0), column, number]
    below = correlation[np.minimum(row + 1, h - 1), column, number]
    left = correlation[row, np.maximum(column - 1, 0), number]
    right = correlation[row, np.minimum(column + 1, w - 1), number]
    is_clear = peak > LEAST_CORRELATION
    has_sides = (row > 0) & (row < h - 1) & (column > 0) & (column < w - 1)
    is_known = is_clear & has_sides
    x = np.where(is_known, column + offset(left, right), np.nan)
    y = np.where(is_known, row + offset(above, below), np.nan)
    return x, y


def _on_planes(
    x: np.ndarray, y: np.ndarray, grid: tuple[int, int], sigma: float
) -> tuple[np.ndarray, np.ndarray]:
    """The map on planes through the known pixels nearby; NaN where there are too few of them.

    Pixels that are off their plane keep what they have: there is an edge.
    """
    known = np.isfinite(x).reshape(grid)
    row, column = np.indices(grid).astype(np.float64)

    def mean(values: np.ndarray) -> np.ndarray:
        weighted = np.where(known, values, 0.0)
        return scipy.ndimage.gaussian_filter(weighted, sigma, mode="constant")

    weight = mean(np.ones(grid))
    is_supported = weight > LEAST_PLANE_SHARE
    weight = np.where(is_supported, weight, 1.0)
    middle_row = mean(row) / weight
    middle_column = mean(column) / weight
    rr = mean(row**2) / weight - middle_row**2
    cc = mean(column**2) / weight - middle_column**2
    rc = mean(row * column) / weight - middle_row * middle_column
    determinant = np.maximum(rr * cc - rc**2, 1e-9)
    planes = []
    for values in (x.reshape(grid), y.reshape(grid)):
        middle = mean(values) / weight
        down = mean(row * values) / weight - middle_row * middle
        across = mean(column * values) / weight - middle_column * middle
        per_row = (cc * down - rc * across) / determinant
        per_column = (rr * across - rc * down) / determinant
        plane = middle + per_row * (row - middle_row) + per_column * (column - middle_column)
        is_off = known & (np.abs(plane - values) > MAX_OFF_PLANE)
        planes.append(np.where(is_off, values, np.where(is_supported, plane, np.nan)).ravel())
    return planes[0], planes[1]
