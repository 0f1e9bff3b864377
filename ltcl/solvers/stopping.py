# SPDX-License-Identifier: BSD-3-Clause
"""One stopping rule for every method, and the system it is asked about.

A right-hand side b is solved when ``||b - S x|| <= max(rtol ||b||, atol)`` (eq. 2 solved for l_d), for each
column of b. Convergence is claimed only of a residual that was computed from x itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ltcl.device import Array, vectors
from ltcl.operators import Operator
from ltcl.solvers.history import SLOTS, History
from ltcl.solvers.result import Status

# Residuals of Chebyshev swing under an envelope that falls, and come close to 0 by chance on the way; so what
# counts is the start and the largest of a long window, not the best residual so far.
_GROWTH = 100.0  # times the first residual: past all transient growth of a nearly self-adjoint system
_RISES = 20  # residuals in a row, each above the one before, up to more than the first
_WINDOW = 100  # steps whose largest residual must be below that of as many steps before
_PATIENCE = 25  # steps without a new best residual once they are near rounding
_DRIFT = 2.0**-20  # relative residual, below which one kept by recursion in float32 may be far off
_ROUNDING = 2.0**-23  # relative residual that is rounding alone, were it computed as 0


class System:
    """S x = b on the device, counting products.

    `whole` is what tolerances are relative to: b, or, where S and b are a part of a system whose other part
    is solved already, the b of both. `least` is the relative residual that is rounding alone.
    """

    least = _ROUNDING

    def __init__(self, S: Operator, b: Array, whole: Array | None = None) -> None:
        self.S = S
        self.b = b
        self.whole = b if whole is None else whole
        self.products = 0

    def apply(self, x: Array, out: Array, *, scale: float = 1.0, add: Array | None = None) -> Array:
        """out = scale * (S x) + add; see `Operator.apply`."""
        self.products += 1
        return self.S.apply(x, out, scale=scale, add=add)

    def apply_transpose(self, x: Array, out: Array) -> Array:
        """out = S^T x."""
        self.products += 1
        return self.S.apply_transpose(x, out)

    def residual(self, x: Array, r: Array) -> Array:
        """r = b - S x."""
        return self.apply(x, r, scale=-1.0, add=self.b)


@dataclass(frozen=True)
class Rule:
    """The tolerance of a solve; `atol` is one number or one per column."""

    rtol: float
    atol: float | np.ndarray
    maxiter: int
    callback: Callable[[int, float], object] | None = None


@dataclass
class Monitor:
    """Watches a solve: decides when it ends, keeps the history and the best iterate.

    A method calls `done(x, r)` once an iteration, with the residual `r` of `x`. A method that keeps its
    residual by recursion passes ``recursive=True``, and it is recomputed before convergence is claimed and
    wherever rounding may have parted the two; with ``replace=True`` the recomputed one is left in `r`.
    Tolerances below the rounding of the system, that of float32, are never claimed.

    A method that needs no numbers on the host passes ``lazy=True``: then its residuals wait on the device,
    and several are read at once where the tolerance may have been met, or after 8 steps. `factor` is what a
    step shrinks its residual by in theory, where it knows.

    After a call that read them, `norms` are those of the columns of `r`, and `unsolved` the columns above the
    tolerance: a method whose steps differ between columns takes them there only.
    """

    system: System
    rule: Rule
    status: Status | None = None
    residuals: list[float] = field(default_factory=list)
    best: Array | None = None
    factor: float = 1.0

    def __post_init__(self) -> None:
        norms = vectors.norm(self.system.whole)
        self._scale = np.where(norms > 0, norms, 1.0)
        self._history = History(self.system.b, self._scale)
        self._ahead: int | None = None  # steps from the last reading to the next, once foreseen
        self._target = np.maximum(self.rule.rtol * norms, self.rule.atol)
        self._reachable = bool(np.all(self._target >= self.system.least * norms))
        self._trusted = np.maximum(self._target, _DRIFT * norms)
        self.norms = norms
        self.unsolved = np.ones(norms.shape, bool)
        self.lowest = np.inf
        self._lowest_at = 0
        self._rises = 0
        self._finite = True

    @property
    def iterations(self) -> int:
        """Iterations done: the first residual is that of the start."""
        return max(0, len(self.residuals) - 1)

    @property
    def left(self) -> float:
        """What the residuals of the columns above the tolerance have to shrink by, at most 1."""
        where = self.unsolved
        return float(np.min(self._target[where] / self.norms[where], initial=1.0))

    def done(
        self, x: Array, r: Array, *, recursive: bool = False, replace: bool = False, lazy: bool = False
    ) -> bool:
        """Whether the solve ends with the iterate `x`; sets `status` when it does."""
        if lazy and self._may_wait(x, r, self._trusted if recursive else self._target):
            return False
        self._ahead = None
        *waiting, norms = self._history.read(r)
        if (recursive or replace) and np.all(norms <= self._trusted):
            norms = vectors.norm(self.system.residual(x, r if replace else r.like()))
        self.norms = norms
        self.unsolved = self.above(norms)
        troubles = [self._judge(found) for found in (*waiting, norms)]
        if self._finite:
            self._keep(x)
        if self._finite and self._reachable and not self.unsolved.any():
            self.status = Status.CONVERGED
        else:
            self.status = next((trouble for trouble in troubles if trouble is not None), None)
        return self.status is not None

    def above(self, norms: np.ndarray) -> np.ndarray:
        """The columns, (k,) bool, in which residuals of such norms are above the tolerance, or NaN."""
        return ~(norms <= self._target)

    def due(self, norms: np.ndarray) -> bool:
        """Whether a method that need not form its iterate after every step has to after this one.

        `norms` are what it knows of the residual without; where the answer is no, they are recorded.
        """
        if self.iterations + 1 >= self.rule.maxiter or not np.all(np.isfinite(norms)):
            return True
        self._record(norms)
        return False

    def give_up(self, status: Status) -> None:
        """End the solve where the method has no next step; the best iterate stays."""
        self.status = status

    def forgive(self, x: Array, r: Array) -> bool:
        """Whether a solve that grew may go on, with another choice of its method, from its best iterate."""
        if self.status is not Status.DIVERGED or self.best is None or self.iterations >= self.rule.maxiter:
            return False
        self.status, self._rises, self._finite = None, 0, True
        self.norms = vectors.norm(self.system.residual(x.copy_from(self.best), r))
        self.unsolved = self.above(self.norms)
        return True

    def _may_wait(self, x: Array, r: Array, target: np.ndarray) -> bool:
        """Queue the residual of a step where nothing has to be decided yet."""
        if self.best is None:
            return False
        if self._ahead is None:
            self._ahead = self._foresee(target)
        if self._history.waiting + 1 >= self._ahead:
            return False
        self._history.queue(x, r, self.lowest, self.best)
        return True

    def _foresee(self, target: np.ndarray) -> int:
        """Steps until the next reading: half of those until the tolerance, or divergence, is reached.

        Half, since residuals may fall faster than they did, and no more than were made so far: products made
        in vain cost more than readings.
        """
        done, residual = self.iterations, self.residuals[-1]
        if done == 0 or not residual > 0.0:
            return 1
        recent = np.array(self.residuals[-SLOTS - 1 :])
        ratios = recent[1:] / recent[:-1]
        factor = min(float(np.min(ratios)), self.factor)
        wanted = np.maximum(target, _ROUNDING * self._scale)
        left = _steps(float(np.max(self.norms / wanted)), 1.0 / factor)
        growth = _steps(_GROWTH * self.residuals[0] / residual, float(ratios[-1]))
        most = min(left, growth, 2.0 * SLOTS, 2.0 * (self.rule.maxiter - done))
        return max(1, min(int((most + 1.0) / 2.0), done))

    def _judge(self, norms: np.ndarray) -> Status | None:
        """Record the norms of one iterate; what is wrong with it, if anything."""
        self._record(norms)
        self._finite &= bool(np.isfinite(self.residuals[-1]))  # what comes after an overflow is no iterate
        if self._finite and self.residuals[-1] < self.lowest:
            self.lowest, self._lowest_at = self.residuals[-1], self.iterations
        return self._trouble()

    def _record(self, norms: np.ndarray) -> None:
        residual = float(np.max(norms / self._scale, initial=0.0))
        previous = self.residuals[-1] if self.residuals else np.inf
        self.residuals.append(residual)
        if self.rule.callback is not None:
            self.rule.callback(self.iterations, residual)
        self._rises = self._rises + 1 if residual > previous else 0

    def _keep(self, x: Array) -> None:
        if self.residuals[-1] == self.lowest:  # again, where one column is stuck while others improve
            self.best = (x.like() if self.best is None else self.best).copy_from(x)

    def _trouble(self) -> Status | None:
        first, residual = self.residuals[0], self.residuals[-1]
        grown = residual > _GROWTH * first or (self._rises >= _RISES and residual > first)
        if grown or not np.isfinite(residual):
            return Status.DIVERGED
        if not self._reachable and residual <= self.system.least:
            return Status.STAGNATED  # all that its numbers can tell
        waited = self.iterations - self._lowest_at
        if (waited >= _PATIENCE and self.lowest < _DRIFT) or self._stalled():
            return Status.STAGNATED
        return Status.MAXITER if self.iterations >= self.rule.maxiter else None

    def _stalled(self) -> bool:
        before, recent = self.residuals[-2 * _WINDOW : -_WINDOW], self.residuals[-_WINDOW:]
        return len(before) == _WINDOW and max(recent) >= max(before)


def _steps(times: float, rate: float) -> float:
    """Steps in which what grows by `rate` a step grows so many times; infinite where it never does.

    >>> _steps(8.0, 2.0), _steps(0.5, 2.0), _steps(8.0, 0.5)
    (3.0, 0.0, inf)
    """
    if times <= 1.0:
        return 0.0
    return math.log(times) / math.log(rate) if rate > 1.0 else math.inf
