# SPDX-License-Identifier: BSD-3-Clause
"""Gauss-Seidel, SOR, block Gauss-Seidel and Southwell: relaxation of rows, or blocks of rows.

    row after row i:       l_i += omega (l_out_i - sum_(j<i) S_ij l_j^(k+1)
                                         - sum_(j>=i) S_ij l_j^(k)) / S_ii
    block after block B:   l_B += (S_BB)^-1 (l_out - S l)_B
    i = argmax |r_i|:      l_i += r_i / S_ii,   r -= S[:, i] r_i / S_ii

If S is self-adjoint, sweeps converge for every albedo (Saad, Iterative Methods for Sparse Linear
Systems, 2nd ed., theorem 4.10). The residual of an iterate comes with the next sweep: k iterations
take k + 1, each about one product. Southwell takes the largest residual first, as progressive
radiosity does (Cohen et al., SIGGRAPH 1988).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.operators.relaxation import DEFAULT_BLOCK_ROWS, Steps, Sweeps, relaxation
from ltcl.solvers.method import IterativeMethod
from ltcl.solvers.stopping import SLOTS, CountedOperator, Monitor

# Steps of an iteration of Southwell's, if `rows` is not given and there are that many pixels.
SOUTHWELL_STEPS = 64


@dataclass(frozen=True)
class BlockGaussSeidel(IterativeMethod):
    """Block Gauss-Seidel. Option: ``block``, rows of a block, which changes the iterates.

    Inverses of the blocks take 4 N block bytes. With blocks of one row it is Gauss-Seidel, with one
    block the direct solution.
    """

    name: ClassVar[str] = "block_gauss_seidel"
    block: int | None = DEFAULT_BLOCK_ROWS
    omega: ClassVar[float | None] = None

    def __post_init__(self) -> None:
        if self.block is not None or self.omega is None:
            checks.count("block", self.block)
        if self.omega is not None:
            checks.number("omega", self.omega, above=0.0, below=2.0)

    def iterate(self, system: CountedOperator, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it with an iterate."""
        plan = relaxation(system.S, self.name, self.block, self.omega)
        sweeps = Sweeps(plan, x, system.b, r)
        sweeps.sweep()
        system.products += 1
        _repeat(sweeps.sweep, system, sweeps.before, r, monitor)
        x.copy_from(sweeps.before)


@dataclass(frozen=True)
class GaussSeidel(BlockGaussSeidel):
    """Gauss-Seidel. Option: ``block``, rows of a block; it changes the speed, not the iterates."""

    name: ClassVar[str] = "gauss_seidel"
    block: int | None = None
    omega: ClassVar[float | None] = 1.0


@dataclass(frozen=True)
class SOR(GaussSeidel):
    """Successive overrelaxation, which is Gauss-Seidel for omega = 1.

    Options: ``omega`` in (0, 2), and ``block`` as of Gauss-Seidel.
    """

    name: ClassVar[str] = "sor"
    omega: float = 1.0  # pyright: ignore[reportIncompatibleVariableOverride]


@dataclass(frozen=True)
class Southwell(IterativeMethod):
    """Southwell's relaxation. Option: ``rows`` relaxed in one step, or a 64th of the picture.

    With ``rows=1`` it converges for every self-adjoint S. With more, as many equal pieces of the
    picture relax their largest residuals at once, which may diverge. An iteration relaxes N rows:
    one product.
    """

    name: ClassVar[str] = "southwell"
    rows: int | None = None

    def __post_init__(self) -> None:
        if self.rows is not None:
            checks.count("rows", self.rows)

    def iterate(self, system: CountedOperator, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends the solve."""
        n = x.shape[0]
        rows = self.rows
        if rows is None:
            rows = max(1, n // SOUTHWELL_STEPS)
        rows = min(rows, n)
        steps = Steps(system.S, self.name, x, r, rows)

        def relax_all() -> None:
            for _ in range(-(-n // rows)):
                steps.step()
            # r learns of the last picks.
            steps.step(picks=False)

        _repeat(relax_all, system, x, r, monitor)


def _repeat(
    iterate_once: Callable[[], None],
    system: CountedOperator,
    x: Array,
    r: Array,
    monitor: Monitor,
) -> None:
    """Queue iterations, which leave the residual of `x` in `r`, until the solve ends."""
    squares = x.device.empty((SLOTS, x.columns))
    while True:
        ahead = monitor.steps_ahead()
        for slot in range(ahead):
            iterate_once()
            vectors.queue_dot(r, r, squares, slot)
        system.products += ahead
        norms = np.sqrt(squares.get()[:ahead].astype(np.float64))
        if monitor.check(x, r, norms, travelled=np.inf):
            return


METHODS = (GaussSeidel, SOR, BlockGaussSeidel, Southwell)
