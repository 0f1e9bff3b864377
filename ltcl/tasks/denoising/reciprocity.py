# SPDX-License-Identifier: BSD-3-Clause
"""The factors d of reciprocity, T_ij d_j = T_ji d_i, fitted to a noisy T of a Lambertian scene.

d holds areas and irradiance, no albedo. Errors of d would be the largest errors of smooth pictures,
so the fit is linear in T: logarithms of dim entries, as `ltcl.transport.diagnostics` takes them,
have a bias, 12 % of d in a path-traced corner. With r = sqrt(d) and Z_ij = T_ij r_j / r_i, a change
e of log d obeys

    Z_ij - Z_ji = Z_ij (e_i - e_j) + noise

Those wavelet coefficients of log d that the covariance of the fit explains are dropped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltcl.tasks.denoising.multiwavelets import Grid, SeparableBasis, multiwavelets

# Linear steps: the first ones move the weights, the last one hardly moves d.
FIT_STEPS = 3
# Largest |log d|: beyond a factor of 20, errors of d cost bounces.
MAX_LOG_FACTOR = 3.0
# Relative error of a pair, at least, so that no bright pair decides alone.
MIN_PAIR_ERROR = 1e-4
# Standard deviations that a coefficient must exceed to be kept.
SIGNIFICANCE = 3.0
# Shifts of the wavelets of log d.
SHIFTS = 6
TINY = np.finfo(np.float32).tiny


@dataclass(frozen=True, kw_only=True)
class FactorStep:
    """A linear step of the fit.

    `change` is e, (N,); `covariance` that of e, (N, N); `noise_ratio` the mean square of residuals
    over what the noise model states.
    """

    change: np.ndarray
    covariance: np.ndarray
    noise_ratio: float


def fit_log_factors(
    X: np.ndarray, variance: np.ndarray, smooth_light: np.ndarray, grid: Grid
) -> np.ndarray:
    """Fit log d (N,) to entries X (N, N) without a diagonal, of this variance.

    `smooth_light` is X without most of its noise: weights that followed the noise would move d.
    """
    bases = multiwavelets((grid, grid), count=SHIFTS)
    # The geometric mean of a pair is that of Z, whatever d is.
    pair_light = np.sqrt(np.maximum(smooth_light, 0.0) * np.maximum(smooth_light.T, 0.0))
    log_d = np.zeros(len(X))
    for _ in range(FIT_STEPS):
        step = _linear_step(X, variance, pair_light, log_d)
        log_d = _keep_significant(log_d + step.change, step, bases)
        log_d = np.clip(log_d, -MAX_LOG_FACTOR, MAX_LOG_FACTOR)
    return log_d


def pair_gauge(log_d: np.ndarray) -> np.ndarray:
    """The factors r_j / r_i, (N, N) float32, that make a reciprocal T symmetric."""
    r = np.exp(log_d / 2).astype(np.float32)
    return r / r[:, None]


def _linear_step(
    X: np.ndarray, variance: np.ndarray, pair_light: np.ndarray, log_d: np.ndarray
) -> FactorStep:
    """Weighted least squares for e, with weights Z / variance of the pair."""
    gauge = pair_gauge(log_d)
    Z = X * gauge
    pair_variance = variance * gauge**2
    pair_variance += pair_variance.T
    del gauge
    min_variance = np.maximum((MIN_PAIR_ERROR * pair_light) ** 2, TINY)
    weight = pair_light / np.maximum(pair_variance, min_variance)
    pull = weight * (Z - Z.T)
    Z = np.maximum(Z + Z.T, 0.0) / 2
    # Smooth light is wrong where an entry deviates from it significantly.
    deviates = (Z - pair_light) ** 2 > SIGNIFICANCE**2 / 4 * pair_variance
    weight *= np.where(deviates, Z, pair_light)
    del Z, pair_variance, min_variance, deviates

    # Normal equations; one factor common to all d is free, and a prior holds it.
    degree = weight.sum(axis=1, dtype=float)
    normal = degree.mean() / len(X) - weight.astype(float)
    np.einsum("ii->i", normal)[:] += degree + MAX_LOG_FACTOR**-2.0
    covariance = np.linalg.inv(normal)
    change = (covariance @ pull.sum(axis=1, dtype=float)).astype(np.float32)

    pull -= weight * (change[:, None] - change)
    squares = np.square(pull, out=pull).sum(dtype=float)
    total_weight = degree.sum()
    noise_ratio = 0.0
    if total_weight > 0.0:
        noise_ratio = squares / total_weight
    return FactorStep(change=change, covariance=covariance, noise_ratio=noise_ratio)


def _keep_significant(
    log_d: np.ndarray, step: FactorStep, bases: list[SeparableBasis]
) -> np.ndarray:
    """Drop the wavelet coefficients of log d that errors of the fit explain."""
    significant = np.zeros(len(log_d))
    for basis in bases:
        coefficients = basis.forward_picture(log_d)
        variance = np.diag(basis.forward(step.covariance))
        variance = max(1.0, step.noise_ratio) * variance
        is_significant = coefficients**2 > SIGNIFICANCE**2 * variance
        log_of_basis = basis.backward_picture(coefficients * is_significant)
        significant += log_of_basis / len(bases)
    return significant
