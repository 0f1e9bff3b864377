# SPDX-License-Identifier: BSD-3-Clause
"""GMRES with restarts: the smallest residual that so many products can reach, of any S, symmetric or not.

Of all x in x_0 + span(r, S r, ..., S^(m-1) r) it takes the one with the smallest residual, which can then
never grow. It needs no bounds, but memory for m + 1 directions and, at step j, 2 j + 1 inner products, read
back in two goes: where products are cheap Chebyshev takes less time, in a few products more.

Each right-hand side has a space of its own and rests once it is solved. The residual is known before the
iterate is, so that x is formed only at the end of a cycle; the true residual is computed there.

Numbers in comments: Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithms 6.9 and 6.11.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.solvers import arnoldi
from ltcl.solvers.columns import ratio
from ltcl.solvers.hessenberg import Hessenberg
from ltcl.solvers.result import Status
from ltcl.solvers.stopping import Monitor, System

_FALL = 2.0**-20  # of the first residual: below, a float32 cycle has to start again from the true one


@dataclass(frozen=True)
class GMRES:
    """Options: ``restart``, the directions of one cycle; each takes the memory of a picture."""

    name: ClassVar[str] = "gmres"
    restart: int = 20

    def __post_init__(self) -> None:
        checks.count("restart", self.restart)

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        stuck = np.zeros(r.columns, bool)
        while not monitor.done(x, r):
            if monitor.unsolved.any() and stuck[monitor.unsolved].all():
                monitor.give_up(Status.BREAKDOWN)
                return
            stuck, _ = cycle(system, x, r, monitor, self.restart)


def cycle(system: System, x: Array, r: Array, monitor: Monitor, steps: int) -> tuple[np.ndarray, Hessenberg]:
    """Improve `x` and its residual `r`, whose `norms` the monitor holds, by up to so many steps.

    Returns the columns (k,) whose space holds all of S and no solution, and what was learnt of S.
    """
    beta, step = monitor.norms, monitor.unsolved
    basis = [vectors.axpby_columns(ratio(np.ones_like(beta), beta, step), r, 0.0, r, r.like())]  # 1.
    problem = Hessenberg(beta, steps)
    stuck = np.zeros_like(step)
    for j in range(steps):  # 2.
        w = system.apply(basis[j], r.like())  # 3.
        h = arnoldi.extend(basis, w, step)  # 4. to 10.
        problem.extend(h)
        above = monitor.above(problem.residuals)
        stuck |= step & above & (h[:, -1] == 0.0)
        step = step & ~stuck & above & ~(problem.residuals <= _FALL * beta)
        if j + 1 == steps or not step.any() or monitor.due(problem.residuals):
            break
    for y, v in zip(problem.solve().T, basis, strict=False):  # 12.; the newest direction has no y
        vectors.axpby_columns(y, v, 1.0, x, x)
    system.residual(x, r)
    return stuck, problem
