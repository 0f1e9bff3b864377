# SPDX-License-Identifier: BSD-3-Clause
"""`solve`: one entrance for every method.

Its steps: validate, scale each right-hand side to a unit of its own, choose the method, run it, unscale.

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
from ltcl.solvers.chebyshev import Chebyshev
from ltcl.solvers.gmres import GMRES
from ltcl.solvers.hybrid import Hybrid
from ltcl.solvers.monte_carlo import Channel, MonteCarlo, check_method, of_channel
from ltcl.solvers.precision import Direct
from ltcl.solvers.relaxation import SOR, BlockGaussSeidel, GaussSeidel, Southwell
from ltcl.solvers.result import Solution, Status, joined
from ltcl.solvers.stationary import Jacobi, Neumann, Richardson
from ltcl.solvers.stopping import CLAIM, Rule

_SWEEPS = (GaussSeidel, SOR, BlockGaussSeidel, Southwell)
ITERATIVE = {
    kind.name: kind for kind in (Jacobi, Neumann, Richardson, Chebyshev, *_SWEEPS, CG, GMRES, BiCGStab)
}
SAMPLED = {kind.name: kind for kind in (MonteCarlo, Hybrid)}
KINDS: dict[str, Any] = {**ITERATIVE, **SAMPLED, Direct.name: Direct}
METHODS: tuple[str, ...] = (*KINDS, "auto")

_MAXITER = 1000
_ROWS = 256  # of a narrow array side by side: NumPy reduces long rows thirty times as fast as short ones
_LARGEST, _NORMAL = float(np.finfo(np.float32).max), 2.0**-126


@dataclasses.dataclass(frozen=True)
class _Problem:
    """S x = b with b (N,) or (N, k) on the host, the start (None for zero) and `rule`, all in units `unit`.

    `required` is the relative residual that all columns have to reach; `exact` is what a compressed S stands
    for; `method` is None of "auto"; the residual comes back `with_residual` where the method has it.
    """

    S: Operator
    b: np.ndarray
    x0: np.ndarray | None
    rule: Rule
    unit: np.ndarray
    required: float
    method: Any
    exact: Operator | None
    with_residual: bool = False


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
        What a compressed S stands for, ``T.interreflection`` of the uncompressed T: S then makes the steps,
        and the residual is that of `exact`, for a tolerance that S alone cannot keep: any down to 1e-6 by
        products in float32, and below that, to about 1e-15, in float64 where the numbers of `exact` are at
        hand. See `ltcl.solvers.refinement`.
    **options
        Of the method, for instance ``spectrum=(0.5, 4.0)`` of chebyshev. An unknown one is an error.

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
    ltcl.solvers.matrix_series, ltcl.solvers.matrix_iteration : the whole inverse at once, eq. 8, 10 and 21

    Notes
    -----
    Every tolerance is judged by the numbers that were given, those of a float64 array in float64.

    "auto" factorizes small or precise systems; else it compares the times that methods need, by the row
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
    |                     pixels: (P,) of them to estimate; all. error: standard error wanted,
    |                     in units of x; the last samples of a pixel are then at most 2^20
    |                     estimator: "collision" or "endpoint". sampler: "alias", "uniform"
    |                     albedo: m of eq. 24. adjoint: walks from b, without pixels, error,
    |                     sampler and estimator="collision"; False
    |                     gather: one exact product at the end; False
    hybrid                samples: columns of each row; 32. seed, sampler, gather: as above
    |                     iterations: of Jacobi; those that rtol asks for
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
    if checks.one_of("method", method, METHODS) and _is_colour(S):
        return joined(_in_colour(S, b, method, **settings, **options))
    return _solve(S, b, method, throw, **settings, **options)


def _solve(
    S: Any, b: Any, method: str, throw: bool = True, with_residual: bool = False, **settings: Any
) -> Solution:
    """`solve` of one S."""
    start = time.perf_counter()
    problem = dataclasses.replace(_validate(S, b, method, **settings), with_residual=with_residual)
    with np.errstate(all="ignore"):  # what leaves its range ends the solve, with a status
        solution = _automatic(problem) if problem.method is None else _attempt(problem.method, problem)
    solution = dataclasses.replace(solution, seconds=time.perf_counter() - start)
    if throw and solution.status not in (Status.CONVERGED, Status.SAMPLED):
        raise ConvergenceError(str(solution), solution)
    return solution


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

    `parts` are b of each, (N,) or (N, k); `exact` is that of each, where there is one; `settings` are those
    of `solve`, but for x0. `with_residual` asks for b - S x where it costs little.
    """
    exacts = exact or [None] * len(systems)
    if len(systems) == 1 or method not in SAMPLED or any(one is not None for one in exacts):
        checks.one_of("method", method, METHODS)
        settings["with_residual"] = with_residual
        each = zip(systems, parts, exacts, strict=True)
        return tuple(_solve(S, b, method, exact=E, **settings) for S, b, E in each)
    settings.pop("throw", None)  # noise is no failure
    return _in_colour(systems, np.stack(parts), method, **settings)


def _is_colour(S: Any) -> bool:
    """Whether S is Operators, one per colour channel; several matrices that are none are refused."""
    several = isinstance(S, (tuple, list)) and len(S) > 0
    if several and any(isinstance(part, Operator) for part in S):
        return True
    if several and all(len(getattr(part, "shape", ())) == 2 for part in S):
        raise InputTypeError(
            f"S is {len(S)} matrices; of three colour channels it must be three Operators, such as "
            "T.interreflection"
        )
    return False


def _in_colour(
    systems: Sequence[Operator], b: Any, method: str, *, x0: Any = None, **settings: Any
) -> tuple[Solution, ...]:
    """Three channels by samples that they share."""
    start, n = time.perf_counter(), len(systems)
    if method not in SAMPLED or n != 3:
        raise InputTypeError(f"S is {n} operators, one per colour channel; it must be one: solve each")
    shapes = [_shape(S) for S in systems]
    if len(set(shapes)) > 1:
        raise InputError(f"S is operators of shapes {shapes}; all must be the same")
    rows = shapes[0][0]
    parts = _channels("b", b, rows)
    guesses = [None] * n if x0 is None else _channels("x0", x0, rows)
    _validate(systems[0], np.zeros(rows), method, **settings)  # what all channels share
    problems = [
        of_channel(c, _validate, *one, method, x0=guess, **settings)
        for c, (*one, guess) in enumerate(zip(systems, parts, guesses, strict=True))
    ]
    solutions = _sample(problems[0].method, problems)
    seconds = time.perf_counter() - start
    return tuple(dataclasses.replace(solution, seconds=seconds) for solution in solutions)


def _channels(name: str, value: Any, rows: int) -> np.ndarray:
    array = checks.real(name, value)
    if array.ndim not in (2, 3) or array.shape[:2] != (3, rows):
        raise InputError(
            f"{name} has shape {array.shape}; of three S it must be (3, {rows}) or (3, {rows}, k)"
        )
    return array


def _shape(S: Any) -> tuple[int, ...]:
    """The shape of S before it becomes an operator on a device."""
    if hasattr(type(S), "interreflection"):
        raise InputTypeError(
            f"S is a {type(S).__name__}; give its interreflection operator, T.interreflection"
        )
    shape = getattr(S, "shape", None) or checks.real("S", S).shape
    if len(shape) != 2 or shape[0] != shape[1]:
        raise InputError(f"S has shape {shape}; it must be square, (N, N)")
    return shape


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
    **options: Any,
) -> _Problem:
    """Refuse bad input before anything is uploaded; b, x0 and atol in units of each column."""
    b = checks.finite("b", checks.real("b", b))
    n = _shape(S)[0]
    if b.ndim not in (1, 2) or b.shape[0] != n or b.size == 0:
        raise InputError(f"b has shape {b.shape}; it must be ({n},) or ({n}, k)")
    size = max(float(np.max(b)), -float(np.min(b)))
    if size > _LARGEST:
        raise InputError(f"b reaches {size:.3g}; it must be within float32, at most 3.4e+38")
    rtol = checks.number("rtol", rtol, least=0.0, below=1.0)
    atol = checks.number("atol", atol, least=0.0)
    if rtol == 0.0 and atol == 0.0:
        raise InputError("rtol and atol are both 0; one of them must be positive")
    if callback is not None and not callable(callback):
        raise InputTypeError(f"callback is {callback!r}; it must be callable(iteration, relative residual)")
    maxiter = _MAXITER if maxiter is None else checks.count("maxiter", maxiter)
    if x0 is not None:
        x0 = checks.shape("x0", checks.finite("x0", checks.real("x0", x0)), b.shape)
    chosen = _method(method, options)
    if exact is not None and method in SAMPLED:
        raise InputTypeError(f"exact= corrects iterates, but method {method!r} samples; leave it out")
    if isinstance(chosen, MonteCarlo):
        chosen.check(n)
    b, unit = scale_rhs(b)
    rule = Rule(rtol, atol / unit if atol else 0.0, maxiter, callback)
    required = _required(b, rule)
    A = precision.operator(S)
    if exact is not None:
        exact = refinement.exact_operator(exact, A)
    elif required < A.solution_error:  # says less about the solution than S itself
        also = f" and atol {atol:g}" if atol else ""
        raise InputError(
            f"rtol is {rtol:g}{also}; S is compressed and its solutions may be off by "
            f"{checks.upwards(A.solution_error)}: ask for no less, or give exact=T, the uncompressed one"
        )
    return _Problem(A, b, None if x0 is None else x0 / unit, rule, unit, required, chosen, exact)


def _method(name: str, options: dict[str, Any]) -> Any:
    """The method with its options, None of "auto"; an unknown option is named, with those there are."""
    check_method(name, options, SAMPLED)
    known = [] if name == "auto" else [field.name for field in dataclasses.fields(KINDS[name])]
    for option in options:
        if name == "auto":
            raise InputTypeError(f"unknown option {option!r}; name a method to give it options")
        if option not in known:
            has = f"has {', '.join(known)}" if known else "has none"
            raise InputTypeError(f"unknown option {option!r}; method {name!r} {has}")
    return None if name == "auto" else KINDS[name](**options)


def _required(b: np.ndarray, rule: Rule) -> float:
    """The relative residual that all columns have to reach; infinite where all are dark."""
    if not np.any(rule.atol):
        return rule.rtol if np.any(b) else np.inf
    norms = np.linalg.norm(b.astype(np.float64), axis=0)
    least = np.maximum(rule.rtol, rule.atol / np.where(norms > 0.0, norms, 1.0))
    return float(np.min(np.where(norms > 0.0, least, np.inf)))


def _automatic(problem: _Problem) -> Solution:
    """The first method of the plan that converges, else the best iterate; all products are counted."""
    attempts: list[Solution] = []
    reasons, products, S = [], 0, problem.S
    target = min(problem.required, 0.5)
    if problem.exact is None and target < auto.PRECISE and S.shape[0] > auto.LARGEST_DIRECT:
        if precision.product(S) is None:
            raise ToleranceError(
                f"rtol is {target:g}, less than float32 products tell of S, whose numbers are on the device "
                f"alone and whose N = {S.shape[0]} is too large to factorize; it must be at least 1e-06",
                auto.PRECISE,
            )
        problem = dataclasses.replace(problem, exact=S)
        reasons.append(f"refined in float64, since rtol={target:g} is below what float32 products reach")
    if problem.exact is not None:
        target = refinement.step_tolerance(S)
    for choice in auto.plan(S, target, problem.b[0].size):
        reasons.append(choice.why)
        products += choice.products
        try:
            attempts.append(_attempt(choice.method, problem))
        except (MemoryLimitError, InputError) as error:  # no room, or no transpose
            if not attempts:
                raise
            reasons.append(f"{choice.method.name} failed: {error}")
            continue
        products += attempts[-1].products
        if attempts[-1].converged:
            break
        reasons.append(f"{attempts[-1].method} ended {attempts[-1].status.name.lower()}")
    best = attempts[-1] if attempts[-1].converged else min(attempts, key=lambda one: one.residual)
    return dataclasses.replace(best, products=products, reason="; ".join(filter(None, reasons)))


def _attempt(method: Any, problem: _Problem) -> Solution:
    """One method, by itself."""
    if method.name in SAMPLED:
        return _sample(method, [problem])[0]
    if isinstance(method, Direct) and problem.exact is None:
        return _factorize(method, problem)
    S, b, x0, rule = problem.S, problem.b, problem.x0, problem.rule
    more = {}
    if problem.exact is None:
        guess = None if x0 is None else S.device.upload(x0)
        right = S.device.upload(b)
        x, monitor, left = refinement.iterate(method, S, right, guess, rule, b, problem.with_residual)
        x = x.get()
        if left is not None:
            more["rest"] = unscale(left.get(), problem.unit)
    else:
        x, monitor = refinement.refine(method, S, problem.exact, b, x0, rule, problem.required)
    assert monitor.status is not None  # noqa: S101 - iterate returns only when the monitor said so
    counts = monitor.iterations, monitor.system.products
    history = tuple(monitor.residuals)
    return _solution(problem, method, x, monitor.status, *counts, history, lowest=monitor.lowest, **more)


def _factorize(method: Direct, problem: _Problem) -> Solution:
    """Claimed where the residual is within the tolerance with all that rounding of float64 may hide."""
    b, rule = problem.b.astype(np.float64), problem.rule
    try:
        x, left, hidden = method.solve(problem.S, b)
    except np.linalg.LinAlgError:
        return _solution(problem, method, np.zeros(b.shape), Status.BREAKDOWN, 0, 0, (1.0,))
    norms = np.linalg.norm(b, axis=0)
    limit = np.maximum(rule.rtol * norms, rule.atol)
    relative = float(np.max(left / np.where(norms > 0.0, norms, 1.0)))
    claimed = np.all(left <= limit) and np.all(left + hidden <= CLAIM * limit)
    if rule.callback is not None:
        rule.callback(0, 1.0)
        rule.callback(1, relative)
    status = Status.CONVERGED if claimed else Status.STAGNATED
    return _solution(problem, method, x, status, 1, 0, (1.0, relative))


def _sample(method: Any, problems: Sequence[_Problem]) -> list[Solution]:
    """A method that samples, on colour channels of one size at once; one solution a channel."""
    channels = []
    for one in problems:
        upload, x0 = one.S.device.upload, one.x0
        guess = None if x0 is None else upload(x0)
        channels.append(
            Channel(one.S, upload(one.b), guess, min(one.required, 1.0), one.unit, one.rule.maxiter)
        )
    solutions = []
    for one, found in zip(problems, method.sample(channels, problems[0].rule.callback), strict=True):
        unknown, error = bool(np.isnan(found.residual)), found.standard_error  # of some pixels alone
        solution = _solution(
            one,
            method,
            found.x,
            Status.CONVERGED if found.converged else Status.SAMPLED,
            found.iterations,
            found.products,
            (np.nan,) if unknown else (1.0, found.residual),
            reason=found.reason,
            lowest=np.inf if unknown else found.residual,  # of x, be it worse than the start
            standard_error=None if error is None else unscale(error, one.unit),
        )
        solutions.append(solution)
    return solutions


def _solution(problem: _Problem, method: Any, x: np.ndarray, *facts: Any, **more: Any) -> Solution:
    """With x in the units of the caller; `facts` are the status, iterations, products and residuals."""
    return Solution(unscale(x, problem.unit), *facts, seconds=0.0, method=method.name, **more)


# Right-hand sides are in units of their own, powers of two, so that squares of any light stay in float32.
_ROWS = 256  # of a narrow array side by side: NumPy reduces long rows thirty times as fast as short ones


def scale_rhs(b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """b in a unit near the largest value of each column, float32 where it is so already; and the units."""
    sizes = _largest(b)
    unit = np.exp2(np.floor(np.log2(np.where(sizes > 0.0, sizes, 1.0))))
    return b / (unit.astype(np.float32) if _in_float32(b, unit) else unit), unit


def unscale(x: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """x times its unit: float32 where x is and where that holds all of it, else float64.

    >>> (
    ...     unscale(np.float32([1.5, 0.0]), np.float64(4.0)).dtype,
    ...     unscale(np.float32([1.5]), np.float64(1e-40)).dtype,
    ... )
    (dtype('float32'), dtype('float64'))
    """
    if _in_float32(x, unit):
        with np.errstate(all="ignore"):
            result = x * unit.astype(np.float32)
        sizes = np.abs(result)
        small = np.min(sizes) < _NORMAL and np.any((sizes < _NORMAL) & (x != 0.0))  # flushed, or may be
        if np.max(sizes) <= _LARGEST and not small:
            return result
    return x * unit


def _largest(b: np.ndarray) -> np.ndarray:
    """The largest size of each column, float64, NaN where it holds one; of both ends, without a copy of b."""
    if b.ndim == 2 and b.shape[0] >= 2 * _ROWS:
        whole = b.shape[0] // _ROWS * _ROWS
        folded = b[:whole].reshape(-1, _ROWS * b.shape[1])
        ends = [end(folded, axis=0).reshape(_ROWS, -1) for end in (np.max, np.min)]
        b = np.concatenate([*ends, b[whole:]])
    most, least = np.max(b, axis=0), np.min(b, axis=0)
    return np.maximum(most.astype(np.float64), -least.astype(np.float64))


def _in_float32(x: np.ndarray, unit: np.ndarray) -> bool:
    """Whether x is float32, and the units are normal numbers of it."""
    return x.dtype == np.float32 and bool(np.all(unit >= _NORMAL))
