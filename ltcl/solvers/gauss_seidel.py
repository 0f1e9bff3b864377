# SPDX-License-Identifier: BSD-3-Clause
"""Gauss-Seidel: Jacobi that uses each new value at once (eq. 17-20 of the paper, in place).

    l_i^(k+1) = (l_out_i - sum_(j<i) S_ij l_j^(k+1) - sum_(j>i) S_ij l_j^(k)) / S_ii

Exact, in place and deterministic: a sweep is a blocked forward substitution on the device, and costs about
one product. It converges for every albedo where S is self-adjoint (Saad, Iterative Methods for Sparse Linear
Systems, 2nd ed., theorem 4.10), so also where Jacobi does not.

The residual of an iterate is a by-product of the sweep that follows it; hence k iterations take k + 1
sweeps, and a product confirms the last one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ltcl import checks
from ltcl.device import Array
from ltcl.operators.relaxation import Relaxation, Sweep, relaxation
from ltcl.solvers.stopping import Monitor, System


@dataclass(frozen=True)
class GaussSeidel:
    """Options: ``block``, rows of a block; it changes the speed, not the iterates."""

    name: ClassVar[str] = "gauss_seidel"
    block: int | None = None

    def __post_init__(self) -> None:
        if self.block is not None:
            checks.count("block", self.block)

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        if not monitor.done(x, r):
            sweeps(system, x, r, monitor, relaxation(system.S, self.name, self.block))


def sweeps(system: System, x: Array, r: Array, monitor: Monitor, relaxation: Relaxation) -> None:
    """Sweep until the monitor ends it with one of the iterates, which is then in `x`."""
    state = Sweep(x, system.b, r)
    _sweep(system, relaxation, state)
    while True:
        _sweep(system, relaxation, state)
        if monitor.done(state.before, r, recursive=True):
            break
    if state.before is not x:
        x.copy_from(state.before)


def _sweep(system: System, relaxation: Relaxation, state: Sweep) -> None:
    system.products += 1
    relaxation.sweep(state)
