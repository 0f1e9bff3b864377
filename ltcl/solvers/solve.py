# SPDX-License-Identifier: BSD-3-Clause
"""`solve`: one entrance for every method."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array
from ltcl.errors import ConvergenceError, InputError, InputTypeError
from ltcl.operators import Operator, as_operator
from ltcl.solvers import auto, coefficients, refinement, sampled, units
from ltcl.solvers.bicgstab import BiCGStab
from ltcl.solvers.block_gauss_seidel import BlockGaussSeidel
from ltcl.solvers.cg import CG
from ltcl.solvers.chebyshev import Chebyshev
from ltcl.solvers.direct import Direct
from ltcl.solvers.gauss_seidel import GaussSeidel
from ltcl.solvers.gmres import GMRES
from ltcl.solvers.hybrid import Hybrid
from ltcl.solvers.jacobi import Jacobi
from ltcl.solvers.monte_carlo import MonteCarlo
from ltcl.solvers.neumann import Neumann
from ltcl.solvers.result import Solution, Status
from ltcl.solvers.richardson import Richardson
from ltcl.solvers.sor import SOR
from ltcl.solvers.southwell import Southwell
from ltcl.solvers.stopping import Rule, System

ITERATIVE = {
    method.name: method
    for method in (
        Jacobi,
        Neumann,
        Richardson,
        Chebyshev,
        GaussSeidel,
        SOR,
        BlockGaussSeidel,
        Southwell,
        CG,
        GMRES,
        BiCGStab,
    )
}
SAMPLED = {method.name: method for method in (MonteCarlo, Hybrid)}
METHODS: tuple[str, ...] = (*ITERATIVE, *SAMPLED, Direct.name, "auto")
_MAXITER = 1000


def solve(
    S: Any,
    b: Any,
    method: str = "auto",
    *,
    rtol: float = 1e-2,
    atol: float = 0.0,
    maxiter: int | None = None,
    x0: Any = None,
    callback: Callable[[int, float], object] | None = None,
    throw: bool = True,
    exact: Any = None,
    **options: Any,
) -> Solution:
    """Solve S x = b with products by S only.

    Parameters
    ----------
    S : (N, N) Operator, array, scipy.sparse matrix or LinearOperator
        `T.interreflection` undoes bounces (eq. 7); ``I - A`` adds them (eq. 4): the same call.
    b : (N,) or (N, k)
        k right-hand sides are solved together, each to its own tolerance.
    method : str
        "jacobi", "neumann", "richardson", "chebyshev", "gauss_seidel", "sor",
        "block_gauss_seidel", "southwell", "cg", "gmres", "bicgstab", "monte_carlo",
        "hybrid", "direct" or "auto".
    rtol, atol : float
        Done when ``||b - S x|| <= max(rtol ||b||, atol)`` in every column.
    maxiter : int, optional
        1000 when not given.
    x0 : like b, optional
        Start; zero when not given.
    callback : callable(iteration, relative residual), optional
        Called with every entry of `residuals`, as it is found; of methods that sample also at each step
        of theirs, whose residual is unknown, NaN.
    throw : bool
        Raise where the tolerance is not met; otherwise look at ``.converged``. Not of methods that sample,
        whose noise is no failure: they end CONVERGED or SAMPLED, with ``.standard_error``.
    exact : like S, optional
        What a compressed S stands for: S then makes the steps, and the residual is that of `exact`, for a
        tolerance that S alone cannot keep; see `ltcl.solvers.refinement`.
    **options
        Of the method, for instance ``spectrum=(0.5, 4.0)`` of chebyshev. An unknown one is an error.

    Returns
    -------
    Solution

    Raises
    ------
    InputError, InputTypeError
        Shapes that do not fit, NaN, a tolerance or option out of range, or below what a compressed S is
        worth.
    ConvergenceError
        Divergence or ``maxiter``, with the best iterate in ``.solution``.

    See Also
    --------
    ltcl.solvers.matrix_series, ltcl.solvers.matrix_iteration : the whole inverse at once, eq. 8, 10 and 21

    Notes
    -----
    "auto" factorizes small or precise systems; else it compares the products that methods need, by the row
    sums of S and a survey of three products, and tries others where its choice fails: see ``.reason``.

    ====================  =======================================================================
    method                options: what they are; their defaults
    ====================  =======================================================================
    jacobi, neumann       none
    richardson            omega: damping, above 0; the best for the free bounds
    chebyshev             spectrum: (lower, upper), between which that of S lies; the free bounds
    |                     arnoldi: steps that refine it, 0 or at least 2; 2, or 0 with a spectrum
    gauss_seidel          block: rows of a block, for speed alone
    sor                   omega: in (0, 2); 1. block: as above
    block_gauss_seidel    block: rows solved together; 128
    southwell             rows: relaxed in one step; a 64th of the picture
    cg                    weights: (N,) of the inner product; those of S
    |                     normal: solve S^T S x = S^T b; False
    gmres                 restart: directions of a cycle; 20
    bicgstab              none
    monte_carlo           samples: walks of each pixel; 256. seed: below 2^64; 0
    |                     pixels: (P,) of them to estimate; all. error: standard error wanted
    |                     estimator: "collision" or "endpoint". sampler: "alias", "uniform", "cdf"
    |                     albedo: m of eq. 24. adjoint: walks from b; False
    |                     gather: one exact product at the end; False
    |                     series: "neumann" or "chebyshev". degree: of the latter
    hybrid                samples: columns of each row; 32. seed, sampler, gather: as above
    |                     iterations: of Jacobi; those that rtol asks for
    direct, auto          none
    ====================  =======================================================================

    Examples
    --------
    >>> import ltcl, numpy
    >>> s = ltcl.solve(numpy.array([[1.0, 0.5], [0.5, 1.0]]), numpy.array([1.0, 0.5]), "jacobi")
    >>> s.converged, s.x.round(1).tolist()
    (True, [1.0, 0.0])
    """
    start = time.perf_counter()
    checks.one_of("method", method, METHODS)
    b_host = checks.finite("b", checks.real("b", b))
    shape = _shape(S)
    rule = _rule(shape, b_host, rtol, atol, maxiter, callback)
    guess = _guess(x0, b_host)
    chosen = _method(method, options)
    if exact is not None and method in SAMPLED:
        raise InputTypeError(f"exact= corrects iterates, but method {method!r} samples; leave it out")
    if isinstance(chosen, MonteCarlo):
        chosen.check(shape[0])
    S = as_operator(S)
    if exact is None:
        refinement.refuse_beyond(S, rule, _wanted(b_host, rule))
    else:
        exact = refinement.exact_operator(exact, S)
    solve_it = _automatic if chosen is None else functools.partial(_run, chosen)
    solution = solve_it(S, b_host, guess, rule, exact)
    solution = dataclasses.replace(solution, seconds=time.perf_counter() - start)
    if throw and solution.status not in (Status.CONVERGED, Status.SAMPLED):
        raise ConvergenceError(str(solution), solution)
    return solution


def _shape(S: Any) -> tuple[int, ...]:
    """The shape of whatever was given for S, before it becomes an operator on a device."""
    if isinstance(S, (tuple, list)) and any(isinstance(part, Operator) for part in S):
        raise InputTypeError(f"S is {len(S)} operators, one per colour channel; it must be one: solve each")
    if hasattr(S, "interreflection"):
        raise InputTypeError(
            f"S is a {type(S).__name__}; give its interreflection operator, T.interreflection"
        )
    return getattr(S, "shape", None) or checks.real("S", S).shape


def _rule(
    shape: tuple[int, ...], b: np.ndarray, rtol: float, atol: float, maxiter: int | None, callback: Any
) -> Rule:
    if len(shape) != 2 or shape[0] != shape[1]:
        raise InputError(f"S has shape {shape}; it must be square, (N, N)")
    rows = shape[0]
    if b.ndim not in (1, 2) or b.shape[0] != rows or b.size == 0:
        raise InputError(f"b has shape {b.shape}; it must be ({rows},) or ({rows}, k)")
    largest = float(np.max(np.abs(b)))
    if largest > float(np.finfo(np.float32).max):
        raise InputError(f"b reaches {largest:.3g}; it must be within float32, at most 3.4e+38")
    rtol = checks.number("rtol", rtol, least=0.0, below=1.0)
    atol = checks.number("atol", atol, least=0.0)
    if rtol == 0.0 and atol == 0.0:
        raise InputError("rtol and atol are both 0; one of them must be positive")
    if callback is not None and not callable(callback):
        raise InputTypeError(f"callback is {callback!r}; it must be callable(iteration, relative residual)")
    return Rule(rtol, atol, _MAXITER if maxiter is None else checks.count("maxiter", maxiter), callback)


def _guess(x0: Any, b: np.ndarray) -> np.ndarray | None:
    if x0 is None:
        return None
    return checks.shape("x0", checks.finite("x0", checks.real("x0", x0)), b.shape)


def _method(name: str, options: dict[str, Any]) -> Any:
    """The method with its options, None of "auto"; an unknown option is named, with those there are."""
    if name == "auto":
        if options:
            raise InputTypeError(f"unknown option {next(iter(options))!r}; name a method to give it options")
        return None
    kind = Direct if name == Direct.name else (ITERATIVE | SAMPLED)[name]
    known = [field.name for field in dataclasses.fields(kind)]
    for option in options:
        if option not in known:
            has = f"has {', '.join(known)}" if known else "has none"
            raise InputTypeError(f"unknown option {option!r}; method {name!r} {has}")
    return kind(**options)


def _automatic(
    S: Operator, b: np.ndarray, guess: np.ndarray | None, rule: Rule, exact: Operator | None
) -> Solution:
    """The first method of the plan that converges, else the best iterate; all products are counted."""
    attempts: list[Solution] = []
    reasons, products = [], 0
    wanted = min(_wanted(b, rule), 0.5) if exact is None else refinement.step_tolerance(S)
    for choice in auto.plan(S, wanted, 1 if b.ndim == 1 else b.shape[1]):
        reasons.append(choice.why)
        attempts.append(_run(choice.method, S, b, guess, rule, exact))
        products += choice.products + attempts[-1].products
        if attempts[-1].converged:
            break
        reasons.append(f"{attempts[-1].method} ended {attempts[-1].status.name.lower()}")
    best = attempts[-1] if attempts[-1].converged else min(attempts, key=lambda one: one.residual)
    return dataclasses.replace(best, products=products, reason="; ".join(filter(None, reasons)))


def _wanted(b: np.ndarray, rule: Rule) -> float:
    """The relative residual that all columns have to reach; infinite where all are dark."""
    norms = np.linalg.norm(b.astype(np.float64), axis=0)
    wanted = np.maximum(rule.rtol, rule.atol / np.where(norms > 0.0, norms, 1.0))
    return float(np.min(np.where(norms > 0.0, wanted, np.inf)))


def _run(
    method: Any,
    S: Operator,
    b: np.ndarray,
    guess: np.ndarray | None,
    rule: Rule,
    exact: Operator | None = None,
) -> Solution:
    if isinstance(method, Direct) and exact is None:
        return _run_direct(method, S, b, rule)
    unit = units.of(b)
    rule = dataclasses.replace(rule, atol=rule.atol / unit)
    light, first = (None if part is None else S.device.upload(part / unit) for part in (b, guess))
    assert light is not None  # noqa: S101 - b is not
    if isinstance(method, MonteCarlo | Hybrid):
        return _run_sampled(method, System(S, light), first, rule, unit)
    if exact is None:
        x, monitor = coefficients.iterate(method, S, light, first, rule)
    else:
        x, monitor = refinement.iterate(method, S, exact, light, first, rule)
    assert monitor.status is not None  # noqa: S101 - iterate returns only when the monitor said so
    return Solution(
        units.restored(x.get(), unit),
        monitor.status,
        monitor.iterations,
        monitor.system.products,
        tuple(monitor.residuals),
        0.0,
        method.name,
        lowest=monitor.lowest,
    )


def _run_sampled(method: Any, system: System, guess: Array | None, rule: Rule, unit: np.ndarray) -> Solution:
    x, r = coefficients.start(system, guess)
    found = method.estimate(system, x.get().astype(np.float64), r, rule, unit)
    return sampled.solution(method, system, found, rule, functools.partial(units.restored, unit=unit))


def _run_direct(method: Direct, S: Operator, b: np.ndarray, rule: Rule) -> Solution:
    b = b.astype(np.float64)
    try:
        x, residual = method.solve(S, b)
    except np.linalg.LinAlgError:
        return Solution(np.zeros(b.shape), Status.BREAKDOWN, 0, 0, (1.0,), 0.0, method.name)
    norms = np.linalg.norm(b, axis=0)
    left = np.linalg.norm(residual, axis=0)
    relative = float(np.max(left / np.where(norms > 0, norms, 1.0)))
    met = np.all(left <= np.maximum(rule.rtol * norms, rule.atol))
    if rule.callback is not None:
        rule.callback(0, 1.0)
        rule.callback(1, relative)
    return Solution(x, Status.CONVERGED if met else Status.STAGNATED, 1, 0, (1.0, relative), 0.0, method.name)
