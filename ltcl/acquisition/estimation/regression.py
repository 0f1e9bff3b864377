# SPDX-License-Identifier: BSD-3-Clause
"""Rows of T from the pictures of patterns: Bayesian linear regression, its prior learned from data.

A camera pixel saw y_m under pattern p_m. Its row of T is sum_k x_k h_k in the functions h_k of its
window (`windows`), so

    y_m = sum_k B_mk x_k + noise of variance n_m,    B_mk = p_m . h_k,    x_k ~ N(0, v_g)

where g is the group of k: its level and its distance. With N of the n_m, the mean of x given y is

    x = V^1/2 (I + V^1/2 B^T N^-1 B V^1/2)^-1 V^1/2 B^T N^-1 y

v is learned: the mean of x_k^2 + var(x_k) in a group, over pixels nearby, since light varies faster
in a crease than on a wall (empirical Bayes, by expectation maximisation). n_m is the noise of the
camera, as far as it is known, and all that the functions leave, which is learned, too, relative to
the light of the pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy  # its subpackage ndimage is loaded at the first use

from ltcl.acquisition.estimation.windows import Windows

# Rounds in which prior and noise are learned.
ROUNDS = 8
# Pixels over which the prior is averaged: standard deviation of a Gaussian.
NEIGHBOURHOOD = 2.0
# Pixels along both sides from one that the prior is learned at to the next.
PRIOR_STEP = 2
# Light of a function before anything is learned, as a share of the pixel's light: its own, others.
OWN_SHARE = 1.0
FIRST_SHARE = 0.01
# Noise of a pixel relative to its light: before it is learned, and at least.
FIRST_NOISE = 0.01
LEAST_NOISE = 1e-5
# Variance of a picture from which on it is unknown.
UNKNOWN_NOISE = 1e9
# Numbers of B at once.
CHUNK_NUMBERS = 1 << 20


@dataclass(frozen=True, eq=False, kw_only=True)
class Prior:
    """Variances of coefficients, (N, groups), and of what they leave, (N,), relative to `light`.

    `light` is that of each camera pixel under a pattern of ones, about.
    """

    light: np.ndarray
    coefficients: np.ndarray
    noise: np.ndarray

    @classmethod
    def first(cls, windows: Windows, light: np.ndarray) -> Prior:
        """The prior before anything is learned."""
        share = np.full(windows.groups, FIRST_SHARE)
        share[0] = OWN_SHARE
        variance = (share / windows.area) ** 2
        pixels = len(light)
        return cls(
            light=light,
            coefficients=np.tile(variance, (pixels, 1)),
            noise=np.full(pixels, FIRST_NOISE**2),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Rows:
    """Coefficients of rows of T and their variances, (N, q), and the residuals of pictures.

    `residual` is the mean square that the rows leave, (N,), by degrees of freedom.
    """

    mean: np.ndarray
    variance: np.ndarray
    residual: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Foretold:
    """Light of pictures beyond what all others foretell, and the variance that is expected of it.

    Both are (N, patterns).
    """

    error: np.ndarray
    variance: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class _Solution:
    """A chunk of rows, its slice of all, and the pictures that others foretell there."""

    chunk: slice
    rows: Rows
    foretold: Foretold


def learn_prior(
    windows: Windows,
    sums: np.ndarray,
    pictures: np.ndarray,
    light: np.ndarray,
    progress: Callable[[int], None],
    variance: np.ndarray | None = None,
) -> Prior:
    """The prior under which pictures (N, patterns) are likely; `sums` are those under all hats.

    It varies so slowly that every `PRIOR_STEP`-th pixel along both sides shows it.
    `variance` is that of the pictures by the noise of the camera, if it is known; `progress` is
    called with the number of rows that were solved since its last call.
    """
    sparse_windows, chosen = windows.every(PRIOR_STEP)
    prior = Prior.first(sparse_windows, light[chosen])
    chosen_variance = None if variance is None else variance[chosen]
    for _ in range(ROUNDS):
        rows = solve_rows(sparse_windows, sums, pictures[chosen], prior, progress, chosen_variance)
        prior = _more_likely(sparse_windows, rows, prior)
    places = np.indices(windows.grid).reshape(2, -1) / PRIOR_STEP
    groups = prior.coefficients.T.reshape(-1, *sparse_windows.grid)
    coefficients = [between(group, places) for group in groups]
    return Prior(
        light=light,
        coefficients=np.stack(coefficients, axis=1),
        noise=between(prior.noise.reshape(sparse_windows.grid), places),
    )


def solve_rows(
    windows: Windows,
    sums: np.ndarray,
    pictures: np.ndarray,
    prior: Prior,
    progress: Callable[[int], None],
    variance: np.ndarray | None = None,
) -> Rows:
    """The rows of T, given a prior; the arguments are those of `learn_prior`."""
    shape = windows.nodes.shape
    rows = Rows(mean=np.zeros(shape), variance=np.zeros(shape), residual=np.zeros(len(prior.light)))
    for solution in _solve_in_chunks(windows, sums, pictures, prior, progress, variance):
        rows.mean[solution.chunk] = solution.rows.mean
        rows.variance[solution.chunk] = solution.rows.variance
        rows.residual[solution.chunk] = solution.rows.residual
    return rows


def foretell(
    windows: Windows,
    sums: np.ndarray,
    pictures: np.ndarray,
    prior: Prior,
    progress: Callable[[int], None],
    variance: np.ndarray | None = None,
) -> Foretold:
    """Compare each picture with all others, given a prior; the arguments are as of `solve_rows`."""
    foretold = Foretold(error=np.zeros(pictures.shape), variance=np.zeros(pictures.shape))
    for solution in _solve_in_chunks(windows, sums, pictures, prior, progress, variance):
        foretold.error[solution.chunk] = solution.foretold.error
        foretold.variance[solution.chunk] = solution.foretold.variance
    return foretold


def _solve_in_chunks(
    windows: Windows,
    sums: np.ndarray,
    pictures: np.ndarray,
    prior: Prior,
    progress: Callable[[int], None],
    variance: np.ndarray | None,
) -> Iterator[_Solution]:
    """The rows of T, as many at once as memory holds."""
    pixels, q = windows.nodes.shape
    patterns = sums.shape[1]
    chunk_rows = max(CHUNK_NUMBERS // (q * (patterns + q)), 1)
    for start in range(0, pixels, chunk_rows):
        chunk = slice(start, start + chunk_rows)
        light = prior.light[chunk, None]
        misfit = prior.noise[chunk, None] * light**2
        noise = np.broadcast_to(misfit, (len(light), patterns))
        if variance is not None:
            noise = noise + variance[chunk]
        rows, foretold = _solve(
            sums[windows.nodes[chunk]],
            pictures[chunk],
            np.sqrt(prior.coefficients[chunk][:, windows.group]) * light,
            noise,
        )
        rows = replace(rows, residual=rows.residual * misfit[:, 0])
        yield _Solution(chunk=chunk, rows=rows, foretold=foretold)
        progress(len(light))


def _solve(
    B: np.ndarray, pictures: np.ndarray, deviation: np.ndarray, noise: np.ndarray
) -> tuple[Rows, Foretold]:
    """Solve rows, with residuals relative to the noise; also foretell each picture by all others.

    B is (rows, q, patterns), `deviation` V^1/2 (rows, q), `noise` (rows, patterns).
    """
    whitening = 1.0 / np.sqrt(noise)
    # (rows, functions, patterns): what a standard deviation of x changes, in those of the noise.
    S = B * deviation[:, :, None] * whitening[:, None, :]
    y = pictures * whitening
    mean, variance, precision = _posterior(S, y)
    residual = y - (mean[:, None, :] @ S)[:, 0, :]
    # Coefficients that the pictures determine, and not the prior.
    determined = S.shape[1] - variance.sum(axis=1)
    known = np.count_nonzero(noise < UNKNOWN_NOISE, axis=1)
    freedom = np.maximum(known - determined, 1.0)
    rows = Rows(
        mean=deviation * mean,
        variance=deviation**2 * variance,
        residual=(residual**2).sum(axis=1) / freedom,
    )
    # Given all others, y errs by residual / precision, with the variance 1 / precision.
    precision = np.maximum(precision, np.finfo(float).tiny)
    foretold = Foretold(error=residual / precision / whitening, variance=noise / precision)
    return rows, foretold


@dataclass(frozen=True, eq=False, kw_only=True)
class ChannelRows:
    """Coefficients of rows for several channels with the same patterns.

    `mean` is (rows, q, channels), `variance` (rows, q), `misfit` the mean square of what they leave
    relative to the noise, (rows,), by degrees of freedom, over all channels.
    """

    mean: np.ndarray
    variance: np.ndarray
    misfit: np.ndarray


def solve_channels(
    B: np.ndarray, pictures: np.ndarray, deviation: np.ndarray, noise: np.ndarray
) -> ChannelRows:
    """Rows of all channels at once, by one system for each row.

    B is (rows, q, patterns), pictures (rows, patterns, channels), `deviation` V^1/2 (rows, q),
    `noise` (rows, patterns).
    """
    whitening = 1.0 / np.sqrt(noise)
    S = B * deviation[:, :, None] * whitening[:, None, :]
    y = pictures * whitening[:, :, None]
    q = S.shape[1]
    transposed = S.transpose(0, 2, 1)
    covariance = np.linalg.inv(np.eye(q) + S @ transposed)
    mean = covariance @ (S @ y)
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    residual = y - transposed @ mean
    known = np.count_nonzero(noise < UNKNOWN_NOISE, axis=1)
    freedom = np.maximum(known - (q - variance.sum(axis=1)), 1.0)
    squares = (residual**2).sum(axis=1).mean(axis=1)
    return ChannelRows(
        mean=deviation[:, :, None] * mean,
        variance=deviation**2 * variance,
        misfit=squares / freedom,
    )


def _posterior(S: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean and variances, (rows, q), of coefficients of unit variance that y shows.

    y = S^T x + noise of unit variance. Last comes the precision of each y given all others, (rows,
    patterns): the diagonal of (I + S^T S)^-1. With few pictures the system of the pictures is the
    smaller one: (I + S S^T)^-1 = I - S (I + S^T S)^-1 S^T.
    """
    _, q, patterns = S.shape
    transposed = S.transpose(0, 2, 1)
    if patterns < q:
        inverse = np.linalg.inv(np.eye(patterns) + transposed @ S)
        product = S @ inverse
        mean = (product @ y[:, :, None])[:, :, 0]
        variance = np.maximum(1.0 - (product * S).sum(axis=2), 0.0)
        precision = np.diagonal(inverse, axis1=1, axis2=2)
    else:
        covariance = np.linalg.inv(np.eye(q) + S @ transposed)
        mean = (covariance @ (S @ y[:, :, None]))[:, :, 0]
        variance = np.diagonal(covariance, axis1=1, axis2=2)
        precision = 1.0 - (S * (covariance @ S)).sum(axis=1)
    return mean, variance, precision


def _more_likely(windows: Windows, rows: Rows, prior: Prior) -> Prior:
    """The prior that makes these rows more likely."""
    light = np.maximum(prior.light, np.finfo(float).tiny)
    squares = (rows.mean**2 + rows.variance) / light[:, None] ** 2
    is_there = windows.nodes != windows.absent
    learned = np.empty_like(prior.coefficients)
    for group in range(windows.groups):
        members = windows.group == group
        count = np.count_nonzero(is_there[:, members], axis=1)
        total = np.where(is_there[:, members], squares[:, members], 0.0).sum(axis=1)
        nearby_total = nearby(total, windows.grid)
        nearby_count = nearby(count.astype(float), windows.grid)
        learned[:, group] = nearby_total / np.maximum(nearby_count, 1e-6)
    noise = nearby(rows.residual / light**2, windows.grid)
    return Prior(
        light=prior.light,
        coefficients=learned,
        noise=np.maximum(noise, LEAST_NOISE**2),
    )


def nearby(values: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """Means over places nearby, (N,), of values at those of a grid."""
    sigma = NEIGHBOURHOOD / PRIOR_STEP
    return scipy.ndimage.gaussian_filter(values.reshape(grid), sigma, mode="nearest").ravel()


def between(values: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Values (rows, columns) of a grid at places between its nodes, (2, N), bilinearly.

    >>> between(np.array([[0.0, 2.0]]), np.array([[0.0, 0.0], [0.5, 3.0]])).tolist()
    [1.0, 2.0]
    """
    return scipy.ndimage.map_coordinates(values, places, order=1, mode="nearest")
