# SPDX-License-Identifier: BSD-3-Clause
"""One stopping rule for every method, and the system it is asked about.

``||b - S x|| <= max(rtol ||b||, atol)`` (eq. 2) for each column of b. CONVERGED is claimed only of a residual
within the tolerance with all that rounding may hide (`ltcl.solvers.precision`), computed anew where
needed.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.errors import InputError
from ltcl.operators import Operator
from ltcl.solvers import precision
from ltcl.solvers.result import Status

SLOTS = 8  # steps between two readings, at most

# Residuals of Chebyshev swing: what counts is the start and the largest of a long window, not the
# best.
GROWTH = (
    100.0  # times the first residual: past all transient growth of a nearly self-adjoint system
)
_RISES = 20  # residuals in a row, each above the one before, up to more than the first
_WINDOW = 100  # steps whose largest residual must be 1 % below that of as many steps before
_PATIENCE = 25  # steps without a new best residual once they are near rounding
_DRIFT = 2.0**-20  # relative residual, below which one kept by recursion in float32 may be far off
CLAIM = 1.01  # times the tolerance: what a residual may reach with what rounding hides added
_REFUSALS = 3  # claims in a row that could not be confirmed, none better than those before
_BETTER = 0.99  # times a residual: less of it is progress
_MOST, _NORMAL = float(np.finfo(np.float32).max), 2.0**-126  # of float32


@dataclass(eq=False)
class System:
    """S x = b on the device, counting products.

    `norms` (k,) are what tolerances are relative to: those of the whole right-hand side. `host` is
    b before it became float32. Of a `fine` system x is float64 on the host, residuals are computed
    in float64, and r is rounded once. With `on_coefficients` x comes back to pixels in float32:
    float64 proves nothing.
    """

    S: Operator
    b: Array
    norms: np.ndarray
    host: np.ndarray | None = None
    on_coefficients: bool = False
    fine: bool = False
    products: int = 0

    @functools.cached_property
    def times(self) -> Callable[[np.ndarray], np.ndarray] | None:
        """Products by S in float64, None where its numbers are not at hand on the host."""
        return None if self.on_coefficients else self.S.product_float64()

    def residual(self, x: Any, r: Array) -> np.ndarray:
        """r = b - S x, and its norms (k,)."""
        self.products += 1
        if self.fine:
            return self.exact_residual(x, r)
        x = x if isinstance(x, Array) else self.S.device.upload(x)
        return vectors.norm(self.S.apply(x, r, scale=-1.0, add=self.b))

    def exact_residual(self, x: Any, r: Array) -> np.ndarray:
        """The same in float64, with b and S as they were given."""
        assert self.times is not None  # noqa: S101 - asked for by the callers
        b = np.asarray(self.b.get() if self.host is None else self.host, np.float64)
        x = x.get() if isinstance(x, Array) else x
        left = b - self.times(x.astype(np.float64).reshape(len(b), -1)).reshape(b.shape)
        if np.all(np.abs(left) <= np.finfo(np.float32).max):
            r.set(left)
        return np.atleast_1d(np.linalg.norm(left, axis=0))


@dataclass(frozen=True)
class Rule:
    """The tolerance of a solve; `atol` is one number or one per column."""

    rtol: float
    atol: float | np.ndarray
    maxiter: int
    callback: Callable[[int, float], object] | None = None

    def target(self, norms: np.ndarray) -> np.ndarray:
        """Norms (k,) that residuals may have where right-hand sides have `norms`."""
        return np.maximum(self.rtol * norms, self.atol)


@dataclass
class Monitor:
    """Watches a solve: decides when it ends, keeps the history and the best iterate.

    A method asks `steps_ahead()` how many steps it may queue, and calls `check` after them; where
    it has no next step, it sets `status`. `factor` is what a step shrinks its residual by in
    theory, where it knows. After a check `norms` (k,) are those of the residual, and `unsolved` the
    columns above the tolerance.
    """

    system: System
    rule: Rule
    status: Status | None = None
    residuals: list[float] = field(default_factory=list)
    best: Any = None
    lowest: float = math.inf
    factor: float = 1.0

    def __post_init__(self) -> None:
        self.norms = self.system.norms
        self._scale = np.where(self.norms > 0, self.norms, 1.0)
        self._target = self.rule.target(self.norms)
        self._trusted = np.maximum(self._target, _DRIFT * self.norms)
        self.unsolved = np.ones(self.norms.shape, bool)
        self._lowest_at = self._rises = self._refused = 0
        self._steps, self._travelled = 0, 0.0  # since the residual was computed from x itself
        self._unproven = math.inf
        self._finite = True

    @property
    def iterations(self) -> int:
        """Iterations done: the first residual is that of the start."""
        return max(0, len(self.residuals) - 1)

    def steps_ahead(self) -> int:
        """Steps to queue before residuals are read: half of those that the tolerance seems to take.

        No more than were made so far: products made in vain cost more than readings.
        """
        done = self.iterations
        if done == 0:
            return 1
        with np.errstate(all="ignore"):
            recent = np.array(self.residuals[-SLOTS - 1 :])
            factor = min(float(np.min(recent[1:] / recent[:-1])), self.factor)
            goal = np.maximum(self._target, precision.EPS * self._scale)
            digits = np.log(np.max(self.norms / goal, initial=1.0))
            required = digits / -np.log(factor) if factor < 1.0 else math.inf
        most = min(required, 2.0 * SLOTS - 1.0, 2.0 * (self.rule.maxiter - done) - 1.0)
        return max(1, min(int((most + 1.0) / 2.0), done))

    def check(self, x: Any, r: Array, norms: np.ndarray, travelled: Any = None) -> bool:
        """Whether the solve ends with the iterate `x`, whose residual is `r`; sets `status` when it does.

        `norms` (m, k) are those of the residuals of the m steps since the last check, the newest
        last. `travelled` is None where r was computed from x itself; of a residual by recursion,
        computed anew into `r` before convergence is claimed where rounding could hide it, the way
        (k,) of x, `inf` if unknown.
        """
        *before, last = norms
        if travelled is None:
            self._steps, self._travelled = 0, 0.0
        else:
            self._steps, self._travelled = self._steps + len(norms), self._travelled + travelled
        self.norms, claimed = self._confirm(x, r, last)
        troubles = [self._judge(norms) for norms in (*before, self.norms)]
        self.unsolved = self.above(self.norms)
        if (
            not claimed and not self.unsolved.any()
        ):  # within the tolerance, but for what rounding may hide
            self.unsolved = self.norms > 0.0
        if (
            self._finite and self.residuals[-1] <= self.lowest
        ):  # equal: one column stuck, others improve
            if self.residuals[-1] < self.lowest:
                self.lowest, self._lowest_at = self.residuals[-1], self.iterations
            self.best = x if claimed else x.copy()
        if self._finite and claimed:
            self.status = Status.CONVERGED
        else:
            self.status = next((trouble for trouble in troubles if trouble is not None), None)
        return self.status is not None

    def above(self, norms: np.ndarray) -> np.ndarray:
        """The columns, (k,) bool, in which residuals of such norms are above the tolerance, or NaN."""
        return ~(norms <= self._target)

    def due(self, norms: np.ndarray) -> bool:
        """Whether a method that need not form its iterate after every step has to after this one.

        `norms` are what it knows of the residual without; where the answer is no, they are
        recorded.
        """
        if self.iterations + 1 >= self.rule.maxiter or not np.all(np.isfinite(norms)):
            return True
        self._steps += 1
        self._record(norms)
        return False

    def resume(self, x: Array, r: Array) -> bool:
        """Whether a solve that grew may go on, with another choice of its method, from its best iterate."""
        if (
            self.status is not Status.DIVERGED
            or self.best is None
            or self.iterations >= self.rule.maxiter
        ):
            return False
        self.status, self._rises, self._finite = None, 0, True
        self._steps, self._travelled = 0, 0.0
        self.norms = self.system.residual(x.copy_from(self.best), r)
        self.unsolved = self.above(self.norms)
        return True

    def result(self, x: Any) -> Any:
        """The last iterate where it solves the system, else the best one."""
        return x if self.status is Status.CONVERGED or self.best is None else self.best

    def _confirm(self, x: Any, r: Array, norms: np.ndarray) -> tuple[np.ndarray, bool]:
        """The norms of the newest residual, as exact as need be, and whether they solve the system."""
        system, seems_solved = self.system, np.all(norms <= self._target)
        if not seems_solved and not (self._steps and np.all(norms <= self._trusted)):
            return norms, False
        if system.fine or self._is_proven(x, norms):
            return norms, bool(seems_solved)
        at_hand = system.S.has_cheap_float64_product and system.times is not None
        if self._steps and not (at_hand and seems_solved and np.all(np.isfinite(self._travelled))):
            self._steps, self._travelled = 0, 0.0
            norms = system.residual(x, r)
            if self._is_proven(x, norms):
                return norms, True
        if not seems_solved:
            return norms, False
        if at_hand or (self._refused + 1 >= _REFUSALS and system.times is not None):
            norms = system.exact_residual(x, r)
            self._steps, self._travelled = 0, 0.0
            if np.all(norms <= self._target):
                return norms, True
        worst = float(np.max(norms / self._scale))
        self._refused = self._refused + 1 if worst > _BETTER * self._unproven else 1
        self._unproven = min(worst, self._unproven)
        return norms, False

    def _is_proven(self, x: Any, norms: np.ndarray) -> bool:
        """Whether norms are within the tolerance with all that rounding may hide of the residual of x."""
        if not np.all(norms <= self._target):
            return False
        norm, is_bound = self.system.S.norm_bound()
        if self._steps and not is_bound:
            return False
        size = vectors.norm(x) if isinstance(x, Array) else np.linalg.norm(x, axis=0)
        hidden = precision.UNIT * norm * (self._steps + 1) * (size + self._travelled)
        rounded = 0.5 * precision.EPS * self.system.norms  # of b
        return bool(np.all(norms + hidden + rounded <= CLAIM * self._target))

    def _judge(self, norms: np.ndarray) -> Status | None:
        """Record the norms of one iterate; what is wrong with it, if anything."""
        self._record(norms)
        first, residual = self.residuals[0], self.residuals[-1]
        self._finite &= bool(np.isfinite(residual))  # what comes after an overflow is no iterate
        grown = residual > GROWTH * first or (self._rises >= _RISES and residual > first)
        if grown or not np.isfinite(residual):
            return Status.DIVERGED
        before, recent = self.residuals[-2 * _WINDOW : -_WINDOW], self.residuals[-_WINDOW:]
        stalled = len(before) == _WINDOW and max(recent) > _BETTER * max(before)
        waited = self.iterations - self._lowest_at
        if stalled or (waited >= _PATIENCE and self.lowest < _DRIFT) or self._refused >= _REFUSALS:
            return Status.STAGNATED
        return Status.MAXITER if self.iterations >= self.rule.maxiter else None

    def _record(self, norms: np.ndarray) -> None:
        residual = float(np.max(norms / self._scale, initial=0.0))
        previous = self.residuals[-1] if self.residuals else np.inf
        self.residuals.append(residual)
        if self.rule.callback is not None:
            self.rule.callback(self.iterations, residual)
        self._rises = self._rises + 1 if residual > previous else 0


def scale_rhs(b: Any, n: int) -> tuple[np.ndarray, np.ndarray]:
    """b, (n,) or (n, k), in units near the largest value of each column, float32 where it is so already.

    The units come with it: powers of two, so that squares of any light stay in float32 and no digit
    is lost.
    """
    b = checks.finite("b", checks.real("b", b))
    if b.ndim not in (1, 2) or b.shape[0] != n or b.size == 0:
        raise InputError(f"b has shape {b.shape}; it must be ({n},) or ({n}, k)")
    whole = (
        len(b) // 256 * 256
    )  # 256 rows side by side: NumPy reduces an axis of few columns slowly
    sizes = (
        np.abs(b[:whole])
        .reshape(256, -1)
        .max(axis=0)
        .reshape(-1, *b.shape[1:])
        .max(axis=0, initial=0)
    )
    sizes = np.maximum(sizes, np.abs(b[whole:]).max(axis=0, initial=0)).astype(np.float64)
    unit = np.exp2(np.floor(np.log2(np.where(sizes > 0.0, sizes, 1.0))))
    is_float32 = b.dtype == np.float32 and np.all(unit >= _NORMAL)
    return b / (unit.astype(np.float32) if is_float32 else unit), unit


def unscale(x: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """x times its unit: float32 where x is and where that holds all of it, else float64."""
    if x.dtype == np.float32 and np.all(unit >= _NORMAL):
        with np.errstate(all="ignore"):
            result = x * unit.astype(np.float32)
        sizes = np.abs(result)
        if np.max(sizes) <= _MOST and not np.any(x[sizes < _NORMAL]):  # flushed, or may be
            return result
    return x * unit


def relative(residuals: np.ndarray, norms: np.ndarray) -> float:
    """The largest residual relative to its right-hand side; absolute of a dark one."""
    return float(np.max(residuals / np.where(norms > 0.0, norms, 1.0), initial=0.0))
