# SPDX-License-Identifier: BSD-3-Clause
"""Richardson iteration: Jacobi with damping, which makes it converge for every albedo below one.

    l^(k+1) = l^(k) + omega (l_out - S l^(k))

The error of an eigenvector of S with eigenvalue s shrinks by |1 - omega s| a step. On a spectrum in [a, b]
the best omega is 2 / (a + b), with the factor (b - a) / (b + a); for one albedo m, [1 / (1 + m), 1 / (1 - m)]
gives omega = 1 - m^2 and the factor m. Chebyshev needs about the square root of its products.

Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., example 4.1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from ltcl import checks, theory
from ltcl.device import Array, vectors
from ltcl.operators import Operator
from ltcl.solvers.stopping import Monitor, System


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
        omega = _best(system.S) if self.omega is None else self.omega
        while not monitor.done(x, r, lazy=True):
            vectors.axpy(omega, r, x)
            system.residual(x, r)


def _best(S: Operator) -> float:
    lower, upper = theory.free_bounds(S)
    # Row sums that leave float32 tell nothing; a first step without damping shows that S does, too.
    return 2.0 / (lower + upper) if math.isfinite(upper) else 1.0
