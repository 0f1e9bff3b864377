# SPDX-License-Identifier: BSD-3-Clause
"""Stationary iterations: Jacobi, the Neumann series, Richardson; and the loop they share with Chebyshev.

One launch a step (`Operator.stepper`), with x the iterate and r its residual:

    x += d,   r -= S d,   d = keep d + gain r

Jacobi (eq. 20), keep = 0 and gain = 1: what the projector must still add is what the last guess lacks,
l^(k+1) = l^(k) + (l_out - S l^(k)). Started from zero, k steps are the k-term inverse Neumann series
(eq. 10), whose next term is the residual; the forward dual (eq. 18) is the same on I - A. Both converge
where the spectral radius of R is below 1.

Richardson, gain = omega: damping makes it converge for every albedo below one. On a spectrum in [a, b] the
best omega is 2 / (a + b), with the factor (b - a) / (b + a) a step; for one albedo m that is omega = 1 - m^2
and the factor m (Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., example 4.1).
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
from ltcl.solvers.stopping import SLOTS, Monitor, System


def steps(
    system: System, x: Array, r: Array, monitor: Monitor, coefficients: Iterator[tuple[float, float]]
) -> Iterator[None]:
    """Take steps with (keep, gain), the first for d = gain r alone, until the monitor ends it.

    Yields after each reading of residuals that does not end the solve.
    """
    stepper = system.S.stepper(x, r, SLOTS)
    keep, gain = next(coefficients)
    stepper.start(gain)
    length = abs(gain) * monitor.norms  # of d, at most
    travelled = np.zeros_like(length)
    while True:
        taken = list(itertools.islice(coefficients, monitor.steps_ahead()))
        for keep, gain in taken:
            stepper.step(keep, gain)
        system.products += len(taken)
        norms = stepper.norms()
        for (keep, gain), norm in zip(taken, norms, strict=True):
            travelled += length
            length = abs(keep) * length + abs(gain) * norm
        if monitor.check(x, r, norms, recursive=True, travelled=travelled):
            return
        yield


@dataclass(frozen=True)
class Jacobi:
    """No options."""

    name: ClassVar[str] = "jacobi"

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        _damped(system, x, r, monitor, 1.0)


@dataclass(frozen=True)
class Neumann(Jacobi):
    """The series is Jacobi's iteration started from zero; no options."""

    name: ClassVar[str] = "neumann"


@dataclass(frozen=True)
class Richardson:
    """Options: ``omega``, the damping; the best one for the free bounds of S when not given."""

    name: ClassVar[str] = "richardson"
    omega: float | None = None

    def __post_init__(self) -> None:
        if self.omega is not None:
            checks.number("omega", self.omega, above=0.0)

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        omega = self.omega
        if omega is None:
            lower, upper = theory.free_bounds(system.S)
            # Row sums that leave float32 tell nothing; a first step without damping shows that S does, too.
            omega = 2.0 / (lower + upper) if math.isfinite(upper) else 1.0
        _damped(system, x, r, monitor, omega)


def _damped(system: System, x: Array, r: Array, monitor: Monitor, omega: float) -> None:
    if not monitor.check(x, r, system.start_norms):
        for _ in steps(system, x, r, monitor, itertools.repeat((0.0, float(omega)))):
            pass
