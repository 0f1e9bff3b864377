# SPDX-License-Identifier: BSD-3-Clause
"""The stopping rule of all methods, and the system that it judges.

``||b - S x|| <= max(rtol ||b||, atol)`` (eq. 2) for each column of b. CONVERGED is claimed only if
a residual is within the tolerance after all that rounding may hide of it is added
(`ltcl.solvers.precision`); it is recomputed from x where needed.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ltcl.device import Array, vectors
from ltcl.operators import Operator
from ltcl.operators.knowledge import Product
from ltcl.operators.shared_vector import SharedVector
from ltcl.solvers import precision
from ltcl.solvers.result import Solution, Status

# Most steps between two readings of residuals.
SLOTS = 8

# A residual of so many times the first one is past all transient growth of a nearly self-adjoint
# system. Residuals of Chebyshev swing, so that the first one counts here, not the best.
GROWTH_LIMIT = 100.0

# So many residuals in a row, each above the one before, are growth once they exceed the first one.
MAX_RISES = 20

# Residuals stagnate if the largest of so many is not 1 % below the largest of as many before.
STAGNATION_WINDOW = 100

# Residuals near rounding stagnate after so many steps without a new best one.
PATIENCE = 25

# A residual that falls by less than this factor makes no progress.
PROGRESS_FACTOR = 0.99

# A relative residual below this, kept by recursion in float32, may be far off.
RECURSION_LIMIT = 2.0**-20

# What a claimed residual may reach, in tolerances, with all that rounding hides added.
CLAIM_LIMIT = 1.01

# A solve stagnates after so many claims in a row that could not be confirmed.
MAX_REFUSALS = 3


@dataclass(frozen=True, kw_only=True)
class StoppingRule:
    """The tolerance of a solve; `atol` is one number or one per column."""

    rtol: float
    atol: float | np.ndarray = 0.0
    maxiter: int
    callback: Callable[[int, float], object] | None = None

    def target(self, norms: np.ndarray) -> np.ndarray:
        """Return the norms (k,) that residuals may have for right-hand sides of `norms`."""
        return np.maximum(self.rtol * norms, self.atol)


@dataclass(eq=False, kw_only=True)
class CountedOperator:
    """S x = b on the device, with a count of the products.

    Attributes
    ----------
    S, b
        The operator, and the right-hand side on the device.
    norms : (k,) float64
        Norms of the whole right-hand side, to which tolerances are relative.
    host : like b, optional
        b before it became float32.
    on_coefficients : bool
        x is converted to pixels in float32 at the end, so that float64 would prove nothing.
    in_float64 : bool
        x is float64 on the host; residuals are computed in float64, and r is rounded once.
    """

    S: Operator
    b: Array
    norms: np.ndarray
    host: np.ndarray | None = None
    on_coefficients: bool = False
    in_float64: bool = False
    products: int = 0

    @functools.cached_property
    def product_float64(self) -> Product | None:
        """Products by S in float64; None if the host does not have its numbers."""
        if self.on_coefficients:
            return None
        return self.S.product_float64()

    def residual(self, x: Any, r: Any) -> np.ndarray:
        """Compute r = b - S x by one product; return its norms (k,)."""
        if isinstance(x, SharedVector):
            norms = self.residual(x.gather(), r.whole)
            r.hand_out()
            return norms
        self.products += 1
        if self.in_float64:
            return self.exact_residual(x, r)
        on_device = x if isinstance(x, Array) else self.S.device.upload(x)
        return vectors.norm(self.S.apply(on_device, r, scale=-1.0, add=self.b))

    def exact_residual(self, x: Any, r: Any) -> np.ndarray:
        """Compute the same in float64, with b and S as they were given."""
        product = self.product_float64
        assert product is not None  # noqa: S101 - asked for by the callers
        b = self.b.get() if self.host is None else self.host
        b = np.asarray(b, np.float64)
        if not isinstance(x, np.ndarray):
            x = x.get()
        columns = x.astype(np.float64).reshape(len(b), -1)
        residual = b - product(columns).reshape(b.shape)
        if np.all(np.abs(residual) <= np.finfo(np.float32).max):
            r.set(residual)
        return np.atleast_1d(np.linalg.norm(residual, axis=0))


@dataclass(kw_only=True)
class Monitor:
    """Watches a solve: decides when it ends, keeps the history and the best iterate.

    A method asks `steps_ahead()` how many steps it may queue, and calls `check` after them. A
    method without a next step sets `status`.

    Attributes
    ----------
    residuals : list of float
        Largest relative residual over the columns, before the first step and after each.
    best, lowest
        The iterate with the smallest residual, and that residual.
    factor : float
        What a step reduces its residual by in theory, if the method knows.
    norms : (k,) float64
        Norms of the residual at the last check.
    unsolved : (k,) bool
        Columns whose residual is above the tolerance.
    """

    system: CountedOperator
    rule: StoppingRule
    status: Status | None = None
    residuals: list[float] = field(default_factory=list)
    best: Any = None
    lowest: float = math.inf
    factor: float = 1.0

    def __post_init__(self) -> None:
        self.norms = self.system.norms
        self.unsolved = np.ones(self.norms.shape, bool)
        self._scale = np.where(self.norms > 0, self.norms, 1.0)
        self._target = self.rule.target(self.norms)
        self._recursion_limit = np.maximum(self._target, RECURSION_LIMIT * self.norms)
        self._lowest_at = 0
        self._rises = 0
        self._refusals = 0
        self._lowest_refused = math.inf
        self._is_finite = True
        self._restart_recursion()

    @property
    def iterations(self) -> int:
        """The number of iterations; the first residual belongs to the start."""
        return max(0, len(self.residuals) - 1)

    def steps_ahead(self) -> int:
        """Return the steps to queue before residuals are read: half of those that seem missing.

        They are at most as many as were made so far: a product in vain costs more than a reading.
        """
        done = self.iterations
        if done == 0:
            return 1
        required = self._required_steps()
        remaining = self.rule.maxiter - done
        max_steps = min(required, 2.0 * SLOTS - 1.0, 2.0 * remaining - 1.0)
        half = int((max_steps + 1.0) / 2.0)
        return max(1, min(half, done))

    def check(self, x: Any, r: Any, norms: np.ndarray, travelled: Any = None) -> bool:
        """Return whether the solve ends with the iterate `x`, and set `status` if it does.

        Parameters
        ----------
        x, r
            The iterate and its residual: arrays of the host or the device, or shared vectors.
        norms : (m, k)
            Norms of the residuals of the m steps since the last check, the newest last.
        travelled : None or (k,)
            None if r was computed from x itself. Else r was kept by recursion while x moved by this
            length, `inf` if it is unknown. r is recomputed before convergence is claimed, if
            rounding could hide the difference.
        """
        *earlier, newest = norms
        if travelled is None:
            self._restart_recursion()
        else:
            self._recursion_steps += len(norms)
            self._travelled = self._travelled + travelled

        self.norms, is_solved = self.confirm(x, r, newest)
        troubles = []
        for step_norms in (*earlier, self.norms):
            troubles.append(self._judge(step_norms))
        self.unsolved = self.above(self.norms)
        if not is_solved and not self.unsolved.any():
            # All columns are within the tolerance, but for what rounding may hide.
            self.unsolved = self.norms > 0.0

        newest_residual = self.residuals[-1]
        # An equal residual is a new best iterate, too: one column is stuck while others improve.
        if self._is_finite and newest_residual <= self.lowest:
            if newest_residual < self.lowest:
                self.lowest = newest_residual
                self._lowest_at = self.iterations
            self.best = x if is_solved else x.copy()

        if self._is_finite and is_solved:
            self.status = Status.CONVERGED
        else:
            self.status = next((trouble for trouble in troubles if trouble is not None), None)
        return self.status is not None

    def above(self, norms: np.ndarray) -> np.ndarray:
        """Return the columns, (k,) bool, whose residual norms exceed the tolerance or are NaN."""
        return ~(norms <= self._target)

    def needs_iterate(self, norms: np.ndarray) -> bool:
        """Return whether a method that forms its iterate only now and then has to after this step.

        `norms` (k,) are what the method knows of the residual without the iterate; if the answer is
        no, they are recorded.
        """
        if self.iterations + 1 >= self.rule.maxiter or not np.all(np.isfinite(norms)):
            return True
        self._recursion_steps += 1
        self._record(norms)
        return False

    def resume(self, x: Array, r: Array) -> bool:
        """Go back to the best iterate of a diverged solve, to go on with other parameters.

        Returns whether that is possible.
        """
        if self.status is not Status.DIVERGED:
            return False
        if self.best is None or self.iterations >= self.rule.maxiter:
            return False
        self.status = None
        self._rises = 0
        self._is_finite = True
        self._restart_recursion()
        self.norms = self.system.residual(x.copy_from(self.best), r)
        self.unsolved = self.above(self.norms)
        return True

    def result(self, x: Any) -> Any:
        """Return the last iterate if it solves the system, else the best one."""
        if self.status is Status.CONVERGED or self.best is None:
            return x
        if isinstance(self.best, SharedVector):
            return self.best.gather()
        return self.best

    def solution(self, x: np.ndarray, method: str, residual: np.ndarray | None = None) -> Solution:
        """Return the solution x by `method` with the history of this solve."""
        assert self.status is not None  # noqa: S101 - a method returns when the solve has ended
        return Solution(
            x=x,
            status=self.status,
            iterations=self.iterations,
            products=self.system.products,
            residuals=tuple(self.residuals),
            method=method,
            lowest=self.lowest,
            rest=residual,
        )

    def _restart_recursion(self) -> None:
        """Count recursive steps, and the way of x, from a residual computed from x itself."""
        self._recursion_steps = 0
        self._travelled: Any = 0.0

    def _required_steps(self) -> float:
        """Return how many steps the tolerance seems to take, by the fastest of the last ones."""
        with np.errstate(all="ignore"):
            recent = np.array(self.residuals[-SLOTS - 1 :])
            fastest = float(np.min(recent[1:] / recent[:-1]))
            factor = min(fastest, self.factor)
            goal = np.maximum(self._target, precision.EPS * self._scale)
            # A factor of NaN tells nothing, either.
            if not factor < 1.0:
                return math.inf
            digits = np.log(np.max(self.norms / goal, initial=1.0))
            return digits / -np.log(factor)

    def confirm(
        self, x: Any, r: Any, norms: np.ndarray, *, is_last: bool = False
    ) -> tuple[np.ndarray, bool]:
        """Return norms (k,) of the newest residual, as exact as needed, and whether x solves.

        A claim is decided by the first of these that can decide it: the bound on what rounding may
        hide in the residual at hand; the same bound for the residual computed anew; the residual in
        float64, where that is cheap (small systems), after too many refusals, or if x `is_last`.
        """
        system = self.system
        seems_solved = bool(np.all(norms <= self._target))
        seems_recursive = self._recursion_steps > 0 and np.all(norms <= self._recursion_limit)
        if not seems_solved and not seems_recursive:
            return norms, False
        if system.in_float64 or self._is_proven(x, norms):
            return norms, seems_solved

        # A residual by recursion is recomputed, unless float64 decides at once and at little cost.
        is_cheap = system.S.has_cheap_float64_product and system.product_float64 is not None
        decides_at_once = is_cheap and seems_solved and np.all(np.isfinite(self._travelled))
        if self._recursion_steps and not decides_at_once:
            self._restart_recursion()
            norms = system.residual(x, r)
            if self._is_proven(x, norms):
                return norms, True
        if not seems_solved:
            return norms, False

        is_last_refusal = is_last or self._refusals + 1 >= MAX_REFUSALS
        if is_cheap or (is_last_refusal and system.product_float64 is not None):
            norms = system.exact_residual(x, r)
            self._restart_recursion()
            if np.all(norms <= self._target):
                return norms, True
        self._refuse(norms)
        return norms, False

    def _refuse(self, norms: np.ndarray) -> None:
        """Count a claim that was not confirmed; one better than those before restarts the count."""
        worst = float(np.max(norms / self._scale))
        if worst > PROGRESS_FACTOR * self._lowest_refused:
            self._refusals += 1
        else:
            self._refusals = 1
        self._lowest_refused = min(worst, self._lowest_refused)

    def _is_proven(self, x: Any, norms: np.ndarray) -> bool:
        """Return whether norms are within the tolerance with all that rounding may hide added."""
        if not np.all(norms <= self._target):
            return False
        norm = self.system.S.norm_bound()
        if self._recursion_steps and not norm.is_bound:
            return False
        size = _column_norms(x)
        # Each product rounds by UNIT ||S|| times what it multiplies: x itself when r was computed,
        # and since then steps whose lengths add up to the way of x.
        way = size + self._travelled
        hidden = precision.UNIT * norm.value * (self._recursion_steps + 1) * way
        rounding_of_b = 0.5 * precision.EPS * self.system.norms
        return bool(np.all(norms + hidden + rounding_of_b <= CLAIM_LIMIT * self._target))

    def _judge(self, norms: np.ndarray) -> Status | None:
        """Record the norms of one iterate; return what is wrong with it, if anything."""
        self._record(norms)
        first = self.residuals[0]
        residual = self.residuals[-1]
        # No iterate after an overflow is one, whatever its residual.
        self._is_finite &= bool(np.isfinite(residual))
        has_grown = residual > GROWTH_LIMIT * first
        keeps_growing = self._rises >= MAX_RISES and residual > first
        if has_grown or keeps_growing or not np.isfinite(residual):
            return Status.DIVERGED
        if self._has_stalled() or self._refusals >= MAX_REFUSALS:
            return Status.STAGNATED
        if self.iterations >= self.rule.maxiter:
            return Status.MAXITER
        return None

    def _has_stalled(self) -> bool:
        """Return whether residuals have stopped falling, at large or near rounding."""
        earlier = self.residuals[-2 * STAGNATION_WINDOW : -STAGNATION_WINDOW]
        recent = self.residuals[-STAGNATION_WINDOW:]
        is_full = len(earlier) == STAGNATION_WINDOW
        if is_full and max(recent) > PROGRESS_FACTOR * max(earlier):
            return True
        waited = self.iterations - self._lowest_at
        return waited >= PATIENCE and self.lowest < RECURSION_LIMIT

    def _record(self, norms: np.ndarray) -> None:
        """Append the largest relative residual, and call the callback."""
        residual = float(np.max(norms / self._scale, initial=0.0))
        has_risen = bool(self.residuals) and residual > self.residuals[-1]
        self.residuals.append(residual)
        if self.rule.callback is not None:
            self.rule.callback(self.iterations, residual)
        if has_risen:
            self._rises += 1
        else:
            self._rises = 0


def relative_residual(residual_norms: np.ndarray, norms: np.ndarray) -> float:
    """Return the largest residual relative to its right-hand side; absolute where that is dark."""
    return float(np.max(residual_norms / np.where(norms > 0.0, norms, 1.0), initial=0.0))


def _column_norms(x: Any) -> np.ndarray:
    """Return the norms of the columns of x, wherever it is."""
    if isinstance(x, SharedVector):
        return x.norms()
    if isinstance(x, Array):
        return vectors.norm(x)
    return np.linalg.norm(x, axis=0)
