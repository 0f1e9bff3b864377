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
from ltcl.operators import Operator
from ltcl.solvers import given, refinement, sampled
from ltcl.solvers.methods import METHODS, SAMPLED
from ltcl.solvers.result import Solution, Status, joined
from ltcl.solvers.run import automatic, run, sample


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
        products in float32, and below that, to about 1e-15, in float64 where `exact` has its numbers on the
        host or dense on the device; else the least is told. See `ltcl.solvers.refinement`.
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
    given.refuse_matrices(S)
    if given.is_several(S):
        return joined(_in_colour(S, b, method, **settings, **options))
    chosen, asked = given.problem(S, b, method, **settings, **options)
    solution = automatic(asked) if chosen is None else run(chosen, asked)
    solution = dataclasses.replace(solution, seconds=time.perf_counter() - start)
    if throw and solution.status not in (Status.CONVERGED, Status.SAMPLED):
        raise ConvergenceError(refinement.failure(solution, asked.rule, asked.exact), solution)
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
    shapes = [given.shape_of(S) for S in systems]
    if len(set(shapes)) > 1:
        raise InputError(f"S is operators of shapes {shapes}; all must be the same")
    parts = given.channels("b", b, shapes[0][0])
    guesses = [None] * n if x0 is None else given.channels("x0", x0, shapes[0][0])
    given.problem(systems[0], np.zeros(shapes[0][:1]), method, **settings)  # what all channels share
    checked = [
        sampled.of_channel(c, given.problem, *one, method, x0=guess, **settings)
        for c, (*one, guess) in enumerate(zip(systems, parts, guesses, strict=True))
    ]
    found = sample(checked[0][0], [one for _, one in checked])
    seconds = time.perf_counter() - start
    return tuple(dataclasses.replace(solution, seconds=seconds) for solution in found)
