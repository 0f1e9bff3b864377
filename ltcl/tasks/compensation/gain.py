# SPDX-License-Identifier: BSD-3-Clause
"""The largest gain at which a picture is within the projector's reach.

Exactly: the light without bounds is affine in the gain, p = gain u - v with T u = desired and T v =
background, so that each pixel allows an interval of gains.

Up to a loss: with C the pictures T p + background of all p within the bounds, which is convex,

    h(gain) = min over c in C of ||W (gain d - c)|| - loss ||gain W d||

is convex in the gain, so that the gains with h <= 0 are an interval. Its upper end is enclosed:
every c is within the loss at gains where a quadratic is at most 0, and the largest of these is in
reach; every solve has a certificate, and with it a tangent below h, whose zero cannot be passed and
is the next gain (Newton).

A certificate may take thousands of products where T has fewer rows than columns, or small singular
values: systems of few numbers are solved on the host by active sets (Stark and Parker,
Bounded-variable least squares, Computational Statistics 10, 1995), large ones in a limited number
of steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.optimize

from ltcl.errors import InputError
from ltcl.solvers import Status
from ltcl.tasks.compensation.problem import Columns, Limits, Problem

TOLERANCE = 0.01  # of the gain; of the least error, where that is sought
_COARSE = 0.1  # of what the error is above the loss: how exact solves on the way are
_FINE = 0.2  # of what the tolerance of the gain is worth, to which the last ones are
_FLOOR = 1e-6  # relative error that float32 resolves
_STEPS, _MAXITER = 60, 200  # of the search; of each solve in it
_ON_HOST = (
    1 << 14
)  # entries of a system: an active set changes in about the time of a step on the device
_MORE = 1.1  # times the least error of all gains, that the largest may have where none is in reach


@dataclass(frozen=True, eq=False)
class Trial:
    """The nearest light that was found at a gain; errors relative to ||gain W d||.

    For every gain' min ||W (gain' d - c)|| / ||W d|| is at least gain * least + slope * (gain' - gain).
    `cosine` is that of W c with W d, `sine` the error of this light at the gain that suits it best,
    `size` that of W c over that of W d.
    """

    gain: float
    light: Columns
    error: float
    least: float
    slope: float
    cosine: float
    sine: float
    size: float
    settled: bool  # no further step would improve it

    def largest(self, loss: float) -> float:
        """The largest gain at which this light is within `loss`; 0 where it is at none."""
        if self.sine > loss or self.cosine <= 0.0:
            return 0.0
        return self.size * (self.cosine + float(np.sqrt(loss**2 - self.sine**2))) / (1.0 - loss**2)


def exact(u: Columns, v: Columns, limits: Limits) -> float | None:
    """The largest gain with low <= gain u - v <= high at all pixels that are lit; None if there is none."""
    least, most = 0.0, np.inf
    for slope, shift in zip(u, v, strict=True):
        constant = (slope == 0.0) | limits.masked[:, None]
        beyond = limits.exceeded(-shift)
        if beyond is not None and (beyond & constant).any():
            return None
        ends = np.stack([limits.low + shift, limits.high + shift]) / np.where(constant, 1.0, slope)
        least = max(least, float(np.max(np.min(ends, axis=0), where=~constant, initial=0.0)))
        most = min(most, float(np.min(np.max(ends, axis=0), where=~constant, initial=np.inf)))
    return most if least <= most and 0.0 < most < np.inf else None


def within_loss(problem: Problem, loss: float | None) -> tuple[float, Columns]:
    """The largest gain within `loss`, or where that is None within the least that can be; its light."""
    search = Search(problem)
    if loss is not None:
        return search.largest(loss)
    rtol = problem.rules["rtol"]
    return search.largest(max(rtol, _MORE * search.closest(enough=rtol / _MORE).sine))


class Search:
    """Trials of gains for a problem."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.size = float(np.linalg.norm(problem.norms(problem.desired)))
        if self.size == 0.0:
            raise InputError(
                "gain is 'auto', but desired is 0 everywhere that weights count: no gain is too large"
            )
        self.on_host = all(np.prod(system.A.shape) <= _ON_HOST for system in problem.systems)
        self.A: list[Any] = [
            system.A.to_dense() if self.on_host else system.A for system in problem.systems
        ]

    def largest(self, loss: float) -> tuple[float, Columns]:
        """The largest gain, within `TOLERANCE`, at which some light comes within `loss`; that light."""
        high, light = self._from_above(loss)
        low, best = 0.0, light
        gain, accuracy = high, _COARSE * (1.0 - loss)
        for _ in range(_STEPS):
            trial = self._nearest(gain, light, accuracy)
            light, own = trial.light, trial.largest(loss)
            if own > low:
                low, best = own, light
            rise = trial.slope - loss
            if trial.least > loss:  # the tangent decides
                if rise <= 0.0 or trial.least - loss >= rise:
                    break
                high = gain * (1.0 - (trial.least - loss) / rise)
                accuracy = max(_COARSE * (trial.error - loss), _FINE * TOLERANCE * rise)
            elif trial.settled:
                high = gain
            else:
                accuracy /= 4
            if high <= (1.0 + TOLERANCE) * low:
                break
            if trial.least > loss or trial.settled:
                gain = high * (1.0 - TOLERANCE / 2)
        if low > 0.0:
            return low, best
        nearest = self.closest()
        if nearest.sine <= loss:
            return nearest.largest(loss), nearest.light
        raise InputError(
            f"gain is 'auto', but no gain brings the picture within a loss of {loss:g}; the least is "
            f"about {nearest.sine:.3g}; give a larger loss, or brighten the picture's dark parts"
        )

    def closest(self, enough: float = 0.0) -> Trial:
        """The light with the least `sine`, to `TOLERANCE` of it, or one within `enough`.

        In t = 1 / gain the least error is convex: the next trial is where the tangents of those
        before are lowest, at most at twice the largest t.
        """
        first, light = self._from_above(0.0)
        enough = max(enough, _FLOOR)
        lines: list[tuple[float, float]] = []
        t, farthest, bound, trials = 1.0, 1.0, 0.0, list[Trial]()
        for _ in range(_STEPS):
            sine = min((trial.sine for trial in trials), default=1.0)
            if trials and sine <= max(enough, (1.0 + TOLERANCE) * bound):
                break
            accuracy = max(_COARSE * (sine - bound), TOLERANCE / 4 * max(sine, enough))
            trials.append(self._nearest(first / t, light, accuracy))
            light = trials[-1].light
            lines.append((trials[-1].slope, (trials[-1].least - trials[-1].slope) / t))
            farthest = max(farthest, t)
            # Where in (0, 2 farthest] the largest of the lines a + b t is lowest, and how low.
            a, b = np.array(lines).T
            with np.errstate(divide="ignore", invalid="ignore"):
                crossings = ((a[:, None] - a) / (b - b[:, None])).ravel()
            ts = np.append(crossings[(crossings > 0.0) & (crossings < 2 * farthest)], 2 * farthest)
            heights = np.max(a + b * ts[:, None], axis=1)
            t, bound = float(ts[np.argmin(heights)]), float(np.min(heights))
        return min(trials, key=lambda trial: trial.sine)

    def _from_above(self, loss: float) -> tuple[float, Columns]:
        """A gain that none with h <= 0 exceeds, and the light in whose picture the most of W d is found.

        ``gain ||W d||^2 - max (W c).(W d) <= ||gain W d - W c|| ||W d||``; in p the maximum is of a linear
        function.
        """
        problem, limits, reach, light = self.problem, self.problem.limits, 0.0, []
        twice = problem.weighted(problem.weighted(problem.desired))
        for A, system, wwd, dark in zip(self.A, problem.systems, twice, problem.dark, strict=True):
            use = system.scale[:, None] * (A.T @ wwd)  # T^T W^2 d
            best = limits.clip(np.where(use > 0.0, limits.high, limits.low))
            light.append(best)
            reach += float(np.sum(use * best) + np.sum(dark * wwd))
        if reach <= 0.0:
            raise InputError(
                "gain is 'auto', but no light within the bounds brings the picture nearer to desired than "
                "darkness does: desired or T is negative"
            )
        return reach / ((1.0 - loss) * self.size**2), light

    def _nearest(self, gain: float, light: Columns, accuracy: float) -> Trial:
        """The trial at this gain, whose error is above the least by `accuracy` at most, if it has settled."""
        problem = self.problem
        columns = sum(d.shape[1] for d in problem.desired)
        rules = {
            "rtol": 0.0,
            "atol": accuracy * gain * self.size / np.sqrt(columns),
            "maxiter": _MAXITER,
        }
        # of each system light, error and its lower bound of each column, and whether it settled
        solves = []
        for which, start in enumerate(light):
            if self.on_host:
                solves.append((*_active_sets(problem, which, gain, self.A[which]), True))
                continue
            p, solution = problem.nearest(which, gain, start, **rules)
            settled = solution.status is not Status.CONVERGED or not np.any(solution.errors)
            solves.append(
                (p, solution.errors / problem.unit, solution.least / problem.unit, settled)
            )
        light = [p for p, *_ in solves]
        parts = zip(problem.target(gain), self.A, problem.systems, light, strict=True)
        missing = problem.weighted(
            [b - A @ (system.scale[:, None] * p) for b, A, system, p in parts]
        )
        Wd = problem.weighted(problem.desired)
        error = float(np.sqrt(_inner(missing, missing)))
        # Each column has a bound and a slope of its own; these add up with the weights error /
        # norm.
        above = sum(float(np.sum(errors * (errors - least))) for _, errors, least, _ in solves)
        Wc = [gain * d - r for d, r in zip(Wd, missing, strict=True)]
        norm, along = float(np.sqrt(_inner(Wc, Wc))), _inner(Wc, Wd) / self.size**2
        across = [c - along * d for c, d in zip(Wc, Wd, strict=True)]
        return Trial(
            gain=gain,
            light=light,
            error=error / (gain * self.size),
            least=(error - above / (error or 1.0)) / (gain * self.size),
            slope=_inner(missing, Wd) / ((error or 1.0) * self.size),
            cosine=along * self.size / (norm or 1.0),
            sine=float(np.sqrt(_inner(across, across))) / (norm or 1.0) if along > 0.0 else 1.0,
            size=norm / self.size,
            settled=all(settled for *_, settled in solves),
        )


def _active_sets(
    problem: Problem, which: int, gain: float, A: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Light, errors and least errors of each column, in float64."""
    limits, scale, target = (
        problem.limits,
        problem.systems[which].scale,
        problem.target(gain)[which],
    )
    low, high = limits.low, limits.high
    lit = (scale > 0.0) & ~limits.masked
    light = limits.clip(np.zeros((len(scale), target.shape[1])))
    errors, least = np.zeros((2, target.shape[1]))
    for column, b in enumerate(target.T.astype(np.float64)):
        w = np.ones(len(b)) if problem.weights is None else problem.weights[which][:, column]
        T, b = w[:, None] * (A * scale)[:, lit], w * b
        x = (
            scipy.optimize.lsq_linear(T, b, (low, high), "bvls", 1e-12).x
            if lit.any()
            else np.zeros(0)
        )
        r = T @ x - b
        g, error = T.T @ r, float(np.linalg.norm(r))
        gap = float(np.sum(np.maximum(g * (x - low), g * (x - high))))  # as of `solvers.bounded`
        light[lit, column] = np.clip(x.astype(np.float32), low, high)
        errors[column] = np.linalg.norm(T @ light[lit, column] - b)
        least[column] = max(error - gap / error, 0.0) if error > 0.0 else 0.0
    return light, errors, np.minimum(least, errors)


def _inner(a: Columns, b: Columns) -> float:
    return float(sum(np.sum(x * y, dtype=np.float64) for x, y in zip(a, b, strict=True)))
