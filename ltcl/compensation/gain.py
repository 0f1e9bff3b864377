# SPDX-License-Identifier: BSD-3-Clause
"""The largest gain at which a picture is within the projector's reach.

Exactly: the light without bounds is affine in the gain, p = gain u - v with T u = desired and T v =
background, so that each pixel allows an interval of gains.

Up to a loss: with C the pictures T p + background of all p within the bounds, which is convex, and W d the
weighted desired picture,

    h(gain) = min over c in C of ||W (gain d - c)|| - loss ||gain W d||

is convex in the gain, so that the gains with h <= 0 are an interval. Its upper end is held between two
numbers. Every c comes within the loss at gains of its own, where a quadratic is at most 0: the largest of
these is in reach. Every solve at a gain has a certificate, and with it a tangent below h: its zero cannot be
passed, and is where Newton's method goes on. Where such a tangent has no zero, h has none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltcl.compensation.problem import Limits, Problem
from ltcl.errors import InputError
from ltcl.solvers import Status

TOLERANCE = 0.01  # of the gain; of the least error, where that is sought
_COARSE = 0.1  # of what the error is above the loss: how exact solves on the way are
_FINE = 0.2  # of what the tolerance of the gain is worth, to which the last ones are
_FLOOR = 1e-6  # relative error that float32 hardly tells from none
_STEPS = 60


@dataclass(frozen=True, eq=False)
class Trial:
    """The nearest light that was found at a gain; errors relative to ||gain W d||.

    For every gain' min ||W (gain' d - c)|| / ||W d|| is at least gain * least + slope * (gain' - gain).
    `own` are the parts of ||W c||: its cosine with W d, and its size over ||W d||.
    """

    gain: float
    light: list[np.ndarray]
    error: float
    least: float
    slope: float
    own: tuple[float, float]
    settled: bool  # no further step would tell more

    @property
    def sine(self) -> float:
        """The error of this light at the gain that suits it best; 1 where none does."""
        cosine = max(self.own[0], 0.0)
        return float(np.sqrt(max(1.0 - cosine**2, 0.0)))

    def largest(self, loss: float) -> float:
        """The largest gain at which this light is within `loss`; 0 where it is at none."""
        cosine, size = self.own
        room = loss**2 - (1.0 - cosine**2)
        if room < 0.0 or cosine <= 0.0:
            return 0.0
        return size * (cosine + float(np.sqrt(room))) / (1.0 - loss**2)


def exact(u: list[np.ndarray], v: list[np.ndarray], limits: Limits) -> float | None:
    """The largest gain with low <= gain u - v <= high at all pixels that are lit; None where there is none.

    >>> limits = Limits(0.0, 1.0, np.array([False, False, True]))
    >>> exact([np.array([[0.5], [-0.1], [9.0]])], [np.array([[0.0], [-0.1], [0.0]])], limits)
    1.0
    """
    least, most = 0.0, np.inf
    for slope, shift in zip(u, v, strict=True):
        still = (slope == 0.0) | limits.masked[:, None]
        if (limits.exceeded(-shift) & still).any():
            return None
        ends = np.stack([limits.low + shift, limits.high + shift]) / np.where(still, 1.0, slope)
        least = max(least, float(np.max(np.min(ends, axis=0), where=~still, initial=0.0)))
        most = min(most, float(np.min(np.max(ends, axis=0), where=~still, initial=np.inf)))
    return most if least <= most and 0.0 < most < np.inf else None


def largest(problem: Problem, loss: float) -> tuple[float, list[np.ndarray]]:
    """The largest gain, within `TOLERANCE`, at which some light comes within `loss`; that light.

    Raises
    ------
    InputError
        No gain does.
    """
    high, light = _from_above(problem, loss)
    low, best = 0.0, light
    gain, accuracy = high, _COARSE * (1.0 - loss)
    for _ in range(_STEPS):
        trial = _nearest(problem, gain, light, accuracy)
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
    nearest = closest(problem)
    if nearest.sine <= loss:
        return nearest.largest(loss), nearest.light
    raise InputError(
        f"gain is 'auto', but no gain brings the picture within a loss of {loss:g}; the least is "
        f"about {nearest.sine:.3g}; give a larger loss, or brighten the picture's dark parts"
    )


def closest(problem: Problem, enough: float = 0.0) -> Trial:
    """The light with the least `sine`, to `TOLERANCE` of it, or one within `enough`.

    In t = 1 / gain the least error is convex: the tangents of all trials bound it from below, and where
    that bound is lowest is the next one. Gains below half of the least tried are not looked at.
    """
    first, light = _from_above(problem, 0.0)
    enough = max(enough, _FLOOR)
    lines: list[tuple[float, float]] = []
    t, farthest, bound, best = 1.0, 1.0, 0.0, None
    for _ in range(_STEPS):
        sine = 1.0 if best is None else best.sine
        accuracy = max(_COARSE * (sine - bound), TOLERANCE / 4 * max(sine, enough))
        trial = _nearest(problem, first / t, light, accuracy)
        light = trial.light
        lines.append((trial.slope, (trial.least - trial.slope) / t))
        if best is None or trial.sine < best.sine:
            best = trial
        farthest = max(farthest, t)
        t, bound = _lowest(lines, 2 * farthest)
        if best.sine <= max(enough, (1.0 + TOLERANCE) * bound):
            break
    assert best is not None  # noqa: S101 - there are steps
    return best


def _lowest(lines: list[tuple[float, float]], most: float) -> tuple[float, float]:
    """Where in (0, most] the largest of the lines a + b t is lowest, and how low."""
    a, b = np.array(lines).T
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings = ((a[:, None] - a) / (b - b[:, None])).ravel()
    t = np.append(crossings[(crossings > 0.0) & (crossings < most)], most)
    heights = np.max(a + b * t[:, None], axis=1)
    return float(t[np.argmin(heights)]), float(np.min(heights))


def _nearest(problem: Problem, gain: float, light: list[np.ndarray], accuracy: float) -> Trial:
    """The trial at this gain, whose error is above the least by `accuracy` at most."""
    size = _size(problem)
    columns = sum(part.shape[1] for part in problem.desired)
    rules = {"rtol": 0.0, "atol": accuracy * gain * size / np.sqrt(columns)}
    pairs = [problem.nearest(which, gain, start, **rules) for which, start in enumerate(light)]
    light, solves = [p for p, _ in pairs], [found for _, found in pairs]
    wanted = problem.weighted(problem.desired)
    left = problem.weighted(_residual(problem, gain, light))
    error = float(np.sqrt(_inner(left, left)))
    # Each column has a bound and a slope of its own; of the norm, these add up with the weights error / norm.
    above = sum(float(np.sum(found.errors * (found.errors - found.least))) for found in solves)
    along = _inner(left, wanted)
    seen = [gain * part - rest for part, rest in zip(wanted, left, strict=True)]
    norm = float(np.sqrt(_inner(seen, seen)))
    return Trial(
        gain=gain,
        light=light,
        error=error / (gain * size),
        least=(error - above / (error or 1.0)) / (gain * size),
        slope=along / ((error or 1.0) * size),
        own=(_inner(seen, wanted) / ((norm or 1.0) * size), norm / size),
        settled=all(found.status is not Status.CONVERGED or not np.any(found.errors) for found in solves),
    )


def _size(problem: Problem) -> float:
    size = problem.norm(problem.desired)
    if size == 0.0:
        everywhere = not any(part.any() for part in problem.desired)
        where = "everywhere" if everywhere else "wherever weights are above 0"
        raise InputError(f"gain is 'auto', but desired is 0 {where}: no gain is too large for that")
    return size


def _from_above(problem: Problem, loss: float) -> tuple[float, list[np.ndarray]]:
    """A gain that none with h <= 0 exceeds, and the light in whose picture the most of W d is found.

    ``gain ||W d||^2 - max (W c).(W d) <= ||gain W d - W c|| ||W d||``; in p the maximum is of a linear
    function.
    """
    size, reach, light = _size(problem), 0.0, []
    limits = problem.limits
    for system, wwd, dark in zip(
        problem.systems, problem.weighted(problem.weighted(problem.desired)), problem.dark, strict=True
    ):
        use = system.scale[:, None] * (system.A.T @ wwd)  # T^T W^2 d
        best = limits.clip(np.where(use > 0.0, limits.high, limits.low))
        light.append(best)
        reach += float(np.sum(use * best) + np.sum(dark * wwd))
    if reach <= 0.0:
        raise InputError(
            "gain is 'auto', but no light within the bounds looks more like desired than none does; "
            "is desired negative, or T?"
        )
    return reach / ((1.0 - loss) * size**2), light


def _residual(problem: Problem, gain: float, light: list[np.ndarray]) -> list[np.ndarray]:
    """gain * desired - dark - T p."""
    seen = (system.A @ system.to_x(p) for system, p in zip(problem.systems, light, strict=True))
    return [target - part for target, part in zip(problem.target(gain), seen, strict=True)]


def _inner(a: list[np.ndarray], b: list[np.ndarray]) -> float:
    return float(sum(np.sum(x * y, dtype=np.float64) for x, y in zip(a, b, strict=True)))
