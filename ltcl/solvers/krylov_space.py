# SPDX-License-Identifier: BSD-3-Clause
"""Arnoldi's process for (N, k) right-hand sides, column by column.

Numbers in comments: Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithm 6.2 in
blocks and 6.9, section 6.5.3 for the rotations. Gram-Schmidt is done twice, which is enough for
orthogonality to rounding (Giraud, Langou, Rozloznik, Comput. Math. Appl. 50, 2005).
"""

from __future__ import annotations

import math

import numpy as np

from ltcl.operators import Operator
from ltcl.operators.shared_vector import Vector
from ltcl.solvers.column_reductions import column_reductions, safe_ratio
from ltcl.solvers.stopping import CountedOperator, Monitor

# A cycle in float32 has to start again from the true residual below this part of the first one.
CYCLE_REDUCTION = 2.0**-20

# What the rotations leave of a column of H, or of H, is rounding of products below this part of it.
SINGULAR = 2.0**-20


class KrylovSpace:
    """An orthonormal basis v_0, v_1, ... of the Krylov space of S and r (N, k), with S V = V H.

    Attributes
    ----------
    V : (steps + 1, N k), on the device
        If r is a shared vector, each device has its rows.
    H : (k, steps + 1, steps) float64
        Hessenberg matrix of each column.
    steps, count : int
        Steps that there is room for, perhaps fewer than asked for, and those that were taken.
    residuals : (k,) float64
        Residuals of min ||beta e_1 - H y|| so far, where beta are the norms of r.
    complete : (k,) bool
        Columns whose space is invariant under S and contains no solution.
    """

    def __init__(self, S: Operator, r: Vector, beta: np.ndarray, steps: int) -> None:
        columns = column_reductions(r, "vector_dots", "krylov_subtract")
        self._columns = columns
        # A work-group holds the coefficients of its columns.
        self.steps = min(steps, columns.max_totals - 3)
        self.count = -1
        rows = self.steps + 1
        size = math.prod(r.shape)
        self.V = columns.directions(
            rows, f"restart={steps}, {rows} directions of {size} values each,"
        )
        self.H = np.zeros((r.columns, rows, rows - 1))
        self.complete = np.zeros(r.columns, bool)
        self._beta = np.asarray(beta, np.float64)
        self.residuals = self._beta
        # Columns of H that are not 0 after the rotations.
        self._is_step = np.zeros((r.columns, rows - 1), bool)
        # The last row q of all Givens rotations, q^T H = 0.
        self._q = np.ones((r.columns, 1))
        self._bind(S, r, rows)
        self._orthogonalize()

    def _bind(self, S: Operator, r: Vector, rows: int) -> None:
        """Bind the product, the inner products and the two passes of Gram-Schmidt."""
        columns = self._columns
        v = r.like()
        w = r.copy()
        sums = columns.sums(rows + 1)
        self._first_h = columns.numbers(rows + 1)
        self._h = columns.numbers(rows + 1)
        self._product = columns.bind_product(S, v, w)
        # <v_j, w> of all directions, and <w, w>.
        self._dots = columns.bind(
            "vector_dots",
            first=0,
            pairs=0,
            weighted=0,
            weights=w,
            a=self.V,
            b=w,
            c=w,
            partials=sums,
        )
        shared = {
            "extra": rows + 2,
            "count": 0,
            "slices": columns.slices,
            "partials": sums,
            "first_pass": self._first_h,
            "V": self.V,
            "w": w,
        }
        first_pass = columns.bind(
            "krylov_subtract", second_pass=0, unit_length=0, h=self._first_h, out=w, **shared
        )
        second_pass = columns.bind(
            "krylov_subtract", second_pass=1, unit_length=1, h=self._h, out=v, **shared
        )
        self._passes = [first_pass, second_pass]

    def extend(self, active: np.ndarray | bool = True) -> np.ndarray:
        """Take one step of the `active` columns, (k,) bool; return those whose space is invariant.

        There S v lies in the space but for rounding, and the next direction is 0. A column of H
        that is 0 after the rotations leaves its least squares problem as it was.
        """
        j = self.count
        self._product()  # 3.
        self._orthogonalize()
        coefficients = self._h.get()[: j + 2].astype(np.float64)
        h = np.where(active, coefficients, 0.0).T
        below = h[:, -1]

        # The next rotation (section 6.5.3): of the rotated column, its last two entries.
        rotated = np.einsum("kj,kj->k", self._q, h[:, :-1])
        length = np.hypot(rotated, below)
        # NaN counts as a step: the residual will show it.
        is_step = ~(length <= SINGULAR * np.linalg.norm(h, axis=1))
        sine = np.where(is_step, safe_ratio(below, length, is_step), 1.0)
        cosine = safe_ratio(rotated, length, is_step)
        self._q = np.column_stack([sine[:, None] * self._q, -cosine])
        self.residuals = self._beta * np.abs(self._q[:, 0])
        self.H[:, : j + 2, j] = h
        self._is_step[:, j] = is_step
        return active & (below == 0.0)

    def improve(self, x: Vector, r: Vector) -> np.ndarray:
        """Move x to the least residual in the space, and r with it; return how far, (k,)."""
        steps = self.count
        H = self.H[:, : steps + 1, :steps]
        used = H * self._is_step[:, None, :steps]
        is_finite = np.all(np.isfinite(H), axis=(1, 2), keepdims=True)
        e_1 = np.eye(steps + 1, 1)
        right = self._beta[:, None, None] * e_1

        inverse = np.linalg.pinv(np.where(is_finite, used, 0.0), rcond=SINGULAR)
        y = np.where(is_finite, inverse @ right, np.nan)
        residual = right - used @ y
        self.residuals = np.linalg.norm(residual[..., 0], axis=1)
        self._add_combination(x, y[..., 0])  # 12.
        self._add_combination(r, (residual - right)[..., 0])
        return np.linalg.norm(y[..., 0], axis=1)

    def ritz_values(self) -> np.ndarray:
        """Return the eigenvalues of the square parts of all H, complex: estimates of those of S."""
        values: list[np.ndarray] = [np.zeros(0)]
        for H in self.H:
            if not np.isfinite(H).all():
                continue
            # The steps before the first column of zeros.
            is_nonzero = np.append(np.any(H[:, : self.count], axis=0), False)
            steps = int(np.argmin(is_nonzero))
            values.append(np.linalg.eigvals(H[:steps, :steps]))
        return np.concatenate(values)

    def _add_combination(self, x: Vector, y: np.ndarray) -> None:
        """Add sum_j y_j v_j to x, with y (k, j)."""
        count = y.shape[1]
        # The kernel subtracts what sums of one slice say; the last of these is <w, w>, not used.
        minus_y = self._columns.upload(np.pad(-y.T, ((0, 1), (0, 0))))
        subtract = self._columns.bind(
            "krylov_subtract",
            extra=count + 2,
            count=count,
            slices=1,
            second_pass=0,
            unit_length=0,
            partials=minus_y,
            first_pass=self._first_h,
            h=self._h,
            V=self.V,
            w=x,
            out=x,
        )
        subtract()

    def _orthogonalize(self) -> None:
        """Make the next direction of the last product."""
        self.count += 1
        self._columns.resize(self._dots, self.count + 1)
        # The first direction is r itself, and has nothing to be orthogonal to.
        passes = self._passes if self.count else self._passes[1:]
        for subtract in passes:
            self._dots()  # 4.
            subtract.set(count=self.count)
            subtract()  # 5. to 8.


def krylov_cycle(
    system: CountedOperator, x: Vector, r: Vector, monitor: Monitor, steps: int
) -> KrylovSpace:
    """Improve `x` and its residual `r`, whose norms the monitor knows, by a few steps of GMRES."""
    beta = monitor.norms
    active = monitor.unsolved
    remaining = monitor.rule.maxiter - monitor.iterations
    steps = max(1, min(steps, r.shape[0], remaining))
    space = KrylovSpace(system.S, r, beta, steps)  # 1.
    while True:
        is_invariant = space.extend(active)
        above = monitor.above(space.residuals)
        space.complete |= is_invariant & above
        has_fallen = space.residuals <= CYCLE_REDUCTION * beta
        active = active & ~space.complete & above & ~has_fallen
        if space.count == space.steps or not active.any():
            break
        if monitor.needs_iterate(space.residuals):
            break
    system.products += space.count
    travelled = space.improve(x, r)
    if np.all(CYCLE_REDUCTION * travelled <= beta):
        monitor.check(x, r, space.residuals[None], travelled)
    else:
        # S is so nearly singular, or so small, that float32 may have lost r on the way.
        monitor.check(x, r, system.residual(x, r)[None])
    return space
