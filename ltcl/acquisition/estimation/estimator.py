# SPDX-License-Identifier: BSD-3-Clause
"""`Estimator`: T from pictures of patterns, in the functions of `windows`, by `regression`.

T is C W with the sums W under hat functions (`ltcl.operators.Hats`): few numbers in each row of C.
It becomes a compressed transport, with the noise of its entries.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.acquisition.estimation.hats import HatLevels, light_of_scales
from ltcl.acquisition.estimation.pairs import Pairs
from ltcl.acquisition.estimation.regression import (
    PRIOR_STEP,
    ROUNDS,
    Foretold,
    Prior,
    Rows,
    foretell,
    learn_prior,
    solve_rows,
)
from ltcl.acquisition.estimation.windows import (
    Windows,
    hat_matrix,
    sums_under_hats,
)
from ltcl.transport import stored
from ltcl.transport.first_bounce import drop_uncertain
from ltcl.transport.noise import Noise
from ltcl.transport.noise.fit import noise_step

# Change of an entry of the mixing after which rows are solved once more.
NOTABLE_MIXING = 0.002
# Condition of the products of colours up to which patterns tell them apart.
MAX_COLOUR_CONDITION = 1e4
# The functions of `windows`, as a basis of `ltcl.operators`.
BASIS = "hats"
# Standard deviations by which a first bounce must be above 0.
FIRST_BOUNCE_SIGMAS = 5.0
# Least factor of the variances of entries.
LEAST_SCALE = 1e-4
# Light of a function that is left out, relative to that of the camera pixel.
NEGLIGIBLE_LIGHT = 1e-6


class Estimator:
    """Priors and rows of all channels, for pixels of a grid.

    `progress` is called with "fit", rows that are done, and all rows of `solves` solutions.
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
        self.windows = Windows.of(grid)
        self.W = hat_matrix(grid)
        self.W_squared: Any = scipy.sparse.csr_array(self.W.multiply(self.W))
        self.channels = channels
        self.finds_mixing = mixing is None and channels == 3
        self.mixing = np.eye(channels) if mixing is None else mixing
        self.priors: list[Prior] = []
        self.rows: list[Rows] = []
        self._progress = progress
        self._done = 0
        # Rows that are solved: some in each round that learns the prior, and all.
        sparse_windows, _ = self.windows.every(PRIOR_STEP)
        prior_rows = ROUNDS * len(sparse_windows.nodes)
        self._expected = prior_rows + solves * len(self.windows.nodes)

    def learn(self, pairs: Pairs) -> None:
        """Learn the priors, and the mixing of the colours if it is asked for; solve the rows."""
        self.finds_mixing = self.finds_mixing and _shows_colours(pairs)
        if self.finds_mixing:
            self.mixing = _first_mixing(pairs)
        self.priors = []
        for channel in range(self.channels):
            pictures = pairs.photographs[:, :, channel].T
            light = _light(pairs.patterns @ self.mixing[channel], pairs.photographs[:, :, channel])
            sums = self._sums(pairs.patterns, channel)
            variance = _of_channel(pairs.variance, channel)
            prior = learn_prior(self.windows, sums, pictures, light, self._count, variance)
            self.priors.append(prior)
        self.solve(pairs)
        if not self.finds_mixing:
            return
        mixing = self._find_mixing(pairs)
        change = np.abs(mixing - self.mixing).max()
        self.mixing = mixing
        if change > NOTABLE_MIXING:
            self.solve(pairs)
            self.mixing = self._find_mixing(pairs)

    def solve(self, pairs: Pairs) -> None:
        """Solve the rows of all channels."""
        self.rows = []
        for channel in range(self.channels):
            sums = self._sums(pairs.patterns, channel)
            pictures = pairs.photographs[:, :, channel].T
            prior = self.priors[channel]
            variance = _of_channel(pairs.variance, channel)
            rows = solve_rows(self.windows, sums, pictures, prior, self._count, variance)
            self.rows.append(rows)

    def explain(self, patterns: np.ndarray) -> np.ndarray:
        """T p of patterns, (frames, N, channels)."""
        channels = []
        for channel in range(self.channels):
            sums = self._sums(patterns, channel)
            channels.append((self.coefficients(channel) @ sums[:-1]).T)
        return np.stack(channels, axis=2)

    def coarsest(self, pairs: Pairs) -> tuple[Estimator, Pairs]:
        """Return itself, and the pairs at its pixels, which `RefinedEstimator` averages."""
        return self, pairs

    def foretell(self, pairs: Pairs, channel: int) -> Foretold:
        """Compare each photograph with all others, by the priors that were learned."""
        return foretell(
            self.windows,
            self._sums(pairs.patterns, channel),
            pairs.photographs[:, :, channel].T,
            self.priors[channel],
            self._count,
            _of_channel(pairs.variance, channel),
        )

    @property
    def noise(self) -> float:
        """The median of what rows leave of a photograph, relative to the light of the pixel."""
        variances = [prior.noise for prior in self.priors]
        return float(np.sqrt(np.median(variances)))

    def scale_of_variance(self, patterns: np.ndarray, residual_squares: np.ndarray) -> np.ndarray:
        """Factors of the variances of all entries, under which T p errs as it did, (channels,).

        `residual_squares` are the squares that T left of photographs of patterns, summed up over
        them and all pixels, (channels,). Errors of entries in a row go together, which their
        variances do not tell.
        """
        scales = []
        for channel in range(self.channels):
            prior = self.priors[channel]
            squares = (patterns @ self.mixing[channel]) ** 2
            sums = self.W_squared @ squares.T
            expected = (self.variances(channel) @ sums).sum()
            noise = len(patterns) * (prior.noise * prior.light**2).sum()
            measured = max(residual_squares[channel] - noise, 0.0)
            scales.append(max(measured / expected, LEAST_SCALE))
        return np.array(scales)

    def unknown_light(self) -> np.ndarray:
        """The variance of the light of each scale and place of the projector, (levels, h, w).

        It is that under a hat of the level around a pixel, for all camera pixels and channels, as
        much of it as belongs to the pixel.
        """
        hats = HatLevels(self.grid)
        variance = np.zeros(hats.nodes)
        for channel in range(self.channels):
            variance += self.variances(channel).sum(axis=0)
        return light_of_scales(hats, variance)

    def own_variance(self) -> np.ndarray:
        """Variances of the light of each pixel's own, (channels, N)."""
        return np.stack([self._own(channel)[1] for channel in range(self.channels)])

    def arrays(self, scales: np.ndarray) -> dict[str, np.ndarray]:
        """The arrays of the transport (`ltcl.transport.stored`), with the noise of its entries."""
        pixels = len(self.windows.nodes)
        samples = [self._entries(channel, scales[channel]) for channel in range(self.channels)]
        noise = Noise.fit((pixels, pixels), samples, "acquired")
        return self._transport_arrays() | noise.to_arrays()

    def _entries(self, channel: int, scale: float) -> Iterator[tuple[np.ndarray, ...]]:
        """Rows, columns, light and variances of the entries of T that `Noise.fit` looks at."""
        C: Any = self.coefficients(channel)
        V: Any = self.variances(channel) * scale
        pixels = C.shape[0]
        step = noise_step((pixels, pixels))
        by_column = self.W.tocsc()
        squares_by_column = self.W_squared.tocsc()
        for first in range(step):
            chosen = np.arange(first, pixels, step)
            light = (C[chosen] @ by_column[:, chosen]).toarray()
            variance = (V[chosen] @ squares_by_column[:, chosen]).toarray()
            # A pixel that the camera does not see has none.
            i, j = np.nonzero(variance)
            yield chosen[i], chosen[j], light[i, j], variance[i, j]

    def _transport_arrays(self) -> dict[str, np.ndarray]:
        cores = []
        diagonals = []
        first_bounce = []
        own = np.arange(len(self.windows.nodes))
        for channel in range(self.channels):
            C = self.coefficients(channel)
            products: Any = C.multiply(self.W.T)
            diagonals.append(products.sum(axis=1) - 1.0)
            identity = scipy.sparse.eye_array(len(own), self.windows.absent, format="csr")
            cores.append(scipy.sparse.csr_array(C - identity))
            direct, variance = self._own(channel)
            first_bounce.append(drop_uncertain(direct, variance, FIRST_BOUNCE_SIGMAS))
        mixing = self.mixing if self.channels == 3 else None
        return stored.arrays_of_scan(
            self.grid, cores, np.stack(diagonals), np.stack(first_bounce), mixing, BASIS
        )

    def _own(self, channel: int) -> tuple[np.ndarray, np.ndarray]:
        """The light of each pixel's own function, and its variance, (N,)."""
        own = np.arange(len(self.windows.nodes))
        is_own = self.windows.nodes == own[:, None]
        rows = self.rows[channel]
        direct = np.where(is_own, rows.mean, 0.0).sum(axis=1)
        variance = np.where(is_own, rows.variance, 0.0).sum(axis=1)
        return direct, variance

    def coefficients(self, channel: int) -> scipy.sparse.csr_array:
        """C (N, nodes) of T = C W."""
        return self._in_nodes(channel, self.rows[channel].mean)

    def variances(self, channel: int) -> scipy.sparse.csr_array:
        """Variances of C, in the same pattern."""
        return self._in_nodes(channel, self.rows[channel].variance)

    def _in_nodes(self, channel: int, values: np.ndarray) -> scipy.sparse.csr_array:
        """Values of functions of each row, (N, q), at their nodes, where T has light."""
        mean = self.rows[channel].mean
        area = self.windows.area[self.windows.group]
        light = self.priors[channel].light[:, None]
        is_there = self.windows.nodes != self.windows.absent
        matters = is_there & (np.abs(mean) * area > NEGLIGIBLE_LIGHT * light)
        row, function = np.nonzero(matters)
        column = self.windows.nodes[row, function]
        shape = len(mean), self.windows.absent
        return scipy.sparse.csr_array((values[row, function], (row, column)), shape=shape)

    def _sums(self, patterns: np.ndarray, channel: int) -> np.ndarray:
        """Sums under all hats of the light that a channel answers to."""
        return sums_under_hats(self.W, list(patterns @ self.mixing[channel]))

    def _find_mixing(self, pairs: Pairs) -> np.ndarray:
        """The mixing that explains the photographs best, given the rows."""
        mixing = np.empty_like(self.mixing)
        for channel in range(self.channels):
            C = self.coefficients(channel)
            answers = []
            for colour in range(3):
                sums = sums_under_hats(self.W, list(pairs.patterns[:, :, colour]))
                answers.append((C @ sums[:-1]).ravel())
            answer = np.stack(answers, axis=1)
            pictures = pairs.photographs[:, :, channel].T.ravel()
            shares = np.linalg.lstsq(answer, pictures, rcond=1e-6)[0]
            mixing[channel] = shares / shares.sum()
        return mixing

    def _count(self, rows: int) -> None:
        """Tell the progress that some rows were solved."""
        self._done += rows
        if self._progress is not None:
            expected = self._expected * self.channels
            self._progress("fit", self._done, max(self._done, expected))


def _light(patterns: np.ndarray, photographs: np.ndarray) -> np.ndarray:
    """Light of each camera pixel under a pattern of ones, about, (N,)."""
    mean = photographs.mean(axis=0) / max(patterns.mean(), np.finfo(float).tiny)
    return np.maximum(mean, mean.max() * 1e-6)


def _first_mixing(pairs: Pairs) -> np.ndarray:
    """The mixing that the changes of each pixel show, from its own light alone, (3, 3)."""
    changes, products = _products_of_colours(pairs)
    answers = np.einsum("fic,fid->cd", pairs.photographs, changes)
    shares = np.linalg.solve(products, answers.T).T
    return shares / shares.sum(axis=1, keepdims=True)


def _shows_colours(pairs: Pairs) -> bool:
    """Return True if the patterns tell colours apart; grey ones do not."""
    _, products = _products_of_colours(pairs)
    return bool(np.linalg.cond(products) < MAX_COLOUR_CONDITION)


def _products_of_colours(pairs: Pairs) -> tuple[np.ndarray, np.ndarray]:
    """Patterns less their means, (frames, N, 3), and the products of their colours, (3, 3)."""
    changes = pairs.patterns - pairs.patterns.mean(axis=0)
    return changes, np.einsum("fic,fid->cd", changes, changes)


def _of_channel(variance: np.ndarray | None, channel: int) -> np.ndarray | None:
    """Variances (N, frames) of a channel of pictures (frames, N, channels)."""
    if variance is None:
        return None
    return variance[:, :, channel].T
