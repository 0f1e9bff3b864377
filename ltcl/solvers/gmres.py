# SPDX-License-Identifier: BSD-3-Clause
"""GMRES with restarts: the smallest residual that so many products can reach, of any S, symmetric or not.

Of all x in x_0 + span(r, S r, ..., S^(m-1) r) it takes the one with the smallest residual, which can then
never grow. It needs no bounds, but memory for m + 1 directions and, at step j, 2 j + 1 inner products, read
back in one go: where products are cheap Chebyshev takes less time, in a few products more.

Each right-hand side has a space of its own and rests once it is solved. Norms of residuals are known before
x is, which is formed only at the end of a cycle, and with it its residual V (beta e_1 - H y).

Numbers in comments: Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithms 6.2 in blocks, 6.9
and 6.11; section 6.5.3 of the rotations. Gram-Schmidt is done twice, which is enough for orthogonality to
rounding (Giraud, Langou, Rozloznik, Comput. Math. Appl. 50, 2005).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ltcl import checks
from ltcl.device import Array
from ltcl.operators import Operator
from ltcl.solvers.columns import Columns, ratio
from ltcl.solvers.result import Status
from ltcl.solvers.stopping import Monitor, System

_COUNT = 2  # argument of krylov_subtract
_FALL = 2.0**-20  # of the first residual: below, a float32 cycle has to start again from the true one
_SINGULAR = 2.0**-20  # of its length: what the rotations left of a column, and of H, is rounding of products


@dataclass(frozen=True)
class GMRES:
    """Options: ``restart``, the most directions of one cycle; each takes the memory of a picture."""

    name: ClassVar[str] = "gmres"
    restart: int = 20

    def __post_init__(self) -> None:
        checks.count("restart", self.restart)

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        while monitor.status is None:
            complete = cycle(system, x, r, monitor, self.restart).complete
            unsolved = monitor.unsolved
            if monitor.status is None and unsolved.any() and complete[unsolved].all():
                monitor.status = Status.BREAKDOWN


class KrylovSpace:
    """An orthonormal basis v_0, v_1, ... of what products with S reach from r (N, k), S V = V H, by columns.

    V is (steps + 1, N k) on the device, H (k, steps + 1, steps) float64; `residuals` (k,) are those of min
    ||beta e_1 - H y|| so far, beta being the norms of r; `complete` are the columns whose space holds all of
    S and no solution. Of `steps` that there is room for, perhaps fewer than asked for, `count` are made.
    """

    def __init__(self, S: Operator, r: Array, beta: np.ndarray, steps: int) -> None:
        device, self.count = r.device, -1
        self._columns = columns = Columns(r, "krylov", "krylov_pairs", "krylov_subtract")
        self.steps = min(steps, columns.room - 3)  # whose coefficients a work-group holds
        rows = self.steps + 1
        device.require(rows * r.nbytes, f"restart={steps}, {rows} directions of {r.size} values each,")
        self.V, self.H = device.empty((rows, r.size)), np.zeros((r.columns, rows, rows - 1))
        self.residuals = self._beta = np.asarray(beta, np.float64)
        self.complete = np.zeros(r.columns, bool)
        self._is_step = np.zeros((r.columns, rows - 1), bool)
        self._q = np.ones((r.columns, 1))  # q^T H = 0, the last row of all Givens rotations
        v, w = r.like(), r.copy()
        sums, self._h = columns.sums(rows + 1), [device.empty((rows + 1, columns.k)) for _ in range(2)]
        self._product = S.bind(v, w)
        self._dots = columns.bind("krylov_pairs", 0, 0, w, self.V, w, w, sums)
        self._subtract = [
            columns.bind(
                *("krylov_subtract", 0, columns.slices, again, again, sums, self._h[0], h, self.V, w, out),
                extra=rows + 2,
            )
            for again, h, out in ((0, self._h[0], w), (1, self._h[1], v))
        ]
        self._orthogonalize()

    def extend(self, active: np.ndarray | bool = True) -> np.ndarray:
        """One step of the `active` columns, (k,) bool; where S v lies in the space but for rounding.

        There the next direction is 0. A column of H that is 0 once rotated leaves its problem as it was.
        """
        j = self.count
        self._product()  # 3.
        self._orthogonalize()
        h = np.where(active, self._h[1].get()[: j + 2].astype(np.float64), 0.0).T
        turned, below = np.einsum("kj,kj->k", self._q, h[:, :-1]), h[:, -1]
        length = np.hypot(turned, below)
        step = ~(length <= _SINGULAR * np.linalg.norm(h, axis=1))  # NaN is a step; the residual will tell
        s = np.where(step, ratio(below, length, step), 1.0)
        self._q = np.column_stack([s[:, None] * self._q, -ratio(turned, length, step)])
        self.residuals = self._beta * np.abs(self._q[:, 0])
        self.H[:, : j + 2, j], self._is_step[:, j] = h, step
        return active & (below == 0.0)

    def improve(self, x: Array, r: Array) -> np.ndarray:
        """Move x to the least residual in the space, and r with it; the lengths (k,) of the way."""
        H, e_1 = self.H[:, : self.count + 1, : self.count], np.eye(self.count + 1, 1)
        used = H * self._is_step[:, None, : self.count]
        finite = np.all(np.isfinite(H), axis=(1, 2), keepdims=True)
        right = self._beta[:, None, None] * e_1
        y = np.where(finite, np.linalg.pinv(np.where(finite, used, 0.0), rcond=_SINGULAR) @ right, np.nan)
        left = right - used @ y
        self.residuals = np.linalg.norm(left[..., 0], axis=1)
        self._add(x, y[..., 0])  # 12.
        self._add(r, (left - right)[..., 0])
        return np.linalg.norm(y[..., 0], axis=1)

    def ritz_values(self) -> np.ndarray:
        """Eigenvalues of the square parts of all H, complex: estimates of those of S."""
        values: list[np.ndarray] = [np.zeros(0)]
        for H in self.H:
            steps = int(np.argmin([*np.any(H[:, : self.count], axis=0), False]))  # before a column of 0
            if np.isfinite(H).all():
                values.append(np.linalg.eigvals(H[:steps, :steps]))
        return np.concatenate(values)

    def _add(self, x: Array, y: np.ndarray) -> None:
        """x = x + sum_j y_j v_j with y (k, j)."""
        count = y.shape[1]
        minus_y = x.device.upload(np.pad(-y.T, ((0, 1), (0, 0))))  # as sums of one slice, <w, w> among them
        arguments = (count, 1, 0, 0, minus_y, *self._h, self.V, x, x)
        self._columns.bind("krylov_subtract", *arguments, extra=count + 2)()

    def _orthogonalize(self) -> None:
        """What a product left becomes the next direction."""
        self.count += 1
        self._dots.resize(self._columns.items(self.count + 1))
        for subtract in self._subtract[0 if self.count else 1 :]:
            self._dots()  # 4.
            subtract.set(_COUNT, self.count)
            subtract()  # 5. to 8.


def cycle(system: System, x: Array, r: Array, monitor: Monitor, steps: int) -> KrylovSpace:
    """Improve `x` and its residual `r`, whose `norms` the monitor holds, by up to so many steps."""
    beta, active = monitor.norms, monitor.unsolved
    steps = max(1, min(steps, r.shape[0], monitor.rule.maxiter - monitor.iterations))
    space = KrylovSpace(system.S, r, beta, steps)  # 1.
    while True:
        ended = space.extend(active)
        above = monitor.above(space.residuals)
        space.complete |= ended & above
        active = active & ~space.complete & above & ~(space.residuals <= _FALL * beta)
        if space.count == space.steps or not active.any() or monitor.due(space.residuals):
            break
    system.products += space.count
    travelled = space.improve(x, r)
    if np.all(_FALL * travelled <= beta):
        monitor.check(x, r, space.residuals[None], travelled)
    else:  # S is so nearly singular, or so small, that float32 may have lost r on the way
        monitor.check(x, r, system.residual(x, r)[None])
    return space
