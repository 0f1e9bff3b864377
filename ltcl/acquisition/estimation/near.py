# SPDX-License-Identifier: BSD-3-Clause
"""Near light at the nodes of a level: functions around each node, their prior, their regression.

What coarser nodes leave of the pictures at a node is written in

    level l        the node's own hat and those up to REACH away; of level 0, pixels
    before         hats of the coarser level, up to COARSE_REACH away

for all channels at once: they have the same patterns, so one system gives them all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ltcl.acquisition.estimation.hats import HatLevels
from ltcl.acquisition.estimation.regression import (
    FIRST_NOISE,
    FIRST_SHARE,
    LEAST_NOISE,
    OWN_SHARE,
    ROUNDS,
    between,
    nearby,
    solve_channels,
)
from ltcl.acquisition.estimation.windows import COARSE_REACH, REACH

# Nodes at which the prior is learned, about, and the least step between them along a side. Steps
# are odd: patterns are alike at multiples of powers of 2.
PRIOR_NODES = 4096
LEAST_PRIOR_STEP = 7
# Nodes that are solved at once while it is learned.
NODES_AT_ONCE = 512


@dataclass(frozen=True, eq=False, kw_only=True)
class Seen:
    """Pictures at some nodes less what coarser nodes say, and the variance of their noise.

    `pictures` is (nodes, patterns, channels), `variance` (nodes, patterns), relative to white.
    """

    pictures: np.ndarray
    variance: np.ndarray


class NearFunctions:
    """The functions around the nodes of a level, and sums of patterns under them.

    Attributes
    ----------
    group : (q,)
        Group of each function: of the same level and distance; group 0 is the node itself.
    area : (groups,)
        Pixels under a hat of the group.
    """

    def __init__(self, hats: HatLevels, level: int, before: int, patterns: np.ndarray) -> None:
        self.size = hats.sizes[level]
        self._coarse_size = hats.sizes[before]
        self._levels_between = before - level
        self._first = hats.first[level], hats.first[before]
        own = _rings(REACH)
        coarse = _rings(COARSE_REACH)
        self.group = np.concatenate([own, coarse + own.max() + 1])
        areas = [4.0**level] * (REACH + 1) + [4.0**before] * (COARSE_REACH + 1)
        self.area = np.array(areas)
        self._own_sums = _with_zero(hats, level, patterns)
        self._coarse_sums = _with_zero(hats, before, patterns)

    def sums(self, numbers: np.ndarray) -> np.ndarray:
        """Sums of the patterns under the functions of some nodes, (nodes, q, patterns)."""
        own, coarse = self._nodes(numbers)
        return np.concatenate([self._own_sums[own], self._coarse_sums[coarse]], axis=1)

    def columns(self, numbers: np.ndarray) -> np.ndarray:
        """The functions of some nodes among the hats of all levels, (nodes, q); -1 for none."""
        own, coarse = self._nodes(numbers)
        first_own, first_coarse = self._first
        of_own = np.where(own >= 0, own + first_own, -1)
        of_coarse = np.where(coarse >= 0, coarse + first_coarse, -1)
        return np.concatenate([of_own, of_coarse], axis=1)

    def _nodes(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of own and of coarse functions within their levels, -1 beyond the rim."""
        row, column = np.divmod(numbers, self.size[1])
        own = _around(row, column, REACH, self.size)
        half = (1 << self._levels_between) >> 1
        nearest_row = (row + half) >> self._levels_between
        nearest_column = (column + half) >> self._levels_between
        coarse = _around(nearest_row, nearest_column, COARSE_REACH, self._coarse_size)
        return own, coarse


@dataclass(frozen=True, eq=False, kw_only=True)
class NearPrior:
    """Variances of coefficients, (rows, columns, groups), and of what they leave, (rows, columns).

    They are relative to white, and stand at every `step`-th node along both sides.
    """

    step: int
    coefficients: np.ndarray
    noise: np.ndarray

    def at(self, numbers: np.ndarray, columns: int) -> tuple[np.ndarray, np.ndarray]:
        """Variances of coefficients, (nodes, groups), and of noise, (nodes,), at some nodes."""
        places = np.stack(np.divmod(numbers, columns)) / self.step
        groups = [between(values, places) for values in np.moveaxis(self.coefficients, 2, 0)]
        return np.stack(groups, axis=1), between(self.noise, places)


def learn_prior(near: NearFunctions, seen: Callable[[np.ndarray], Seen]) -> NearPrior:
    """The prior under which what is `seen` is likely, by expectation maximisation."""
    height, width = near.size
    step = max(int(np.sqrt(height * width / PRIOR_NODES)) | 1, LEAST_PRIOR_STEP)
    numbers = np.arange(height * width).reshape(near.size)[::step, ::step]
    shape = numbers.shape
    chosen = numbers.ravel()
    B = near.sums(chosen)
    is_there = near.columns(chosen) >= 0
    known = seen(chosen)
    share = np.full(len(near.area), FIRST_SHARE)
    share[0] = OWN_SHARE
    coefficients = np.tile((share / near.area) ** 2, (len(chosen), 1))
    noise = np.full(len(chosen), FIRST_NOISE**2)
    for _ in range(ROUNDS):
        squares, misfit = _solve_some(near, B, known, coefficients, noise)
        for group in range(len(near.area)):
            members = near.group == group
            total = np.where(is_there[:, members], squares[:, members], 0.0).sum(axis=1)
            count = np.count_nonzero(is_there[:, members], axis=1).astype(float)
            mean_count = nearby(count, shape)
            coefficients[:, group] = nearby(total, shape) / np.maximum(mean_count, 1e-6)
        noise = np.maximum(nearby(misfit * noise, shape), LEAST_NOISE**2)
    return NearPrior(
        step=step,
        coefficients=coefficients.reshape(*shape, -1),
        noise=noise.reshape(shape),
    )


def _solve_some(
    near: NearFunctions, B: np.ndarray, known: Seen, coefficients: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean squares of the coefficients of nodes, (nodes, q), and misfits, (nodes,), by a prior."""
    squares = np.empty(B.shape[:2])
    misfit = np.empty(len(B))
    for start in range(0, len(B), NODES_AT_ONCE):
        chosen = slice(start, start + NODES_AT_ONCE)
        deviation = np.sqrt(coefficients[chosen])[:, near.group]
        variance = noise[chosen, None] + known.variance[chosen]
        rows = solve_channels(B[chosen], known.pictures[chosen], deviation, variance)
        squares[chosen] = (rows.mean**2).mean(axis=2) + rows.variance
        misfit[chosen] = rows.misfit
    return squares, misfit


def _rings(reach: int) -> np.ndarray:
    """The distance of each function of a window from its middle; the middle comes first."""
    down, across = _offsets(reach)
    return np.maximum(np.abs(down), np.abs(across))


def _offsets(reach: int) -> tuple[np.ndarray, np.ndarray]:
    """Offsets of the functions of a window, (q,) each, the middle first."""
    down, across = np.indices((2 * reach + 1, 2 * reach + 1)).reshape(2, -1) - reach
    order = np.argsort(np.maximum(np.abs(down), np.abs(across)), kind="stable")
    return down[order], across[order]


def _around(row: np.ndarray, column: np.ndarray, reach: int, size: tuple[int, int]) -> np.ndarray:
    """Numbers of the nodes of a window around each place, (places, q); -1 beyond the rim."""
    down, across = _offsets(reach)
    rows = row[:, None] + down
    columns = column[:, None] + across
    is_there = (rows >= 0) & (rows < size[0]) & (columns >= 0) & (columns < size[1])
    return np.where(is_there, rows * size[1] + columns, -1)


def _with_zero(hats: HatLevels, level: int, patterns: np.ndarray) -> np.ndarray:
    """Sums of patterns (frames, h, w) under the hats of a level, (nodes + 1, frames).

    The last is 0: that of number -1.
    """
    # Pixels of patterns that are on or off fit a byte.
    is_small = level == 0 and patterns.dtype.itemsize < np.dtype(np.float32).itemsize
    dtype = patterns.dtype if is_small else np.float32
    sums = np.zeros((hats.nodes_of(level) + 1, len(patterns)), dtype)
    for number, pattern in enumerate(patterns):
        sums[:-1, number] = hats.sums(level, pattern).ravel()
    return sums
