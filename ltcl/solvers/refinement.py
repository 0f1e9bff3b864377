# SPDX-License-Identifier: BSD-3-Clause
"""Where a solve runs, on coefficients or pixels, and iterative refinement, where an exact S judges.

Of S = I + W^T C W in an orthonormal basis W, S x = b is (I + C) a = W b with x = W^T a: two transforms in
all, where pixels take two for every product. W keeps lengths, so that residuals, tolerances and the spectrum
are those of pixels. Where W has but some coefficients of such a basis, W W^T = I still, S is the identity on
the rest of b, and x = b + W^T (a - W b). Inner products with weights, diagonal in pixels, are not so in
coefficients: `cg` with weights runs in pixels.

Where S~ is a compressed S, S~ solves and S judges:

    x^(k+1) = x^(k) + S~^-1 (b - S x^(k))

With S~ = S + E and each solve to a tolerance t, the error shrinks by about ||S~^-1 E|| + t a step. Below 1,
any tolerance is reached that products by S can tell; otherwise residuals may grow, which the monitor sees
(Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., chapter 12). x is float64 on the host; so
are residuals where the numbers of S are at hand and a product with them is cheap, or float32 could not tell:
that reaches about 1e-15. Iterations are steps of refinement, and products those by S and by S~ together.
"""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.errors import InputError, InputTypeError
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
    if hasattr(type(exact), "interreflection"):  # asked of the object, it would upload
        raise InputTypeError(f"exact is a {type(exact).__name__}; it must be like S: give T.interreflection")
    if isinstance(exact, (tuple, list)) and any(isinstance(part, Operator) for part in exact):
        raise InputTypeError(f"exact is {len(exact)} operators, S is one; give that of the same colour")
    if not hasattr(exact, "shape"):
        checks.real("exact", exact)
    E = precision.operator(exact, S.device)
    if E.shape != S.shape:
        raise InputError(f"exact has shape {E.shape}; it must be that of S, {S.shape}")
    if E.device is not S.device:
        raise InputError(f"exact is on another device, {E.device}; it must be on {S.device}")
    return E


def step_tolerance(S: Operator) -> float:
    """Relative residual of the solves with S~: no smaller than what S~ is worth.

    >>> from ltcl.operators import IdentityPlus, as_operator
    >>> step_tolerance(IdentityPlus(as_operator([[0.5]]), solution_error=0.004))
    0.004
    """
    return min(max(S.solution_error, _LEAST), _MOST)


_entered: weakref.WeakKeyDictionary[IdentityPlus, OnCoefficients] = weakref.WeakKeyDictionary()


class OnCoefficients(IdentityPlus):
    """I + sign C of S = I + sign W^T C W. `row_sums`, which bound the spectrum, are those of S in pixels."""

    def __init__(self, S: IdentityPlus, core: Operator) -> None:
        super().__init__(core, S.sign)
        self.weights = S.weights
        self._row_sums = S.row_sums()


def iterate(
    method: Any,
    S: Operator,
    b: Array,
    guess: Array | None,
    rule: Rule,
    host: np.ndarray | None = None,
    with_residual: bool = False,
) -> tuple[Array, Monitor, Array | None]:
    """Run an iterative method on S x = b; x in pixels, and what watched it.

    `host` is b before it became float32; `guess` is None for zero. Where it converged and that is wanted, the
    residual b - S x comes back, too.
    """
    W, right = None, b
    weighted = isinstance(method, CG) and method.inner(S) is not None
    if isinstance(S, IdentityPlus) and isinstance(S.R, Compressed) and S.R.two_sided and not weighted:
        if S not in _entered:  # what is learnt of it serves all solves
            _entered[S] = OnCoefficients(S, S.R.core)
        W, S = S.R.into, _entered[S]
        assert W is not None  # noqa: S101 - two_sided says so
        right, guess, host = W.apply(b), None if guess is None else W.apply(guess), None
    system = System(S, right, b, host)
    if guess is None:  # whose residual is b and costs no product
        x, r = vectors.fill(right.like(), 0.0), right.copy()
        system.whole_norms, *own = vectors.norms(b) if W is None else vectors.norms(b, right)
        system.start_norms = own[0][None] if own else system.whole_norms[None]
    else:
        x, r = guess, system.residual(guess, right.like())
    monitor = Monitor(system, rule)
    method.iterate(system, x, r, monitor)
    x = monitor.result(x)
    left = r if with_residual and monitor.status is Status.CONVERGED else None
    if W is None:
        return x, monitor, left
    left = left and W.apply_transpose(left)
    if not W.orthonormal:
        return W.apply_transpose(vectors.axpby(1.0, x, -1.0, right, x.like()), add=b), monitor, left
    return W.apply_transpose(x), monitor, left


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
    system = System(exact, S.device.upload(b), host=b)
    system.fine = system.times is not None and (precision.is_small(exact) or required < _FLOAT32)
    if guess is None:
        x, r = np.zeros(b.shape), system.b.copy()
    else:
        x = guess.astype(np.float64)
        r = system.residual(x, system.b.like())
    monitor = Monitor(system, rule)
    while not monitor.check(x, r):
        tolerance = min(max(step_tolerance(S), _HALF * monitor.left), _MOST)
        step = _step(method, S, r, Rule(tolerance, 0.0, rule.maxiter), system)
        if isinstance(step, Status):
            monitor.give_up(step)
            break
        x = x + step
        system.residual(x, r)
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
