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

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.ndimage

from ltcl.acquisition.estimation.windows import Windows

# Rounds in which prior and noise are learned.
ROUNDS = 4
# Pixels over which the prior is averaged: standard deviation of a Gaussian.
NEIGHBOURHOOD = 2.0
# Light of a function before anything is learned, as a share of the pixel's light: its own, others.
OWN_SHARE = 1.0
FIRST_SHARE = 0.01
# Noise of a pixel relative to its light: before it is learned, and at least.
FIRST_NOISE = 0.01
LEAST_NOISE = 1e-5
# Variance of a picture from which on it is unknown.
UNKNOWN_NOISE = 1e9
# Numbers of B at once.
CHUNK_NUMBERS = 1 << 22


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


def learn_prior(
    windows: Windows,
    sums: np.ndarray,
    pictures: np.ndarray,
    light: np.ndarray,
    progress: Callable[[int], None],
    variance: np.ndarray | None = None,
) -> Prior:
    """The prior under which pictures (N, patterns) are likely; `sums` are those under all hats.

    `variance` is that of the pictures by the noise of the camera, if it is known; `progress` is
    called with the number of rows that were solved since its last call.
    """
    prior = Prior.first(windows, light)
    for _ in range(ROUNDS):
        rows = solve_rows(windows, sums, pictures, prior, progress, variance)
        prior = _more_likely(windows, rows, prior)
    return prior


def solve_rows(
    windows: Windows,
    sums: np.ndarray,
    pictures: np.ndarray,
    prior: Prior,
    progress: Callable[[int], None],
    variance: np.ndarray | None = None,
) -> Rows:
    """The rows of T, given a prior; the arguments are those of `learn_prior`."""
    pixels, q = windows.nodes.shape
    mean = np.zeros((pixels, q))
    uncertainty = np.zeros((pixels, q))
    residual = np.zeros(pixels)
    patterns = sums.shape[1]
    chunk = max(CHUNK_NUMBERS // (q * (patterns + q)), 1)
    for start in range(0, pixels, chunk):
        part = slice(start, start + chunk)
        light = prior.light[part, None]
        left = prior.noise[part, None] * light**2
        noise = np.broadcast_to(left, (len(light), patterns))
        if variance is not None:
            noise = noise + variance[part]
        mean[part], uncertainty[part], misfit = _solve(
            sums[windows.nodes[part]],
            pictures[part],
            np.sqrt(prior.coefficients[part][:, windows.group]) * light,
            noise,
        )
        residual[part] = misfit * left[:, 0]
        progress(len(light))
    return Rows(mean=mean, variance=uncertainty, residual=residual)


def _solve(
    B: np.ndarray, pictures: np.ndarray, deviation: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean and variance of some rows, and the mean square of what they leave, relative to noise.

    B is (rows, q, patterns), `deviation` V^1/2 (rows, q), `noise` (rows, patterns).
    """
    q = B.shape[1]
    precision_of_pictures = 1.0 / np.sqrt(noise)
    scaled = B * deviation[:, :, None] * precision_of_pictures[:, None, :]
    whitened = pictures * precision_of_pictures
    precision = scaled @ scaled.transpose(0, 2, 1)
    diagonal = np.arange(q)
    precision[:, diagonal, diagonal] += 1.0
    covariance = np.linalg.inv(precision)
    unscaled = (covariance @ (scaled @ whitened[:, :, None]))[:, :, 0]
    left = whitened - (unscaled[:, None, :] @ scaled)[:, 0, :]
    shrunk = covariance[:, diagonal, diagonal]
    # Coefficients that the pictures determine, and not the prior.
    determined = q - shrunk.sum(axis=1)
    known = np.count_nonzero(noise < UNKNOWN_NOISE, axis=1)
    freedom = np.maximum(known - determined, 1.0)
    mean = deviation * unscaled
    variance = deviation**2 * shrunk
    misfit = (left**2).sum(axis=1) / freedom
    return mean, variance, misfit


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
        nearby_total = _nearby(total, windows.grid)
        nearby_count = _nearby(count.astype(float), windows.grid)
        learned[:, group] = nearby_total / np.maximum(nearby_count, 1e-6)
    noise = _nearby(rows.residual / light**2, windows.grid)
    return Prior(
        light=prior.light,
        coefficients=learned,
        noise=np.maximum(noise, LEAST_NOISE**2),
    )


def _nearby(values: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """Means over pixels nearby, (N,)."""
    smooth = scipy.ndimage.gaussian_filter(values.reshape(grid), NEIGHBOURHOOD, mode="nearest")
    return smooth.ravel()
