# SPDX-License-Identifier: BSD-3-Clause
"""Dense LU of S (N, N) in float64, by LAPACK: O(N^3) once per operator, O(N^2) per solve.

Convergence is claimed where the residual is within the tolerance after all that rounding of
float64 may hide is added.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import scipy.linalg

from ltcl import checks
from ltcl.device import Array
from ltcl.errors import MemoryLimitError
from ltcl.operators import Operator
from ltcl.solvers import precision
from ltcl.solvers.method import Method
from ltcl.solvers.problem import LinearProblem, unscale
from ltcl.solvers.refinement import Correction, refine
from ltcl.solvers.result import Solution, Status
from ltcl.solvers.stopping import CLAIM_LIMIT, relative_residual

_getrf, _gecon = scipy.linalg.get_lapack_funcs(("getrf", "gecon"), dtype=np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Factorization:
    """P S = L U.

    `hidden` is what rounding may hide of a residual, relative to the norm of x.
    """

    matrix: np.ndarray
    lu: np.ndarray
    pivots: np.ndarray
    hidden: float


@dataclass(frozen=True, kw_only=True, eq=False)
class DirectSolution:
    """x in float64, the norms (k,) of b - S x, and what rounding may hide of them, (k,)."""

    x: np.ndarray
    norms: np.ndarray
    hidden: np.ndarray


@dataclass(frozen=True)
class Direct(Method):
    """Dense LU factorization. No options."""

    name: ClassVar[str] = "direct"

    def solve(self, problem: LinearProblem) -> Solution:
        """Solve by one substitution, or refine the solutions of a compressed S."""
        if problem.exact is not None:
            return refine(self, problem, problem.exact)
        b = problem.b.astype(np.float64)
        substituted = substitute(problem.S, b)
        if substituted is None:
            return self._without_factors(problem)

        rule = problem.rule
        norms = np.linalg.norm(b, axis=0)
        largest = substituted.norms + substituted.hidden
        limit = rule.target(norms)
        is_within = bool(np.all(substituted.norms <= limit))
        is_claimed = is_within and bool(np.all(largest <= CLAIM_LIMIT * limit))
        residuals = 1.0, relative_residual(substituted.norms, norms)
        if rule.callback is not None:
            for iteration, residual in enumerate(residuals):
                rule.callback(iteration, residual)
        solution = Solution(
            x=unscale(substituted.x, problem.unit),
            status=Status.CONVERGED,
            iterations=1,
            products=0,
            residuals=residuals,
            method=self.name,
        )
        if is_claimed:
            return solution
        least_rtol = relative_residual(largest, norms)
        return dataclasses.replace(solution, status=Status.STAGNATED, least_rtol=least_rtol)

    def _without_factors(self, problem: LinearProblem) -> Solution:
        """Return x = 0 for a singular S, which solves the system if there is no light."""
        is_dark = not np.any(problem.b)
        return Solution(
            x=np.zeros(problem.b.shape),
            status=Status.CONVERGED if is_dark else Status.BREAKDOWN,
            iterations=0,
            products=0,
            residuals=(0.0,) if is_dark else (1.0,),
            method=self.name,
        )

    def correct(self, S: Operator, r: Array, tolerance: float, maxiter: int) -> Correction:
        """Solve S d = r to the precision of float64, whatever the tolerance."""
        substituted = substitute(S, r.get())
        if substituted is None:
            return Correction(failure=Status.BREAKDOWN)
        return Correction(step=substituted.x)


def substitute(S: Operator, b: np.ndarray) -> DirectSolution | None:
    """Solve S x = b with the factors of S; None if S is singular to working precision."""
    factors = factorize(S)
    if factors is None:
        return None
    with np.errstate(all="ignore"):
        # LAPACK's wrapper shifts the pivots while it runs; each thread works on a copy.
        lu_and_pivots = factors.lu, factors.pivots.copy()
        x = scipy.linalg.lu_solve(lu_and_pivots, b.astype(np.float64), check_finite=False)
        hidden = factors.hidden * np.linalg.norm(x, axis=0)
        norms = np.linalg.norm(b - factors.matrix @ x, axis=0)
    return DirectSolution(x=x, norms=np.atleast_1d(norms), hidden=np.atleast_1d(hidden))


def factorize(S: Operator) -> Factorization | None:
    """Return the factors of S, computed once; None if S is singular to working precision."""
    if S.known.factorization is None:
        S.known.factorization = _compute_factors(S)
    return S.known.factorization


def _compute_factors(S: Operator) -> Factorization | None:
    n = S.shape[0]
    nbytes = 3 * 8 * n * n
    purpose = f"method='direct' factorizes S densely, which for N = {n}"
    checks.fits_host(purpose, nbytes)
    try:
        matrix, is_exact = S.matrix_float64()
        with np.errstate(all="ignore"):
            one_norm = np.linalg.norm(matrix, 1)
            inf_norm = np.linalg.norm(matrix, np.inf)
            lu, pivots, info = _getrf(matrix)
            rcond, _ = _gecon(lu, one_norm)
    except MemoryLimitError:
        raise
    except MemoryError as error:
        raise MemoryLimitError(
            f"{purpose} needs {checks.size(nbytes)}, more than the host gives"
        ) from error
    # A condition number of NaN is refused, too.
    if info != 0 or not rcond >= np.finfo(np.float64).eps:
        return None
    # Bounds of the 2-norm: the geometric mean of the 1-norm and the inf-norm, and Frobenius'.
    norm = min(math.sqrt(one_norm * inf_norm), float(np.linalg.norm(matrix)))
    rounding = precision.UNIT_FLOAT64 if is_exact else precision.UNIT
    return Factorization(matrix=matrix, lu=lu, pivots=pivots, hidden=rounding * norm)
