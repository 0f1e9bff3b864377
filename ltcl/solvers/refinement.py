# SPDX-License-Identifier: BSD-3-Clause
"""Where a solve runs, on coefficients or pixels, and iterative refinement, where an exact S judges.

Of S = I + W^T C W in an orthonormal basis W, S x = b is (I + C) a = W b with x = W^T a: two transforms in
all, where pixels take two for every product. Where W has but some coefficients of such a basis, S is the
identity on the rest of b, and x = b + W^T (a - W b). `cg` with weights, diagonal in pixels alone, runs there.

Where S~ is a compressed S, S~ solves and S judges:

    x^(k+1) = x^(k) + S~^-1 (b - S x^(k))

With S~ = S + E and each solve to a tolerance t, the error shrinks by about ||S~^-1 E|| + t a step (Higham,
Accuracy and Stability of Numerical Algorithms, 2nd ed., chapter 12). x is float64 on the host; so are
residuals where the numbers of S are at hand and a product with them is cheap, or float32 could not tell.
Iterations are steps of refinement, and products those by S and by S~ together.
"""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np

from ltcl.device import Array, vectors
from ltcl.errors import InputError
from ltcl.operators import Compressed, IdentityPlus, Operator
from ltcl.solvers import precision
from ltcl.solvers.cg import CG
from ltcl.solvers.precision import Direct
from ltcl.solvers.result import Status
from ltcl.solvers.stopping import Monitor, Rule, System

_FLOAT32 = 2.0**-20  # relative residual, below which float32 products are left
_LEAST, _MOST = 1e-3, 0.1  # of the tolerance of a step: many short steps waste products by S, long ones by S~
_HALF = 0.5  # of a residual: a solve that ended early but left no more is a step, too


def exact_operator(exact: Any, S: Operator) -> Operator:
    """`exact` on the device of S, checked."""
    if (shape := precision.shape("exact", exact)) != S.shape:
        raise InputError(f"exact has shape {shape}; it must be that of S, {S.shape}")
    E = precision.operator(exact, S.device)
    if E.device is not S.device:
        raise InputError(f"exact is on another device, {E.device}; it must be on {S.device}")
    return E


def step_tolerance(S: Operator) -> float:
    """Relative residual of the solves with S~: no smaller than what S~ is worth."""
    return min(max(S.solution_error, _LEAST), _MOST)


_on_coefficients: weakref.WeakKeyDictionary[IdentityPlus, IdentityPlus] = weakref.WeakKeyDictionary()


def iterate(
    method: Any,
    S: Operator,
    b: Array,
    guess: Array | None,
    rule: Rule,
    host: np.ndarray | None = None,
    with_residual: bool = False,
) -> tuple[Array, Monitor, Array | None]:
    """x in pixels of S x = b by an iterative method, what watched it, and b - S x where that is wanted.

    `host` is b before it became float32; `guess` is None for zero.
    """
    W, right = None, b
    weighted = isinstance(method, CG) and method.inner(S) is not None
    if isinstance(S, IdentityPlus) and isinstance(S.R, Compressed) and S.R.two_sided and not weighted:
        W, core = S.R.into, S.R.core
        if S not in _on_coefficients:  # what is learnt of it serves all solves
            inside = _on_coefficients[S] = IdentityPlus(core, S.sign)
            inside.weights, inside._row_sums = S.weights, S.row_sums()  # in pixels these bound the spectrum
        S = _on_coefficients[S]
    if W is None:
        norms = vectors.norms(b)
    else:
        right, guess, host = W.apply(b), guess and W.apply(guess), None
        norms = vectors.norms(b, right)
    system = System(S, right, norms[0], host, on_coefficients=W is not None)
    if guess is None:  # whose residual is b and costs no product
        x, r, first = vectors.fill(right.like(), 0.0), right.copy(), norms[-1]
    else:
        x, r = guess, right.like()
        first = system.residual(x, r)
    monitor = Monitor(system, rule)
    if not monitor.check(x, r, first[None]):
        method.iterate(system, x, r, monitor)
    x = monitor.result(x)
    left = r if with_residual and monitor.status is Status.CONVERGED else None
    if W is None:
        return x, monitor, left
    left = left and W.apply_transpose(left)
    if W.orthonormal:
        return W.apply_transpose(x), monitor, left
    return W.apply_transpose(vectors.axpby(1.0, x, -1.0, right, x.like()), add=b), monitor, left


def refine(
    method: Any,
    S: Operator,
    exact: Operator,
    b: np.ndarray,
    guess: np.ndarray | None,
    rule: Rule,
    required: float,
) -> tuple[np.ndarray, Monitor]:
    """Refine solutions of S~ x = b, `S` being S~, until `exact` finds the `required` relative residual."""
    right = S.device.upload(b)
    system = System(exact, right, vectors.norm(right), b)
    system.fine = (precision.is_small(exact) or required < _FLOAT32) and system.times is not None
    if guess is None:
        x, r, norms = np.zeros(b.shape), right.copy(), system.norms
    else:
        x, r = guess.astype(np.float64), right.like()
        norms = system.residual(x, r)
    monitor = Monitor(system, rule)
    while not monitor.check(x, r, norms[None]):
        tolerance = min(max(step_tolerance(S), _HALF * monitor.left), _MOST)
        step = _step(method, S, r, Rule(tolerance, 0.0, rule.maxiter), system)
        if isinstance(step, Status):
            monitor.status = step
            break
        x = x + step
        norms = system.residual(x, r)
    x = monitor.result(x)
    return (x if system.fine else x.astype(np.float32)), monitor


def _step(method: Any, S: Operator, r: Array, rule: Rule, system: System) -> np.ndarray | Status:
    """S~^-1 r, or why there is none."""
    if isinstance(method, Direct):
        try:
            return method.solve(S, r.get())[0]
        except np.linalg.LinAlgError:
            return Status.BREAKDOWN
    step, inner, _ = iterate(method, S, r, None, rule)
    system.products += inner.system.products
    assert inner.status is not None  # noqa: S101 - iterate returns only when the monitor said so
    return step.get() if inner.status is Status.CONVERGED or inner.lowest <= _HALF else inner.status
