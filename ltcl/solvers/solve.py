# SPDX-License-Identifier: BSD-3-Clause
"""`solve`: check the request, run the method that is named or chosen, measure the time.

The methods are those of the tuples `METHODS` of their files. Each solves a `LinearProblem`
(`ltcl.solvers.method`).
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import ConvergenceError, InputError, InputTypeError
from ltcl.interop.calls import Differentiable
from ltcl.operators import Operator
from ltcl.solvers import chebyshev, krylov, relaxation, stationary
from ltcl.solvers.auto import solve_automatically
from ltcl.solvers.derivative import SolutionDerivative
from ltcl.solvers.direct import Direct
from ltcl.solvers.hybrid import Hybrid
from ltcl.solvers.joined import may_join, solve_joined
from ltcl.solvers.method import Method
from ltcl.solvers.monte_carlo import MonteCarlo
from ltcl.solvers.problem import LinearProblem, SolveSettings, check_square, naming_channel
from ltcl.solvers.result import Solution, Status, join_channels
from ltcl.solvers.sampling import Sampler

_ITERATIVE_METHODS = (
    *stationary.METHODS,
    *chebyshev.METHODS,
    *relaxation.METHODS,
    *krylov.METHODS,
)
ITERATIVE = {method.name: method for method in _ITERATIVE_METHODS}
SAMPLED = {method.name: method for method in (MonteCarlo, Hybrid)}
KINDS: dict[str, Any] = {**ITERATIVE, **SAMPLED, Direct.name: Direct}
METHODS: tuple[str, ...] = (*KINDS, "auto")


def _option_names(kind: Any) -> list[str]:
    return [field.name for field in dataclasses.fields(kind) if field.init]


# Names of the options of each method.
OPTIONS = {name: _option_names(kind) for name, kind in KINDS.items()}


def _derivative(S: Any, b: Any, method: str, **options: Any) -> SolutionDerivative:
    if isinstance(KINDS.get(method), type) and issubclass(KINDS[method], Sampler):
        raise InputTypeError(
            f"method is {method!r}, which samples and has no derivative; take another one for b "
            "whose derivative is asked for"
        )
    return SolutionDerivative(S, b, solve, method, options)


@checks.takes_arrays("b", "x0", differentiable=Differentiable(("b",), _derivative))
def solve(
    S: Any,
    b: Any,
    method: str | Method = "auto",
    *,
    rtol: float = SolveSettings.rtol,
    atol: float = SolveSettings.atol,
    maxiter: int | None = None,
    x0: Any = None,
    callback: Callable[[int, float], object] | None = None,
    throw: bool = True,
    exact: Any = None,
    **options: Any,
) -> Solution:
    """Solve S x = b by products with S only.

    Parameters
    ----------
    S : (N, N) Operator, array, scipy.sparse matrix or LinearOperator
        `T.interreflection` undoes bounces (eq. 7); ``I - A`` adds them (eq. 4): the same call. For
        a T in colour these are three Operators, which "monte_carlo" and "hybrid" take together.
    b : (N,) or (N, k), or (3, N) or (3, N, k) for three S
        k right-hand sides are solved together, each to its own tolerance.
    method : str or Method
        A name of the table below, or a method of your own (`examples/solver.py`).
    rtol, atol : float
        Done when ``||b - S x|| <= max(rtol ||b||, atol)`` in every column. The numbers that were
        given decide, in float64 if the array is float64.
    maxiter : int, optional
        1000 when not given.
    x0 : like b, optional
        Start; zero when not given.
    callback : callable(iteration, relative residual), optional
        Called with every entry of `residuals`, and at each step of a method that samples, with NaN.
    throw : bool
        Raise if the tolerance is not met; otherwise look at ``.converged``. The noise of methods
        that sample is no failure: they end CONVERGED or SAMPLED, with ``.standard_error``.
    exact : like S, optional
        The operator that a compressed S stands for, ``T.interreflection`` of the uncompressed T. S
        computes the steps of an iterative refinement, and `exact` the residual. Down to 1e-6 by
        products in float32, and to about 1e-15 in float64 if the host has the numbers of `exact`.
    **options
        Options of the method, as in the table below.

    Returns
    -------
    Solution
        x is like b. With ``pixels=`` it is (P,) or (P, k), and the `residual` is infinite, since it
        is unknown.

    Raises
    ------
    InputError, InputTypeError
        Shapes that do not fit, NaN, a tolerance or option out of range, or below the error of a
        compressed S.
    ToleranceError
        A tolerance below the precision of float32 for an S that is too large to factorize.
    ConvergenceError
        Divergence or ``maxiter``, with the best iterate in ``.solution``.

    Notes
    -----
    "auto" factorizes small systems; else the row sums of S decide, or "gmres" is tried. At the
    second solve, or if that fails, a survey of three products shows what takes the least time: see
    ``.reason``. Below rtol = 1e-6 its choice computes the steps of a refinement in float64.
    `ltcl.solvers.matrix_series` inverts S.

    ====================  =======================================================================
    method                options: meaning; defaults
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
    if maxiter is None:
        maxiter = SolveSettings.maxiter
    settings = SolveSettings(
        rtol=rtol,
        atol=atol,
        maxiter=maxiter,
        callback=callback,
        throw=throw,
    )
    chosen = choose_method(method, options)
    if isinstance(S, (tuple, list)) and any(isinstance(channel, Operator) for channel in S):
        if not isinstance(chosen, Sampler) or len(S) != 3:
            raise InputTypeError(
                f"S is {len(S)} operators, one per colour channel; it must be one: solve each"
            )
        return join_channels(_solve_together(S, b, chosen, settings, x0=x0, exact=exact))
    return _solve_one(S, b, chosen, settings, x0=x0, exact=exact)


def solve_each(
    systems: Sequence[Operator],
    sides: Sequence[np.ndarray],
    method: str = "auto",
    *,
    exact: Sequence[Operator | None] = (),
    x0: Any = None,
    rtol: float = SolveSettings.rtol,
    atol: float = SolveSettings.atol,
    maxiter: int | None = None,
    callback: Callable[[int, float], object] | None = None,
    throw: bool = True,
    with_residual: bool = False,
    **options: Any,
) -> tuple[Solution, ...]:
    """Solve one system a colour channel; methods that sample take walks that all three share.

    The arguments are those of `ltcl.solve`, with one `exact` a channel.

    Parameters
    ----------
    systems : sequence of (N, N) Operator
    sides : sequence of (N,) or (N, k)
    with_residual : bool
        Keep b - S x in `Solution.rest`, where it costs little.

    Returns
    -------
    tuple of Solution

    Examples
    --------
    >>> from ltcl.operators import as_operator
    >>> solutions = solve_each([as_operator([[2.0]]), as_operator([[4.0]])], [[1.0], [1.0]])
    >>> [solution.x.tolist() for solution in solutions]
    [[0.5], [0.25]]
    """
    if maxiter is None:
        maxiter = SolveSettings.maxiter
    settings = SolveSettings(
        rtol=rtol,
        atol=atol,
        maxiter=maxiter,
        callback=callback,
        throw=throw,
        with_residual=with_residual,
    )
    chosen = choose_method(method, options)
    exacts = list(exact)
    if not exacts:
        exacts = [None] * len(systems)
    has_exact = any(operator is not None for operator in exacts)
    if isinstance(chosen, Sampler) and len(systems) == 3 and not has_exact:
        return _solve_together(systems, np.stack(sides), chosen, settings, x0=x0)
    if chosen is None and not has_exact and may_join(systems, sides, settings, x0):
        start = time.perf_counter()
        joined = solve_joined(systems, sides, settings)
        if joined is not None:
            seconds = time.perf_counter() - start
            return tuple(dataclasses.replace(s, seconds=seconds) for s in joined)
    solutions = []
    for S, b, channel_exact in zip(systems, sides, exacts, strict=True):
        solutions.append(_solve_one(S, b, chosen, settings, x0=x0, exact=channel_exact))
    return tuple(solutions)


def choose_method(name: str | Method, options: dict[str, Any]) -> Method | None:
    """Return the method with its options, checked; None for "auto", which has none."""
    if isinstance(name, Method):
        if options:
            own_options = ", ".join(options)
            raise InputTypeError(
                f"options of a method of your own are its fields; got {own_options}"
            )
        return name
    checks.one_of("method", name, METHODS)
    for option in options:
        owners = [owner for owner, names in OPTIONS.items() if option in names]
        if not owners:
            known = OPTIONS.get(name)
            listed = "none"
            if known:
                listed = ", ".join(known)
            raise InputTypeError(f"unknown option {option!r}; method {name!r} has {listed}")
        if name not in owners:
            several = " or ".join(map(repr, owners))
            raise InputTypeError(
                f"option {option!r} is one of method={several}, but method is {name!r}"
            )
    return KINDS[name](**options) if name in KINDS else None


def _check_sampler(method: Method | None, rows: int, exact: Any) -> None:
    """Refuse what does not fit a method that samples."""
    if not isinstance(method, Sampler):
        return
    if exact is not None:
        raise InputTypeError(
            f"exact= corrects iterates, but method {method.name!r} samples; leave it out"
        )
    method.check_size(rows)


def _solve_one(
    S: Any, b: Any, method: Method | None, settings: SolveSettings, *, x0: Any, exact: Any
) -> Solution:
    """Solve one system, and raise if it fails and the settings ask for that."""
    start = time.perf_counter()
    _check_sampler(method, check_square("S", S)[0], exact)
    # Numbers that leave their range end the solve with a status.
    with np.errstate(all="ignore"):
        problem = LinearProblem.from_arrays(S, b, settings, x0=x0, exact=exact)
        if method is None:
            solution = solve_automatically(problem)
        else:
            solution = method.solve(problem)
    solution = dataclasses.replace(solution, seconds=time.perf_counter() - start)
    if settings.throw and solution.status not in (Status.CONVERGED, Status.SAMPLED):
        raise ConvergenceError(str(solution), solution)
    return solution


def _solve_together(
    systems: Sequence[Any],
    b: Any,
    method: Sampler,
    settings: SolveSettings,
    *,
    x0: Any = None,
    exact: Any = None,
) -> tuple[Solution, ...]:
    """Solve three channels by samples that they share; noise is no failure."""
    start = time.perf_counter()
    shapes = [check_square("S", S) for S in systems]
    if len(set(shapes)) > 1:
        raise InputError(f"S is operators of shapes {shapes}; all must be the same")
    rows = shapes[0][0]
    _check_sampler(method, rows, exact)
    b = _check_three("b", b, rows)
    starts: Any = [None] * len(systems)
    if x0 is not None:
        starts = _check_three("x0", x0, rows)
    problems = []
    with np.errstate(all="ignore"):
        for number, S in enumerate(systems):
            with naming_channel(number):
                problem = LinearProblem.from_arrays(S, b[number], settings, x0=starts[number])
            problems.append(problem)
        solutions = method.solve_channels(problems)
    seconds = time.perf_counter() - start
    return tuple(dataclasses.replace(solution, seconds=seconds) for solution in solutions)


def _check_three(name: str, value: Any, rows: int) -> np.ndarray:
    """Return pictures of three channels, (3, rows) or (3, rows, k)."""
    array = checks.real(name, value)
    if array.ndim not in (2, 3) or array.shape[:2] != (3, rows):
        allowed = f"(3, {rows}) or (3, {rows}, k)"
        raise InputError(f"{name} has shape {array.shape}; for three S it must be {allowed}")
    return array
