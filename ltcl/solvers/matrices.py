# SPDX-License-Identifier: BSD-3-Clause
"""The whole inverse at once, by matrix iteration (eq. 21) or by the matrix series (eq. 8 and 10).

    iteration   Sinv_k = I - R Sinv_(k-1)     or, of I - A,   S_k = I + A S_(k-1)
    series      Sinv_k = I - R + ... + (-R)^k, each term -R times the one before

One code for both signs, as of every solver here. k steps of the two are equal but for rounding, and so are
the costs: N^3 a step. The paper's baseline for small N; `solve` needs N^2 a step for one picture.

Columns of the iterate never mix, so the device works on some of them at a time. What the next step adds
is the residual, I - S Sinv_k = Sinv_(k+1) - Sinv_k = (-R)^(k+1), so that convergence is told at no cost.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.device.device import SPARE_BYTES
from ltcl.errors import ConvergenceError, InputError
from ltcl.operators import Operator, as_operator
from ltcl.solvers.result import Solution, Status

_CHUNK = 64  # columns of the iterate in one product
_GROWTH = 100.0  # times the first residual, as of `stopping`
_RISES = 20  # residuals in a row, each above the one before, up to more than the first

Step = Callable[[Operator, Array, Array, Array], Array]  # S, x, its residual, columns of I -> the residual


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
    maxiter : int
        Most steps.
    throw : bool
        Raise where the tolerance is not met.

    Returns
    -------
    Solution
        `x` is the inverse, (N, N) float32; `products` counts those of N x N matrices, the last one for
        the residual.

    Raises
    ------
    MemoryLimitError
        Two N x N iterates do not fit the device; said before anything is allocated.
    ConvergenceError
        Divergence, or `maxiter` reached; ``.solution`` holds the last iterate.

    Examples
    --------
    >>> from ltcl.operators import IdentityPlus, as_operator
    >>> A = as_operator([[0.0, 0.5], [0.5, 0.0]])
    >>> print(matrix_iteration(IdentityPlus(A, sign=-1), rtol=1e-4).x.round(2))
    [[1.33 0.67]
     [0.67 1.33]]
    """
    return _run("matrix_iteration", _iterate, S, rtol, steps, maxiter, throw)


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
    return _run("matrix_series", _add_term, S, rtol, steps, maxiter, throw)


def _iterate(S: Operator, x: Array, r: Array, e: Array) -> Array:
    """x = e - R x = x + r; returns its residual, in the memory of `r`."""
    vectors.axpy(1.0, r, x)
    return S.apply(x, r, scale=-1.0, add=e)


def _add_term(S: Operator, x: Array, r: Array, e: Array) -> Array:
    """x gains the term r; returns the next, -R r = r - S r, in the memory of `e`."""
    vectors.axpy(1.0, r, x)
    return S.apply(r, e, scale=-1.0, add=r)


def _run(
    name: str, step: Step, S: Any, rtol: float, steps: int | None, maxiter: int, throw: bool
) -> Solution:
    start = time.perf_counter()
    rtol = checks.number("rtol", rtol, above=0.0, below=1.0)
    most = checks.count("maxiter", maxiter) if steps is None else checks.count("steps", steps, least=0)
    S = _square(as_operator(S))
    iterate = _Iterate(S)
    residuals, status = [iterate.residual()], None
    while (status := _judge(residuals, rtol if steps is None else 0.0, most)) is None:
        iterate.advance(step)
        residuals.append(iterate.residual())
    seconds = time.perf_counter() - start
    made = len(residuals)
    found = Solution(iterate.get(), status, made - 1, made, tuple(residuals), seconds, name)
    if throw and steps is None and not found.converged:
        raise ConvergenceError(str(found), found)
    return found


def _square(S: Operator) -> Operator:
    n = S.shape[1]
    if S.shape[0] != n:
        raise InputError(f"S has shape {S.shape}; it must be square, (N, N)")
    width = _width(S)
    what = f"a matrix iteration for N = {n}, two N x N iterates,"
    S.device.require(2 * 4 * n * n + 4 * n * width, what)
    checks.fits_host(what, 2 * 4 * n * n)
    return S


def _width(S: Operator) -> int:
    """Columns in one product: no array may be beyond what the device allocates at once."""
    return max(1, min(_CHUNK, S.shape[0], (S.device.max_allocation - SPARE_BYTES) // (4 * S.shape[0])))


class _Iterate:
    """X (N, N) and its residual I - S X, some columns at a time; X = I at first."""

    def __init__(self, S: Operator) -> None:
        self.S = S
        n, width = S.shape[0], _width(S)
        self.starts = [(start, min(width, n - start)) for start in range(0, n, width)]
        self.x = [self._identity(*chunk) for chunk in self.starts]
        self.r = [S.apply(x, scale=-1.0, add=x) for x in self.x]  # of the identity: add is e as well

    def advance(self, step: Step) -> None:
        """One step of every column."""
        for place, chunk in enumerate(self.starts):
            self.r[place] = step(self.S, self.x[place], self.r[place], self._identity(*chunk))

    def residual(self) -> float:
        """The largest of a column; columns of I have norm 1."""
        return float(max(vectors.norm(r).max() for r in self.r))

    def get(self) -> np.ndarray:
        """X on the host."""
        return np.concatenate([x.get() for x in self.x], axis=1)

    def _identity(self, start: int, width: int) -> Array:
        columns = np.zeros((self.S.shape[0], width), np.float32)
        columns[start + np.arange(width), np.arange(width)] = 1.0
        return self.S.device.upload(columns)


def _judge(residuals: list[float], rtol: float, most: int) -> Status | None:
    """How it ended, if it did; with ``rtol=0``, for a fixed number of steps, only by their number."""
    first, last = residuals[0], residuals[-1]
    recent = residuals[-_RISES - 1 :]
    rises = len(recent) > _RISES and all(a < b for a, b in itertools.pairwise(recent))
    if rtol and last <= rtol:
        return Status.CONVERGED
    if rtol and (not np.isfinite(last) or last > _GROWTH * first or (rises and last > first)):
        return Status.DIVERGED
    return Status.MAXITER if len(residuals) > most else None
