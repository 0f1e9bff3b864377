# SPDX-License-Identifier: BSD-3-Clause
"""Block Gauss-Seidel: the pixels of a block of rows are solved together, with the newest light of all others.

    l_B^(k+1) = l_B + (S_BB)^-1 (l_out - S l)_B,  block B after block

The inverses of the blocks are computed once, in float64, and kept with the matrix. This is another method
than `gauss_seidel`, whose blocks change its speed only: here a larger block brings more of S into the
inverse, and other iterates. With blocks of one row it is `gauss_seidel`, with one block the direct solution.
No part of a sweep is sequential. It converges for every albedo where S is self-adjoint (Saad, Iterative
Methods for Sparse Linear Systems, 2nd ed., section 4.1.1 and theorem 4.10).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ltcl import checks
from ltcl.device import Array
from ltcl.operators.blocks import INVERTED
from ltcl.operators.relaxation import block_relaxation
from ltcl.solvers.gauss_seidel import sweeps
from ltcl.solvers.stopping import Monitor, System


@dataclass(frozen=True)
class BlockGaussSeidel:
    """Options: ``block``, rows of a block, which changes the iterates; inverses take 8 N block bytes."""

    name: ClassVar[str] = "block_gauss_seidel"
    block: int = INVERTED

    def __post_init__(self) -> None:
        checks.count("block", self.block)

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        if not monitor.done(x, r):
            sweeps(system, x, r, monitor, block_relaxation(system.S, self.name, self.block))
