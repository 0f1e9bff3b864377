# SPDX-License-Identifier: BSD-3-Clause
"""The whole inverse at once, by the matrix series (eq. 8 and 10): N^3 a term, the paper's baseline.

    Sinv_k = I - R + ... + (-R)^k,  each term -R times the one before; of I - A:  S_k = I + A + ... + A^k

k steps of the matrix iteration Sinv_k = I - R Sinv_(k-1) (eq. 21) are the same but for rounding. The next
term is the residual, I - S Sinv_k = (-R)^(k+1), so that convergence is seen at no cost. Columns never mix:
the device works on some of them at a time.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import vectors
from ltcl.errors import ConvergenceError, InputError
from ltcl.operators import as_operator
from ltcl.solvers.result import Solution, Status

_CHUNK = 64  # columns of the iterate in one product
_GROWTH = 100.0  # times the first residual, as of `stopping`


def matrix_series(
    S: Any, *, rtol: float = 1e-2, steps: int | None = None, maxiter: int = 1000, throw: bool = True
) -> Solution:
    """S^-1 = I - R + R^2 - ... (eq. 10), or (I - A)^-1 = I + A + A^2 + ... (eq. 8), term by term.

    Parameters
    ----------
    S : (N, N) Operator, or anything `solve` takes
        ``T.interreflection`` inverts light transport, ``IdentityPlus(A, sign=-1)`` makes it from one bounce.
    rtol : float
        Done when ``||e_j - S x_j|| <= rtol`` for every column x_j.
    steps : int, optional
        Make exactly so many, k of the formula, and judge nothing.
    maxiter, throw
        As of `solve`.

    Returns
    -------
    Solution
        `x` is the inverse, (N, N) float32; `products` counts those of N x N matrices, one for the residual.

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
    most = checks.count("maxiter", maxiter) if steps is None else checks.count("steps", steps, least=0)
    S = as_operator(S)
    n, device = S.shape[1], S.device
    if S.shape[0] != n:
        raise InputError(f"S has shape {S.shape}; it must be square, (N, N)")
    what = f"a matrix series for N = {n}, two N x N iterates,"
    device.require(2 * 4 * n * n + 4 * n * _CHUNK, what)
    checks.fits_host(what, 2 * 4 * n * n)
    x = [
        device.upload(np.eye(n, min(_CHUNK, n - first), -first, np.float32)) for first in range(0, n, _CHUNK)
    ]
    r = [S.apply(e, scale=-1.0, add=e) for e in x]
    residuals: list[float] = []
    status = None
    while status is None:
        if residuals:
            for place, (xs, rs) in enumerate(zip(x, r, strict=True)):
                vectors.axpy(1.0, rs, xs)
                r[place] = S.apply(rs, scale=-1.0, add=rs)  # the next term, -R r = r - S r
        residual = float(max(vectors.norm(columns).max() for columns in r))  # columns of I have norm 1
        residuals.append(residual)
        if steps is None and residual <= rtol:
            status = Status.CONVERGED
        elif steps is None and not (np.isfinite(residual) and residual <= _GROWTH * residuals[0]):
            status = Status.DIVERGED
        elif len(residuals) > most:
            status = Status.MAXITER
    inverse, count = np.concatenate([columns.get() for columns in x], axis=1), len(residuals)
    seconds = time.perf_counter() - start
    solution = Solution(inverse, status, count - 1, count, tuple(residuals), seconds, "matrix_series")
    if throw and steps is None and not solution.converged:
        raise ConvergenceError(str(solution), solution)
    return solution
