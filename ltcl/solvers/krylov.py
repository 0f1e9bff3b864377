# SPDX-License-Identifier: BSD-3-Clause
"""Krylov methods with coefficients of their own for each right-hand side: CG, BiCGStab and GMRES.

Numbers in comments: Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithm 7.7 for
BiCGStab, 6.11 for restarted GMRES. Coefficients of CG and BiCGStab stay on the device
(`column_reductions`), so that several steps are queued between two readings.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.errors import InputError, MemoryLimitError
from ltcl.operators import Operator
from ltcl.operators.shared_vector import Vector, share_vectors
from ltcl.solvers import krylov_state
from ltcl.solvers.column_reductions import column_reductions
from ltcl.solvers.krylov_space import krylov_cycle
from ltcl.solvers.krylov_state import (
    PHASE_BROKEN,
    PHASE_FRESH,
    PHASE_RESTS,
    PHASE_WAITS,
    row_in_copy,
)
from ltcl.solvers.method import IterativeMethod
from ltcl.solvers.result import Status
from ltcl.solvers.stopping import CountedOperator, Monitor


@dataclass(frozen=True)
class CG(IterativeMethod):
    """Conjugate gradients, the fewest products for a self-adjoint S. Option: ``weights`` of <x, y>.

    S of a Lambertian scene is self-adjoint in <x, y> = sum_i w_i x_i y_i with w = area / albedo, by
    reciprocity: with pixels of equal area w = 1 / F, the default if S = T F^-1 comes from a
    transport.

    Recurrences of Chronopoulos and Gear (J. Comput. Appl. Math. 25, 1989, section 3): one update a
    step.
    """

    name: ClassVar[str] = "cg"
    weights: Any = None

    def __post_init__(self) -> None:
        if self.weights is None:
            return
        weights = checks.finite("weights", checks.real("weights", self.weights))
        wrong = np.count_nonzero(~(weights > 0))
        if wrong:
            raise InputError(f"weights has {wrong} value(s) that are not positive; all must be")

    def needs_pixels(self, S: Operator) -> bool:
        """Return whether weights are given, which are diagonal in pixels alone."""
        return self.inner_weights(S) is not None

    def inner_weights(self, S: Operator) -> Any:
        """Return the weights of the inner product for S, (N,); None for the plain one."""
        return S.weights if self.weights is None else self.weights

    def iterate(self, system: CountedOperator, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends the solve."""
        with share_vectors(system.S, x, r) as (x, r):
            iteration = _CGIteration(system, x, r, monitor, self.inner_weights(system.S))
            iteration.run()


class _CGIteration:
    """The state of one solve with CG: w = S r, directions p, q = S p."""

    def __init__(
        self, system: CountedOperator, x: Vector, r: Vector, monitor: Monitor, weights: Any
    ) -> None:
        self.system = system
        self.monitor = monitor
        self.x = x
        self.r = r
        columns = column_reductions(r, "vector_dots", "krylov_cg")
        self.columns = columns
        w = r.like()
        p = columns.zeros(r)
        q = columns.zeros(r)
        self.state = columns.state()
        sums = columns.sums(2)
        self.unsolved = monitor.unsolved
        # Columns that rest, since they are solved.
        self.resting = columns.upload(~self.unsolved, np.int32)

        # Without weights the kernel does not read them.
        on_device = r
        if weights is not None:
            on_device = self._upload_weights(weights)
        # <r, r> and <w, r>.
        dots = columns.bind(
            "vector_dots",
            across=2,
            first=0,
            pairs=vectors.dot_pairs("aa", "ba"),
            weighted=int(weights is not None),
            weights=on_device,
            a=r,
            b=w,
            c=w,
            partials=sums,
        )
        self.update = columns.bind(
            "krylov_cg",
            extra=2,
            slices=columns.slices,
            iteration=0,
            restart=1,
            resting=self.resting,
            partials=sums,
            state=self.state,
            w=w,
            p=p,
            q=q,
            x=x,
            r=r,
        )
        # Not a method of this object: device memory is freed by reference counting alone.
        keep_direction = functools.partial(self.update.set, restart=0)
        self.launches = [columns.bind_product(system.S, r, w), dots, self.update, keep_direction]

    def _upload_weights(self, weights: Any) -> Vector:
        """Upload the weights in units of the largest one, repeated for all columns."""
        r = self.r
        weights = np.asarray(weights, np.float64)
        weights = checks.shape("weights", weights, self.system.b.shape[:1])
        shape = (-1, *[1] * (len(r.shape) - 1))
        relative = (weights / weights.max()).reshape(shape)
        return r.like().set(np.broadcast_to(relative, r.shape))

    def run(self) -> None:
        """Take steps until the monitor ends the solve, or no column has a next step."""
        monitor = self.monitor
        step = 0
        while True:
            steps = range(step, step + monitor.steps_ahead())
            readings = self.columns.run(self.launches, [self.update], steps, self.state)
            self.system.products += len(steps)
            step = steps.stop
            if monitor.check(self.x, self.r, readings.norms, np.inf):
                return
            indefinite_row = row_in_copy(krylov_state.CG_INDEFINITE, step)
            is_indefinite = readings.state[indefinite_row] > 0.0
            if is_indefinite.any() and is_indefinite[monitor.unsolved].all():
                monitor.status = Status.INDEFINITE
                return
            # The monitor may have recomputed r, to which the last direction does not belong.
            was_recomputed = not np.array_equal(monitor.norms, readings.norms[-1])
            self.update.set(restart=int(was_recomputed))
            if (monitor.unsolved != self.unsolved).any():
                self.unsolved = monitor.unsolved
                self.resting.set(~self.unsolved)


@dataclass(frozen=True)
class BiCGStab(IterativeMethod):
    """BiCGStab for any S: two products a step, eight vectors of memory. No options.

    Where a step does not exist (a division by 0) a column restarts, or rests if a restart has no
    step either. A step is five launches: as <r*, S p> = <S^T r*, p>, the first coefficient is known
    before S p is. If S has no transpose, a sixth launch finds it.
    """

    name: ClassVar[str] = "bicgstab"

    def iterate(self, system: CountedOperator, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends the solve."""
        with share_vectors(system.S, x, r) as (x, r):
            iteration = _BiCGStabIteration(system, x, r, monitor)
            iteration.run()


class _BiCGStabIteration:
    """The state of one solve with BiCGStab; in Saad's names shadow is r*, half is s; g = S^T r*."""

    def __init__(self, system: CountedOperator, x: Vector, r: Vector, monitor: Monitor) -> None:
        self.system = system
        self.monitor = monitor
        self.x = x
        self.r = r
        S = system.S
        columns = column_reductions(r, "vector_dots", "krylov_half", "krylov_bicgstab")
        self.columns = columns
        self.shadow = r.like()
        self.p = r.like()
        self.g = r.like()
        v = r.like()
        half = r.like()
        t = r.like()
        self.state = columns.state()
        two_sums = columns.sums(2)
        five_sums = columns.sums(5)

        # <g, p> and <p, p>, or <r*, v> and <v, v> without a transpose.
        self.dots_of_g = self._bind_dots(two_sums, "ba bb", a=self.g, b=self.p, c=self.p)
        self.dots_of_v = self._bind_dots(two_sums, "ba bb", a=self.shadow, b=v, c=v)
        # <t, s>, <t, t>, <r*, s>, <r*, t> and <s, s>.
        dots_of_t = self._bind_dots(five_sums, "ab aa cb ca bb", a=t, b=half, c=self.shadow)
        shared = {"slices": columns.slices, "iteration": 0, "state": self.state, "r": r, "v": v}
        to_half = columns.bind("krylov_half", extra=2, partials=two_sums, half_way=half, **shared)
        to_next = columns.bind(
            "krylov_bicgstab",
            extra=5,
            first=0,
            partials=five_sums,
            next_partials=two_sums,
            g=self.g,
            half_way=half,
            t=t,
            p=self.p,
            x=x,
            **shared,
        )
        self.updates = [to_half, to_next]
        # 4. to 9.
        to_v = columns.bind_product(S, self.p, v)
        to_t = columns.bind_product(S, half, t)
        self.launches = [to_v, to_half, to_t, dots_of_t, to_next]

        self.numbers = np.zeros((krylov_state.STATE_ROWS, r.columns))
        self.phase = np.full(r.columns, PHASE_WAITS)
        self.step = 0
        self.has_transpose = True

    def _bind_dots(self, sums: Any, pairs: str, *, a: Vector, b: Vector, c: Vector) -> Any:
        """Bind inner products of pairs of the arrays, as "ab bb"."""
        names = pairs.split()
        return self.columns.bind(
            "vector_dots",
            across=len(names),
            first=0,
            pairs=vectors.dot_pairs(*names),
            weighted=0,
            # Not read.
            weights=a,
            a=a,
            b=b,
            c=c,
            partials=sums,
        )

    def run(self) -> None:
        """Take steps until the monitor ends the solve, or no column has a next step."""
        monitor = self.monitor
        while True:
            self._restart_columns()
            steps = range(self.step, self.step + monitor.steps_ahead())
            readings = self.columns.run(self.launches, self.updates, steps, self.state)
            self.system.products += 2 * len(steps)
            self.step = steps.stop
            self.numbers = readings.state
            self.phase = self.numbers[row_in_copy(krylov_state.BICGSTAB_PHASE, self.step)]
            if monitor.check(self.x, self.r, readings.norms, np.inf):
                return
            is_broken = self.phase == PHASE_BROKEN
            if is_broken.any() and is_broken[monitor.unsolved].all():
                monitor.status = Status.NO_STEP
                return
            if not np.array_equal(monitor.norms, readings.norms[-1]):
                # The monitor has recomputed r, to which p does not belong.
                self.phase = np.where(is_broken, self.phase, PHASE_WAITS)

    def _restart_columns(self) -> None:
        """Restart the columns that wait, and let those rest that are solved."""
        monitor = self.monitor
        phase_row = row_in_copy(krylov_state.BICGSTAB_PHASE, self.step)
        rho_row = row_in_copy(krylov_state.BICGSTAB_RHO, self.step)
        waits = (self.phase == PHASE_WAITS) | (self.phase == PHASE_RESTS)
        restarts = monitor.unsolved & waits
        rests = ~monitor.unsolved & (self.phase != PHASE_BROKEN)

        changed = self.numbers.copy()
        phase = np.where(rests, PHASE_RESTS, self.phase)
        changed[phase_row] = np.where(restarts, PHASE_FRESH, phase)
        if restarts.any():
            self._restart_vectors(restarts)
            squares = monitor.norms**2
            for row in (rho_row, krylov_state.BICGSTAB_SHADOW):
                changed[row] = np.where(restarts, squares, changed[row])
            changed[krylov_state.BICGSTAB_AGAINST] = changed[krylov_state.BICGSTAB_SHADOW]
            against = self._apply_transpose()
            if against is not None:
                changed[krylov_state.BICGSTAB_AGAINST] = against
        if not np.array_equal(changed, self.numbers):
            self.state.set_rows(0, self.columns.upload(changed))
        if restarts.any() and self.has_transpose:
            self.dots_of_g()

    def _restart_vectors(self, restarts: np.ndarray) -> None:
        """Set r* and p to r in the columns that restart."""
        # All are in the same shares.
        r: Any = self.r
        # 1. and 2.
        for vector in (self.shadow, self.p):
            if self.step == 0:
                vector.copy_from(r)
            else:
                vector.set(np.where(restarts, r.get(), vector.get()))

    def _apply_transpose(self) -> np.ndarray | None:
        """Compute g = S^T r*; return |g|^2 of each column.

        If S has no transpose, or no memory for it, queue <r*, v> instead from then on.
        """
        if not self.has_transpose:
            return None
        try:
            squares = self.columns.apply_transpose(self.system.S, self.shadow, self.g)
        except (InputError, MemoryLimitError):
            self.has_transpose = False
            self.launches.insert(1, self.dots_of_v)
            return None
        self.system.products += 1
        return squares


@dataclass(frozen=True)
class GMRES(IterativeMethod):
    """The least residual for any S, in m + 1 pictures of memory. Option: ``restart``, m.

    m is the number of steps of a cycle.

    Step j makes 2 j + 1 inner products: where products are cheap Chebyshev takes less time. x is
    formed at the end of a cycle, with its residual V (beta e_1 - H y).
    """

    name: ClassVar[str] = "gmres"
    restart: int = 20

    def __post_init__(self) -> None:
        checks.count("restart", self.restart)

    def iterate(self, system: CountedOperator, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends the solve."""
        with share_vectors(system.S, x, r) as (x, r):
            while monitor.status is None:
                space = krylov_cycle(system, x, r, monitor, self.restart)
                unsolved = monitor.unsolved
                if monitor.status is None and unsolved.any() and space.complete[unsolved].all():
                    monitor.status = Status.BREAKDOWN


METHODS = (CG, GMRES, BiCGStab)
