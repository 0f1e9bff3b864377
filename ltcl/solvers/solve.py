# SPDX-License-Identifier: BSD-3-Clause
"""`solve`: validate, scale right-hand sides, choose a method, run it, unscale.

A method is a frozen dataclass whose fields are its options, with `name`, and `iterate(system, x, r,
monitor)` or, where it draws random numbers, `sample(channels, callback)`.

Of S = I + W^T C W in an orthonormal basis W, S x = b is (I + C) a = W b with x = W^T a: two
transforms in all. Where W has but some coefficients of such a basis, x = b + W^T (a - W b). `cg`
with weights, diagonal in pixels alone, runs there.

Where an exact S judges, a compressed S~ = S + E makes the steps of an iterative refinement,

    x^(k+1) = x^(k) + S~^-1 (b - S x^(k))

With solves to a tolerance t, the error shrinks by about ||S~^-1 E|| + t a step (Higham, 2nd ed., chapter 12).
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.errors import (
    ConvergenceError,
    InputError,
    InputTypeError,
    MemoryLimitError,
    ToleranceError,
)
from ltcl.operators import Operator
from ltcl.operators.conversion import as_exact_operator
from ltcl.solvers import auto, krylov, stationary
from ltcl.solvers.monte_carlo import Channel, Hybrid, MonteCarlo, of_channel
from ltcl.solvers.precision import Direct
from ltcl.solvers.result import Solution, Status, joined
from ltcl.solvers.stopping import CLAIM, Monitor, Rule, System, relative, scale_rhs, unscale

ITERATIVE = {kind.name: kind for kind in (*stationary.METHODS, *krylov.METHODS)}
SAMPLED = {kind.name: kind for kind in (MonteCarlo, Hybrid)}
KINDS: dict[str, Any] = {**ITERATIVE, **SAMPLED, Direct.name: Direct}
METHODS: tuple[str, ...] = (*KINDS, "auto")
OPTIONS = {
    name: [own.name for own in dataclasses.fields(kind) if own.init] for name, kind in KINDS.items()
}

_FLOAT32 = 2.0**-20  # relative residual, below which float32 products are left
_LEAST, _MOST = (
    1e-3,
    0.1,
)  # of the tolerance of a step: many short steps waste products by S, long ones by S~
_HALF = 0.5  # of a residual: a solve that ended early but left no more is a step, too


@dataclasses.dataclass(frozen=True)
class _Problem:
    """S x = b with b (N,) or (N, k) on the host, the start (None for zero) and `rule`, all in units `unit`.

    `required` is the relative residual that all columns have to reach; `method` is None of "auto".
    """

    S: Operator
    b: np.ndarray
    x0: np.ndarray | None
    rule: Rule
    unit: np.ndarray
    required: float
    method: Any
    exact: Operator | None
    with_residual: bool

    def solution(self, method: Any, x: np.ndarray, *facts: Any, **more: Any) -> Solution:
        """With x in the units of the caller; `facts` are the status, iterations, products and residuals."""
        return Solution(unscale(x, self.unit), *facts, seconds=0.0, method=method.name, **more)


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
        `T.interreflection` undoes bounces (eq. 7); ``I - A`` adds them (eq. 4): the same call. Of a
        T in colour those are three Operators, which "monte_carlo" and "hybrid" take together.
    b : (N,) or (N, k), or (3, N) or (3, N, k) of three S
        k right-hand sides are solved together, each to its own tolerance.
    method : str
    rtol, atol : float
        Done when ``||b - S x|| <= max(rtol ||b||, atol)`` in every column, judged by the numbers that were
        given, those of a float64 array in float64.
    maxiter : int, optional
        1000 when not given.
    x0 : like b, optional
        Start; zero when not given.
    callback : callable(iteration, relative residual), optional
        Called with every entry of `residuals`, and at each step of a method that samples, with NaN.
    throw : bool
        Raise where the tolerance is not met; otherwise look at ``.converged``. Not of methods that
        sample, whose noise is no failure: they end CONVERGED or SAMPLED, with ``.standard_error``.
    exact : like S, optional
        What a compressed S stands for, ``T.interreflection`` of the uncompressed T: S makes the
        steps of an iterative refinement, and the residual is that of `exact`. Down to 1e-6 by
        products in float32, and to about 1e-15 in float64 where the numbers of `exact` are at hand.
    **options
        Of the method, as in the table below.

    Returns
    -------
    Solution
        x is like b; of ``pixels=`` (P,) or (P, k), with an infinite `residual`, which nobody knows
        then.

    Raises
    ------
    InputError, InputTypeError
        Shapes that do not fit, NaN, a tolerance or option out of range, or below the error of a
        compressed S.
    ToleranceError
        A tolerance below what float32 keeps of an S that is too large to factorize.
    ConvergenceError
        Divergence or ``maxiter``, with the best iterate in ``.solution``.

    Notes
    -----
    "auto" factorizes small systems; else the row sums of S decide, or "gmres" is tried; at the
    second solve, or where it fails, a survey of three products shows what takes the least time: see
    ``.reason``. Below rtol = 1e-6 its choice takes the steps of a refinement in float64.
    `ltcl.solvers.matrix_series` inverts S.

    ====================  =======================================================================
    method                options: what they are; their defaults
    ====================  =======================================================================
    jacobi, neumann       none
    richardson            omega: damping, above 0; the best for the free bounds
    chebyshev             spectrum: (lower, upper), between which that of S lies; the free bounds.
                          arnoldi: steps that refine it, 0 or at least 2; 2, or 0 with a spectrum
    gauss_seidel          block: rows of a block, for speed alone
    sor                   omega: in (0, 2); 1. block: as above
    block_gauss_seidel    block: rows solved together; 128
    southwell             rows: relaxed in one step; a 64th of the picture
    cg                    weights: (N,) of the inner product; those of S
    gmres                 restart: directions of a cycle; 20
    monte_carlo           samples: walks of each pixel; 256. seed: below 2^64; 0.
                          pixels: (P,) of them to estimate; all. error: standard error wanted,
                          in units of x; the last samples of a pixel are then at most 2^20.
                          albedo: m of eq. 24. adjoint: walks from b, without pixels and
                          error; False. gather: one exact product at the end; False
    hybrid                samples: columns of each row; 32. seed, gather: as above
    bicgstab, direct      none; nor has auto
    ====================  =======================================================================

    Examples
    --------
    >>> import ltcl, numpy
    >>> s = ltcl.solve(numpy.array([[1.0, 0.5], [0.5, 1.0]]), numpy.array([1.0, 0.5]), "jacobi")
    >>> s.converged, s.x.round(1).tolist()
    (True, [1.0, 0.0])
    """
    if "with_residual" in options:
        raise InputTypeError("unknown option 'with_residual'; the options are those of the method")
    options |= dict(rtol=rtol, atol=atol, maxiter=maxiter, x0=x0, callback=callback, exact=exact)  # noqa: C408
    checks.one_of("method", method, METHODS)
    if isinstance(S, (tuple, list)) and any(isinstance(channel, Operator) for channel in S):
        return joined(_in_colour(S, b, method, **options))
    return _solve(S, b, method, throw, **options)


def solve_each(
    systems: Sequence[Operator],
    sides: Sequence[np.ndarray],
    method: str = "auto",
    *,
    exact: Sequence[Operator | None] = (),
    with_residual: bool = False,
    **settings: Any,
) -> tuple[Solution, ...]:
    """One solution a colour channel, as `solve` gives; methods that sample take walks that all three share.

    `settings` are those of `solve`, but for x0; `with_residual` asks for b - S x where it costs
    little.
    """
    exacts = exact or [None] * len(systems)
    if len(systems) == 1 or method not in SAMPLED or any(E is not None for E in exacts):
        checks.one_of("method", method, METHODS)
        settings["with_residual"] = with_residual
        each = zip(systems, sides, exacts, strict=True)
        return tuple(_solve(S, b, method, exact=E, **settings) for S, b, E in each)
    settings.pop("throw", None)  # noise is no failure
    return _in_colour(systems, np.stack(sides), method, **settings)


def _solve(S: Any, b: Any, method: str, throw: bool = True, **settings: Any) -> Solution:
    """`solve` of one S."""
    start = time.perf_counter()
    with np.errstate(all="ignore"):  # what leaves its range ends the solve, with a status
        problem = _validate(S, b, method, **settings)
        solution = (
            _automatic(problem) if problem.method is None else _attempt(problem.method, problem)
        )
    solution = dataclasses.replace(solution, seconds=time.perf_counter() - start)
    if throw and solution.status not in (Status.CONVERGED, Status.SAMPLED):
        raise ConvergenceError(str(solution), solution)
    return solution


def _in_colour(
    systems: Sequence[Operator], b: Any, method: str, *, x0: Any = None, **settings: Any
) -> tuple[Solution, ...]:
    """Three channels by samples that they share."""
    start, n = time.perf_counter(), len(systems)
    if method not in SAMPLED or n != 3:
        raise InputTypeError(
            f"S is {n} operators, one per colour channel; it must be one: solve each"
        )
    shapes = [_shape("S", S) for S in systems]
    if len(set(shapes)) > 1:
        raise InputError(f"S is operators of shapes {shapes}; all must be the same")
    rows = shapes[0][0]
    sides = {"b": b} if x0 is None else {"b": b, "x0": x0}
    for name, value in sides.items():
        array = sides[name] = checks.real(name, value)
        if array.ndim not in (2, 3) or array.shape[:2] != (3, rows):
            allowed = f"(3, {rows}) or (3, {rows}, k)"
            raise InputError(f"{name} has shape {array.shape}; of three S it must be {allowed}")
    problems = []
    with np.errstate(all="ignore"):
        _validate(systems[0], np.zeros(rows), method, **settings)  # what all channels share
        for c, S in enumerate(systems):
            own = {name: array[c] for name, array in sides.items()}
            problems.append(of_channel(c, _validate, S, method=method, **own, **settings))
        solutions = _sample(problems[0].method, problems)
    seconds = time.perf_counter() - start
    return tuple(dataclasses.replace(solution, seconds=seconds) for solution in solutions)


def _validate(
    S: Any,
    b: Any,
    method: str,
    *,
    rtol: float = 1e-2,
    atol: float = 0.0,
    maxiter: int | None = None,
    x0: Any = None,
    callback: Any = None,
    exact: Any = None,
    with_residual: bool = False,
    **options: Any,
) -> _Problem:
    """Refuse bad input before anything is uploaded; b, x0 and atol in units of each column."""
    n = _shape("S", S)[0]
    b, unit = scale_rhs(b, n)
    rtol = checks.number("rtol", rtol, least=0.0, below=1.0)
    atol = checks.number("atol", atol, least=0.0)
    if rtol == 0.0 and atol == 0.0:
        raise InputError("rtol is 0; it must be above 0 and below 1, or atol above 0")
    if callback is not None and not callable(callback):
        raise InputTypeError(
            f"callback is {callback!r}; it must be callable(iteration, relative residual)"
        )
    maxiter = 1000 if maxiter is None else checks.count("maxiter", maxiter)
    if x0 is not None:
        x0 = checks.shape("x0", checks.finite("x0", checks.real("x0", x0)), b.shape)
    for option in options:
        owners = [name for name, own in OPTIONS.items() if option in own]
        if not owners:
            has = ", ".join(OPTIONS.get(method, ())) or "none"
            raise InputTypeError(f"unknown option {option!r}; method {method!r} has {has}")
        if method not in owners:
            several = " or ".join(map(repr, owners))
            raise InputTypeError(
                f"option {option!r} is one of method={several}, but method is {method!r}"
            )
    chosen = KINDS[method](**options) if method in KINDS else None  # of "auto"
    if exact is not None and method in SAMPLED:
        raise InputTypeError(
            f"exact= corrects iterates, but method {method!r} samples; leave it out"
        )
    if isinstance(chosen, MonteCarlo):
        chosen.check(n)
    rule = Rule(rtol, atol / unit if atol else 0.0, maxiter, callback)
    required = rtol if np.any(b) else np.inf  # where all columns are dark
    if np.any(b) and atol:
        norms = np.atleast_1d(np.linalg.norm(b.astype(np.float64), axis=0))
        lit = norms > 0.0
        required = float(np.min(rule.target(norms)[lit] / norms[lit], initial=np.inf))
    A = S if isinstance(S, Operator) else as_exact_operator(S)
    if exact is not None:
        exact = _exact_operator(exact, A)
    elif required < A.solution_error:  # says less about the solution than S itself
        also = f" and atol {atol:g}" if atol else ""
        raise InputError(
            f"rtol is {rtol:g}{also}; S is compressed and its solutions may be off by "
            f"{checks.upwards(A.solution_error)}: ask for no less, or give exact=T, the uncompressed one"
        )
    x0 = (
        None if x0 is None else np.where(np.any(b, axis=0), x0 / unit, 0.0)
    )  # no light: x = 0 is exact
    return _Problem(A, b, x0, rule, unit, required, chosen, exact, with_residual)


def _exact_operator(exact: Any, S: Operator) -> Operator:
    """`exact` on the device of S, checked."""
    if (shape := _shape("exact", exact)) != S.shape:
        raise InputError(f"exact has shape {shape}; it must be that of S, {S.shape}")
    E = as_exact_operator(exact, S.device)
    if E.device is not S.device:
        raise InputError(f"exact is on another device, {E.device}; it must be on {S.device}")
    return E


def _shape(name: str, S: Any) -> tuple[int, ...]:
    """The shape of a square S before it becomes an operator on a device."""
    if hasattr(type(S), "interreflection"):  # asked of the object, it would upload
        raise InputTypeError(
            f"{name} is a {type(S).__name__}; give its operator, T.interreflection"
        )
    own = getattr(S, "shape", None) or checks.real(name, S).shape
    if len(own) != 2 or own[0] != own[1]:
        raise InputError(f"{name} has shape {own}; it must be square, (N, N)")
    return own


def _automatic(problem: _Problem) -> Solution:
    """The first method of the plan that converges, else the best iterate; all products are counted."""
    attempts: list[Solution] = []
    reasons: list[str] = []
    failure: Exception | None = None
    products, S = 0, problem.S
    target = min(problem.required, 0.5)
    if problem.exact is None and target < auto.PRECISE and S.shape[0] > auto.SMALL:
        if S.product_float64() is not None:
            problem = dataclasses.replace(problem, exact=S)
            reasons.append(
                f"refined in float64, since rtol={target:g} is below what float32 products reach"
            )
        elif S.shape[0] > auto.LARGEST_DIRECT:
            raise ToleranceError(
                f"rtol is {target:g}, less than float32 products tell of S, whose numbers are on the device "
                f"alone and whose N = {S.shape[0]} is too large to factorize; it must be at least 1e-06",
                auto.PRECISE,
            )
    if problem.exact is not None:
        target = _step_tolerance(S)
    for method, why, surveyed in auto.plan(S, target, problem.b[0].size, problem.exact is not None):
        reasons.append(why)
        products += surveyed
        try:
            attempts.append(_attempt(method, problem))
        except (MemoryLimitError, InputError) as error:  # no room, or no transpose
            if not attempts and isinstance(error, InputError):
                raise
            failure = error
            reasons.append(f"{method.name} failed: {error}")
            continue
        products += attempts[-1].products
        if attempts[-1].converged:
            break
        reasons.append(f"{attempts[-1].method} ended {attempts[-1].status.name.lower()}")
        if attempts[-1].residual < 1.0:  # the next goes on from there
            problem = dataclasses.replace(problem, x0=attempts[-1].x / problem.unit)
    if failure is not None and not attempts:
        raise failure
    best = (
        attempts[-1]
        if attempts[-1].converged
        else min(attempts, key=lambda attempt: attempt.residual)
    )
    return dataclasses.replace(best, products=products, reason="; ".join(reasons))


def _attempt(method: Any, problem: _Problem) -> Solution:
    """One method, by itself."""
    if method.name in SAMPLED:
        return _sample(method, [problem])[0]
    if isinstance(method, Direct) and problem.exact is None:
        return _factorize(method, problem)
    S, x0, rest = problem.S, problem.x0, None
    if problem.exact is None:
        guess, b = None if x0 is None else S.device.upload(x0), S.device.upload(problem.b)
        x, monitor, r = _iterate(
            method, S, b, guess, problem.rule, problem.b, problem.with_residual
        )
        x, rest = x.get(), r and unscale(r.get(), problem.unit)
    else:
        x, monitor = _refine(method, problem, problem.exact)
    facts = monitor.status, monitor.iterations, monitor.system.products, tuple(monitor.residuals)
    return problem.solution(method, x, *facts, lowest=monitor.lowest, rest=rest)


def _iterate(
    method: Any,
    S: Operator,
    b: Array,
    guess: Array | None,
    rule: Rule,
    host: np.ndarray | None = None,
    with_residual: bool = False,
) -> tuple[Array, Monitor, Array | None]:
    """x in pixels of S x = b by an iterative method, what watched it, and b - S x where that is asked for.

    `host` is b before it became float32; `guess` is None for zero.
    """
    W, right = None, b
    weighted = isinstance(method, krylov.CG) and method.inner(S) is not None
    if S.coefficient_basis is not None and not weighted:
        W = S.coefficient_basis
        S = S.on_coefficients()
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
    rest = r if with_residual and monitor.status is Status.CONVERGED else None
    if W is None:
        return x, monitor, rest
    rest = rest and W.apply_transpose(rest)
    if W.orthonormal:
        return W.apply_transpose(x), monitor, rest
    return W.apply_transpose(vectors.axpby(1.0, x, -1.0, right, x.like()), add=b), monitor, rest


def _refine(method: Any, problem: _Problem, exact: Operator) -> tuple[np.ndarray, Monitor]:
    """Refine solutions of S~ x = b, in float64, until `exact` finds the residual required."""
    S, b, rule = problem.S, problem.b, problem.rule
    right = S.device.upload(b)
    system = System(exact, right, vectors.norm(right), b)
    system.fine = (
        exact.has_cheap_float64_product or problem.required < _FLOAT32
    ) and system.times is not None
    x, r, norms = np.zeros(b.shape), right.copy(), system.norms
    if problem.x0 is not None:
        x = problem.x0.astype(np.float64)
        norms = system.residual(x, r)
    monitor = Monitor(system, rule)
    while not monitor.check(x, r, norms[None]):
        if isinstance(method, Direct):
            solved = method.solve(S, r.get())
            step, failure = (x, Status.BREAKDOWN) if solved is None else (solved[0], None)
        else:
            missing = np.divide(problem.required, monitor.residuals[-1])  # infinite of 0
            tolerance = min(max(_step_tolerance(S), _HALF * float(missing)), _MOST)
            light, inner, _ = _iterate(method, S, r, None, Rule(tolerance, 0.0, rule.maxiter))
            system.products += inner.system.products
            step, failure = light.get(), None if inner.lowest <= _HALF else inner.status
        if failure is not None:
            monitor.status = failure
            break
        x = x + step
        norms = system.residual(x, r)
    x = monitor.result(x)
    return (x if system.fine else x.astype(np.float32)), monitor


def _step_tolerance(S: Operator) -> float:
    """Relative residual of the solves with S~: no smaller than what S~ is worth."""
    return min(max(S.solution_error, _LEAST), _MOST)


def _factorize(method: Direct, problem: _Problem) -> Solution:
    """Claimed where the residual is within the tolerance with all that rounding of float64 may hide."""
    b, rule = problem.b.astype(np.float64), problem.rule
    solved = method.solve(problem.S, b)
    if solved is None:
        status, residual = (Status.BREAKDOWN, 1.0) if np.any(b) else (Status.CONVERGED, 0.0)
        return problem.solution(method, np.zeros(b.shape), status, 0, 0, (residual,))
    x, left, hidden = solved
    norms = np.linalg.norm(b, axis=0)
    limit = rule.target(norms)
    claimed = np.all(left <= limit) and np.all(left + hidden <= CLAIM * limit)
    residuals = 1.0, relative(left, norms)
    if rule.callback is not None:
        for iteration, residual in enumerate(residuals):
            rule.callback(iteration, residual)
    status = Status.CONVERGED if claimed else Status.STAGNATED
    least = None if claimed else relative(left + hidden, norms)
    return problem.solution(method, x, status, 1, 0, residuals, least_rtol=least)


def _sample(method: Any, problems: Sequence[_Problem]) -> list[Solution]:
    """A method that samples, on colour channels of one size at once; one solution a channel."""
    channels = [Channel(method.name, problem) for problem in problems]
    solutions = []
    for p, estimate in zip(
        problems, method.sample(channels, problems[0].rule.callback), strict=True
    ):
        error = estimate.standard_error
        error = None if error is None else unscale(error, p.unit)
        solutions.append(
            dataclasses.replace(estimate, x=unscale(estimate.x, p.unit), standard_error=error)
        )
    return solutions
