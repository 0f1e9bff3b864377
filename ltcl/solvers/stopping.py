# SPDX-License-Identifier: BSD-3-Clause
"""One stopping rule for every method, and the system it is asked about.

A right-hand side b is solved when ``||b - S x|| <= max(rtol ||b||, atol)`` (eq. 2 solved for l_d), for each
column of b. CONVERGED is claimed only of a residual of x itself that is within the tolerance with all that
rounding may hide (`ltcl.solvers.precision`): the one the method has where that is little, else one that is
computed anew, in float64 where the numbers of S are at hand.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ltcl.device import Array, vectors
from ltcl.operators import Epilogue, Operator
from ltcl.solvers import precision
from ltcl.solvers.result import Status

SLOTS = 8  # steps between two readings, at most
_BOUND = 8  # products of which the arrays are kept

# Residuals of Chebyshev swing under an envelope that falls, and come close to 0 by chance on the way; so what
# counts is the start and the largest of a long window, not the best residual so far.
_GROWTH = 100.0  # times the first residual: past all transient growth of a nearly self-adjoint system
_RISES = 20  # residuals in a row, each above the one before, up to more than the first
_WINDOW = 100  # steps whose largest residual must be below that of as many steps before
_PATIENCE = 25  # steps without a new best residual once they are near rounding
_DRIFT = 2.0**-20  # relative residual, below which one kept by recursion in float32 may be far off
CLAIM = 1.01  # times the tolerance: what a residual may reach with what rounding hides added
_REFUSALS = 3  # claims in a row that could not be confirmed, none better than those before
_BETTER = 0.99  # times the least residual of such claims


class System:
    """S x = b on the device, counting products.

    `whole` is what tolerances are relative to: b, or, where S and b are a part of a system whose other part
    is solved already, the b of both. `host` is b before it became float32. Of a `fine` system x is float64 on
    the host, and so are residuals; what is left of them in r is rounded once.
    """

    fine = False
    _norms: np.ndarray | None = None

    def __init__(
        self, S: Operator, b: Array, whole: Array | None = None, host: np.ndarray | None = None
    ) -> None:
        self.S = S
        self.b = b
        self.whole = b if whole is None else whole
        self.products = 0
        self.start_norms: np.ndarray | None = None  # (1, k) of the first residual, where they are known
        self._host = host
        self._bound: dict[tuple[Any, ...], Callable[[], object]] = {}  # products that loops come back to

    @functools.cached_property
    def times(self) -> precision.Product | None:
        """Products by S in float64, None where its numbers are not at hand on the host."""
        return precision.product(self.S)

    @functools.cached_property
    def whole_norms(self) -> np.ndarray:
        """Norms (k,) of the right-hand sides that tolerances are relative to."""
        return vectors.norm(self.whole)

    @property
    def least(self) -> float:
        """Relative residual that is rounding alone."""
        return 2.0**-52 if self.fine else precision.EPS

    def apply(self, x: Array, out: Array, *, scale: float = 1.0, add: Array | None = None) -> Array:
        """out = scale * (S x) + add; see `Operator.apply`."""
        self.products += 1
        key = (x, out, scale, add)
        if key not in self._bound:
            if len(self._bound) == _BOUND:
                self._bound.clear()
            self._bound[key] = self.S.bind(x, out, Epilogue(scale, 0.0 if add is None else 1.0, add))
        self._bound[key]()
        return out

    def apply_transpose(self, x: Array, out: Array) -> Array:
        """out = S^T x."""
        self.products += 1
        return self.S.apply_transpose(x, out)

    def residual(self, x: Any, r: Array) -> Array:
        """r = b - S x."""
        if not self.fine:
            return self.apply(self._on_device(x), r, scale=-1.0, add=self.b)
        self.products += 1
        self._norms = self.exact_norms(x, r)
        return r

    def confirm(
        self, x: Any, r: Array, norms: np.ndarray, limit: np.ndarray, travelled: Any, steps: int
    ) -> tuple[np.ndarray, bool]:
        """Norms of the residual of x as exact as can be told, and whether they are below `limit`.

        `norms` are of a residual computed from x itself `steps` steps ago and kept by recursion since;
        `travelled` bounds the way of x since then, None if unknown. What is computed anew is left in `r`.
        """
        if self.fine:
            norms = self.whole_norms if self._norms is None else self._norms  # of x = 0
            return norms, _within(norms, limit)
        x = self._on_device(x)
        if steps and (travelled is None or not precision.is_bounded(self.S)):
            (norms, size), steps = vectors.norms(self.residual(x, r), x), 0
        else:
            size = vectors.norm(x) if _within(norms, limit) else norms
        if self._proven(size, norms, limit, travelled if steps else 0.0, steps):
            return norms, True
        if precision.is_small(self.S) and self.times is not None:
            norms = self.exact_norms(x, r)
            return norms, _within(norms, limit)
        if steps:
            norms, size = vectors.norms(self.residual(x, r), x)
            return norms, self._proven(size, norms, limit)
        return norms, False

    def exact_norms(self, x: Any, r: Array) -> np.ndarray:
        """Norms of b - S x in float64, with b and S as they were given; the residual is left in `r`."""
        assert self.times is not None  # noqa: S101 - asked for by the callers
        b = np.asarray(self.b.get() if self._host is None else self._host, np.float64)
        x = x.get() if isinstance(x, Array) else x
        left = b - self.times(x.astype(np.float64).reshape(len(b), -1)).reshape(b.shape)
        if np.all(np.abs(left) <= np.finfo(np.float32).max):
            r.set(left)
        return np.atleast_1d(np.linalg.norm(left, axis=0))

    def _on_device(self, x: Any) -> Array:
        return x if isinstance(x, Array) else self.S.device.upload(x)

    def _proven(
        self, size: np.ndarray, norms: np.ndarray, limit: np.ndarray, travelled: Any = 0.0, steps: int = 0
    ) -> bool:
        """Whether norms are within the limit with what rounding may hide; `size` are norms (k,) of x."""
        if not _within(norms, limit):
            return False
        hidden = precision.UNIT * precision.norm_bound(self.S) * (steps + 1) * (size + travelled)
        return _within(norms + hidden + 0.5 * precision.EPS * self.whole_norms, CLAIM * limit)


def _within(norms: np.ndarray, limit: np.ndarray) -> bool:
    return bool(np.all(norms <= limit))


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

    A method asks `steps_ahead()` how many steps it may queue, and calls `check` after them with the iterate
    and its residual. `factor` is what a step shrinks its residual by in theory, where it knows. After a check
    `norms` are those of the columns of the residual, and `unsolved` the columns above the tolerance.
    """

    system: System
    rule: Rule
    status: Status | None = None
    residuals: list[float] = field(default_factory=list)
    best: Any = None
    lowest: float = math.inf
    factor: float = 1.0

    def __post_init__(self) -> None:
        norms = self.system.whole_norms
        self._scale = np.where(norms > 0, norms, 1.0)
        self._target = np.maximum(self.rule.rtol * norms, self.rule.atol)
        self._trusted = np.maximum(self._target, _DRIFT * norms)
        self.norms = norms
        self.unsolved = np.ones(norms.shape, bool)
        self._lowest_at = self._rises = self._refused = self._true_at = 0
        self._untrue = math.inf
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

    def steps_ahead(self) -> int:
        """Steps to queue before residuals are read: half of those to the tolerance, or to divergence.

        Half, since residuals may fall faster than they did, and no more than were made so far: products made
        in vain cost more than readings.
        """
        done, residual = self.iterations, self.residuals[-1]
        if done == 0 or not residual > 0.0:
            return 1
        with np.errstate(all="ignore"):
            recent = np.array(self.residuals[-SLOTS - 1 :])
            ratios = recent[1:] / recent[:-1]
            factor = min(float(np.min(ratios)), self.factor)
            wanted = np.maximum(self._target, self.system.least * self._scale)
            left = _steps(float(np.max(self.norms / wanted)), 1.0 / factor if factor > 0.0 else math.inf)
            growth = _steps(_GROWTH * self.residuals[0] / residual, float(ratios[-1]))
        most = min(left, growth, 2.0 * SLOTS - 1.0, 2.0 * (self.rule.maxiter - done) - 1.0)
        return max(1, min(int((most + 1.0) / 2.0), done))

    def check(
        self,
        x: Any,
        r: Array,
        norms: np.ndarray | None = None,
        *,
        recursive: bool = False,
        travelled: np.ndarray | None = None,
    ) -> bool:
        """Whether the solve ends with the iterate `x`; sets `status` when it does.

        `norms` (m, k) are those of the residuals of the m steps since the last check, the newest last; that
        of `r` is measured now when not given. A residual kept by recursion is computed anew, into `r`, before
        convergence is claimed and wherever rounding may have parted the two; but not where `travelled`, a
        bound (k,) on the way of x since that was done last, shows that nothing that counts can be lost.
        """
        *before, last = vectors.norm(r)[None] if norms is None else norms
        steps = len(self.residuals) + len(before) - self._true_at if recursive else 0
        norms, claimed = self._confirm(x, r, last, travelled, steps)
        troubles = [self._judge(one) for one in (*before, norms)]
        if norms is not last or not steps:
            self._true_at = self.iterations
        self.norms, self.unsolved = norms, self.above(norms)
        if not claimed and not self.unsolved.any():  # within the tolerance, but for what rounding may hide
            self.unsolved = norms > 0.0
        if self._finite and self.residuals[-1] <= self.lowest:  # equal: one column stuck, others improve
            if self.residuals[-1] < self.lowest:
                self.lowest, self._lowest_at = self.residuals[-1], self.iterations
            self.best = x.copy()
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

        `norms` are what it knows of the residual without; where the answer is no, they are recorded.
        """
        if self.iterations + 1 >= self.rule.maxiter or not np.all(np.isfinite(norms)):
            return True
        self._record(norms)
        return False

    def give_up(self, status: Status) -> None:
        """End the solve where the method has no next step; the best iterate stays."""
        self.status = status

    def resume(self, x: Array, r: Array) -> bool:
        """Whether a solve that grew may go on, with another choice of its method, from its best iterate."""
        if self.status is not Status.DIVERGED or self.best is None or self.iterations >= self.rule.maxiter:
            return False
        self.status, self._rises, self._finite, self._true_at = None, 0, True, self.iterations
        self.norms = vectors.norm(self.system.residual(x.copy_from(self.best), r))
        self.unsolved = self.above(self.norms)
        return True

    def result(self, x: Any) -> Any:
        """The last iterate where it solves the system, else the best one."""
        return x if self.status is Status.CONVERGED or self.best is None else self.best

    def _confirm(
        self, x: Any, r: Array, norms: np.ndarray, travelled: np.ndarray | None, steps: int
    ) -> tuple[np.ndarray, bool]:
        """The norms of the newest residual, confirmed where they seem to be small enough, and if they are."""
        if not _within(norms, self._trusted if steps else self._target):
            return norms, False
        found, claimed = self.system.confirm(x, r, norms, self._target, travelled, steps)
        if claimed or not _within(norms, self._target):
            return found, claimed
        worst = float(np.max(found / self._scale))
        self._refused = self._refused + 1 if worst > _BETTER * self._untrue else 1
        self._untrue = min(worst, self._untrue)
        if self._refused >= _REFUSALS and self.system.times is not None:
            found = self.system.exact_norms(x, r)
            return found, _within(found, self._target)
        return found, False

    def _judge(self, norms: np.ndarray) -> Status | None:
        """Record the norms of one iterate; what is wrong with it, if anything."""
        self._record(norms)
        self._finite &= bool(np.isfinite(self.residuals[-1]))  # what comes after an overflow is no iterate
        return self._trouble()

    def _record(self, norms: np.ndarray) -> None:
        residual = float(np.max(norms / self._scale, initial=0.0))
        previous = self.residuals[-1] if self.residuals else np.inf
        self.residuals.append(residual)
        if self.rule.callback is not None:
            self.rule.callback(self.iterations, residual)
        self._rises = self._rises + 1 if residual > previous else 0

    def _trouble(self) -> Status | None:
        first, residual = self.residuals[0], self.residuals[-1]
        grown = residual > _GROWTH * first or (self._rises >= _RISES and residual > first)
        if grown or not np.isfinite(residual):
            return Status.DIVERGED
        waited = self.iterations - self._lowest_at
        if (waited >= _PATIENCE and self.lowest < _DRIFT) or self._stalled() or self._refused >= _REFUSALS:
            return Status.STAGNATED
        return Status.MAXITER if self.iterations >= self.rule.maxiter else None

    def _stalled(self) -> bool:
        before, recent = self.residuals[-2 * _WINDOW : -_WINDOW], self.residuals[-_WINDOW:]
        return len(before) == _WINDOW and max(recent) >= max(before)


def _steps(times: float, rate: float) -> float:
    """Steps in which what grows by `rate` a step grows so many times; infinite where it never does.

    >>> _steps(8.0, 2.0), _steps(0.5, 2.0), _steps(8.0, 0.5), _steps(8.0, float("inf"))
    (3.0, 0.0, inf, 0.0)
    """
    if times <= 1.0 or rate == math.inf:
        return 0.0
    return math.log(times) / math.log(rate) if rate > 1.0 else math.inf
