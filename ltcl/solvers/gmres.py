# SPDX-License-Identifier: BSD-3-Clause
"""GMRES with restarts: the smallest residual that so many products can reach, of any S, symmetric or not.

Of all x in x_0 + span(r, S r, ..., S^(m-1) r) it takes the one with the smallest residual, which can then
never grow. It needs no bounds, but memory for m + 1 directions and, at step j, 2 j + 1 inner products, read
back in one go: where products are cheap Chebyshev takes less time, in a few products more.

Each right-hand side has a space of its own and rests once it is solved. The residual is known before the
iterate is, so that x is formed only at the end of a cycle; the true residual is computed there.

Numbers in comments: Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithms 6.9 and 6.11;
section 6.5.3 of the rotations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ltcl import checks
from ltcl.device import Array
from ltcl.solvers.arnoldi import Arnoldi
from ltcl.solvers.columns import ratio
from ltcl.solvers.result import Status
from ltcl.solvers.stopping import Monitor, System

_FALL = 2.0**-20  # of the first residual: below, a float32 cycle has to start again from the true one
_SINGULAR = 2.0**-20  # of its length: what the rotations left of a column is the rounding of products


@dataclass(frozen=True)
class GMRES:
    """Options: ``restart``, the most directions of one cycle; each takes the memory of a picture."""

    name: ClassVar[str] = "gmres"
    restart: int = 20

    def __post_init__(self) -> None:
        checks.count("restart", self.restart)

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        complete = np.zeros(r.columns, bool)
        while not monitor.check(x, r):
            if monitor.unsolved.any() and complete[monitor.unsolved].all():
                monitor.give_up(Status.BREAKDOWN)
                return
            complete, _ = cycle(system, x, r, monitor, self.restart)


class Hessenberg:
    """The small problems min ||beta e_1 - H y||, one for each right-hand side, on the host in float64.

    H (m + 1, m) is upper Hessenberg and grows by a column a step. The unit vector q with q^T H = 0, the last
    row of all Givens rotations so far, tells the norms of the residuals, |q_1| beta, before y is known.

    Attributes
    ----------
    residuals : (k,)
    """

    def __init__(self, beta: np.ndarray) -> None:
        self._beta = self.residuals = np.array(beta, np.float64)
        self._q = np.ones((len(beta), 1))
        self._columns: list[np.ndarray] = []  # of H
        self._steps: list[np.ndarray] = []  # (k,) bool

    def extend(self, h: np.ndarray) -> np.ndarray:
        """Append the columns h (k, j + 1); returns where they are a step, that is not 0 once rotated.

        A column that is 0 leaves its problem as it was: the right-hand side rests, or S is singular.
        """
        turned, below = np.einsum("kj,kj->k", self._q, h[:, :-1]), h[:, -1]
        length = np.hypot(turned, below)
        step = ~(length <= _SINGULAR * np.linalg.norm(h, axis=1))  # NaN is a step; the residual will tell
        s = np.where(step, ratio(below, length, step), 1.0)
        self._q = np.column_stack([s[:, None] * self._q, -ratio(turned, length, step)])
        self.residuals = self._beta * np.abs(self._q[:, 0])
        self._columns.append(h)
        self._steps.append(step)
        return step

    def solve(self) -> np.ndarray:
        """y (k, m), 0 in unknowns that were no step."""
        steps = np.stack(self._steps, axis=1)
        k, m = steps.shape
        H = np.zeros((k, 2 * m + 1, m))  # and a row for each unknown, which is its own where it was no step
        for j, h in enumerate(self._columns):
            H[:, : j + 2, j] = np.where(steps[:, j, None], h, 0.0)
            H[:, m + 1 + j, j] = ~steps[:, j]
        Q, triangle = np.linalg.qr(H)
        return np.linalg.solve(triangle, (self._beta[:, None] * Q[:, 0])[..., None])[..., 0]

    def ritz_values(self) -> np.ndarray:
        """Eigenvalues of the square parts of all H, complex: estimates of those of S."""
        found = []
        for c in range(len(self.residuals)):
            steps = next((j for j, h in enumerate(self._columns) if not h[c].any()), len(self._columns))
            H = np.zeros((steps, steps))
            for j in range(steps):
                H[: j + 2, j] = self._columns[j][c, : min(j + 2, steps)]
            found.append(np.linalg.eigvals(H) if np.isfinite(H).all() else np.zeros(0))
        return np.concatenate(found)


def cycle(system: System, x: Array, r: Array, monitor: Monitor, steps: int) -> tuple[np.ndarray, Hessenberg]:
    """Improve `x` and its residual `r`, whose `norms` the monitor holds, by up to so many steps.

    Returns the columns (k,) whose space holds all of S and no solution, and what was learnt of S.
    """
    beta, step = monitor.norms, monitor.unsolved
    complete = np.zeros_like(step)
    steps = max(1, min(steps, r.shape[0], monitor.rule.maxiter - monitor.iterations))
    space, problem = Arnoldi(system.S, r, steps), Hessenberg(beta)  # 1.
    for j in range(space.steps):  # 2.
        h = np.where(step[:, None], space.extend(), 0.0)  # 3. to 10.
        problem.extend(h)
        above = monitor.above(problem.residuals)
        complete |= step & above & (h[:, -1] == 0.0)
        step = step & ~complete & above & ~(problem.residuals <= _FALL * beta)
        if j + 1 == space.steps or not step.any() or monitor.due(problem.residuals):
            break
    system.products += space.count
    space.add_to(x, problem.solve())  # 12.
    system.residual(x, r)
    return complete, problem
