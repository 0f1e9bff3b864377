# SPDX-License-Identifier: BSD-3-Clause
"""Iterative refinement: a compressed S~ solves, and the S that it stands for judges.

    x^(k+1) = x^(k) + S~^-1 (b - S x^(k))

With S~ = S + E and each solve to a tolerance t, the error shrinks by about ||S~^-1 E|| + t a step, the first
of which the `solution_error` of S~ bounds. Below 1, any tolerance is reached that products by S can tell, one
of them a step; the others are by S~, and run on its coefficients. Otherwise residuals may grow, which the
monitor sees. (Wilkinson, Rounding Errors in Algebraic Processes, 1963; Higham, Accuracy and Stability of
Numerical Algorithms, 2nd ed., chapter 12.)

Float32 products tell residuals of about 1e-7 to 1e-6 of b. Tolerances below 1e-6 are therefore refined in
float64, x and residuals both, where the numbers of S are at hand on the host (`double`), and are then met
down to about 1e-15; where they are not, the least that can be asked is told.

A solve reports true residuals, those of S; its iterations are steps of refinement, and its products those by
S and by S~ together.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Operator, as_operator
from ltcl.solvers import coefficients
from ltcl.solvers.direct import Direct
from ltcl.solvers.double import Product
from ltcl.solvers.result import Solution, Status
from ltcl.solvers.stopping import Monitor, Rule, System

_OF_S = "exact=T.interreflection of the uncompressed T"
_OF_A_TASK = "exact=T, the uncompressed transport"
_LEAST, _MOST = 1e-3, 0.1  # of the tolerance of a step: many short steps waste products by S, long ones by S~
FINE = 2.0**-20  # relative residual, below which float32 products are left
_MARGIN = 1.5  # times what was reached: what is reached again
_HALF = 0.5  # of a residual: a solve that ended early but left no more is a step, too


def refuse_beyond(S: Operator, rule: Rule, wanted: float) -> None:
    """Refuse a relative residual `wanted` that says less about the solution than S itself."""
    error = S.solution_error
    if wanted < error:
        atol = f" and atol {rule.atol:g}" if np.any(rule.atol) else ""
        raise InputError(
            f"rtol is {rule.rtol:g}{atol}; S is compressed and its solutions may be off by "
            f"{checks.upwards(error)}: ask for no less, or give {_OF_S}"
        )


@contextmanager
def of_a_task() -> Iterator[None]:
    """Refusals of the block advise what a task takes as `exact`, a transport and no S."""
    try:
        yield
    except InputError as error:
        if _OF_S not in str(error):
            raise
        raise type(error)(str(error).replace(_OF_S, _OF_A_TASK)) from None


def exact_operator(exact: Any, S: Operator) -> Operator:
    """`exact` on the device of S, checked."""
    if hasattr(type(exact), "interreflection"):  # asked of the object, it would upload
        raise InputTypeError(f"exact is a {type(exact).__name__}; it must be like S: give {_OF_S}")
    if isinstance(exact, (tuple, list)) and any(isinstance(part, Operator) for part in exact):
        raise InputTypeError(f"exact is {len(exact)} operators, S is one; give that of the same colour")
    if not hasattr(exact, "shape"):
        checks.real("exact", exact)
    found = as_operator(exact, S.device)
    if found.shape != S.shape:
        raise InputError(f"exact has shape {found.shape}; it must be that of S, {S.shape}")
    if found.device is not S.device:
        raise InputError(f"exact is on another device, {found.device}; it must be on {S.device}")
    return found


def step_tolerance(S: Operator) -> float:
    """Relative residual of the solves with S~: no smaller than what S~ is worth.

    >>> from ltcl.operators import IdentityPlus, as_operator
    >>> step_tolerance(IdentityPlus(as_operator([[0.5]]), solution_error=0.004))
    0.004
    """
    return min(max(S.solution_error, _LEAST), _MOST)


def iterate(
    method: Any, S: Operator, exact: Operator, b: Array, guess: Array | None, rule: Rule
) -> tuple[Array, Monitor]:
    """Refine solutions of S~ x = b, `S` being S~, until the monitor ends it; the iterate to return."""
    system = System(exact, b)
    x, r = coefficients.start(system, guess)
    monitor = Monitor(system, rule)
    while not monitor.done(x, r):
        step = _step(method, S, r, Rule(_tolerance(S, monitor), 0.0, rule.maxiter), system)
        if isinstance(step, Status):
            monitor.give_up(step)
            break
        vectors.axpy(1.0, step, x)
        system.residual(x, r)
    best = x if monitor.status is Status.CONVERGED or monitor.best is None else monitor.best
    return best, monitor


class _Double(System):
    """S x = b with b and residuals in float64, (N, k) on the host."""

    least = 2.0**-52

    def __init__(self, S: Operator, b: np.ndarray, product: Product) -> None:
        super().__init__(S, S.device.upload(b))
        self._exact, self._times = b.reshape(len(b), -1), product

    def left(self, x: np.ndarray, r: Array) -> Array:
        """r = b - S x, rounded once."""
        self.products += 1
        return r.set((self._exact - self._times(x.reshape(self._exact.shape))).reshape(r.shape))


def iterate_in_double(
    method: Any, S: Operator, exact: Operator, product: Product, b: np.ndarray, guess: Any, rule: Rule
) -> tuple[np.ndarray, Monitor]:
    """As `iterate`, with x and residuals in float64 on the host, by the `product` of `exact`."""
    system = _Double(exact, b.astype(np.float64), product)
    x = np.zeros(b.shape) if guess is None else guess.astype(np.float64)
    r = system.b.copy() if guess is None else system.left(x, system.b.like())
    monitor, best, told = Monitor(system, rule), x, system.b.like()
    while not monitor.done(told.set(x), r):
        best = x if monitor.residuals[-1] == monitor.lowest else best
        step = _step(method, S, r, Rule(_tolerance(S, monitor), 0.0, rule.maxiter), system)
        if isinstance(step, Status):
            monitor.give_up(step)
            break
        x = x + step.get()
        system.left(x, r)
    last = monitor.status is Status.CONVERGED or monitor.residuals[-1] == monitor.lowest
    return (x if last else best), monitor


def failure(found: Solution, rule: Rule, exact: Operator | None) -> str:
    """Why a solve failed, with the least tolerance where it was beyond what rounding leaves of `exact`."""
    if exact is None or found.status is not Status.STAGNATED or found.residual > _HALF * FINE:
        return str(found)
    floor = System.least if found.x.dtype == np.float32 else _Double.least
    least = checks.upwards(max(_MARGIN * found.residual, floor))
    atol = f" and atol {rule.atol:g}" if np.any(rule.atol) else ""
    return (
        f"rtol is {rule.rtol:g}{atol}, but products with exact= are rounded, which left {found.residual:.2g} "
        f"after {found.iterations} iterations of {found.method}; the least that can be asked is {least}"
    )


def _tolerance(S: Operator, monitor: Monitor) -> float:
    """Of the next step: that of S~, or more where less is left to do."""
    return min(max(step_tolerance(S), _HALF * monitor.left), _MOST)


def _step(method: Any, S: Operator, r: Array, rule: Rule, system: System) -> Array | Status:
    """S~^-1 r, or why there is none."""
    if isinstance(method, Direct):
        try:
            return S.device.upload(method.solve(S, r.get().astype(np.float64))[0])
        except np.linalg.LinAlgError:
            return Status.BREAKDOWN
    step, inner = coefficients.iterate(method, S, r, None, rule)
    system.products += inner.system.products
    assert inner.status is not None  # noqa: S101 - iterate returns only when the monitor said so
    return step if inner.status is Status.CONVERGED or inner.lowest <= _HALF else inner.status
