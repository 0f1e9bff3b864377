# SPDX-License-Identifier: BSD-3-Clause
"""Shrinking of the coefficients of T in orthonormal bases, averaged over the bases.

A first estimate P drops coefficients below a threshold. With P as pilot, the Wiener factor
P^2 / (P^2 + variance) is applied to the measured coefficients (Ghael, Sayeed and Baraniuk, Improved
wavelet denoising via empirical Wiener filtering, 1997), in bases that do not cross the folds
between walls, which P shows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ltcl.tasks.denoising.multiwavelets import (
    DEFAULT_SHIFTS,
    SeparableBasis,
    find_folds,
    multiwavelets,
    singular_vectors,
)
from ltcl.tasks.denoising.problem import DenoisingProblem
from ltcl.tasks.denoising.reciprocity import SHIFTS, SIGNIFICANCE, TINY
from ltcl.tasks.denoising.walls import shrink_wall_products

# Times that outstanding entries are looked for.
OUTSTANDING_PASSES = 3
# Called with the share of a step that is done.
NoteShare = Callable[[float], object]


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Denoised entries Z and simulated remaining noise of as much variance, (M, N) float32."""

    Z: np.ndarray
    noise: np.ndarray


@dataclass(frozen=True, kw_only=True)
class FirstEstimate:
    """A problem without its outstanding entries, and its estimate Z."""

    problem: DenoisingProblem
    pilot: np.ndarray


def first_estimate(problem: DenoisingProblem, note: NoteShare) -> FirstEstimate:
    """Z (M, N) by thresholds, and once more without the entries that stand out of it."""
    pilot = _pilot(problem, note)
    for _ in range(OUTSTANDING_PASSES):
        outstanding_count = np.count_nonzero(problem.is_outstanding)
        problem = problem.without_outstanding(pilot)
        if np.count_nonzero(problem.is_outstanding) == outstanding_count:
            break
        pilot = _pilot(problem, _ignore_share)
    return FirstEstimate(problem=problem, pilot=pilot)


def _pilot(problem: DenoisingProblem, note: NoteShare) -> np.ndarray:
    """Z (M, N) by thresholds; of a reciprocal T once more in its own singular vectors.

    Where T is not reciprocal, these are left out: they move light of bounces at low noise.
    """
    pilot = threshold_coefficients(problem, multiwavelets(problem.grids), note)
    if problem.is_reciprocal:
        basis = singular_vectors(pilot, problem.grid)
        pilot = apply_wiener_factors(problem, [basis], pilot, _ignore_share).Z
    return pilot


def refine(problem: DenoisingProblem, pilot: np.ndarray, note: NoteShare) -> Estimate:
    """Z by Wiener factors of a pilot, then by products between the walls that the pilot shows."""
    camera_folds = find_folds(pilot, problem.camera_grid)
    projector_folds = find_folds(pilot.T, problem.grid)
    count = DEFAULT_SHIFTS
    if problem.is_reciprocal:
        count = SHIFTS
    bases = multiwavelets(problem.grids, (camera_folds, projector_folds), count)
    estimate = apply_wiener_factors(problem, bases, pilot, note)
    if problem.has_cancelling_errors:
        # Few products would keep sums worse than they are known.
        return estimate
    Z, noise = shrink_wall_products(
        estimate.Z,
        estimate.noise,
        grids=problem.grids,
        folds=(camera_folds, projector_folds),
        is_reciprocal=problem.is_reciprocal,
    )
    return Estimate(Z=Z, noise=noise)


def threshold_coefficients(
    problem: DenoisingProblem, bases: list[SeparableBasis], note: NoteShare
) -> np.ndarray:
    """Z (M, N) without the coefficients below 3 standard deviations, averaged over `bases`."""
    total = np.zeros(problem.Z.shape, np.float32)
    for count, basis in enumerate(bases, 1):
        C, variance = problem.coefficients(problem.Z, basis)
        threshold = SIGNIFICANCE**2 * variance
        power = C * C
        C *= power > threshold
        total += basis.backward(C)
        note(count / len(bases))
    return total / len(bases)


def apply_wiener_factors(
    problem: DenoisingProblem,
    bases: list[SeparableBasis],
    pilot: np.ndarray,
    note: NoteShare,
) -> Estimate:
    """Z by Wiener factors of `pilot`, averaged over `bases`; the noise is that of the last one."""
    Z = problem.Z
    if problem.camera_grid == problem.grid:
        # Z has zeros where the first bounce was; the pilot is smooth there.
        Z = Z + np.diag(np.diag(pilot))
    total = np.zeros(Z.shape, np.float32)
    remaining_variance = np.zeros(0, np.float32)
    for count, basis in enumerate(bases, 1):
        C, variance = problem.coefficients(Z, basis)
        factor = basis.forward(np.maximum(pilot, 0.0)) ** 2
        factor /= np.maximum(factor + variance, TINY)
        C *= factor
        total += basis.backward(C)
        remaining_variance = factor * variance
        note(count / len(bases))
    noise = bases[-1].backward(_unit_noise(problem) * np.sqrt(remaining_variance))
    return Estimate(Z=total / len(bases), noise=noise)


def _unit_noise(problem: DenoisingProblem) -> np.ndarray:
    """Random numbers of variance 1, (M, N) float32; symmetric where Z is."""
    noise = np.random.default_rng(0).standard_normal(problem.Z.shape, np.float32)
    if problem.is_reciprocal:
        noise = (noise + noise.T) * np.float32(0.5**0.5)
    return noise


def _ignore_share(share: float) -> None:
    """A step too short to be noted."""
