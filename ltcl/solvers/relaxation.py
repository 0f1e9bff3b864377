# SPDX-License-Identifier: BSD-3-Clause
"""Relaxation, one row or block of rows after the other: Gauss-Seidel, SOR, block Gauss-Seidel, Southwell.

Gauss-Seidel is Jacobi that uses each new value at once (eq. 17-20 of the paper, in place), SOR stretches its
corrections, and block Gauss-Seidel solves the rows of a block together:

    l_i += omega (l_out_i - sum_(j<i) S_ij l_j^(k+1) - sum_(j>=i) S_ij l_j^(k)) / S_ii,  row i after row i
    l_B += (S_BB)^-1 (l_out - S l)_B,  block B after block

A sweep costs about one product. They converge for every albedo where S is self-adjoint, so also where Jacobi
does not (Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., sections 4.1.1 and 4.2.1, theorem 4.10).
The residual of an iterate is a by-product of the sweep that follows it; hence k iterations take k + 1 sweeps,
and a product confirms the last one.

Southwell relaxes the largest residual first, as progressive radiosity does with light (R. V. Southwell,
Relaxation Methods in Engineering Science, 1940; M. Cohen et al., A Progressive Refinement Approach to Fast
Radiosity Image Generation, SIGGRAPH 1988):

    i = argmax |r_i|,  l_i += r_i / S_ii,  r -= S[:, i] r_i / S_ii
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.operators.relaxation import INVERTED, Steps, Sweeps, relaxation
from ltcl.solvers.stopping import SLOTS, Monitor, System

_STEPS = 64  # of an iteration of Southwell's, where `rows` is not given and there are that many pixels


@dataclass(frozen=True)
class BlockGaussSeidel:
    """Options: ``block``, rows of a block, which changes the iterates; inverses take 4 N block bytes.

    With blocks of one row it is Gauss-Seidel, with one block the direct solution.
    """

    name: ClassVar[str] = "block_gauss_seidel"
    block: int | None = INVERTED
    omega: ClassVar[float | None] = None

    def __post_init__(self) -> None:
        if self.block is not None or self.omega is None:
            checks.count("block", self.block)
        if self.omega is not None:
            checks.number("omega", self.omega, above=0.0, below=2.0)

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it with one of the iterates."""
        sweeps = Sweeps(relaxation(system.S, self.name, self.block, self.omega), x, system.b, r)
        sweeps.sweep()
        system.products += 1
        _repeat(sweeps.sweep, system, sweeps.before, r, monitor)
        x.copy_from(sweeps.before)


@dataclass(frozen=True)
class GaussSeidel(BlockGaussSeidel):
    """Options: ``block``, rows of a block; it changes the speed, not the iterates."""

    name: ClassVar[str] = "gauss_seidel"
    block: int | None = None
    omega: ClassVar[float | None] = 1.0


@dataclass(frozen=True)
class SOR(GaussSeidel):
    """Options: ``omega`` in (0, 2), and ``block`` as of Gauss-Seidel, which SOR is with omega = 1."""

    name: ClassVar[str] = "sor"
    omega: float = 1.0  # pyright: ignore[reportIncompatibleVariableOverride]


@dataclass(frozen=True)
class Southwell:
    """Options: ``rows`` relaxed in one step; a 64th of the picture when not given.

    With ``rows=1`` it is the sequential method, which converges for every self-adjoint S. With more, each of
    as many equal parts of the picture relaxes its own largest residual at the same time, so a device has
    work; too many at once behave like Jacobi and may diverge. An iteration is as many steps as relax N rows,
    and so costs what one product costs.
    """

    name: ClassVar[str] = "southwell"
    rows: int | None = None

    def __post_init__(self) -> None:
        if self.rows is not None:
            checks.count("rows", self.rows)

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        n = x.shape[0]
        rows = min(max(1, n // _STEPS) if self.rows is None else self.rows, n)
        steps = Steps(system.S, self.name, x, r, rows)

        def relax_all() -> None:
            for _ in range(-(-n // rows)):
                steps.step()
            steps.step(picks=False)

        _repeat(relax_all, system, x, r, monitor)


def _repeat(iteration: Callable[[], None], system: System, x: Array, r: Array, monitor: Monitor) -> None:
    """Queue iterations, each of which leaves `r` of `x`, until the monitor ends it; few readings of norms."""
    squares = x.device.empty((SLOTS, x.columns))
    while True:
        ahead = monitor.steps_ahead()
        for slot in range(ahead):
            iteration()
            vectors.queue_dot(r, r, squares, slot)
        system.products += ahead
        norms = np.sqrt(squares.get()[:ahead].astype(np.float64))
        if monitor.check(x, r, norms, travelled=np.inf):
            return
