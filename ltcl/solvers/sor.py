# SPDX-License-Identifier: BSD-3-Clause
"""Successive over-relaxation (end of section 6): Gauss-Seidel with each correction stretched by omega.

    l_i^(k+1) = (1 - omega) l_i^(k) + omega (the value of Gauss-Seidel)

With omega = 1 it is Gauss-Seidel; on self-adjoint S it converges for every omega in (0, 2) (Saad, Iterative
Methods for Sparse Linear Systems, 2nd ed., section 4.2.1 and theorem 4.10).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ltcl import checks
from ltcl.device import Array
from ltcl.operators.relaxation import relaxation
from ltcl.solvers.gauss_seidel import sweeps
from ltcl.solvers.stopping import Monitor, System


@dataclass(frozen=True)
class SOR:
    """Options: ``omega`` in (0, 2), and ``block``, rows of a block, which changes the speed only."""

    name: ClassVar[str] = "sor"
    omega: float = 1.0
    block: int | None = None

    def __post_init__(self) -> None:
        checks.number("omega", self.omega, above=0.0, below=2.0)
        if self.block is not None:
            checks.count("block", self.block)

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        if not monitor.done(x, r):
            chosen = relaxation(system.S, self.name, self.block, float(self.omega))
            sweeps(system, x, r, monitor, chosen)
