# SPDX-License-Identifier: BSD-3-Clause
"""Krylov methods: CG, BiCGStab and GMRES, with coefficients of their own for each right-hand side.

The kernels leave partial sums of each column in a few slices of the rows; a group of the next
kernel adds them up and computes the coefficients of its columns: CG and BiCGStab queue several
steps between readings.

Numbers in comments: Saad, Iterative Methods for Sparse Linear Systems, 2nd ed.; of BiCGStab
algorithm 7.7, of GMRES 6.2 in blocks, 6.9 and 6.11, section 6.5.3 of the rotations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.device.kernels import Launch
from ltcl.errors import InputError, MemoryLimitError
from ltcl.operators import Operator
from ltcl.solvers.result import Status
from ltcl.solvers.stopping import SLOTS, Monitor, System

STATE = (
    16  # rows of numbers that a method leaves in its state; residuals of SLOTS steps follow them
)
_VALUES = 32  # an item should have, before there are more groups
_SLICES = 256  # at most, as many as groups
_PAIRS = 0b0001_0000  # <r, r> and <w, r>, of arrays r, w; the left operand in the lower bits
_TWO = 0b0101_0001  # <a, b> and <b, b>, of arrays a, b
_FIVE = (
    0b0101_0010_0110_0000_0100  # <t, s>, <t, t>, <r*, s>, <r*, t> and <s, s>, of arrays t, s, r*
)
_STEP, _ANEW, _COUNT = 3, 4, 2  # arguments: of all updates, of krylov_cg, of krylov_subtract
_INDEFINITE = 2, 6  # rows of the state of CG, of even and of odd steps
_RHO, _PHASE, _SHADOW, _AGAINST = (
    (0, 4),
    (1, 5),
    9,
    10,
)  # of that of BiCGStab; two of even and of odd steps
_FRESH, _WAITS, _BROKEN, _RESTS = 1.0, 2.0, 3.0, 4.0  # phases
_FALL = (
    2.0**-20
)  # of the first residual: below, a float32 cycle has to start again from the true one
_SINGULAR = (
    2.0**-20
)  # of its length: what the rotations left of a column, and of H, is rounding of products


def ratio(numerator: np.ndarray, denominator: np.ndarray, where: np.ndarray) -> np.ndarray:
    """numerator / denominator in the columns `where` a step is taken, 0 in those that rest.

    A denominator beyond float32 gives NaN, not a step of 0 that would be repeated for ever.
    """
    with np.errstate(
        divide="ignore", invalid="ignore", over="ignore"
    ):  # the monitor sees what comes of it
        return np.where(
            where, numerator / np.where(np.isfinite(denominator), denominator, np.nan), 0.0
        )


class Columns:
    """How kernels of files that include `common/columns.h` run on arrays like `x`, (N,) or (N, k)."""

    def __init__(self, x: Array, *kernels: str) -> None:
        self.device, self.k, self.rows = x.device, x.columns, x.shape[0]
        on_cpu = self.device.is_cpu
        self._kernels = {name: vectors.kernel_of(self.device, name) for name in kernels}
        items = (16 if self.k <= 16 else 64) if on_cpu else 256
        self.group = min(kernel.group(items) for kernel in self._kernels.values())
        most = 4 * self.device.compute_units if on_cpu else _SLICES
        self.slices = max(1, min(-(-x.size // (_VALUES * self.group)), most, _SLICES))

    def bind(
        self, name: str, *arguments: object, extra: int = 0, across: int = 1, rows: int = 0
    ) -> Launch:
        """Kernel `name` on `rows` rows, `across` times, with local memory for `extra` reals a column."""
        scratch = self.device.local(self.group + extra * min(self.k, self.group))
        sizes = rows or self.rows, self.k
        return self._kernels[name].bind(
            self.items(across), (self.group, 1, 1), *sizes, *arguments, scratch
        )

    def items(self, across: int) -> tuple[int, int, int]:
        """Work-items of a launch, `across` times."""
        return self.slices * self.group, across, -(-self.k // self.group)

    def sums(self, count: int) -> Array:
        """Room for `count` partial sums of each column."""
        return self.device.empty((self.slices * count, self.k))

    def state(self) -> Array:
        """`STATE` rows of numbers, all 0, and room for the squares of the residuals of `SLOTS` steps."""
        return vectors.fill(self.device.empty((STATE + SLOTS * self.slices, self.k)), 0.0)

    def run(
        self,
        queued: Sequence[Callable[[], object]],
        updates: Sequence[Launch],
        steps: range,
        state: Array,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Queue these steps; then the numbers of the state (STATE, k), and residual norms (steps, k)."""
        for step in steps:
            for update in updates:
                update.set(_STEP, step)
            for launch in queued:
                launch()
        numbers = state.get().astype(np.float64)
        squares = numbers[STATE:].reshape(SLOTS, self.slices, self.k)[np.asarray(steps) % SLOTS]
        return numbers[:STATE], np.sqrt(squares.sum(axis=1))


@dataclass(frozen=True)
class CG:
    """Conjugate gradients, the fewest products where S is self-adjoint. Options: ``weights``, of <x, y>.

    Of a Lambertian scene S is self-adjoint in <x, y> = sum_i w_i x_i y_i with w = area / albedo, by
    reciprocity: with pixels of equal area w = 1 / F, the default where S = T F^-1 comes from a
    transport.

    Recurrences of Chronopoulos and Gear (J. Comput. Appl. Math. 25, 1989, section 3): one update a
    step.
    """

    name: ClassVar[str] = "cg"
    weights: Any = None

    def __post_init__(self) -> None:
        weights = 1.0 if self.weights is None else checks.real("weights", self.weights)
        if few := np.count_nonzero(~(checks.finite("weights", np.asarray(weights)) > 0)):
            raise InputError(f"weights has {few} value(s) that are not positive; all must be")

    def inner(self, S: Operator) -> Any:
        """The weights of the inner product that a solve with S has, (N,), or None of the plain one."""
        return S.weights if self.weights is None else self.weights

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        weights, inner = r, self.inner(system.S)  # r is not read
        if inner is not None:  # of all values, in units of the largest one
            inner = checks.shape("weights", np.asarray(inner, np.float64), system.b.shape[:1])
            inner = (inner / inner.max()).reshape(-1, *[1] * (len(r.shape) - 1))
            weights = r.device.upload(np.broadcast_to(inner, r.shape))
        columns = Columns(r, "vector_dots", "krylov_cg")
        w, p, q = r.like(), vectors.fill(r.like(), 0.0), vectors.fill(r.like(), 0.0)
        state, sums, unsolved = columns.state(), columns.sums(2), monitor.unsolved
        rest = r.device.upload(~unsolved, np.int32)
        dots = columns.bind(
            "vector_dots", 0, _PAIRS, int(weights is not r), weights, r, w, w, sums, across=2
        )
        moves = (columns.slices, 0, 1, rest, sums, state, w, p, q, x, r)
        update = columns.bind("krylov_cg", *moves, extra=2)
        queued = [system.S.bind(r, w), dots, update, lambda: update.set(_ANEW, 0)]
        step = 0
        while True:
            steps = range(step, step + monitor.steps_ahead())
            numbers, norms = columns.run(queued, [update], steps, state)
            system.products += len(steps)
            step = steps.stop
            if monitor.check(x, r, norms, np.inf):
                return
            broken = numbers[_INDEFINITE[step % 2]] > 0.0
            if broken.any() and broken[monitor.unsolved].all():
                monitor.status = Status.INDEFINITE
                return
            update.set(
                _ANEW, int(not np.array_equal(monitor.norms, norms[-1]))
            )  # r is the true residual now
            if (monitor.unsolved != unsolved).any():
                unsolved = monitor.unsolved
                rest.set(~unsolved)


@dataclass(frozen=True)
class BiCGStab:
    """Any S, two products a step, eight vectors of memory however many steps it takes. No options.

    Where a step does not exist (a division by 0) a column starts anew, or rests where a fresh start
    has none either. A step is five launches: as <r*, S p> = <S^T r*, p>, the first coefficient is
    known before S p is. Where S has no transpose a sixth finds it.
    """

    name: ClassVar[str] = "bicgstab"

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        S, columns = system.S, Columns(r, "vector_dots", "krylov_half", "krylov_bicgstab")
        shadow, p, g, v, half, t = (r.like() for _ in range(6))
        state, two, five, slices = columns.state(), columns.sums(2), columns.sums(5), columns.slices
        of_g = columns.bind("vector_dots", 0, _TWO, 0, r, g, p, p, two, across=2)
        of_v = columns.bind("vector_dots", 0, _TWO, 0, r, shadow, v, v, two, across=2)
        of_t = columns.bind("vector_dots", 0, _FIVE, 0, r, t, half, shadow, five, across=5)
        to_half = columns.bind("krylov_half", slices, 0, two, state, r, v, half, extra=2)
        moves = (slices, 0, five, state, two, g, half, t, v, p, x, r)
        to_next = columns.bind("krylov_bicgstab", *moves, extra=5)
        queued = [S.bind(p, v), to_half, S.bind(half, t), of_t, to_next]  # 4. to 9.
        numbers, phase, step, transposes = (
            np.zeros((STATE, r.columns)),
            np.full(r.columns, _WAITS),
            0,
            True,
        )
        while True:
            anew = monitor.unsolved & ((phase == _WAITS) | (phase == _RESTS))
            changed, now = numbers.copy(), step % 2
            rests = ~monitor.unsolved & (phase != _BROKEN)
            changed[_PHASE[now]] = np.where(anew, _FRESH, np.where(rests, _RESTS, phase))
            if anew.any():
                for vector in (shadow, p):  # 1., 2.
                    vector.copy_from(
                        r.device.upload(np.where(anew, r.get(), vector.get())) if step else r
                    )
                for row in (_RHO[now], _SHADOW):
                    changed[row] = np.where(anew, monitor.norms**2, changed[row])
                changed[_AGAINST] = changed[_SHADOW]
                if transposes:
                    try:
                        S.apply_transpose(shadow, g)
                        system.products += 1
                        changed[_AGAINST] = vectors.dot(g, g)
                    except (InputError, MemoryLimitError):  # no transpose, or no memory for it
                        transposes = False
                        queued.insert(1, of_v)
            if not np.array_equal(changed, numbers):
                state.set_rows(0, r.device.upload(changed))
            if anew.any() and transposes:
                of_g()
            steps = range(step, step + monitor.steps_ahead())
            numbers, norms = columns.run(queued, [to_half, to_next], steps, state)
            system.products += 2 * len(steps)
            step = steps.stop
            phase = numbers[_PHASE[step % 2]]
            if monitor.check(x, r, norms, np.inf):
                return
            if (phase == _BROKEN).any() and (phase[monitor.unsolved] == _BROKEN).all():
                monitor.status = Status.NO_STEP
                return
            if not np.array_equal(
                monitor.norms, norms[-1]
            ):  # r is the true residual now, p is not of it
                phase = np.where(phase == _BROKEN, phase, _WAITS)


@dataclass(frozen=True)
class GMRES:
    """The least residual for any S, in m + 1 pictures of memory. Options: ``restart``, m, steps of a cycle.

    Step j makes 2 j + 1 inner products: where products are cheap Chebyshev takes less time. x is
    formed at the end of a cycle, with its residual V (beta e_1 - H y). Gram-Schmidt is done twice,
    which is enough for orthogonality to rounding (Giraud, Langou, Rozloznik, Comput. Math. Appl.
    50, 2005).
    """

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

    V is (steps + 1, N k) on the device, H (k, steps + 1, steps) float64; `residuals` (k,) are those
    of min ||beta e_1 - H y|| so far, beta being the norms of r; `complete` are the columns whose
    space holds all of S and no solution. Of `steps` that there is room for, perhaps fewer than
    asked for, `count` are made.
    """

    def __init__(self, S: Operator, r: Array, beta: np.ndarray, steps: int) -> None:
        device, self.count = r.device, -1
        self._columns = columns = Columns(r, "vector_dots", "krylov_subtract")
        room = (device.local_memory // 4 - columns.group) // min(columns.k, columns.group)
        self.steps = min(steps, room - 3)  # whose coefficients a work-group holds
        rows = self.steps + 1
        device.require(
            rows * r.nbytes, f"restart={steps}, {rows} directions of {r.size} values each,"
        )
        self.V, self.H = device.empty((rows, r.size)), np.zeros((r.columns, rows, rows - 1))
        self.residuals = self._beta = np.asarray(beta, np.float64)
        self.complete = np.zeros(r.columns, bool)
        self._is_step = np.zeros((r.columns, rows - 1), bool)
        self._q = np.ones((r.columns, 1))  # q^T H = 0, the last row of all Givens rotations
        v, w = r.like(), r.copy()
        sums, self._h = (
            columns.sums(rows + 1),
            [device.empty((rows + 1, columns.k)) for _ in range(2)],
        )
        self._product = S.bind(v, w)
        self._dots = columns.bind("vector_dots", 0, 0, 0, w, self.V, w, w, sums)
        passes = [(0, 0, sums, self._h[0], self._h[0], self.V, w, w)]
        passes.append((1, 1, sums, self._h[0], self._h[1], self.V, w, v))
        self._subtract = [
            columns.bind("krylov_subtract", 0, columns.slices, *arrays, extra=rows + 2)
            for arrays in passes
        ]
        self._orthogonalize()

    def extend(self, active: np.ndarray | bool = True) -> np.ndarray:
        """One step of the `active` columns, (k,) bool; where S v lies in the space but for rounding.

        There the next direction is 0. A column of H that is 0 once rotated leaves its problem as it
        was.
        """
        j = self.count
        self._product()  # 3.
        self._orthogonalize()
        h = np.where(active, self._h[1].get()[: j + 2].astype(np.float64), 0.0).T
        turned, below = np.einsum("kj,kj->k", self._q, h[:, :-1]), h[:, -1]
        length = np.hypot(turned, below)
        step = ~(
            length <= _SINGULAR * np.linalg.norm(h, axis=1)
        )  # NaN is a step; the residual will tell
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
        y = np.where(
            finite, np.linalg.pinv(np.where(finite, used, 0.0), rcond=_SINGULAR) @ right, np.nan
        )
        left = right - used @ y
        self.residuals = np.linalg.norm(left[..., 0], axis=1)
        self._add(x, y[..., 0])  # 12.
        self._add(r, (left - right)[..., 0])
        return np.linalg.norm(y[..., 0], axis=1)

    def ritz_values(self) -> np.ndarray:
        """Eigenvalues of the square parts of all H, complex: estimates of those of S."""
        values: list[np.ndarray] = [np.zeros(0)]
        for H in self.H:
            steps = int(
                np.argmin([*np.any(H[:, : self.count], axis=0), False])
            )  # before a column of 0
            if np.isfinite(H).all():
                values.append(np.linalg.eigvals(H[:steps, :steps]))
        return np.concatenate(values)

    def _add(self, x: Array, y: np.ndarray) -> None:
        """x = x + sum_j y_j v_j with y (k, j)."""
        count = y.shape[1]
        minus_y = x.device.upload(
            np.pad(-y.T, ((0, 1), (0, 0)))
        )  # as sums of one slice, <w, w> among them
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


METHODS = (CG, GMRES, BiCGStab)
