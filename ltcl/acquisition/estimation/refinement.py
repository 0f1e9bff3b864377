# SPDX-License-Identifier: BSD-3-Clause
"""`RefinedEstimator`: T of many pixels, from far light at few nodes and near light at every pixel.

Relative to the light of a camera pixel under white, which has the albedo of its surface, light from
far is smooth over the camera's pixels, too. So it is estimated (`Estimator`) at the nodes of a
coarse level of hats, with pictures that are averaged under them, and interpolated between. Finer
nodes, and the pixels at last, do the same in turn: what the coarser nodes around them say, less the
functions of these nodes' own, which hold direct light; and by regression what is left, in the
functions near them (`near`). So

    T = diag(w) sum_l W_l^T K_l W

with the light w under white, sums W under the hats of all levels, those of level l W_l, and the
coefficients K_l of its nodes. Stages are the levels that have nodes, the coarsest first.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.acquisition.estimation import windows
from ltcl.acquisition.estimation.estimator import (
    BASIS,
    FIRST_BOUNCE_SIGMAS,
    LEAST_SCALE,
    Estimator,
)
from ltcl.acquisition.estimation.hats import HatLevels, light_of_scales
from ltcl.acquisition.estimation.near import (
    NearFunctions,
    NearPrior,
    Seen,
    learn_prior,
)
from ltcl.acquisition.estimation.pairs import Pairs
from ltcl.acquisition.estimation.regression import between, solve_channels
from ltcl.acquisition.scratch import scratch_array
from ltcl.transport import stored
from ltcl.transport.first_bounce import drop_uncertain
from ltcl.transport.noise import Noise
from ltcl.transport.noise.fit import noise_step

# Nodes of the coarsest stage, and of the one before the pixels, at most.
MAX_COARSE_NODES = 2500
MAX_MIDDLE_NODES = 1 << 18
# Levels from one stage to the next, but for the pixels.
LEVELS_OF_STAGE = 2
# Nodes that are solved, and rows of T that are made, at once.
CHUNK_NODES = 512
CHUNKS_OF_WORKER = 16
ROWS_AT_ONCE = 1 << 12
# Pixels between which the noise of entries is looked at, about.
NOISE_PIXELS = 2048
# Light of a near function that is left out: relative to that of the camera pixel, and in standard
# deviations. To keep all would lower the error of pictures by a quarter, of four times the bytes.
NEGLIGIBLE_SHARE = 5e-4
LEAST_SIGMAS = 0.6
# Light under white of pixels that the camera does not see, relative to the brightest.
UNSEEN_LIGHT = 1e-6
# Variance relative to the square of white from which on a value is unknown, and that of such.
MAX_RELATIVE_VARIANCE = 1e3
UNKNOWN_VARIANCE = 1e12


# Nodes, their coefficients and variances, and what these leave.
_Solved = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def make_estimator(
    grid: tuple[int, int],
    channels: int,
    mixing: np.ndarray | None,
    progress: Callable[[str, int, int], object] | None,
    solves: int = 1,
) -> Estimator | RefinedEstimator:
    """The estimator for a grid, with the parameters of `Estimator`."""
    windows.check_memory(grid, channels)
    if grid[0] * grid[1] > windows.MAX_WHOLE_PIXELS:
        return RefinedEstimator(grid, channels, mixing, progress, solves)
    return Estimator(grid, channels, mixing, progress, solves)


def stage_levels(grid: tuple[int, int]) -> list[int]:
    """The levels of the stages for a grid, the coarsest first; the last is 0, the pixels.

    >>> stage_levels((256, 512)), stage_levels((1080, 1920))
    ([3, 1, 0], [5, 3, 2, 0])
    """
    hats = HatLevels(grid)
    coarsest = _first_level(hats, MAX_COARSE_NODES)
    if coarsest == 0:
        return [0]
    before_pixels = max(_first_level(hats, MAX_MIDDLE_NODES), 1)
    levels = [coarsest]
    while levels[-1] > before_pixels:
        levels.append(max(levels[-1] - LEVELS_OF_STAGE, before_pixels))
    return [*levels, 0]


def _first_level(hats: HatLevels, nodes: int) -> int:
    """The finest level of at most so many nodes."""
    level = 0
    while hats.nodes_of(level) > nodes:
        level += 1
    return level


@dataclass(frozen=True, eq=False, kw_only=True)
class Stage:
    """Rows of T at the nodes of a level, relative to white, less what coarser nodes say there.

    Attributes
    ----------
    level : int
    mean, variance : list of (nodes of the level, all nodes) sparse
        Coefficients of the sums under hats, and their variances, of each channel.
    noise : (nodes of the level,)
        Variance of what they leave of pictures.
    """

    level: int
    mean: list[Any]
    variance: list[Any]
    noise: np.ndarray

    def without_own(self, first: int) -> Stage:
        """The rows without the function of each node's own; `first` is the number of the first."""
        mean = [_without_own(values, first) for values in self.mean]
        variance = [_without_own(values, first) for values in self.variance]
        return replace(self, mean=mean, variance=variance)


class RefinedEstimator:
    """Priors and rows of all channels, for pixels of a large grid.

    It has the methods of `Estimator`, which estimates its coarsest stage; parameters are those.
    """

    def __init__(
        self,
        grid: tuple[int, int],
        channels: int,
        mixing: np.ndarray | None,
        progress: Callable[[str, int, int], object] | None,
        solves: int = 1,
    ) -> None:
        self.grid = grid
        self.channels = channels
        self.hats = HatLevels(grid)
        self.levels = stage_levels(grid)
        self.pixels = grid[0] * grid[1]
        self.light = np.zeros((self.pixels, channels))
        self.stages: list[Stage] = []
        self._priors: dict[tuple[int, int], NearPrior] = {}
        self._progress = progress
        self._done = 0
        fine_rows = sum(self.hats.nodes_of(level) for level in self.levels[1:])
        self._expected = solves * fine_rows
        self.coarse = Estimator(
            self.hats.sizes[self.levels[0]], channels, mixing, self._count_coarse, solves
        )

    @property
    def mixing(self) -> np.ndarray:
        """The mixing of the colours, (channels, channels)."""
        return self.coarse.mixing

    @property
    def noise(self) -> float:
        """The noise of the pixels, as in `Estimator.noise`."""
        return float(np.sqrt(np.median(self.stages[-1].noise)))

    def learn(self, pairs: Pairs) -> None:
        """Learn the priors, and the mixing of the colours if it is asked for; solve the rows."""
        self._priors = {}
        self.light = _light_under_white(pairs, self.mixing)
        self.coarse.learn(self._averaged(pairs))
        self._solve_stages(pairs)

    def solve(self, pairs: Pairs) -> None:
        """Solve the rows of all channels."""
        self.light = _light_under_white(pairs, self.mixing)
        self.coarse.solve(self._averaged(pairs))
        self._solve_stages(pairs)

    def coarsest(self, pairs: Pairs) -> tuple[Estimator, Pairs]:
        """The estimator of the coarsest stage, and the pairs at its nodes, relative to white."""
        return self.coarse, self._averaged(pairs)

    def explain(self, patterns: np.ndarray) -> np.ndarray:
        """T p of patterns, (frames, N, channels)."""
        explained = np.empty((len(patterns), self.pixels, self.channels))
        for channel in range(self.channels):
            sums = self.hats.sums_from(0, self._pictures(patterns, channel))
            shares = self._at_pixels(sums, [stage.mean[channel] for stage in self.stages])
            explained[:, :, channel] = (self.light[:, channel, None] * shares).T
        return explained

    def scale_of_variance(self, patterns: np.ndarray, residual_squares: np.ndarray) -> np.ndarray:
        """The same as `Estimator.scale_of_variance`."""
        scales = []
        for channel in range(self.channels):
            variances = [stage.variance[channel] for stage in self.stages]
            light = self.light[:, channel] ** 2
            expected = 0.0
            # One by one: the sums of all would take a quarter of the memory of the rows.
            for frame in range(len(patterns)):
                squares = self._pictures(patterns[frame : frame + 1], channel) ** 2
                sums = self.hats.sums_from(0, squares, power=2)
                expected += float(light @ self._at_pixels(sums, variances)[:, 0])
            noise = len(patterns) * (self.stages[-1].noise * light).sum()
            measured = max(residual_squares[channel] - noise, 0.0)
            scales.append(max(measured / expected, LEAST_SCALE))
        return np.array(scales)

    def unknown_light(self) -> np.ndarray:
        """The same as `Estimator.unknown_light`; rows of a stage are summed under its hats."""
        variance = np.zeros(self.hats.nodes)
        for channel in range(self.channels):
            light = self.light[:, channel].reshape(self.grid) ** 2
            for stage in self.stages:
                of_rows = self.hats.sums(stage.level, light).ravel()
                variance += stage.variance[channel].T @ of_rows
        return light_of_scales(self.hats, variance)

    def own_variance(self) -> np.ndarray:
        """Variances of the light of each pixel's own, (channels, N)."""
        return np.stack([self._own(channel)[1] for channel in range(self.channels)])

    def arrays(self, scales: np.ndarray) -> dict[str, np.ndarray]:
        """The arrays of the transport (`ltcl.transport.stored`), with the noise of its entries."""
        return self._transport_arrays() | self._noise(scales).to_arrays()

    def _noise(self, scales: np.ndarray) -> Noise:
        """The noise of the entries of T, by those between the pixels of a sparse grid.

        Factors of rows and columns vary slowly from one to the next, relative to the light there.
        """
        step = _odd_step(self.grid, NOISE_PIXELS)
        sparse = np.arange(self.pixels).reshape(self.grid)[::step, ::step]
        chosen = sparse.ravel()
        samples = []
        for channel in range(self.channels):
            samples.append(self._entries(channel, chosen, scales[channel]))
        noise = Noise.fit((len(chosen), len(chosen)), samples, "acquired")
        rows = []
        columns = []
        places = np.indices(self.grid).reshape(2, -1) / step
        for channel in range(self.channels):
            light = self.light[:, channel] ** 2
            relative = noise.rows[channel] / light[chosen]
            rows.append(light * between(relative.reshape(sparse.shape), places))
            of_columns = noise.columns[channel].reshape(sparse.shape)
            columns.append(between(of_columns, places))
        white = np.full((self.channels, self.pixels), np.inf)
        spread = replace(noise, rows=np.stack(rows), columns=np.stack(columns), white=white)
        return self._with_true_sums(spread, scales)

    def _with_true_sums(self, noise: Noise, scales: np.ndarray) -> Noise:
        """The noise with the variance of the whole picture under white, own light aside.

        Pixels of a sparse grid are no neighbours, whose light is known least.
        """
        factors = []
        for channel in range(self.channels):
            own_light, own_variance = self._own(channel)
            squares = self.hats.sums_from(0, np.ones((1, *self.grid)), power=2)
            variances = [stage.variance[channel] for stage in self.stages]
            w = self.light[:, channel]
            of_rows = w**2 * self._at_pixels(squares, variances)[:, 0]
            expected = scales[channel] * (of_rows - own_variance).sum()

            columns = noise.columns[channel]
            sums = self.hats.sums_from(0, columns.reshape(1, *self.grid))
            means = [stage.mean[channel] for stage in self.stages]
            light = w * self._at_pixels(sums, means)[:, 0] - own_light * columns
            floor = noise.floor[channel] ** 2 * (columns.sum() - columns)
            stated = (noise.rows[channel] * (noise.photons[channel] * light + floor)).sum()
            factors.append(expected / stated)
        factor = np.array(factors)
        return replace(
            noise,
            photons=noise.photons * factor,
            floor=noise.floor * np.sqrt(factor),
            direct=noise.direct / factor,
        )

    def _solve_stages(self, pairs: Pairs) -> None:
        """The rows of all stages, the coarsest first."""
        self.stages = [self._coarsest_stage()]
        for level in self.levels[1:]:
            before = self.stages[-1]
            self.stages[-1] = before.without_own(self.hats.first[before.level])
            groups = self._alike_channels(pairs.patterns)
            solved = [self._solve_near(pairs, level, channels) for channels in groups]
            mean: list[Any] = []
            variance: list[Any] = []
            for stage in solved:
                mean += stage.mean
                variance += stage.variance
            noise = np.mean([stage.noise for stage in solved], axis=0)
            self.stages.append(Stage(level=level, mean=mean, variance=variance, noise=noise))

    def _coarsest_stage(self) -> Stage:
        """The rows of the coarse estimator, for sums over pixels."""
        level = self.levels[0]
        # Its patterns are means under hats.
        unit = 4.0**level
        mean = []
        variance = []
        for channel in range(self.channels):
            coefficients: Any = self.coarse.coefficients(channel) / unit
            coefficients.data = with_few_bits(coefficients.data)
            mean.append(self._among_all(coefficients, level))
            variance.append(self._among_all(self.coarse.variances(channel) / unit**2, level))
        noise = np.mean([prior.noise for prior in self.coarse.priors], axis=0)
        return Stage(level=level, mean=mean, variance=variance, noise=noise)

    def _among_all(self, values: Any, level: int) -> Any:
        """Values (rows, nodes from a level on) among the nodes of all levels."""
        csr: Any = scipy.sparse.csr_array(values)
        columns = csr.indices + self.hats.first[level]
        shape = (csr.shape[0], self.hats.nodes)
        return scipy.sparse.csr_array((csr.data, columns, csr.indptr), shape=shape)

    def _alike_channels(self, patterns: np.ndarray) -> list[list[int]]:
        """Channels that see the same patterns: all, if patterns are grey."""
        channels = list(range(self.channels))
        if _are_grey(patterns):
            return [channels]
        return [[channel] for channel in channels]

    def _solve_near(self, pairs: Pairs, level: int, channels: list[int]) -> Stage:
        """The rows of some channels at the nodes of a level; coarser stages are solved."""
        patterns, _ = self._patterns(pairs.patterns, channels[0])
        factors = [self._patterns(pairs.patterns, channel)[1] for channel in channels]
        before = self.stages[-1].level
        near = NearFunctions(self.hats, level, before, patterns)
        photographs = _Photographs(self, pairs, level, channels)
        far = self._far_answers(patterns, factors, channels)

        def seen(numbers: np.ndarray) -> Seen:
            pictures, variance = photographs.at(numbers)
            for stage, answers in zip(self.stages, far, strict=True):
                shares = self.hats.between(stage.level, level, numbers)
                for place, answer in enumerate(answers):
                    pictures[:, :, place] -= shares @ answer
            return Seen(pictures=pictures, variance=variance)

        key = (level, channels[0])
        if key not in self._priors:
            self._priors[key] = learn_prior(near, seen)
        return self._solve_rows(near, seen, self._priors[key], level, factors)

    def _far_answers(
        self, patterns: np.ndarray, factors: list[float], channels: list[int]
    ) -> list[list[np.ndarray]]:
        """The answers of the rows of each stage to patterns, (nodes, frames) of each channel.

        Channels answer to the patterns times their factors.
        """
        first_level = self.stages[-1].level
        first = self.hats.first[first_level]
        sums = self.hats.sums_from(first_level, patterns, dtype=np.float32)
        answers = []
        for stage in self.stages:
            of_channels = []
            for channel, factor in zip(channels, factors, strict=True):
                coefficients: Any = stage.mean[channel]
                of_light = np.float32(factor) * coefficients[:, first:].astype(np.float32)
                of_channels.append(of_light @ sums)
            answers.append(of_channels)
        return answers

    def _solve_rows(
        self,
        near: NearFunctions,
        seen: Callable[[np.ndarray], Seen],
        prior: NearPrior,
        level: int,
        factors: list[float],
    ) -> Stage:
        """The near rows of channels at all nodes of a level.

        Channels answer to the patterns of `near` times their factors.
        """
        count = self.hats.nodes_of(level)
        most = len(near.group)
        collected = [_Rows((count, self.hats.nodes), most) for _ in factors]
        noise = np.empty(count)

        def solve(numbers: np.ndarray) -> _Solved:
            known = seen(numbers)
            coefficients, left = prior.at(numbers, near.size[1])
            deviation = np.sqrt(coefficients)[:, near.group]
            rows = solve_channels(
                near.sums(numbers), known.pictures, deviation, left[:, None] + known.variance
            )
            return numbers, rows.mean, rows.variance, left

        for numbers, mean, variance, left in _in_threads(solve, _chunks(count)):
            noise[numbers] = left
            columns = near.columns(numbers)
            light = np.abs(mean) * near.area[near.group][:, None]
            for channel, rows in enumerate(collected):
                is_light = light[:, :, channel] > NEGLIGIBLE_SHARE
                is_known = mean[:, :, channel] ** 2 > LEAST_SIGMAS**2 * variance
                matters = (columns >= 0) & is_light & is_known
                # The first function is the node's own.
                matters[:, 0] = True
                factor = factors[channel]
                coefficients = mean[:, :, channel] / factor
                coefficients[:, 1:] = with_few_bits(coefficients[:, 1:])
                rows.add(columns, matters, coefficients, variance / factor**2)
            self._count(len(numbers))
        matrices = [rows.matrices() for rows in collected]
        return Stage(
            level=level,
            mean=[mean for mean, _ in matrices],
            variance=[variance for _, variance in matrices],
            noise=noise,
        )

    # Photographs and patterns.

    def _averaged(self, pairs: Pairs) -> Pairs:
        """The pairs at the nodes of the coarsest stage, photographs relative to white."""
        level = self.levels[0]
        photographs, variance = averages(self.hats, level, pairs, self.light)
        patterns = []
        for picture in pairs.patterns:
            planes = []
            for channel in range(self.channels):
                plane = picture[:, channel].reshape(self.grid)
                planes.append(self.hats.sums(level, plane).ravel() / 4.0**level)
            patterns.append(np.stack(planes, axis=1))
        size = self.hats.sizes[level]
        return replace(
            pairs,
            grid=size,
            camera_grid=size,
            patterns=np.stack(patterns),
            photographs=photographs,
            variance=variance,
        )

    def _pictures(self, patterns: np.ndarray, channel: int) -> np.ndarray:
        """The light (frames, h, w) that a channel answers to."""
        shown, factor = self._patterns(patterns, channel)
        return factor * shown

    def _patterns(self, patterns: np.ndarray, channel: int) -> tuple[np.ndarray, float]:
        """Patterns (frames, h, w), and their factor in the light that a channel answers to.

        Grey ones are as they were given, of a byte a pixel if they are on or off.
        """
        mixing = self.mixing[channel]
        if _are_grey(patterns):
            return patterns[:, :, 0].reshape(-1, *self.grid), float(mixing.sum())
        return (patterns @ mixing).reshape(-1, *self.grid), 1.0

    # Rows of T.

    def _at_pixels(self, sums: np.ndarray, values: list[Any]) -> np.ndarray:
        """Values of all stages times sums under all hats, at all pixels, (N, frames)."""
        total = np.zeros((self.pixels, sums.shape[1]))
        answers = [of_stage @ sums for of_stage in values]
        for numbers in _chunks(self.pixels, ROWS_AT_ONCE):
            for stage, answer in zip(self.stages, answers, strict=True):
                total[numbers] += self.hats.between(stage.level, 0, numbers) @ answer
        return total

    def _rows(self, values: list[Any], numbers: np.ndarray) -> Any:
        """Values of all stages at some pixels, (pixels, nodes)."""
        total: Any = 0
        for stage, of_stage in zip(self.stages, values, strict=True):
            total = total + self.hats.between(stage.level, 0, numbers) @ of_stage
        return total

    def _own(self, channel: int) -> tuple[np.ndarray, np.ndarray]:
        """The light of each pixel's own function, and its variance, (N,)."""
        light = self.light[:, channel]
        pixels = self.stages[-1]
        mean = pixels.mean[channel][:, : self.pixels].diagonal()
        variance = pixels.variance[channel][:, : self.pixels].diagonal()
        return light * mean, light**2 * variance

    def _entries(
        self, channel: int, pixels: np.ndarray, scale: float
    ) -> Iterator[tuple[np.ndarray, ...]]:
        """Rows, columns, light and variances of the entries between pixels, for `Noise.fit`."""
        means = [stage.mean[channel] for stage in self.stages]
        variances = [stage.variance[channel] for stage in self.stages]
        step = noise_step((len(pixels), len(pixels)))
        for first in range(step):
            places = np.arange(first, len(pixels), step)
            chosen = pixels[places]
            hats: Any = self.hats.at_pixels(chosen)
            w = self.light[chosen, channel, None]
            light = w * (self._rows(means, chosen) @ hats.T).toarray()
            squares = hats.multiply(hats).T
            variance = w**2 * scale * (self._rows(variances, chosen) @ squares).toarray()
            i, j = np.nonzero(variance)
            yield places[i], places[j], light[i, j], variance[i, j]

    def _diagonal(self, channel: int) -> np.ndarray:
        """The diagonal of T, (N,)."""
        means = [stage.mean[channel] for stage in self.stages]
        diagonal = np.empty(self.pixels)
        for numbers in _chunks(self.pixels, ROWS_AT_ONCE):
            hats: Any = self.hats.at_pixels(numbers)
            diagonal[numbers] = hats.multiply(self._rows(means, numbers)).sum(axis=1)
        return self.light[:, channel] * diagonal

    def _transport_arrays(self) -> dict[str, np.ndarray]:
        cores = []
        diagonals = []
        first_bounce = []
        for channel in range(self.channels):
            cores.append(self._core(channel))
            diagonals.append(self._diagonal(channel) - 1.0)
            direct, variance = self._own(channel)
            first_bounce.append(drop_uncertain(direct, variance, FIRST_BOUNCE_SIGMAS))
        mixing = self.mixing if self.channels == 3 else None
        return stored.arrays_of_scan(
            self.grid,
            cores,
            np.stack(diagonals),
            np.stack(first_bounce),
            mixing,
            BASIS,
            scales=self.light.T,
        )

    def _core(self, channel: int) -> scipy.sparse.csr_array:
        """K of all stages, (nodes, nodes), less the identity: T - I = diag(w) W^T K W."""
        by_level = {stage.level: stage.mean[channel] for stage in self.stages}
        blocks = []
        for level in range(len(self.hats.sizes)):
            shape = (self.hats.nodes_of(level), self.hats.nodes)
            block = by_level.get(level)
            blocks.append(scipy.sparse.csr_array(shape) if block is None else block)
        core = _stacked(blocks)
        # The first rows are those of the pixels, and the first number of each is its own.
        own = core.indptr[: self.pixels]
        core.data[own] -= 1.0 / self.light[:, channel]
        core.sort_indices()
        return core

    def _count_coarse(self, stage: str, done: int, total: int) -> None:
        """Tell the progress of the coarsest stage."""
        if self._progress is not None:
            self._progress(stage, done, total + self._expected)
        self._done = done
        self._total = total + self._expected

    def _count(self, rows: int) -> None:
        """Tell the progress that some rows were solved."""
        self._done += rows
        if self._progress is not None:
            self._progress("fit", self._done, max(self._done, self._total))


def with_few_bits(values: np.ndarray) -> np.ndarray:
    """Values rounded to 8 significant bits, float32.

    Those of a node are read as two bytes then (`ltcl.operators.colour_hats`).

    >>> with_few_bits(np.array([1.0 + 2.0**-7, 1.0 + 2.0**-9])).tolist()
    [1.0078125, 1.0]
    """
    bits = np.asarray(values, np.float32).view(np.uint32)
    # To the nearest, and to even where two are.
    is_odd = (bits >> np.uint32(16)) & np.uint32(1)
    rounded = bits + np.uint32(0x7FFF) + is_odd
    return (rounded & np.uint32(0xFFFF0000)).view(np.float32)


def _stacked(blocks: list[Any]) -> scipy.sparse.csr_array:
    """Matrices of as many columns one above the other, in temporary files if they are large."""
    entries = sum(block.nnz for block in blocks)
    data = scratch_array((entries,), np.float32)
    indices = scratch_array((entries,), np.int32)
    ends = [np.zeros(1, np.int32)]
    start = 0
    for block in blocks:
        stop = start + block.nnz
        data[start:stop] = block.data
        indices[start:stop] = block.indices
        ends.append(block.indptr[1:] + np.int32(start))
        start = stop
    rows = sum(block.shape[0] for block in blocks)
    shape = (rows, blocks[0].shape[1])
    return scipy.sparse.csr_array((data, indices, np.concatenate(ends)), shape=shape)


class _Photographs:
    """Photographs relative to white at the nodes of a level."""

    def __init__(
        self, estimator: RefinedEstimator, pairs: Pairs, level: int, channels: list[int]
    ) -> None:
        self._channels = channels
        if level == 0:
            self._photographs = pairs.photographs
            self._variance = pairs.variance
            self._light = estimator.light
        else:
            seen = averages(estimator.hats, level, pairs, estimator.light)
            self._photographs, self._variance = seen
            self._light = np.ones((estimator.hats.nodes_of(level), estimator.channels))

    def at(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pictures (nodes, frames, channels) and their mean variance (nodes, frames)."""
        light = self._light[numbers][:, self._channels]
        pictures = self._photographs[:, numbers][:, :, self._channels] / light
        if self._variance is None:
            return pictures.transpose(1, 0, 2), np.zeros(pictures.shape[1::-1])
        variance = self._variance[:, numbers][:, :, self._channels] / light**2
        is_known = np.all(variance < MAX_RELATIVE_VARIANCE, axis=2)
        mean = np.where(is_known, variance.mean(axis=2), UNKNOWN_VARIANCE)
        return pictures.transpose(1, 0, 2), mean.T


class _Rows:
    """Collects the coefficients of rows and their variances, chunk by chunk.

    A row has `most` at most. Many stand in temporary files, whose unused ends take no place.
    """

    def __init__(self, shape: tuple[int, int], most: int) -> None:
        self._shape = shape
        self._counts: list[np.ndarray] = [np.zeros(1, int)]
        self._end = 0
        self._columns = scratch_array((shape[0] * most,), np.int32)
        self._mean = scratch_array((shape[0] * most,), np.float32)
        self._variance = scratch_array((shape[0] * most,), np.float32)

    def add(
        self, columns: np.ndarray, matters: np.ndarray, mean: np.ndarray, variance: np.ndarray
    ) -> None:
        """Add the next rows: values (rows, q) at columns, as far as they matter."""
        counts = np.count_nonzero(matters, axis=1)
        self._counts.append(counts)
        added = slice(self._end, self._end + counts.sum())
        self._columns[added] = columns[matters]
        self._mean[added] = mean[matters]
        self._variance[added] = variance[matters]
        self._end = added.stop

    def matrices(self) -> tuple[scipy.sparse.csr_array, scipy.sparse.csr_array]:
        """The coefficients and their variances, which share their pattern."""
        ends = np.cumsum(np.concatenate(self._counts)).astype(np.int32)
        columns = self._columns[: self._end]
        mean = self._mean[: self._end]
        variance = self._variance[: self._end]
        return (
            scipy.sparse.csr_array((mean, columns, ends), shape=self._shape),
            scipy.sparse.csr_array((variance, columns, ends), shape=self._shape),
        )


def averages(
    hats: HatLevels, level: int, pairs: Pairs, light: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None]:
    """Photographs relative to white, and their variances, averaged under the hats of a level.

    `light` is that under white, (N, channels); the results are (frames, nodes, channels), in
    temporary files if they are large.
    """
    shape = (len(pairs), hats.nodes_of(level), pairs.channels)
    pictures = scratch_array(shape, np.float32)
    variances = None
    if pairs.variance is not None:
        variances = scratch_array(shape, np.float32)
    for frame in range(len(pairs)):
        relative = pairs.photographs[frame] / light
        is_known = np.ones(relative.shape)
        if pairs.variance is not None and variances is not None:
            variance = pairs.variance[frame] / light**2
            is_known = (variance < MAX_RELATIVE_VARIANCE).astype(float)
            variances[frame] = _variance_of_means(hats, level, variance, is_known)
        pictures[frame] = _means(hats, level, relative, is_known)
    return pictures, variances


def _means(hats: HatLevels, level: int, values: np.ndarray, is_known: np.ndarray) -> np.ndarray:
    """Means of known values (N, channels) under the hats of a level, (nodes, channels)."""
    means = []
    for known, plane in zip(is_known.T, values.T, strict=True):
        weight = hats.sums(level, known.reshape(hats.grid))
        total = hats.sums(level, (known * plane).reshape(hats.grid))
        means.append((total / np.maximum(weight, np.finfo(float).tiny)).ravel())
    return np.stack(means, axis=1)


def _variance_of_means(
    hats: HatLevels, level: int, variance: np.ndarray, is_known: np.ndarray
) -> np.ndarray:
    """Variances of `_means`."""
    variances = []
    for known, plane in zip(is_known.T, variance.T, strict=True):
        weight = hats.sums(level, known.reshape(hats.grid))
        total = hats.sums(level, (known * plane).reshape(hats.grid), power=2)
        mean = total / np.maximum(weight, np.finfo(float).tiny) ** 2
        variances.append(np.where(weight > 0.0, mean, UNKNOWN_VARIANCE).ravel())
    return np.stack(variances, axis=1)


def _light_under_white(pairs: Pairs, mixing: np.ndarray) -> np.ndarray:
    """The light of each pixel under white, (N, channels).

    It is measured where a pattern is white, else the mean over that of the patterns.
    """
    is_white = np.array([bool(np.all(pattern == 1)) for pattern in pairs.patterns])
    if is_white.any():
        light = pairs.photographs[is_white].mean(axis=0, dtype=np.float64)
    else:
        shown = pairs.patterns.mean(axis=(0, 1), dtype=np.float64) @ mixing.T
        light = pairs.photographs.mean(axis=0, dtype=np.float64) / shown
    return np.maximum(light, UNSEEN_LIGHT * light.max(axis=0))


def _odd_step(grid: tuple[int, int], pixels: int) -> int:
    """The step along both sides of a grid that leaves about so many pixels, odd."""
    return int(np.sqrt(grid[0] * grid[1] / pixels)) | 1


def _are_grey(patterns: np.ndarray) -> bool:
    """Return True if the colours of patterns (frames, N, channels) are the same."""
    if patterns.strides[2] == 0 or patterns.shape[2] == 1:
        return True
    return all(np.ptp(pattern, axis=1).max() == 0 for pattern in patterns)


def _without_own(values: Any, first: int) -> Any:
    """Coefficients without those of each row's own node; `first` is the node of row 0."""
    coo = scipy.sparse.coo_array(values)
    row, column = coo.coords
    is_other = column != row + first
    others = (coo.data[is_other], (row[is_other], column[is_other]))
    return scipy.sparse.csr_array(others, shape=coo.shape)


def _in_threads(
    solve: Callable[[np.ndarray], _Solved], chunks: list[np.ndarray]
) -> Iterator[_Solved]:
    """Results for all chunks in their order, of which few wait at a time."""
    workers = os.cpu_count() or 1
    at_once = CHUNKS_OF_WORKER * workers
    with ThreadPoolExecutor(workers) as pool:
        for start in range(0, len(chunks), at_once):
            yield from pool.map(solve, chunks[start : start + at_once])


def _chunks(count: int, size: int = CHUNK_NODES) -> list[np.ndarray]:
    """Numbers below `count`, some at a time."""
    starts = range(0, count, size)
    return [np.arange(start, min(start + size, count)) for start in starts]
