# SPDX-License-Identifier: BSD-3-Clause
"""The whole inverse at once, by matrix iteration (eq. 21) or by the matrix series (eq. 8 and 10).

    iteration   Sinv_k = I - R Sinv_(k-1)     or, of I - A,   S_k = I + A S_(k-1)
    series      Sinv_k = I - R + ... + (-R)^k, each term -R times the one before

One code for both signs, as of every solver here. k steps of the two are equal but for rounding, and so are
the costs: N^3 a step. The paper's baseline for small N; `solve` needs N^2 a step for one picture.

Columns of the iterate never mix, so the device works on some of them at a time. What the next step adds
is the residual, I - S Sinv_k = Sinv_(k+1) - Sinv_k = (-R)^(k+1), so that convergence is seen at no cost.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.device.device import SPARE_BYTES
from ltcl.errors import ConvergenceError, InputError
from ltcl.operators import as_operator
from ltcl.solvers.result import Solution, Status

_CHUNK = 64  # columns of the iterate in one product
_GROWTH = 100.0  # times the first residual, as of `stopping`
_RISES = 20  # residuals in a row, each above the one before, up to more than the first


def matrix_iteration(
    S: Any, *, rtol: float = 1e-2, steps: int | None = None, maxiter: int = 1000, throw: bool = True
) -> Solution:
    """S^-1 by Sinv_k = I - R Sinv_(k-1), or (I - A)^-1 by S_k = I + A S_(k-1) (eq. 21), from I.

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
    >>> from ltcl.operators import IdentityPlus, as_operator
    >>> A = as_operator([[0.0, 0.5], [0.5, 0.0]])
    >>> print(matrix_iteration(IdentityPlus(A, sign=-1), rtol=1e-4).x.round(2))
    [[1.33 0.67]
     [0.67 1.33]]
    """
    return _run("matrix_iteration", S, rtol, steps, maxiter, throw)


def matrix_series(
    S: Any, *, rtol: float = 1e-2, steps: int | None = None, maxiter: int = 1000, throw: bool = True
) -> Solution:
    """S^-1 = I - R + R^2 - ... (eq. 10), or (I - A)^-1 = I + A + A^2 + ... (eq. 8), term by term.

    Parameters, result and refusals are those of `matrix_iteration`.

    Examples
    --------
    >>> matrix_series([[1.0, 0.5], [0.5, 1.0]], steps=1).x.tolist()
    [[1.0, -0.5], [-0.5, 1.0]]
    """
    return _run("matrix_series", S, rtol, steps, maxiter, throw)


def _run(name: str, S: Any, rtol: float, steps: int | None, maxiter: int, throw: bool) -> Solution:
    start = time.perf_counter()
    rtol = checks.number("rtol", rtol, above=0.0, below=1.0)
    most = checks.count("maxiter", maxiter) if steps is None else checks.count("steps", steps, least=0)
    S = as_operator(S)
    n, device = S.shape[1], S.device
    if S.shape[0] != n:
        raise InputError(f"S has shape {S.shape}; it must be square, (N, N)")
    # Columns in one product; no array is beyond the largest allowed.
    width = max(1, min(_CHUNK, n, (device.max_allocation - SPARE_BYTES) // (4 * n)))
    what = f"a matrix iteration for N = {n}, two N x N iterates,"
    device.require(2 * 4 * n * n + 4 * n * width, what)
    checks.fits_host(what, 2 * 4 * n * n)

    def identity(first: int) -> Array:
        """Columns `first` and on of I."""
        return device.upload(np.eye(n, min(width, n - first), -first, np.float32))

    x = [identity(first) for first in range(0, n, width)]
    r = [S.apply(e, scale=-1.0, add=e) for e in x]
    residuals: list[float] = []
    while True:
        residuals.append(float(max(vectors.norm(part).max() for part in r)))  # columns of I have norm 1
        status = _judge(residuals, rtol if steps is None else 0.0, most)
        if status is not None:
            break
        for place, (xs, rs) in enumerate(zip(x, r, strict=True)):
            vectors.axpy(1.0, rs, xs)
            if name == "matrix_series":  # the next term, -R r = r - S r
                r[place] = S.apply(rs, scale=-1.0, add=rs)
            else:  # the residual of x = e - R x
                S.apply(xs, rs, scale=-1.0, add=identity(place * width))
    inverse, made = np.concatenate([part.get() for part in x], axis=1), len(residuals)
    seconds = time.perf_counter() - start
    found = Solution(inverse, status, made - 1, made, tuple(residuals), seconds, name)
    if throw and steps is None and not found.converged:
        raise ConvergenceError(str(found), found)
    return found


def _judge(residuals: list[float], rtol: float, most: int) -> Status | None:
    """How it ended, if it did; with ``rtol=0``, for a fixed number of steps, only by their number."""
    first, last = residuals[0], residuals[-1]
    rises = len(residuals) > _RISES and bool(np.all(np.diff(residuals[-_RISES - 1 :]) > 0.0))
    if rtol and last <= rtol:
        return Status.CONVERGED
    if rtol and (not np.isfinite(last) or last > _GROWTH * first or (rises and last > first)):
        return Status.DIVERGED
    return Status.MAXITER if len(residuals) > most else None
