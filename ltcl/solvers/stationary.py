# SPDX-License-Identifier: BSD-3-Clause
"""Jacobi, the Neumann series and Richardson: one product and one launch a step.

    x += d,   r -= S d,   d = gain r,   gain = 1 or omega

Jacobi (eq. 20), gain = 1: from zero, k steps are the k-term inverse Neumann series (eq. 10), whose
next term is the residual; the forward dual (eq. 18) is the same on I - A. Both need rho(R) < 1.

Richardson, gain = omega, converges for every albedo below one. On a spectrum in [a, b] the best
omega is 2 / (a + b) (Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., example 4.1).

`take_steps` also serves Chebyshev, whose steps keep a part of the last direction:
d = keep d + gain r (`Operator.stepper`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ltcl import checks, theory
from ltcl.device import Array
from ltcl.solvers.method import IterativeMethod
from ltcl.solvers.stopping import SLOTS, CountedOperator, Monitor


def take_steps(
    system: CountedOperator,
    x: Array,
    r: Array,
    monitor: Monitor,
    coefficients: Iterator[tuple[float, float]],
) -> Iterator[None]:
    """Take steps with (keep, gain), the first with d = gain r, until the monitor ends the solve.

    Yields after each reading of residuals that does not end the solve.
    """
    stepper = system.S.stepper(x, r, SLOTS)
    _, gain = next(coefficients)
    stepper.start(gain)
    # A bound on the length of the direction d, which is the way of x in the next step.
    length = abs(gain) * monitor.norms
    while True:
        queued = list(itertools.islice(coefficients, monitor.steps_ahead()))
        for keep, gain in queued:
            stepper.step(keep, gain)
        system.products += len(queued)
        norms = stepper.norms()

        travelled = np.zeros_like(length)
        for (keep, gain), norm in zip(queued, norms, strict=True):
            travelled += length
            length = abs(keep) * length + abs(gain) * norm
        if monitor.check(x, r, norms, travelled):
            return
        yield


@dataclass(frozen=True)
class Jacobi(IterativeMethod):
    """Jacobi's iteration. No options."""

    name: ClassVar[str] = "jacobi"
    omega: ClassVar[float | None] = 1.0

    def iterate(self, system: CountedOperator, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends the solve."""
        omega = self.omega
        if omega is None:
            omega = best_damping(*theory.free_bounds(system.S))
        coefficients = itertools.repeat((0.0, float(omega)))
        for _ in take_steps(system, x, r, monitor, coefficients):
            pass


@dataclass(frozen=True)
class Neumann(Jacobi):
    """The Neumann series, which is Jacobi's iteration from zero. No options."""

    name: ClassVar[str] = "neumann"


@dataclass(frozen=True)
class Richardson(Jacobi):
    """Richardson's iteration. Option: ``omega``, the damping; the best for the free bounds."""

    name: ClassVar[str] = "richardson"
    omega: float | None = None  # pyright: ignore[reportIncompatibleVariableOverride]

    def __post_init__(self) -> None:
        if self.omega is not None:
            checks.number("omega", self.omega, above=0.0)


def best_damping(lower: float, upper: float) -> float:
    """Return the omega that is best for a spectrum in [lower, upper]."""
    if not math.isfinite(upper):
        # Row sums that leave float32 tell nothing; a first step without damping shows that S does,
        # too.
        return 1.0
    return 2.0 / (lower + upper)


METHODS = (Jacobi, Neumann, Richardson)
