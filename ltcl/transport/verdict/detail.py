# SPDX-License-Identifier: BSD-3-Clause
"""Changes from pixel to pixel that no scene explains: offsets of rows, and gains of columns.

The light that camera pixel i gets from distant parts of the projector's grid is smooth in i, but
for the albedo a_i. With its mean B_i over the brighter half of these parts, and D_i over the darker
half, per projector pixel, and F_i its direct light:

    an offset o_i of row i      B_i = a_i b + o_i,  D_i = a_i d + o_i
    a gain g_i of column i      F_i = a_i f g_i

so that D / B = d/b + o / (a b) (1 - d/b) shows o without albedos and gains, and log((B - D) / F)
shows g without albedos and offsets; if there are no offsets, all indirect light in the place of
B - D does so with less noise, and less of what is curved.
What changes smoothly, or steps along an axis, is left out by mixed second differences

    (x[r, c] - x[r, c+1] - x[r+1, c] + x[r+1, c+1]) / 2

within a part of the grid; those of pixels that are 2 apart tell what is curved. Single pixels are
left out by medians.
"""

from __future__ import annotations

import math

import numpy as np

from ltcl.transport.verdict.host_system import HostErrors, HostSystem

# Pixels along a side of a part, at least, and parts along a side of the grid, at most.
PART_SIDE = 3
MAX_PARTS_PER_SIDE = 6
# Median of |x| to the standard deviation of normal x.
MEDIAN_PER_STD = 0.6745
# Factor of a standard deviation that was estimated.
NOISE_MARGIN = 1.5
# Noise of distant light, relative to it, from which on nothing is seen.
MAX_NOISE = 0.3
# d / b, from which on parts are too even to tell an offset from an albedo.
MAX_EVENNESS = 0.8
MIN_LIGHT = 1e-300


class LightDetail:
    """Distant light of one channel of a square T, in halves.

    Attributes
    ----------
    bright, dark : (N,)
        B and D; NaN at pixels that are not lit, or have no distant parts.
    bright_std, dark_std : (N,)
        Their standard deviations by noise.
    typical_bright, evenness : (N,)
        Median B, and d / b, of the part of the grid that a pixel is in.
    indirect, indirect_std : (N,)
        Light of each pixel under white but for the first bounce, and its standard deviation.
    median_white : float
        Median light of lit pixels under white.
    """

    def __init__(
        self, S: HostSystem, errors: HostErrors, channel: int, grid: tuple[int, int]
    ) -> None:
        self.S = S
        self.grid = grid
        self.direct_std = np.sqrt(errors.diagonal_variance(channel))
        self.is_lit = S.F > 0
        self._rows = _parts_along(grid[0])
        self._columns = _parts_along(grid[1])
        columns = self._columns[-1] + 1
        self.part = (self._rows[:, None] * columns + self._columns).ravel()
        is_in_part = self.part[:, None] == np.arange(self.part[-1] + 1)
        sizes = is_in_part.sum(axis=0)
        means = is_in_part / sizes
        levels = np.asarray(S.T @ means.astype(np.float32), np.float64)
        variances = np.maximum(errors.variance(channel, means / sizes), 0.0)
        white = (levels * sizes).sum(axis=1)
        self.indirect = white - S.T.diagonal()
        self.indirect_std = np.sqrt((variances * sizes**2).sum(axis=1))
        self.median_white = max(float(np.median(white[self.is_lit])), MIN_LIGHT)
        self._split(levels, variances)

    def _split(self, levels: np.ndarray, variances: np.ndarray) -> None:
        """Means of the brighter and of the darker half of the distant parts of each pixel."""
        N = len(levels)
        self.bright = np.full(N, np.nan)
        self.dark = np.full(N, np.nan)
        self.bright_std = np.full(N, np.nan)
        self.dark_std = np.full(N, np.nan)
        self.typical_bright = np.full(N, np.nan)
        self.evenness = np.full(N, np.nan)
        for part in range(levels.shape[1]):
            pixels = np.flatnonzero((self.part == part) & self.is_lit)
            distant = self._distant_parts(part)
            half = len(distant) // 2
            if half == 0 or len(pixels) == 0:
                continue
            typical = np.median(levels[pixels][:, distant], axis=0)
            order = distant[np.argsort(typical)]
            halves = {"dark": order[:half], "bright": order[half:]}
            for name, parts in halves.items():
                variance = variances[pixels][:, parts].sum(axis=1) / len(parts) ** 2
                getattr(self, name)[pixels] = levels[pixels][:, parts].mean(axis=1)
                getattr(self, f"{name}_std")[pixels] = np.sqrt(variance)
            bright = np.median(self.bright[pixels])
            dark = np.median(self.dark[pixels])
            self.typical_bright[pixels] = bright
            self.evenness[pixels] = dark / bright if bright > 0 else 1.0

    def _distant_parts(self, part: int) -> np.ndarray:
        """The parts that do not touch this one."""
        rows = self._rows[-1] + 1
        columns = self._columns[-1] + 1
        row, column = divmod(part, columns)
        all_rows, all_columns = np.divmod(np.arange(rows * columns), columns)
        is_distant = (abs(all_rows - row) > 1) | (abs(all_columns - column) > 1)
        return np.flatnonzero(is_distant)

    def row_offset(self) -> float:
        """Offset of a row, in the light of all its pixels, over the median light under white."""
        evenness = np.where(self.evenness < MAX_EVENNESS, self.evenness, np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            if not _median(np.abs(self.bright_std / self.bright)) < MAX_NOISE:
                return 0.0
            scale = self.typical_bright / (1.0 - evenness)
            offset = scale * self.dark / self.bright
            noise = scale * np.hypot(self.dark_std, evenness * self.bright_std) / self.bright
        return len(offset) / self.median_white * self._beyond_noise(offset, noise)

    def column_gain(self, has_offset: bool) -> float:
        """Relative change of the light from column to column."""
        gain = self._gain_of(self.indirect, self.indirect_std)
        difference = self.bright - self.dark
        noise = np.hypot(self.bright_std, self.dark_std)
        gain_of_difference = self._gain_of(difference, noise)
        if not math.isnan(gain_of_difference):
            # Offsets raise the first one, and curved light the second one.
            return float(np.fmin(gain, gain_of_difference))
        if has_offset or math.isnan(gain):
            return 0.0
        return gain

    def _gain_of(self, light: np.ndarray, noise: np.ndarray) -> float:
        """Relative change of light (N,) over F; NaN if noise hides it."""
        F = self.S.F
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.log(np.where(light > 0, light, np.nan) / F)
            relative_noise = np.hypot(noise / light, self.direct_std / F)
        typical_noise = NOISE_MARGIN * _median(np.abs(relative_noise))
        if not typical_noise < MAX_NOISE:
            return math.nan
        return self._beyond_noise(logs, relative_noise)

    def _beyond_noise(self, x: np.ndarray, noise: np.ndarray) -> float:
        """Standard deviation of x (N,) from pixel to pixel that its noise does not explain."""
        near = self._mixed_difference(x, step=1)
        far = self._mixed_difference(x, step=2)
        # Independent values change by as much at both distances, curved ones 4 times as much.
        square = (16.0 * near**2 - far**2) / 15.0
        known_noise = NOISE_MARGIN * _median(noise)
        return math.sqrt(max(square - known_noise**2, 0.0))

    def _mixed_difference(self, x: np.ndarray, step: int) -> float:
        """Typical mixed difference of x (N,) between pixels of one part, in the unit of x."""
        x = x.reshape(self.grid)
        along_rows = x[:, step:] - x[:, :-step]
        detail = (along_rows[step:] - along_rows[:-step]) / 2.0
        is_within = (self._rows[step:] == self._rows[:-step])[:, None]
        is_within = is_within & (self._columns[step:] == self._columns[:-step])
        return _median(np.abs(detail[is_within])) / MEDIAN_PER_STD


def _parts_along(pixels: int) -> np.ndarray:
    """The part that each pixel along a side of the grid is in."""
    parts = int(np.clip(pixels // PART_SIDE, 1, MAX_PARTS_PER_SIDE))
    return np.arange(pixels) * parts // pixels


def _median(values: np.ndarray) -> float:
    """Median of the finite values; 0 if there are none."""
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return 0.0
    return float(np.median(finite))
