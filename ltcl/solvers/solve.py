# SPDX-License-Identifier: BSD-3-Clause
"""`solve`: one entrance for every method."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import ConvergenceError, InputError, InputTypeError
from ltcl.operators import Operator, as_operator
from ltcl.solvers import refinement, sampled, units
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
from ltcl.solvers.result import Solution, Status, joined
from ltcl.solvers.richardson import Richardson
from ltcl.solvers.run import Problem, automatic, run, sample, wanted
from ltcl.solvers.sor import SOR
from ltcl.solvers.southwell import Southwell
from ltcl.solvers.stopping import Rule

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
        and the residual is that of `exact`, for a tolerance that S alone cannot keep; see
        `ltcl.solvers.refinement`.
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
    |                     pixels: (P,) of them to estimate; all. error: standard error wanted,
    |                     in units of x; the last samples of a pixel are then at most 2^20
    |                     estimator: "collision" or "endpoint". sampler: "alias", "uniform", "cdf"
    |                     albedo: m of eq. 24. adjoint: walks from b, without pixels, error,
    |                     sampler and estimator="collision"; False
    |                     gather: one exact product at the end; False
    |                     series: "neumann" or "chebyshev". degree: of the latter
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
    start = time.perf_counter()
    checks.one_of("method", method, METHODS)
    settings = {"rtol": rtol, "atol": atol, "maxiter": maxiter, "x0": x0, "callback": callback}
    settings["exact"] = exact
    _refuse_matrices(S)
    if _is_several(S):
        return joined(_in_colour(S, b, method, **settings, **options))
    chosen, given = _checked(S, b, method, **settings, **options)
    solution = automatic(given) if chosen is None else run(chosen, given)
    solution = dataclasses.replace(solution, seconds=time.perf_counter() - start)
    if throw and solution.status not in (Status.CONVERGED, Status.SAMPLED):
        raise ConvergenceError(str(solution), solution)
    return solution


@refinement.of_a_task()
def solve_each(
    systems: Sequence[Operator],
    parts: Sequence[np.ndarray],
    method: str = "auto",
    *,
    exact: Sequence[Operator | None] = (),
    **settings: Any,
) -> tuple[Solution, ...]:
    """One solution a colour channel, as `solve` gives; methods that sample take walks that all three share.

    `parts` are b of each, (N,) or (N, k); `exact` is that of each, where there is one; `settings` are those
    of `solve`, but for x0. Refusals advise the ``exact=`` of a task.
    """
    judges = exact or [None] * len(systems)
    if len(systems) == 1 or method not in SAMPLED or any(judge is not None for judge in judges):
        each = zip(systems, parts, judges, strict=True)
        return tuple(solve(S, b, method, exact=E, **settings) for S, b, E in each)
    settings.pop("throw", None)  # noise is no failure
    return _in_colour(systems, np.stack(parts), method, **settings)


def _in_colour(
    systems: Sequence[Operator], b: Any, method: str, *, x0: Any = None, **settings: Any
) -> tuple[Solution, ...]:
    start, n = time.perf_counter(), len(systems)
    if method not in SAMPLED or n != 3:
        raise InputTypeError(f"S is {n} operators, one per colour channel; it must be one: solve each")
    shapes = [_shape(S) for S in systems]
    if len(set(shapes)) > 1:
        raise InputError(f"S is operators of shapes {shapes}; all must be the same")
    parts = _channels("b", b, shapes[0][0])
    guesses = [None] * n if x0 is None else _channels("x0", x0, shapes[0][0])
    _checked(systems[0], np.zeros(shapes[0][:1]), method, **settings)  # what all channels share
    checked = [
        sampled.of_channel(c, _checked, *one, method, x0=guess, **settings)
        for c, (*one, guess) in enumerate(zip(systems, parts, guesses, strict=True))
    ]
    found = sample(checked[0][0], [given for _, given in checked])
    seconds = time.perf_counter() - start
    return tuple(dataclasses.replace(solution, seconds=seconds) for solution in found)


def _channels(name: str, value: Any, rows: int) -> np.ndarray:
    array = checks.real(name, value)
    if array.ndim not in (2, 3) or array.shape[:2] != (3, rows):
        raise InputError(
            f"{name} has shape {array.shape}; of three S it must be (3, {rows}) or (3, {rows}, k)"
        )
    return array


def _checked(
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
) -> tuple[Any, Problem]:
    """The method, None of "auto", and what it is to solve; nothing was uploaded where it is refused."""
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
        refinement.refuse_beyond(S, rule, wanted(b_host, rule))
    else:
        exact = refinement.exact_operator(exact, S)
    return chosen, Problem(S, b_host, guess, rule, exact)


def _is_several(S: Any) -> bool:
    return isinstance(S, (tuple, list)) and any(isinstance(part, Operator) for part in S)


def _refuse_matrices(S: Any) -> None:
    several = isinstance(S, (tuple, list)) and S and not _is_several(S)
    if several and all(len(getattr(part, "shape", ())) == 2 for part in S):
        raise InputTypeError(
            f"S is {len(S)} matrices; of three colour channels it must be three Operators, such as "
            "T.interreflection"
        )


def _shape(S: Any) -> tuple[int, ...]:
    """The shape of whatever was given for S, before it becomes an operator on a device."""
    if hasattr(type(S), "interreflection"):
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
    largest = float(np.max(units.largest(b)))
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
    sampled.check_method(name, options, SAMPLED)
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
