# SPDX-License-Identifier: BSD-3-Clause
"""Trials of a gain: the light within the bounds nearest to gain * desired, and its error.

Every solve has a certificate, a lower bound on the least error. It may take thousands of products
where T has fewer rows than columns, or small singular values: systems of few numbers are solved on
the host by active sets (Stark and Parker, Bounded-variable least squares, Computational Statistics
10, 1995), large ones in a limited number of steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy  # its subpackage optimize is loaded at the first use

from ltcl.errors import InputError
from ltcl.solvers import SolveSettings, Status
from ltcl.tasks.compensation.problem import (
    Columns,
    CompensationProblem,
    inner_product,
    multiply,
    subtract,
)

# Steps of a solve on the device.
MAX_SOLVE_STEPS = 200
# Entries of a system that is solved on the host, at most: an active set changes in about the time
# of a step on the device.
MAX_HOST_ENTRIES = 1 << 14


class PictureDirection(NamedTuple):
    """The cosine and sine between W c and W d, and the norm of W c over that of W d.

    The sine is the error of c at the gain that suits it best, 1 if there is none.
    """

    cosine: float
    sine: float
    size: float

    def largest_gain(self, loss: float) -> float:
        """The largest gain at which this picture is within `loss`; 0 if it is at none."""
        if self.sine > loss or self.cosine <= 0.0:
            return 0.0
        root = float(np.sqrt(loss**2 - self.sine**2))
        return self.size * (self.cosine + root) / (1.0 - loss**2)


def combined_direction(along: float, across: float) -> PictureDirection:
    """The direction of a picture with these parts along W d and across it, over ||W d||."""
    size = float(np.hypot(along, across))
    if size == 0.0:
        return PictureDirection(0.0, 1.0, 0.0)
    sine = across / size if along > 0.0 else 1.0
    return PictureDirection(along / size, sine, size)


@dataclass(frozen=True, kw_only=True, eq=False)
class GainTrial:
    """The nearest light that was found at a gain; errors are relative to ||gain W d||.

    Attributes
    ----------
    gain : float
    light : list of (N, k)
        The light of each system.
    error, least : float
        The error of this light, and a lower bound on the error of any light.
    slope : float
        For every gain' min ||W (gain' d - c)|| / ||W d|| is at least
        gain * least + slope * (gain' - gain).
    direction : PictureDirection
    is_settled : bool
        Another trial at this gain gives nothing better: its error is zero, the steps allowed are
        used up, or it was solved on the host.
    """

    gain: float
    light: Columns
    error: float
    least: float
    slope: float
    direction: PictureDirection
    is_settled: bool

    @property
    def sine(self) -> float:
        """The error of this light at the gain that suits it best."""
        return self.direction.sine

    def largest_gain(self, loss: float) -> float:
        """The largest gain at which this light is within `loss`; 0 if it is at none."""
        return self.direction.largest_gain(loss)


class SystemLight(NamedTuple):
    """Light (N, k) of one system, errors and lower bounds on them, (k,) in units of the weights."""

    light: np.ndarray
    errors: np.ndarray
    least: np.ndarray
    is_settled: bool


class GainTrials:
    """Trials of gains for one problem; `desired_norm` is ||W d||."""

    def __init__(self, problem: CompensationProblem) -> None:
        self.problem = problem
        self.desired_norm = float(np.linalg.norm(problem.norms(problem.desired)))
        if self.desired_norm == 0.0:
            raise InputError(
                "gain is 'auto', but desired is 0 everywhere that weights count: "
                "no gain is too large"
            )
        largest_size = max(np.prod(A.shape) for A, _ in problem.systems)
        self.is_on_host = largest_size <= MAX_HOST_ENTRIES
        self.matrices: list[Any] = [A for A, _ in problem.systems]
        if self.is_on_host:
            self.matrices = [A.to_dense() for A in self.matrices]

    def upper_bound(self, loss: float) -> tuple[float, Columns]:
        """A gain that no gain within `loss` exceeds, and the light that is most like desired.

        gain ||W d||^2 - max (W c).(W d) <= ||gain W d - W c|| ||W d||; the maximum is that of a
        linear function of the light.
        """
        problem = self.problem
        limits = problem.limits
        twice_weighted = problem.weighted(problem.weighted(problem.desired))
        largest_product = 0.0
        light = []
        for A, system, wwd, background in zip(
            self.matrices, problem.systems, twice_weighted, problem.background, strict=True
        ):
            # T^T W^2 d
            use = system.scale[:, None] * (A.T @ wwd)
            best = limits.clip(np.where(use > 0.0, limits.highest, limits.low))
            light.append(best)
            largest_product += float(np.sum(use * best) + np.sum(background * wwd))
        if largest_product <= 0.0:
            raise InputError(
                "gain is 'auto', but no light within the bounds brings the picture nearer to "
                "desired than darkness does: desired or T is negative"
            )
        return largest_product / ((1.0 - loss) * self.desired_norm**2), light

    def steepest_light(self) -> tuple[Columns, Columns]:
        """Light along T^T W^2 d that comes nearest to desired, and none for the background.

        A guess at light without bounds, as slopes and shifts, where T has no S.
        """
        problem = self.problem
        twice_weighted = problem.weighted(problem.weighted(problem.desired))
        slopes = []
        for index, (system, wwd) in enumerate(zip(problem.systems, twice_weighted, strict=True)):
            A, scale = system
            x = A.T @ wwd
            picture = A @ x
            if problem.weights is not None:
                picture = picture * problem.weights[index]
            problem.products[index] += 2
            square = float(np.sum(np.square(picture)))
            length = float(np.sum(np.square(x))) / square if square > 0.0 else 0.0
            divisor = np.where(scale > 0.0, scale, 1.0)[:, None]
            slopes.append(length * x / divisor)
        return slopes, [np.zeros(slope.shape) for slope in slopes]

    def nearest(self, gain: float, start: Columns, accuracy: float) -> GainTrial:
        """Try this gain.

        The error of a settled trial is above the least by `accuracy` at most.
        """
        if self.is_on_host:
            solved = [self._solve_on_host(index, gain) for index in range(len(start))]
        else:
            solved = self._solve_on_device(gain, start, accuracy)
        return self._measure(gain, solved)

    def _solve_on_device(self, gain: float, start: Columns, accuracy: float) -> list[SystemLight]:
        """The nearest light of all systems, in a limited number of steps."""
        problem = self.problem
        columns = sum(d.shape[1] for d in problem.desired)
        settings = SolveSettings(
            rtol=0.0,
            atol=accuracy * gain * self.desired_norm / np.sqrt(columns),
            maxiter=MAX_SOLVE_STEPS,
        )
        solved = []
        for light, solution in problem.nearest_each(
            gain, dict(enumerate(start)), settings
        ).values():
            is_settled = solution.status is not Status.CONVERGED or not np.any(solution.errors)
            solved.append(
                SystemLight(
                    light=light,
                    errors=solution.errors / problem.weight_unit,
                    least=solution.least / problem.weight_unit,
                    is_settled=is_settled,
                )
            )
        return solved

    def _solve_on_host(self, index: int, gain: float) -> SystemLight:
        """The nearest light of one system by active sets, in float64."""
        problem = self.problem
        limits = problem.limits
        scale = problem.systems[index].scale
        target = problem.light_to_add(gain)[index]
        is_lit = (scale > 0.0) & ~limits.masked
        T = (self.matrices[index] * scale)[:, is_lit]
        columns = target.shape[1]
        highest = np.broadcast_to(limits.highest[:, 0], scale.shape)[is_lit]
        light = limits.clip(np.zeros((len(scale), columns)))
        errors = np.zeros(columns)
        least = np.zeros(columns)
        for column, b in enumerate(target.T.astype(np.float64)):
            w = np.ones(len(b))
            if problem.weights is not None:
                w = problem.weights[index][:, column]
            weighted_T = w[:, None] * T
            weighted_b = w * b
            x, least_error = _bounded_least_squares(weighted_T, weighted_b, limits.low, highest)
            light[is_lit, column] = np.clip(x.astype(np.float32), limits.low, highest)
            rounded = light[is_lit, column]
            errors[column] = np.linalg.norm(weighted_T @ rounded - weighted_b)
            least[column] = least_error
        return SystemLight(
            light=light, errors=errors, least=np.minimum(least, errors), is_settled=True
        )

    def _measure(self, gain: float, solved: list[SystemLight]) -> GainTrial:
        """The facts of a trial from the light of its systems."""
        problem = self.problem
        Wd = problem.weighted(problem.desired)
        missing = self._weighted_missing(gain, [system.light for system in solved])
        error = float(np.sqrt(inner_product(missing, missing)))
        divisor = error if error > 0.0 else 1.0
        # Each column has a bound and a slope of its own, which add up with weights error / norm.
        above_least = 0.0
        for system in solved:
            above_least += float(np.sum(system.errors * (system.errors - system.least)))

        are_settled = all(system.is_settled for system in solved)
        return GainTrial(
            gain=gain,
            light=[system.light for system in solved],
            error=error / (gain * self.desired_norm),
            least=(error - above_least / divisor) / (gain * self.desired_norm),
            slope=inner_product(missing, Wd) / (divisor * self.desired_norm),
            direction=self._direction(subtract(multiply(gain, Wd), missing)),
            is_settled=are_settled,
        )

    def direction(self, light: Columns) -> PictureDirection:
        """The direction of the picture of this light: one product a system."""
        return self._direction(multiply(-1.0, self._weighted_missing(0.0, light)))

    def _direction(self, Wc: Columns) -> PictureDirection:
        Wd = self.problem.weighted(self.problem.desired)
        along = inner_product(Wc, Wd) / self.desired_norm**2
        across = subtract(Wc, multiply(along, Wd))
        across_norm = float(np.sqrt(inner_product(across, across)))
        return combined_direction(along, across_norm / self.desired_norm)

    def _weighted_missing(self, gain: float, light: Columns) -> Columns:
        """W (gain d - c) of the pictures c of this light."""
        problem = self.problem
        missing = []
        for b, A, system, p in zip(
            problem.light_to_add(gain), self.matrices, problem.systems, light, strict=True
        ):
            missing.append(b - A @ (system.scale[:, None] * p))
        return problem.weighted(missing)


def _bounded_least_squares(
    T: np.ndarray, b: np.ndarray, low: float, high: np.ndarray
) -> tuple[np.ndarray, float]:
    """The x from low to high, (N,), with the least ||T x - b||, and a lower bound on that error."""
    x = np.zeros(T.shape[1])
    if T.shape[1] > 0:
        # SciPy wants room between the bounds; light without it is the lower one.
        bounds = (low, np.maximum(high, np.nextafter(np.float32(low), np.float32(np.inf))))
        x = scipy.optimize.lsq_linear(T, b, bounds, method="bvls", tol=1e-12).x
    residual = T @ x - b
    error = float(np.linalg.norm(residual))
    if error == 0.0:
        return x, 0.0
    # The gap of Frank and Wolfe, as in `ltcl.solvers.bounded`.
    gradient = T.T @ residual
    gap = np.maximum(gradient * (x - low), gradient * (x - high))
    return x, max(error - float(np.sum(gap)) / error, 0.0)
