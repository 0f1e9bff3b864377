# SPDX-License-Identifier: BSD-3-Clause
"""A sample of rows of one channel of T, and the damages that show in single rows.

Rows are dense (n, N). The diagonal entry of each is replaced by the mean of its others, as direct
light is much brighter. Parts of the grid, a sixth of a row of pixels each, average noise out.
"""

from __future__ import annotations

import numpy as np

from ltcl.transport.transport import Transport
from ltcl.transport.verdict.host_system import HostSystem

# Entries to read of a channel.
MAX_ENTRIES = 1 << 24
# Parts of a row of the grid.
PARTS_PER_ROW = 6
# Mean light of a hot row, times that of the median row.
HOT_ROW_RATIO = 5.0
# Least light of a part of a hot row, to the mean of all parts.
HOT_ROW_EVENNESS = 0.5
# Quantile of the parts that tells an offset, and standard deviations of noise below 0.
OFFSET_QUANTILE = 0.02
OFFSET_SIGMAS = 5.0
# An outlier is above this share of F, and above these standard deviations of noise.
OUTLIER_SHARE = 0.1
OUTLIER_SIGMAS = 10.0
# Times its brightest neighbour.
OUTLIER_RATIO = 5.0
MIN_LIGHT = 1e-300


class RowSample:
    """Rows of T at evenly spaced camera pixels.

    Attributes
    ----------
    pixels : (n,)
        Their numbers, ascending.
    rows : (n, N)
        Without direct light.
    direct : (n,)
        Diagonal entries.
    """

    def __init__(self, T: Transport, S: HostSystem, channel: int) -> None:
        self.T = T
        self.S = S
        self.channel = channel
        N = T.shape[1]
        count = max(min(N, MAX_ENTRIES // N), 1)
        self.pixels = np.unique(np.linspace(0, N - 1, count).astype(int))
        self.rows = self._read_rows()
        index = np.arange(len(self.pixels))
        self.direct = self.rows[index, self.pixels].copy()
        self._brightest = self.rows.argmax(axis=1)
        self._brightest_light = self.rows[index, self._brightest]
        others = self.rows.sum(axis=1) - self.direct
        self.rows[index, self.pixels] = others / max(N - 1, 1)
        self._average_parts()

    def _read_rows(self) -> np.ndarray:
        matrix = self.S.T
        if isinstance(matrix, np.ndarray):
            rows = matrix[self.pixels]
        else:
            rows = matrix[self.pixels].toarray()
        return rows.astype(np.result_type(rows, np.float32), copy=False)

    def _average_parts(self) -> None:
        """Mean light of parts of the grid, and the rows that see all patterns alike."""
        height, width = self.T.grid
        N = height * width
        row_starts = np.arange(0, N, width)
        part_starts = np.unique(np.arange(PARTS_PER_ROW) * width // PARTS_PER_ROW)
        # First projector pixel of each part.
        self._part_starts = np.add.outer(row_starts, part_starts).ravel()
        self._part_sizes = np.diff(np.append(self._part_starts, N))
        sums = np.add.reduceat(self.rows, self._part_starts, axis=1)
        self._levels = sums.astype(np.float64) / self._part_sizes
        mean = self._levels.mean(axis=1)
        is_bright = mean > HOT_ROW_RATIO * np.median(np.abs(mean))
        is_even = self._levels.min(axis=1) > HOT_ROW_EVENNESS * mean
        self.is_hot = is_bright & is_even
        self._levels[self.is_hot] = 0.0

    def shifted(self) -> tuple[float, str]:
        """Share of pixels that are brightest at one distance from their own, and this distance."""
        N = self.T.shape[1]
        width = self.T.grid[1]
        is_elsewhere = self._brightest_light > np.maximum(self.direct, 0.0)
        moves = np.where(is_elsewhere, self._brightest - self.pixels, 0)
        # N stands for no move at all.
        distances, counts = np.unique(np.append(moves[moves != 0], N), return_counts=True)
        move = int(distances[counts.argmax()])
        rows = round(move / width)
        return float(np.mean(moves == move)), f"{rows} rows and {move - rows * width} columns"

    def hot_pixels(self) -> np.ndarray:
        """Camera pixels that see all patterns alike."""
        return self.pixels[self.is_hot]

    def negative_offset(self) -> float:
        """Light below 0 of the darkest blocks, beyond noise, over the mean of all blocks."""
        N = self.T.shape[1]
        # Rows of the sample whose pixels lie in the same part.
        group_starts = np.searchsorted(self.pixels, self._part_starts)
        group_starts = np.unique(group_starts.clip(max=len(self.pixels) - 1))
        group_sizes = np.diff(np.append(group_starts, len(self.pixels)))
        blocks = np.add.reduceat(self._levels, group_starts) / group_sizes[:, None]
        floor = self.noise_floor()
        entries_per_part = N / len(self._part_sizes)
        variance = np.add.reduceat(floor**2, group_starts) / entries_per_part
        spread = np.sqrt(variance) / group_sizes
        above_noise = blocks + OFFSET_SIGMAS * spread[:, None]
        below = -float(np.quantile(above_noise, OFFSET_QUANTILE))
        return max(below, 0.0) / max(float(np.abs(blocks).mean()), MIN_LIGHT)

    def outliers(self) -> tuple[float, np.ndarray]:
        """Light of entries far above all neighbours, over that of F, and their camera pixels."""
        F = self.S.F
        least = np.where(F > 0, OUTLIER_SHARE * F, np.inf)
        least = np.maximum(least, OUTLIER_SIGMAS * self.noise_floor()[:, None])
        least[self.is_hot | self.T.masked[self.pixels]] = np.inf
        least = least.astype(self.rows.dtype)
        i, j = np.nonzero(self.rows > least)
        candidates = self.rows[i, j]
        is_lone = candidates > OUTLIER_RATIO * self._brightest_neighbours(i, j)
        light = float(np.linalg.norm(candidates[is_lone]))
        direct = float(np.linalg.norm(F[self.pixels]))
        return light / max(direct, MIN_LIGHT), self.pixels[i[is_lone]]

    def _brightest_neighbours(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """The brightest neighbour of entries (i, j) of the sample.

        Neighbours are those of the projector's pixel, those of the camera's, and the light the
        other way.
        """
        n, N = self.rows.shape
        width = self.T.grid[1]
        neighbours = []
        for distance in (1, -1, width, -width):
            neighbours.append(self.rows[i, np.clip(j + distance, 0, N - 1)])
        for row in (i - 1, i + 1):
            neighbours.append(self.rows[np.clip(row, 0, n - 1), j])
        other_way = np.searchsorted(self.pixels, j)
        neighbours.append(self.rows[np.clip(other_way, 0, n - 1), self.pixels[i]])
        return np.max(neighbours, axis=0)

    def noise_floor(self) -> np.ndarray:
        """Standard deviation (n,) of an entry without light of each row."""
        noise = self.T.noise
        rows = noise.rows[self.channel]
        column_mean = noise.columns[self.channel].mean()
        return noise.floor[self.channel] * np.sqrt(rows * column_mean)[self.pixels]

    def scaled_power(self, inverse_F: np.ndarray) -> float:
        """Sum of the squares of F^-1/2 (rows of T) F^-1/2."""
        scaled = self.rows * np.sqrt(inverse_F).astype(self.rows.dtype)
        light = np.square(scaled).sum(axis=1, dtype=np.float64)
        return float(light @ inverse_F[self.pixels])
