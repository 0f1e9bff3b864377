# SPDX-License-Identifier: BSD-3-Clause
"""The whole R in the chosen basis, its threshold set anew until solutions are within the tolerance.

Both norms are measured on what is handed out, rounding and all, with random starts that no choice has seen.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.compression import choice, fit, sums
from ltcl.compression.choice import Choice
from ltcl.compression.coefficients import Coefficients
from ltcl.compression.cores import Core
from ltcl.compression.fit import Fit, Problem
from ltcl.compression.inverse_norm import inverse_norm
from ltcl.compression.kinds import Kind
from ltcl.compression.parted import Parted
from ltcl.compression.result import ChannelCompression
from ltcl.compression.sources import difference, source
from ltcl.errors import ToleranceError
from ltcl.operators import CSR, Compressed, IdentityPlus, Operator, Sum, Tiles
from ltcl.theory import TwoNorm, two_norm

_TRIES = 6
_AIM = 0.96  # of the tolerance
_LOOSE = 0.8  # of it: so far below, a larger threshold is tried once
_MOST = 3.0  # times: no threshold grows by more
_FRESH = 1  # seed of the random starts
_MORE = 4  # times the numbers kept on the window, which the whole may need


@dataclass(frozen=True)
class Confirmed:
    """R~ and what is known of it."""

    operator: Compressed | Sum
    fit: Fit
    core: Core
    norm: TwoNorm
    inverse: TwoNorm

    @property
    def solution_error(self) -> float:
        """Bound on ||x~ - x|| / ||x||."""
        return self.norm.upper * self.inverse.upper

    def fresh(self, kind: Kind, diagonal: np.ndarray | None) -> Compressed | Sum:
        """R~ again, of the same numbers but without what measuring it has left on the device.

        `kind` is fresh, too; `diagonal` is that of R.
        """
        core, kept, error = self.core.operator, self.fit.coefficients, self.norm.upper
        if isinstance(core, Sum) and isinstance(kept, Parted):
            both = (_again(A, matrix) for A, matrix in zip(sums.parts(core), kept.parts, strict=True))
            return sums.summed(kind, *both, error=error, diagonal=diagonal)
        only = kind.only(self.fit.places)
        return Compressed(_again(core, kept.core), only.out, only.into, error=error, diagonal=diagonal)

    def report(self, problem: Problem, made: Choice) -> ChannelCompression:
        """What is told of this channel."""
        kept, core = self.fit.coefficients, self.core
        return ChannelCompression(
            basis=self.fit.kind.name,
            format=core.format,
            width=core.width,
            precision=core.precision,
            kept=kept.core.nnz / self.operator.shape[0],
            nbytes=core.nbytes,
            seconds=core.seconds,
            threshold=kept.threshold,
            dropped=_dropped(problem, self.fit),
            dropped_between=kept.first,
            quantisation=core.quantisation,
            error=self.norm.upper,
            error_estimate=self.norm.estimate,
            inverse_norm=self.inverse.upper,
            solution_error=self.solution_error,
            confidence=self.norm.confidence + self.inverse.confidence - 1.0,
            trials=made.trials,
        )


def confirm(
    problem: Problem,
    kind: Kind,
    made: Choice,
    same: bool,
    rtol: float,
    budget: float,
    progress: Callable[[float], object] | None = None,
) -> Confirmed:
    """R~ of the whole R with a solution error of at most `rtol`; within the budget, or small.

    Parameters
    ----------
    problem : Problem
    kind : Kind
        The basis, on the grid of the problem.
    made : Choice
        On a window, or, where they are the `same`, on the problem.
    rtol, budget : float
        Of this channel.
    progress : callable, optional
        Called with the share of R that has been read.
    """
    goal = made.goal
    if same:
        found, fitted = made.best.found, made.best.fit
    else:
        found, fitted = _whole(problem, kind, made, progress)
    good: Confirmed | None = None
    reached = math.inf
    for _ in range(_TRIES):
        active = fitted.active()
        core = active.best(problem.device, choice.ROUNDING * goal, budget)
        result = _measured(problem, active, core)
        reached = result.solution_error / rtol
        if reached <= 1.0 and (reached >= _LOOSE or not fitted.coefficients.core.nnz):
            return result
        if good is not None:  # the larger threshold was too large, or gained little
            return min(good, result, key=lambda one: one.core.nbytes) if reached <= 1.0 else good
        good = result if reached <= 1.0 else None
        change = _AIM / max(reached, _AIM / _MOST)
        # From what the fit came to, which may be well below the goal that it had.
        goal = change * max(fitted.norm.upper / choice.DROPPING, 0.5 * goal)
        start = change * fitted.coefficients.dropped
        if found.dropped > choice.DROPPING * goal:
            found = fit.gather(problem, kind, choice.GATHER * choice.DROPPING * goal, progress=progress)
        fitted = fit.fit(problem, kind, found, choice.DROPPING * goal, start)
    least = reached * rtol
    raise ToleranceError(
        f"rtol is {rtol:g}, but after {_TRIES} attempts solutions may be off by "
        f"{checks.upwards(least)}; it must be larger",
        least,
    )


def _again(core: Operator, matrix: Any) -> Operator:
    """A core of the same numbers, `matrix` where nothing was rounded."""
    return Tiles(core.device, core.packed) if isinstance(core, Tiles) else CSR(core.device, matrix)


def _whole(
    problem: Problem, kind: Kind, made: Choice, progress: Callable[[float], object] | None
) -> tuple[Coefficients, Fit]:
    """Coefficients of the whole, begun where the window ended: the same is dropped of each row."""
    window, dropping = made.best.fit.coefficients, choice.DROPPING * made.goal
    pixels = len(window.core.indptr) - 1
    start = window.dropped * math.sqrt(problem.pixels / pixels)
    most = _MORE * math.ceil(window.core.nnz / pixels) * problem.pixels
    found = fit.gather(problem, kind, choice.GATHER * max(start, dropping), most, progress)
    fitted = fit.fit(problem, kind, found, dropping, start)
    if fitted.norm.upper > dropping:
        found = fit.gather(problem, kind, choice.GATHER * dropping, progress=progress)
        fitted = fit.fit(problem, kind, found, dropping, start)
    return found, fitted


def _measured(problem: Problem, fitted: Fit, core: Core) -> Confirmed:
    R = fitted.operator(core.operator)
    total = fit.certain(fitted.coefficients) + core.quantisation
    norm = two_norm(problem.operator, R, factor=1.05, frobenius=total, seed=_FRESH)
    inverse = inverse_norm(IdentityPlus(R), factor=1.05, seed=_FRESH + 1)
    R.error = norm.upper
    core = dataclasses.replace(core, seconds=choice.seconds(R, core))
    return Confirmed(R, fitted, core, norm, inverse)


def _dropped(problem: Problem, fitted: Fit) -> float:
    """||R~ - R||_F before its core was rounded; of a sum from its rows, as its parts may lose the same."""
    kept = fitted.coefficients
    if not isinstance(kept, Parted):
        return kept.dropped
    R = fit.exact(problem.device, fitted.kind, kept)
    return difference(problem.R, source("R", R), problem.memory)
