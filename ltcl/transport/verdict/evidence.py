# SPDX-License-Identifier: BSD-3-Clause
"""Numbers that a measured T gives about its noise and its damages, computed on the host.

Errors by noise are those of `ltcl.transport.uncertainty`, for the picture under white, a plain
picture under its pattern, and bounces 1 to 3 under white,

    b_k = A b_(k-1) = b_(k-1) - S^-1 b_(k-1),    b_0 = F
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ltcl.errors import InputError
from ltcl.transport import diagnostics
from ltcl.transport.covariance import channel_matrices
from ltcl.transport.diagnostics.choice import bounce_spreads, solved_system
from ltcl.transport.first_bounce import ENTRIES
from ltcl.transport.transport import Transport
from ltcl.transport.uncertainty import bounce_variances
from ltcl.transport.verdict.colours import exchanged_colours
from ltcl.transport.verdict.detail import LightDetail
from ltcl.transport.verdict.host_system import HostErrors, HostSystem
from ltcl.transport.verdict.nearest_system import nearest_system
from ltcl.transport.verdict.row_sample import RowSample
from ltcl.transport.verdict.saturation import quantization, saturated_entries

# Fewer pixels tell neither parts of the picture nor noise.
MIN_PIXELS = 64
# Factor of a standard deviation that was estimated.
NOISE_MARGIN = 1.5
# Share of pixels that a plain picture reaches.
REACHED_SHARE = 0.9
# Direct light above the median of its column, to that of the median pixel: a pixel with less lights
# nothing, if its column is not twice as bright where it should be either.
DEAD_SHARE = 0.02
DEAD_RATIO = 2.0
# Offsets of rows, in pictures, from which on they are told from gains of columns.
OFFSET_SHARE = 0.002
# Standard deviations of noise that negative light between parts of a picture does not exceed.
NEGATIVE_SIGMAS = 2.0
# Quantile of the pixels that tells the largest albedo: a few pixels may be damaged.
ALBEDO_QUANTILE = 0.98
MIN_LIGHT = 1e-300


class Measure(NamedTuple):
    """A number about T, and a place in the picture in words, perhaps empty."""

    name: str
    value: float
    place: str = ""


class Evidence:
    """T with its matrices and S on the host, and the numbers they give."""

    def __init__(self, T: Transport) -> None:
        self.T = T
        self.matrices = []
        for matrix in T.matrices:
            # Rows of a store become a matrix in memory.
            is_stored = hasattr(matrix, "row_blocks")
            self.matrices.append(matrix.tocsr() if is_stored else matrix)
        self.systems: list[HostSystem] = []
        self.is_dark = T.masked
        if T.is_square:
            F = np.atleast_2d(T.first_bounce)
            for matrix in self.matrices:
                self.is_dark = self.is_dark | _dead_pixels(matrix)
            for channel, matrix in enumerate(self.matrices):
                self.systems.append(HostSystem(matrix, np.where(self.is_dark, 0.0, F[channel])))

    @cached_property
    def errors(self) -> HostErrors:
        """Errors by the noise of T; InputError if that is unknown."""
        if self.T.noise.source == "unknown":
            raise InputError("T does not show its noise: use ltcl analyze --noise")
        return HostErrors(self.T, self.matrices, self.systems)

    def measures(self) -> Iterator[Measure]:
        """Numbers of the whole T, and of each channel."""
        T = self.T
        yield Measure("no_bounces", T.camera_grid != T.grid)
        yield Measure("blocks", T.blocks is not None)
        yield from self._measure_order()
        for channel in range(T.channels):
            yield from self._measure_range(channel)
        square = self
        if not T.is_square:
            nearest = nearest_system(T)
            square = None if nearest is None else Evidence(nearest)
        # A scan subtracts black: light that reaches all places alike came by unlit surfaces.
        if square is not None and not T.is_acquired:
            yield from square.measure_ambient()
        # From here on the noise of T is needed.
        for channel in range(T.channels):
            yield from self._measure_pictures(channel)
        if square is not None:
            yield from square.measure_damages()
        if T.is_square:
            yield from self._measure_bounces()
            place = describe_place(T.grid, np.flatnonzero(self.is_dark))
            yield Measure("dark", self.is_dark.mean(), place)

    def measure_ambient(self) -> Iterator[Measure]:
        """Ambient light left in a square T."""
        for channel in self._channels_with_entries():
            share = diagnostics.ambient(self.systems[channel].solve, self.T.grid)
            yield Measure("ambient", share)

    def measure_damages(self) -> Iterator[Measure]:
        """Numbers of damages of a square T beyond its noise."""
        for channel in self._channels_with_entries():
            yield from self._measure_damages(channel)

    def _channels_with_entries(self) -> list[int]:
        """The channels whose entries are read; none if there are few."""
        channels = []
        for channel, matrix in enumerate(self.matrices):
            if isinstance(matrix, ENTRIES) and len(self.T.masked) >= MIN_PIXELS:
                channels.append(channel)
        return channels

    def _measure_range(self, channel: int) -> Iterator[Measure]:
        """Entries at the upper end of the camera's range, and the steps of its codes."""
        matrix = self.matrices[channel]
        if isinstance(matrix, ENTRIES) and min(self.T.shape) >= MIN_PIXELS:
            count, pixels = saturated_entries(matrix)
            yield Measure("saturated", count, describe_place(self.T.camera_grid, pixels))
            yield Measure("quantized", quantization(matrix))

    def _measure_order(self) -> Iterator[Measure]:
        """Another grid, and exchanged colours."""
        T = self.T
        if T.is_square:
            grid = diagnostics.other_grid(self.matrices[0], T.grid)
            if grid is not None:
                yield Measure("other_grid", 1.0, f"{grid[0]}x{grid[1]}")
        exchanged = exchanged_colours(T)
        yield Measure("exchanged", len(exchanged), ", ".join(exchanged))

    # Errors by noise.

    def _measure_pictures(self, channel: int) -> Iterator[Measure]:
        """Error of the picture under white, and of a plain picture."""
        matrices: list[Any] = [self.matrices[channel]]
        if self.T.blocks is not None:
            matrices = list(channel_matrices(self.T, channel))
        N = self.T.shape[1]
        pattern = np.ones(N, np.float32)
        white = np.sum([matrix @ pattern for matrix in matrices], axis=0)
        deviation = self.errors.deviation(channel, np.ones(N * len(matrices)))
        yield self._relative_error("pictures", channel, white, deviation)
        if self.T.is_square:
            yield from self._measure_plain_picture(channel, white)

    def _measure_plain_picture(self, channel: int, white: np.ndarray) -> Iterator[Measure]:
        """Error and gain of a plain picture, as bright as nine tenths of the pixels can be."""
        S = self.systems[channel]
        is_lit = S.F > 0
        plain = np.sign(S.F)
        light = S.inverse_F * S.solve(plain[:, None])[:, 0]
        needed = float(np.quantile(light[is_lit], REACHED_SHARE))
        gain = 1.0 / max(needed, 1e-6 * float(np.abs(light).max()), 1e-30)
        median_white = float(np.median(white[is_lit]))
        yield Measure("gain", gain / max(median_white, MIN_LIGHT))
        pattern = np.clip(gain * light, 0.0, 1.0)
        deviation = self.errors.deviation(channel, pattern)
        yield self._relative_error("pictures", channel, gain * plain, deviation)

    def _measure_bounces(self) -> Iterator[Measure]:
        """Errors of bounces 1 to 3 under white, and their changes by F and by larger pixels."""
        random = np.random.default_rng(0)
        for channel, S in enumerate(self.systems):
            yield from self._measure_spread(S)
            bounces = [S.F]
            for _ in range(3):
                b = bounces[-1]
                bounces.append(b - S.solve(b[:, None])[:, 0])
            columns = np.stack(bounces, axis=-1)[:, None, :]
            variances = bounce_variances(self.errors, channel, columns, random)
            deviations = np.sqrt(np.maximum(variances[:, 0], 0.0))
            for k in (1, 2, 3):
                error = self._relative_error(f"bounce_{k}", channel, bounces[k], deviations[:, k])
                yield error
                yield error._replace(name="bounces")

    def _measure_spread(self, S: HostSystem) -> Iterator[Measure]:
        """Changes of bounces by the choice of F, which counts if F is diag(T), and by pixels."""
        system = solved_system(S.T, S.F, S.matmat, S.solve)
        spreads = bounce_spreads(S.T, S.F, system, self.T.grid)
        for k in (1, 2, 3):
            yield Measure(f"spread_{k}", float(spreads.choice[k - 1]))
            change = float(spreads.resolution[k - 1])
            if not math.isnan(change):
                yield Measure(f"resolution_{k}", change)
        largest = float(spreads.choice.max())
        spread = 0.0
        if system.has_diagonal_of_T:
            spread = largest
        yield Measure("spread", spread)

    def _relative_error(
        self, name: str, channel: int, light: np.ndarray, deviation: np.ndarray
    ) -> Measure:
        """Relative error of a picture (M,) and the place where it is largest; NaN if not finite."""
        F = np.ones(len(light))
        if self.T.is_square:
            F = self.systems[channel].F
        light = np.where(F > 0, light, 0.0)
        deviation = np.where(F > 0, deviation, 0.0)
        doubt = deviation / np.maximum(np.abs(light), MIN_LIGHT)
        doubtful = np.flatnonzero(doubt > 2.0 * np.median(doubt))
        place = describe_place(self.T.camera_grid, doubtful, F)
        if not np.isfinite(light).all():
            return Measure(name, math.nan, place)
        norm = float(np.linalg.norm(light))
        if norm == 0.0:
            norm = 1.0
        return Measure(name, float(np.linalg.norm(deviation)) / norm, place)

    # Damages.

    def _measure_damages(self, channel: int) -> Iterator[Measure]:
        grid = self.T.grid
        S = self.systems[channel]
        detail = LightDetail(S, self.errors, channel, grid)
        offset = detail.row_offset()
        yield Measure("row_offset", offset)
        yield Measure("flicker", detail.column_gain(offset > OFFSET_SHARE))
        yield from self._measure_energy(channel)
        sample = RowSample(self.T, S, channel)
        share, move = sample.shifted()
        yield Measure("shifted", share, move)
        hot = sample.hot_pixels()
        yield Measure("hot_rows", len(hot), describe_place(grid, hot))
        yield Measure("offset", sample.negative_offset())
        share, outliers = sample.outliers()
        yield Measure("outliers", share, describe_place(grid, outliers))
        yield Measure("irreciprocal", self._irreciprocity(channel, sample))

    def _measure_energy(self, channel: int) -> Iterator[Measure]:
        """Share of light that a bounce takes away, and the largest one that a pixel returns."""
        S = self.systems[channel]
        between = diagnostics.between_parts(S.solve, self.T.grid, diagnostics.PARTS_PER_SIDE)
        # The errors of the bounce are about those of T F^-1.
        parts = diagnostics.picture_parts(self.T.grid, diagnostics.PARTS_PER_SIDE)
        squares = S.inverse_F[:, None] ** 2 * parts
        variances = parts.T @ np.maximum(self.errors.variance(channel, squares), 0.0)
        pixels = parts.sum(axis=0)
        noise = np.sqrt(variances) / (pixels[:, None] * pixels)
        light = max(float(np.nansum(np.abs(between))), MIN_LIGHT)
        negative = np.maximum(-between - NEGATIVE_SIGMAS * NOISE_MARGIN * noise, 0.0)
        yield Measure("negative_bounce", float(np.nansum(negative)) / light)
        ones = np.ones((len(S.F), 1))
        returned = (ones - S.solve(ones))[S.F > 0]
        yield Measure("bounce_highest", float(np.quantile(returned, ALBEDO_QUANTILE)))

    def _irreciprocity(self, channel: int, sample: RowSample) -> float:
        """The defect of reciprocity beyond that of noise, both of F^-1/2 R F^1/2."""
        S = self.systems[channel]
        direct_deviation = self.T.noise.diagonal(self.T.first_bounce)[channel]
        variances = self.errors.variance(channel, S.inverse_F[:, None])[:, 0]
        direct = np.sum((direct_deviation * S.inverse_F) ** 2)
        share = len(sample.pixels) / len(S.F)
        noise_power = float(S.inverse_F @ variances - direct) * share
        power = sample.scaled_power(S.inverse_F)
        expected = min(NOISE_MARGIN**2 * noise_power / max(power, MIN_LIGHT), 1.0)
        defect = diagnostics.reciprocity_defect(S.T, S.F, entries=diagnostics.QUICK_ENTRIES)
        return math.sqrt(max(defect**2 - expected, 0.0))


def _dead_pixels(matrix: Any) -> np.ndarray:
    """Projector pixels (N,) that light nothing, though their column holds ambient light."""
    if not isinstance(matrix, np.ndarray):
        # Most entries of a sparse column are 0.
        return np.zeros(matrix.shape[1], bool)
    direct = matrix.diagonal()
    typical = np.median(matrix, axis=0)
    above = direct - typical
    is_dim = above < DEAD_SHARE * np.median(above)
    return is_dim & (direct < DEAD_RATIO * typical)


def describe_place(grid: tuple[int, int], pixels: np.ndarray, F: np.ndarray | None = None) -> str:
    """The part of the picture where `pixels` lie, in words; dark if F (N,) is less there."""
    height, width = grid
    if not 0 < len(pixels) < 0.6 * height * width:
        return ""
    y = np.mean(pixels // width + 0.5) / height
    x = np.mean(pixels % width + 0.5) / width
    words = []
    if F is not None and np.median(F[pixels]) < 0.7 * np.median(F[F > 0]):
        words.append("dark")
    if y < 0.4:
        words.append("upper")
    if y > 0.6:
        words.append("lower")
    if x < 0.4:
        words.append("left")
    if x > 0.6:
        words.append("right")
    if not words:
        return ""
    return f" in the {' '.join(words)} part"
