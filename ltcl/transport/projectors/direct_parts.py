# SPDX-License-Identifier: BSD-3-Clause
"""The direct light F_k (M, N_k) in the T_k of a projector: what lies around the peak of a row.

Direct light of a camera pixel comes from few projector pixels side by side, and indirect light from
everywhere. The window around the brightest entry is direct, less the level of the ring around it; a
row without a peak that stands out of its ring has no direct light of this projector. Beside a
crease the other wall is in the window, too: there direct light is as wide as it is elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse

# Values of the rows that are searched at once.
BLOCK_VALUES = 1 << 22
# Pixels of the largest window to each side, and rows that tell the size.
MAX_RADIUS = 6
SAMPLED_ROWS = 512
# Share of a peak down to which the light around it decides on the size of the window.
SPREAD_SHARE = 0.1
# Share of the peak that stands out of the ring around the window, at least.
MIN_CONTRAST = 0.5
# Times the peak of bright rows: dimmer rows have no direct light.
MIN_PEAK = 0.02
BRIGHT_QUANTILE = 0.9
# Times the spread of nine in ten rows, above which light beside the peak is indirect.
MAX_SPREAD = 1.75
SPREAD_QUANTILE = 0.9


class Peaks(NamedTuple):
    """The brightest entry of each row: its projector pixel, and its value, (M,) each."""

    pixels: np.ndarray
    values: np.ndarray

    def at(self, rows: np.ndarray) -> Peaks:
        """The entries of some rows."""
        return Peaks(self.pixels[rows], self.values[rows])


def direct_parts(
    matrices: Sequence[Any], grid: tuple[int, int]
) -> tuple[scipy.sparse.csr_array, ...]:
    """F_k of each channel: the direct part of matrices (M, N_k) on a projector's grid."""
    peaks = _find_peaks(matrices)
    sampled = _sampled_rows(peaks)
    total = _total_light(matrices, sampled)
    radius = _find_radius(total, grid, peaks.at(sampled))
    largest = MAX_SPREAD * _find_spread(total, grid, peaks.at(sampled), radius)
    values: list[list[np.ndarray]] = [[] for _ in matrices]
    pixels = []
    for first, blocks in _row_blocks(matrices):
        rows = slice(first, first + len(blocks[0]))
        window = _window(peaks.pixels[rows], radius, grid)
        ring = _ring(peaks.pixels[rows], radius + 1, grid)
        total = np.sum(blocks, axis=0)
        level = _level(total, ring)
        peak = peaks.values[rows]
        is_direct = peak - level > MIN_CONTRAST * peak
        is_direct &= peak > MIN_PEAK * np.quantile(peaks.values, BRIGHT_QUANTILE)
        pixels.append(window)
        light = _above_level(total, window, ring, radius)
        allowed = largest * light.max(axis=1, keepdims=True)
        share = np.divide(allowed, light, out=np.ones_like(light), where=light > allowed)
        share[~is_direct] = 0.0
        for channel, block in enumerate(blocks):
            values[channel].append(share * _above_level(block, window, ring, radius))
    columns = np.concatenate(pixels)
    shape = (len(columns), grid[0] * grid[1])
    matrices_of_channels = []
    for channel_values in values:
        matrices_of_channels.append(_sparse(np.concatenate(channel_values), columns, shape))
    return tuple(matrices_of_channels)


def _row_blocks(matrices: Sequence[Any]) -> Iterator[tuple[int, list[np.ndarray]]]:
    """First row, and some rows of each channel as arrays."""
    M, N = matrices[0].shape
    step = max(BLOCK_VALUES // N, 1)
    for first in range(0, M, step):
        blocks = []
        for matrix in matrices:
            rows = matrix[first : first + step]
            if scipy.sparse.issparse(rows):
                rows = rows.toarray()
            blocks.append(np.asarray(rows, np.float64))
        yield first, blocks


def _find_peaks(matrices: Sequence[Any]) -> Peaks:
    pixels = []
    values = []
    for _, blocks in _row_blocks(matrices):
        total = np.sum(blocks, axis=0)
        brightest = total.argmax(axis=1)
        pixels.append(brightest)
        values.append(np.take_along_axis(total, brightest[:, None], axis=1)[:, 0])
    return Peaks(np.concatenate(pixels), np.concatenate(values))


def _sampled_rows(peaks: Peaks) -> np.ndarray:
    """Some of the bright rows."""
    bright = np.flatnonzero(peaks.values >= np.quantile(peaks.values, 0.5))
    return bright[:: max(len(bright) // SAMPLED_ROWS, 1)]


def _total_light(matrices: Sequence[Any], rows: np.ndarray) -> np.ndarray:
    """Sum of these rows over all channels, (rows, N)."""
    total: Any = 0.0
    for matrix in matrices:
        block = matrix[rows]
        if scipy.sparse.issparse(block):
            block = block.toarray()
        total = total + np.asarray(block, np.float64)
    return total


def _find_radius(total: np.ndarray, grid: tuple[int, int], peaks: Peaks) -> int:
    """Half the side of the windows, by the area around the peaks of bright rows."""
    window = _window(peaks.pixels, MAX_RADIUS, grid)
    light = np.take_along_axis(total, np.maximum(window, 0), axis=1)
    light = np.where(window >= 0, light, 0.0)
    areas = np.count_nonzero(light > SPREAD_SHARE * peaks.values[:, None], axis=1)
    radius = int(np.ceil((np.sqrt(np.median(areas)) - 1.0) / 2.0)) + 1
    return min(radius, MAX_RADIUS)


def _find_spread(total: np.ndarray, grid: tuple[int, int], peaks: Peaks, radius: int) -> np.ndarray:
    """Direct light beside the peak, relative to it, which few bright rows exceed, (window,)."""
    window = _window(peaks.pixels, radius, grid)
    ring = _ring(peaks.pixels, radius + 1, grid)
    light = _above_level(total, window, ring, radius)
    relative = light / np.maximum(light.max(axis=1, keepdims=True), np.finfo(float).tiny)
    is_outside = window < 0
    relative[is_outside] = np.nan
    # Neighbours that no row has here are not limited.
    relative[:, is_outside.all(axis=0)] = 1.0
    return np.nanquantile(relative, SPREAD_QUANTILE, axis=0)


def _offsets(radius: int) -> np.ndarray:
    """Steps (y, x) to the pixels of a square window, (pixels, 2)."""
    side = np.arange(-radius, radius + 1)
    y, x = np.meshgrid(side, side, indexing="ij")
    return np.stack([y.ravel(), x.ravel()], axis=1)


def _neighbours(pixels: np.ndarray, offsets: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """Pixels at these steps from each pixel, (rows, steps); -1 beyond the border."""
    height, width = grid
    y = pixels[:, None] // width + offsets[:, 0]
    x = pixels[:, None] % width + offsets[:, 1]
    is_inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
    return np.where(is_inside, y * width + x, -1)


def _window(pixels: np.ndarray, radius: int, grid: tuple[int, int]) -> np.ndarray:
    return _neighbours(pixels, _offsets(radius), grid)


def _ring(pixels: np.ndarray, radius: int, grid: tuple[int, int]) -> np.ndarray:
    """The pixels at the border of a window."""
    offsets = _offsets(radius)
    is_border = np.abs(offsets).max(axis=1) == radius
    return _neighbours(pixels, offsets[is_border], grid)


def _above_level(
    block: np.ndarray, window: np.ndarray, ring: np.ndarray, radius: int
) -> np.ndarray:
    """Light in the window above the level of indirect light, (rows, window)."""
    light = np.take_along_axis(block, np.maximum(window, 0), axis=1)
    light = np.maximum(light - _levels(block, ring, radius), 0.0)
    return np.where(window >= 0, light, 0.0)


def _levels(block: np.ndarray, ring: np.ndarray, radius: int) -> np.ndarray:
    """Indirect light in the window, (rows, pixels): that of the ring in the same direction.

    Beside a crease it is brighter on the side of the other wall.
    """
    light = np.take_along_axis(block, np.maximum(ring, 0), axis=1)
    light = np.where(ring >= 0, light, np.nan)
    median = _level(block, ring)
    light = np.where(np.isnan(light), median[:, None], light)
    levels = light @ _directions(radius)
    # In the middle all directions count.
    levels[:, levels.shape[1] // 2] = median
    return np.maximum(levels, 0.0)


def _directions(radius: int) -> np.ndarray:
    """Means (ring, window) over the three pixels of the ring that are nearest in direction."""
    ring = _offsets(radius + 1)
    ring = ring[np.abs(ring).max(axis=1) == radius + 1]
    window = _offsets(radius)
    ring_unit = ring / np.linalg.norm(ring, axis=1, keepdims=True)
    lengths = np.maximum(np.linalg.norm(window, axis=1, keepdims=True), 1.0)
    cosines = ring_unit @ (window / lengths).T
    nearest = np.argsort(-cosines, axis=0)[:3]
    means = np.zeros(cosines.shape)
    np.put_along_axis(means, nearest, 1.0 / 3.0, axis=0)
    return means


def _level(block: np.ndarray, ring: np.ndarray) -> np.ndarray:
    """Median light of the ring of each row; 0 where the grid has none."""
    light = np.take_along_axis(block, np.maximum(ring, 0), axis=1)
    light = np.where(ring >= 0, light, np.nan)
    is_empty = np.all(ring < 0, axis=1)
    light[is_empty] = 0.0
    return np.maximum(np.nanmedian(light, axis=1), 0.0)


def _sparse(
    values: np.ndarray, columns: np.ndarray, shape: tuple[int, int]
) -> scipy.sparse.csr_array:
    is_lit = values > 0.0
    rows, _ = np.nonzero(is_lit)
    entries = (values[is_lit], (rows, columns[is_lit]))
    return scipy.sparse.csr_array(entries, shape=shape)
