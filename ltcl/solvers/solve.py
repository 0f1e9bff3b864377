# SPDX-License-Identifier: BSD-3-Clause
"""`solve`: validate, scale right-hand sides, choose a method, run it, unscale.

A method is a frozen dataclass whose fields are its options, with `name`, and `iterate(system, x, r, monitor)`
or, where it draws random numbers, `sample(channels, callback)`; `Direct` solves at once.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import ConvergenceError, InputError, InputTypeError, MemoryLimitError, ToleranceError
from ltcl.operators import Operator
from ltcl.solvers import auto, precision, refinement
from ltcl.solvers.bicgstab import BiCGStab
from ltcl.solvers.cg import CG
from ltcl.solvers.gmres import GMRES
from ltcl.solvers.monte_carlo import Channel, Hybrid, MonteCarlo, of_channel
from ltcl.solvers.precision import Direct
from ltcl.solvers.relaxation import SOR, BlockGaussSeidel, GaussSeidel, Southwell
from ltcl.solvers.result import Solution, Status, joined
from ltcl.solvers.stationary import Chebyshev, Jacobi, Neumann, Richardson
from ltcl.solvers.stopping import CLAIM, Rule

_SWEEPS = (GaussSeidel, SOR, BlockGaussSeidel, Southwell)
ITERATIVE = {
    kind.name: kind for kind in (Jacobi, Neumann, Richardson, Chebyshev, *_SWEEPS, CG, GMRES, BiCGStab)
}
SAMPLED = {kind.name: kind for kind in (MonteCarlo, Hybrid)}
KINDS: dict[str, Any] = {**ITERATIVE, **SAMPLED, Direct.name: Direct}
METHODS: tuple[str, ...] = (*KINDS, "auto")

_MAXITER = 1000
_LARGEST, _NORMAL = float(np.finfo(np.float32).max), 2.0**-126


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
        `T.interreflection` undoes bounces (eq. 7); ``I - A`` adds them (eq. 4): the same call. Of a T in
        colour those are three Operators, which "monte_carlo" and "hybrid" take together.
    b : (N,) or (N, k), or (3, N) or (3, N, k) of three S
        k right-hand sides are solved together, each to its own tolerance.
    method : str
        One of the table below.
    rtol, atol : float
        Done when ``||b - S x|| <= max(rtol ||b||, atol)`` in every column, judged by the numbers that were
        given, those of a float64 array in float64.
    maxiter : int, optional
        1000 when not given.
    x0 : like b, optional
        Start; zero when not given.
    callback : callable(iteration, relative residual), optional
        Called with every entry of `residuals`, as it is computed; of methods that sample also at each step
        of theirs, whose residual is unknown, NaN.
    throw : bool
        Raise where the tolerance is not met; otherwise look at ``.converged``. Not of methods that sample,
        whose noise is no failure: they end CONVERGED or SAMPLED, with ``.standard_error``.
    exact : like S, optional
        What a compressed S stands for, ``T.interreflection`` of the uncompressed T: S makes the steps of an
        iterative refinement, and the residual is that of `exact`. Any tolerance down to 1e-6 is reached by
        products in float32, and down to about 1e-15 in float64 where the numbers of `exact` are at hand.
    **options
        Of the method; an unknown one is an error.

    Returns
    -------
    Solution
        x is like b; of ``pixels=`` (P,) or (P, k), with an infinite `residual`, which nobody knows then.

    Raises
    ------
    InputError, InputTypeError
        Shapes that do not fit, NaN, a tolerance or option out of range, or below what a compressed S is
        worth.
    ToleranceError
        A tolerance below what float32 keeps of an S that is too large to factorize.
    ConvergenceError
        Divergence or ``maxiter``, with the best iterate in ``.solution``.

    See Also
    --------
    ltcl.solvers.matrix_series : the whole inverse at once, eq. 8 and 10

    Notes
    -----
    "auto" factorizes small systems; else it compares the times that methods need, by the row sums of S and
    a survey of three products, and tries others where its choice fails: see ``.reason``. Below rtol = 1e-6
    its choice takes the steps of a refinement in float64.

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
    gmres                 restart: directions of a cycle; 20
    bicgstab              none
    monte_carlo           samples: walks of each pixel; 256. seed: below 2^64; 0
    |                     pixels: (P,) of them to estimate; all. error: standard error wanted,
    |                     in units of x; the last samples of a pixel are then at most 2^20
    |                     albedo: m of eq. 24. adjoint: walks from b, without pixels and
    |                     error; False
    |                     gather: one exact product at the end; False
    hybrid                samples: columns of each row; 32. seed, gather: as above
    direct, auto          none
    ====================  =======================================================================

    Right-hand sides share the random walks of monte_carlo; hybrid has no standard error.

    Examples
    --------
    >>> import ltcl, numpy
    >>> s = ltcl.solve(numpy.array([[1.0, 0.5], [0.5, 1.0]]), numpy.array([1.0, 0.5]), "jacobi")
    >>> s.converged, s.x.round(1).tolist()
    (True, [1.0, 0.0])
    """
    settings = dict(rtol=rtol, atol=atol, maxiter=maxiter, x0=x0, callback=callback, exact=exact)  # noqa: C408
    checks.one_of("method", method, METHODS)
    if isinstance(S, (tuple, list)) and any(isinstance(channel, Operator) for channel in S):
        return joined(_in_colour(S, b, method, **settings, **options))
    return _solve(S, b, method, throw, **settings, **options)


def solve_each(
    systems: Sequence[Operator],
    parts: Sequence[np.ndarray],
    method: str = "auto",
    *,
    exact: Sequence[Operator | None] = (),
    with_residual: bool = False,
    **settings: Any,
) -> tuple[Solution, ...]:
    """One solution a colour channel, as `solve` gives; methods that sample take walks that all three share.

    `parts` are b of each and `exact` theirs, where there is one; `settings` are those of `solve`, but for x0.
    `with_residual` asks for b - S x where it costs little.
    """
    exacts = exact or [None] * len(systems)
    if len(systems) == 1 or method not in SAMPLED or any(one is not None for one in exacts):
        checks.one_of("method", method, METHODS)
        settings["with_residual"] = with_residual
        each = zip(systems, parts, exacts, strict=True)
        return tuple(_solve(S, b, method, exact=E, **settings) for S, b, E in each)
    settings.pop("throw", None)  # noise is no failure
    return _in_colour(systems, np.stack(parts), method, **settings)


def _solve(S: Any, b: Any, method: str, throw: bool = True, **settings: Any) -> Solution:
    """`solve` of one S."""
    start = time.perf_counter()
    with np.errstate(all="ignore"):  # what leaves its range ends the solve, with a status
        problem = _validate(S, b, method, **settings)
        solution = _automatic(problem) if problem.method is None else _attempt(problem.method, problem)
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
        raise InputTypeError(f"S is {n} operators, one per colour channel; it must be one: solve each")
    shapes = [precision.shape("S", S) for S in systems]
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
    b, n = checks.finite("b", checks.real("b", b)), precision.shape("S", S)[0]
    if b.ndim not in (1, 2) or b.shape[0] != n or b.size == 0:
        raise InputError(f"b has shape {b.shape}; it must be ({n},) or ({n}, k)")
    rtol = checks.number("rtol", rtol, least=0.0, below=1.0)
    atol = checks.number("atol", atol, least=0.0)
    if rtol == 0.0 and atol == 0.0:
        raise InputError("rtol is 0; it must be above 0 and below 1, or atol above 0")
    if callback is not None and not callable(callback):
        raise InputTypeError(f"callback is {callback!r}; it must be callable(iteration, relative residual)")
    maxiter = _MAXITER if maxiter is None else checks.count("maxiter", maxiter)
    if x0 is not None:
        x0 = checks.shape("x0", checks.finite("x0", checks.real("x0", x0)), b.shape)
    kind = KINDS.get(method)  # None of "auto"
    for option in options:
        owners = [name for name, other in KINDS.items() if option in other.__dataclass_fields__]
        if not owners:
            has = ", ".join(kind.__dataclass_fields__ if kind else ()) or "none"
            raise InputTypeError(f"unknown option {option!r}; method {method!r} has {has}")
        if method not in owners:
            several = " or ".join(map(repr, owners))
            raise InputTypeError(f"option {option!r} is one of method={several}, but method is {method!r}")
    chosen = kind(**options) if kind else None
    if exact is not None and method in SAMPLED:
        raise InputTypeError(f"exact= corrects iterates, but method {method!r} samples; leave it out")
    if isinstance(chosen, MonteCarlo):
        chosen.check(n)
    b, unit = scale_rhs(b)
    rule = Rule(rtol, atol / unit if atol else 0.0, maxiter, callback)
    required = _required(b, rule)
    A = S if isinstance(S, Operator) else precision.operator(S)
    if exact is not None:
        exact = refinement.exact_operator(exact, A)
    elif required < A.solution_error:  # says less about the solution than S itself
        also = f" and atol {atol:g}" if atol else ""
        raise InputError(
            f"rtol is {rtol:g}{also}; S is compressed and its solutions may be off by "
            f"{checks.upwards(A.solution_error)}: ask for no less, or give exact=T, the uncompressed one"
        )
    x0 = None if x0 is None else np.where(np.any(b, axis=0), x0 / unit, 0.0)  # no light: x = 0 is exact
    return _Problem(A, b, x0, rule, unit, required, chosen, exact, with_residual)


def _required(b: np.ndarray, rule: Rule) -> float:
    """The relative residual that all columns have to reach; infinite where all are dark."""
    if not np.any(rule.atol):
        return rule.rtol if np.any(b) else np.inf
    norms = np.atleast_1d(np.linalg.norm(b.astype(np.float64), axis=0))
    lit = norms > 0.0
    return float(np.min((rule.target(norms) / np.where(lit, norms, 1.0))[lit], initial=np.inf))


def _automatic(problem: _Problem) -> Solution:
    """The first method of the plan that converges, else the best iterate; all products are counted."""
    attempts: list[Solution] = []
    reasons: list[str] = []
    failure: Exception | None = None
    products, S = 0, problem.S
    target = min(problem.required, 0.5)
    if problem.exact is None and target < auto.PRECISE and S.shape[0] > auto.SMALL:
        if precision.product(S) is not None:
            problem = dataclasses.replace(problem, exact=S)
            reasons.append(f"refined in float64, since rtol={target:g} is below what float32 products reach")
        elif S.shape[0] > auto.LARGEST_DIRECT:
            raise ToleranceError(
                f"rtol is {target:g}, less than float32 products tell of S, whose numbers are on the device "
                f"alone and whose N = {S.shape[0]} is too large to factorize; it must be at least 1e-06",
                auto.PRECISE,
            )
    if problem.exact is not None:
        target = refinement.step_tolerance(S)
    for method, why, made in auto.plan(S, target, problem.b[0].size):
        reasons.append(why)
        products += made
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
    if failure is not None and not attempts:
        raise failure
    best = attempts[-1] if attempts[-1].converged else min(attempts, key=lambda one: one.residual)
    return dataclasses.replace(best, products=products, reason="; ".join(reasons))


def _attempt(method: Any, problem: _Problem) -> Solution:
    """One method, by itself."""
    if method.name in SAMPLED:
        return _sample(method, [problem])[0]
    if isinstance(method, Direct) and problem.exact is None:
        return _factorize(method, problem)
    S, b, x0, rule = problem.S, problem.b, problem.x0, problem.rule
    rest = None
    if problem.exact is None:
        guess, right = None if x0 is None else S.device.upload(x0), S.device.upload(b)
        x, monitor, left = refinement.iterate(method, S, right, guess, rule, b, problem.with_residual)
        x, rest = x.get(), left and unscale(left.get(), problem.unit)
    else:
        x, monitor = refinement.refine(method, S, problem.exact, b, x0, rule, problem.required)
    facts = monitor.status, monitor.iterations, monitor.system.products, tuple(monitor.residuals)
    return problem.solution(method, x, *facts, lowest=monitor.lowest, rest=rest)


def _factorize(method: Direct, problem: _Problem) -> Solution:
    """Claimed where the residual is within the tolerance with all that rounding of float64 may hide."""
    b, rule = problem.b.astype(np.float64), problem.rule
    try:
        x, left, hidden = method.solve(problem.S, b)
    except np.linalg.LinAlgError:
        status, residual = (Status.BREAKDOWN, 1.0) if np.any(b) else (Status.CONVERGED, 0.0)
        return problem.solution(method, np.zeros(b.shape), status, 0, 0, (residual,))
    norms = np.linalg.norm(b, axis=0)
    limit = rule.target(norms)
    relative = float(np.max(left / np.where(norms > 0.0, norms, 1.0)))
    claimed = np.all(left <= limit) and np.all(left + hidden <= CLAIM * limit)
    if rule.callback is not None:
        rule.callback(0, 1.0)
        rule.callback(1, relative)
    status = Status.CONVERGED if claimed else Status.STAGNATED
    least = None if claimed else float(np.max((left + hidden) / np.where(norms > 0.0, norms, 1.0)))
    return problem.solution(method, x, status, 1, 0, (1.0, relative), least_rtol=least)


def _sample(method: Any, problems: Sequence[_Problem]) -> list[Solution]:
    """A method that samples, on colour channels of one size at once; one solution a channel."""
    channels = [
        Channel(method.name, one.S, one.b, one.x0, min(one.required, 1.0), one.unit, one.rule.maxiter)
        for one in problems
    ]
    solutions = []
    for one, estimate in zip(problems, method.sample(channels, problems[0].rule.callback), strict=True):
        error = estimate.standard_error
        error = None if error is None else unscale(error, one.unit)
        x = unscale(estimate.x, one.unit)
        solutions.append(dataclasses.replace(estimate, x=x, standard_error=error))
    return solutions


def scale_rhs(b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """b in units near the largest value of each column, float32 where it is so already; and the units.

    They are powers of two, so that squares of any light stay in float32 and no digit is lost.
    """
    columns = b.reshape(len(b), -1).T  # one by one: NumPy reduces an axis of few columns ten times as slowly
    sizes = np.array([max(float(np.max(one)), -float(np.min(one))) for one in columns]).reshape(b.shape[1:])
    unit = np.exp2(np.floor(np.log2(np.where(sizes > 0.0, sizes, 1.0))))
    is_float32 = b.dtype == np.float32 and np.all(unit >= _NORMAL)
    return b / (unit.astype(np.float32) if is_float32 else unit), unit


def unscale(x: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """x times its unit: float32 where x is and where that holds all of it, else float64."""
    if x.dtype == np.float32 and np.all(unit >= _NORMAL):
        with np.errstate(all="ignore"):
            result = x * unit.astype(np.float32)
        sizes = np.abs(result)
        if np.max(sizes) <= _LARGEST and not np.any((sizes < _NORMAL) & (x != 0.0)):  # flushed, or may be
            return result
    return x * unit
