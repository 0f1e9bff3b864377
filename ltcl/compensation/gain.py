# SPDX-License-Identifier: BSD-3-Clause
"""The largest gain at which a picture is within the projector's reach.

Exactly: the light without bounds is affine in the gain, p = gain u - v with T u = desired and T v =
background, so that each pixel allows an interval of gains.

Up to a loss: with C the pictures T p + background of all p within the bounds, which is convex, and W d the
weighted desired picture,

    h(gain) = min over c in C of ||W (gain d - c)|| - loss ||gain W d||

is convex in the gain. The largest gain with h <= 0 is found by Newton's method from above, where the tangent
of a convex h cannot pass its last zero; h' costs nothing, since min ||r|| has the derivative r.W d / ||r||.
Where h' <= 0 at h > 0, h has no zero. Some pictures have parts that no gain brings within reach, darker than
the light that bounces there: `least_loss` tells what they cost.
"""

from __future__ import annotations

import numpy as np

from ltcl.compensation.problem import Limits, Problem
from ltcl.errors import InputError

_AIM = 0.99  # of the loss, so that Newton from above gets below the loss itself
_ACCURACY = 0.005  # of the loss, to which the last picture is the nearest
_COARSE = 0.02  # of what the error is above the loss, to which those on the way are
_STEPS = 50


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
    """The largest gain at which some light within the limits comes within `loss` of the picture; that light.

    Raises
    ------
    InputError
        No gain does.
    """
    gain, light = _from_above(problem, loss)
    accuracy = _COARSE
    for _ in range(_STEPS):
        light, error, slope = _nearest(problem, gain, light, accuracy)
        if error <= loss:
            return gain, light
        accuracy = max(_ACCURACY * loss, _COARSE * (error - loss))
        rise = slope - _AIM * loss
        gain -= gain * (error - _AIM * loss) / rise if rise > 0.0 else gain
        if gain <= 0.0:
            break
    least = least_loss(problem, max(loss, _COARSE))
    raise InputError(
        f"gain is 'auto', but no gain brings the picture within a loss of {loss:g}; the least is "
        f"about {least:.2g}; give a larger loss, or brighten the picture's dark parts"
    )


def least_loss(problem: Problem, tolerance: float) -> float:
    """The relative error that no darker picture is below by much: halving the gain gains less than this."""
    gain, light = _from_above(problem, 0.0)
    least, error = np.inf, 1.0
    while error < least - tolerance:
        least = error
        gain /= 2
        light, error, _ = _nearest(problem, gain, light, tolerance / 4)
    return min(least, error)


def _nearest(
    problem: Problem, gain: float, light: list[np.ndarray], accuracy: float
) -> tuple[list[np.ndarray], float, float]:
    """The light that comes nearest at this gain, its relative error, and d||r|| / d gain over ||W d||."""
    size = _size(problem)
    columns = sum(part.shape[1] for part in problem.desired)
    rules = {"rtol": 0.0, "atol": accuracy * gain * size / np.sqrt(columns)}
    light = [problem.nearest(which, gain, start, **rules)[0] for which, start in enumerate(light)]
    left = problem.weighted(_residual(problem, gain, light))
    error = float(np.sqrt(_inner(left, left)))
    slope = _inner(left, problem.weighted(problem.desired)) / (error or 1.0)
    return light, error / (gain * size), slope / size


def _size(problem: Problem) -> float:
    size = problem.norm(problem.desired)
    if size == 0.0:
        raise InputError(
            "gain is 'auto', but desired is black where it counts: no gain is too large for that"
        )
    return size


def _from_above(problem: Problem, loss: float) -> tuple[float, list[np.ndarray]]:
    """A gain that none with h <= 0 exceeds, and the light in whose picture the most of W d is found.

    ``gain ||W d||^2 - max (W c).(W d) <= ||gain W d - W c|| ||W d||``; in p the maximum is of a linear
    function.
    """
    reach, light = 0.0, []
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
            "gain is 'auto', but no light within the bounds looks more like the picture than none; "
            "is desired negative, or T?"
        )
    return reach / ((1.0 - loss) * _size(problem) ** 2), light


def _residual(problem: Problem, gain: float, light: list[np.ndarray]) -> list[np.ndarray]:
    """gain * desired - dark - T p."""
    seen = (system.A @ system.to_x(p) for system, p in zip(problem.systems, light, strict=True))
    return [target - part for target, part in zip(problem.target(gain), seen, strict=True)]


def _inner(a: list[np.ndarray], b: list[np.ndarray]) -> float:
    return float(sum(np.sum(x * y, dtype=np.float64) for x, y in zip(a, b, strict=True)))
