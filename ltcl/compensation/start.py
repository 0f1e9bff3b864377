# SPDX-License-Identifier: BSD-3-Clause
"""The light that a target asks for when the projector has no limits, F^-1 S^-1 (gain * desired - background).

Solutions are one per channel, with a column (N,) a frame and colour. Where T has no S there are none, and the
light to start from is none at all.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ltcl.compensation import gain as gains
from ltcl.compensation.problem import Problem
from ltcl.operators import IdentityPlus
from ltcl.solvers import Inverse, Solution, solve_each
from ltcl.transport import Transport

Columns = list[np.ndarray]
_MORE = 1.1  # times the least error of all gains, that the largest may have where none is in reach


@dataclass(frozen=True, eq=False)
class Start:
    """A gain, and the light (N, k) of each system to be brought within the limits.

    `solutions` are those without bounds, one a channel, where T has an S. Light that `meets` the target
    is the best there is if clipping does not change it.
    """

    gain: float
    light: Columns
    solutions: tuple[Solution, ...] = ()
    meets: bool = False


@dataclass(frozen=True)
class Backward:
    """S^-1 of every channel of T: solves with a method and options, or an inverse that is kept."""

    T: Transport
    method: str
    options: dict[str, Any] = field(default_factory=dict)
    exact: tuple[IdentityPlus | None, ...] = ()  # what a compressed S stands for, in every channel
    inverse: Inverse | None = None

    def light(self, parts: Columns) -> Columns:
        """Projector light, one array a system, of one solution a channel."""
        return self.T.join(self.T.to_light(parts))

    def __call__(self, parts: Columns) -> tuple[Solution, ...]:
        """One solution a channel, of one target a system."""
        parts = self.T.split(parts)
        if self.inverse is not None:
            return tuple(self.inverse.solve(b, channel) for channel, b in enumerate(parts))
        return solve_each(self.T.systems, parts, self.method, exact=self.exact, **self.options)


def at_gain(inverse: Backward, problem: Problem, gain: float) -> Start:
    """Of a given gain."""
    if not inverse.T.is_square:
        k = problem.desired[0].shape[1]
        return Start(gain, [np.zeros((len(system.scale), k)) for system in problem.systems])
    solutions = inverse(problem.target(gain))
    # S^-1 meets every pixel but those of masked ones, which count only where weights say so.
    masked = problem.limits.masked
    counted = problem.weights is not None and any(part[masked].any() for part in problem.weights)
    light = inverse.light([solution.x for solution in solutions])
    return Start(gain, light, solutions, meets=not counted)


def at_largest_gain(inverse: Backward, problem: Problem, loss: float | None, exactly: bool) -> Start:
    """Of the largest gain within `loss`; where that is None, within reach `exactly` if there is one.

    Light is affine in the gain: desired and background are solved side by side, once.
    """
    if not inverse.T.is_square:
        return Start(*_at_a_loss(problem, loss))
    solved = inverse([np.hstack(sides) for sides in zip(problem.desired, problem.dark, strict=True)])
    k = problem.desired[0].shape[1]
    u, v = (inverse.light([s.x[:, part] for s in solved]) for part in (slice(k), slice(k, None)))
    gain = gains.exact(u, v, problem.limits) if exactly and loss is None else None
    light = None
    if gain is None:
        gain, light = _at_a_loss(problem, loss)
    solutions = tuple(_combined(s, gain, k) for s in solved)
    if light is not None:
        return Start(gain, light, solutions)
    return Start(gain, inverse.light([s.x for s in solutions]), solutions, meets=True)


def _combined(sides: Solution, gain: float, k: int) -> Solution:
    """gain * the first k columns - the others; both share their samples, so that errors add at worst."""
    error = sides.standard_error
    if error is not None:
        error = gain * error[:, :k] + error[:, k:]
    return dataclasses.replace(sides, x=gain * sides.x[:, :k] - sides.x[:, k:], standard_error=error)


def _at_a_loss(problem: Problem, loss: float | None) -> tuple[float, Columns]:
    if loss is not None:
        return gains.largest(problem, loss)
    rtol = problem.rules["rtol"]
    least = gains.closest(problem, enough=rtol / _MORE).sine
    return gains.largest(problem, max(rtol, _MORE * least))
