# SPDX-License-Identifier: BSD-3-Clause
"""The whole inverse as a series of matrices, the paper's baseline: N^3 operations a term.

    S^-1 = I - R + R^2 - ...   (eq. 10),      (I - A)^-1 = I + A + A^2 + ...   (eq. 8)

The paper's matrix iteration Sinv_k = I - R Sinv_(k-1) (eq. 21) gives the same.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.errors import ConvergenceError
from ltcl.operators import Operator, as_operator
from ltcl.solvers.problem import check_square
from ltcl.solvers.result import Solution, Status
from ltcl.solvers.stopping import GROWTH_LIMIT

# Columns of the series in one product.
COLUMNS_AT_ONCE = 64


def matrix_series(
    S: Any, *, rtol: float = 1e-2, steps: int | None = None, maxiter: int = 1000, throw: bool = True
) -> Solution:
    """Compute S^-1 = I - R + R^2 - ... (eq. 10), or (I - A)^-1 = I + A + A^2 + ... (eq. 8).

    Parameters
    ----------
    S : (N, N) Operator, or anything `solve` takes
        ``T.interreflection`` inverts light transport, ``IdentityPlus(A, sign=-1)`` makes it from
        one bounce.
    rtol : float
        Done when ``||e_j - S x_j|| <= rtol`` for every column x_j.
    steps : int, optional
        Take exactly so many steps and judge nothing; `maxiter` and `throw` are those of `solve`.

    Returns
    -------
    Solution
        `x` is the inverse, (N, N) float32; `products` counts those of N x N matrices, one of them
        for the residual.

    Raises
    ------
    MemoryLimitError, ConvergenceError
        Two N x N iterates do not fit the device; divergence, or `maxiter` reached.

    Examples
    --------
    >>> matrix_series([[1.0, 0.5], [0.5, 1.0]], steps=1).x.tolist()
    [[1.0, -0.5], [-0.5, 1.0]]
    """
    start = time.perf_counter()
    rtol = checks.number("rtol", rtol, above=0.0, below=1.0)
    if steps is None:
        max_steps = checks.count("maxiter", maxiter)
    else:
        max_steps = checks.count("steps", steps, least=0)
    check_square("S", S)
    series = _Series(as_operator(S))

    residuals: list[float] = []
    status = None
    while status is None:
        if residuals:
            series.add_term()
        residuals.append(series.residual())
        if steps is None:
            status = _judge(residuals, rtol)
        if status is None and len(residuals) > max_steps:
            status = Status.MAXITER

    solution = Solution(
        x=series.matrix(),
        status=status,
        iterations=len(residuals) - 1,
        products=len(residuals),
        residuals=tuple(residuals),
        seconds=time.perf_counter() - start,
        method="matrix_series",
    )
    if throw and steps is None and not solution.converged:
        raise ConvergenceError(str(solution), solution)
    return solution


class _Series:
    """Partial sums of the series, and their residuals I - S x, which are the next terms.

    Columns never mix: the device works on some of them at a time.
    """

    def __init__(self, S: Operator) -> None:
        self.S = S
        n = S.shape[0]
        purpose = f"a matrix series for N = {n}, two N x N iterates,"
        S.device.require(2 * 4 * n * n + 4 * n * COLUMNS_AT_ONCE, purpose)
        checks.fits_host(purpose, 2 * 4 * n * n)
        self.sums: list[Array] = []
        self.terms: list[Array] = []
        for first in range(0, n, COLUMNS_AT_ONCE):
            columns = min(COLUMNS_AT_ONCE, n - first)
            identity = S.device.upload(np.eye(n, columns, -first, np.float32))
            self.sums.append(identity)
            self.terms.append(self._next_term(identity))

    def _next_term(self, term: Array) -> Array:
        """Return -R term = term - S term."""
        return self.S.apply(term, scale=-1.0, add=term)

    def add_term(self) -> None:
        """Add the next term to the partial sums."""
        for chunk, term in enumerate(self.terms):
            vectors.axpy(1.0, term, self.sums[chunk])
            self.terms[chunk] = self._next_term(term)

    def residual(self) -> float:
        """Return the largest norm of a column of I - S x; columns of I have norm 1."""
        norms = [vectors.norm(term).max() for term in self.terms]
        return float(max(norms))

    def matrix(self) -> np.ndarray:
        """Return the partial sums, (N, N)."""
        columns = [chunk.get() for chunk in self.sums]
        return np.concatenate(columns, axis=1)


def _judge(residuals: list[float], rtol: float) -> Status | None:
    """Return how the series ends, or None while it goes on."""
    residual = residuals[-1]
    if residual <= rtol:
        return Status.CONVERGED
    if not (np.isfinite(residual) and residual <= GROWTH_LIMIT * residuals[0]):
        return Status.DIVERGED
    return None
