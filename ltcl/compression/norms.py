# SPDX-License-Identifier: BSD-3-Clause
"""Norms that compression rests on: bounds from fresh random starts, ||S^-1||, and estimates to choose by.

What is proven: `ltcl.theory.two_norm` bounds the norm of an operator that was made without knowledge of its
random start, but for a chance of 1 - confidence. So every operator that may be handed out is measured with a
start of its own; what it was made of depends on earlier starts alone. The k-th bound may fail with
miss / (k (k + 1)), which add up to `miss` however many are measured: with 1 - miss all of them hold together.
The starts are pseudo-random and always the same, so that results have the same bits; the chance is over
transports that were made without regard to them.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import scipy.sparse.linalg

from ltcl.errors import ConvergenceError
from ltcl.operators import Compressed, Host, IdentityPlus
from ltcl.solvers import solve
from ltcl.theory.norms import CONFIDENCE, TwoNorm, two_norm

MISS = 2e-6  # the chance that some bound of a compression, or of an inverse, fails
_PURPOSES = ("compress", "rewrite", "sparse inverse", "invert")
_RTOL, _MAXITER = 1e-3, 400  # of the solves behind ||S^-1||
_STEPS = 8  # of the power iteration

Starts = Iterator[dict[str, Any]]


def fresh_starts(purpose: str) -> Starts:
    """`seed` and `confidence` of one bound after the other, as keywords of `two_norm`.

    What builds on each other takes starts of different `purpose`.

    >>> starts = fresh_starts("compress")
    >>> [round(1e6 * (1 - next(starts)["confidence"]), 2) for _ in range(2)]
    [1.0, 0.33]
    """
    first = (1 + _PURPOSES.index(purpose)) << 32
    for k in itertools.count(1):
        yield {"seed": first + k, "confidence": 1.0 - MISS / (k * (k + 1))}


def inverse_norm(
    S: IdentityPlus, *, confidence: float = CONFIDENCE, factor: float = 1.1, seed: int = 0
) -> TwoNorm:
    """||S^-1||_2 = 1 / smallest singular value of S = I + R, with an upper bound.

    Products with S^-1 and S^-T are solves. A solve to the relative residual t gives S^-1 (v - d) with
    ||d|| <= t ||v||: the steps see S^-1 + D, with ||D|| <= t sqrt(products) ||S^-1||, each right-hand side
    being orthogonal to those before, and the bound is widened by that.

    Between two equal orthonormal bases, the solves are with the core. `confidence`, `factor` and `seed` are
    as of `ltcl.theory.two_norm`. An S that is singular, or nearly so, raises ConvergenceError.

    Examples
    --------
    >>> from ltcl.operators import as_operator
    >>> n = inverse_norm(IdentityPlus(as_operator([[0.0, 0.5], [0.5, 0.0]])))
    >>> round(n.estimate, 2), n.upper < 2.3  # eigenvalues of S are 1/2 and 3/2
    (2.0, True)
    """
    core = S.R.core if isinstance(S.R, Compressed) and S.R.two_sided else S.R
    inverse = Host(core.device, _Inverse(IdentityPlus(core, S.sign)))
    found = two_norm(inverse, confidence=confidence, factor=factor, seed=seed)
    upper = found.upper / (1.0 - _RTOL * math.sqrt(found.products))
    # Of some coefficients: S is the identity on the others.
    least = 1.0 if core.shape[0] < S.shape[0] else 0.0
    return dataclasses.replace(found, estimate=max(found.estimate, least), upper=max(upper, least))


class _Inverse(scipy.sparse.linalg.LinearOperator):
    """S^-1, by solves."""

    def __init__(self, S: IdentityPlus) -> None:
        super().__init__(np.float64, S.shape)
        self._S, self._ST = S, IdentityPlus(S.R.T, S.sign)

    def _matmat(self, X: np.ndarray) -> np.ndarray:
        return _solved(self._S, X)

    def _rmatmat(self, X: np.ndarray) -> np.ndarray:
        return _solved(self._ST, X)


def _solved(S: IdentityPlus, X: np.ndarray) -> np.ndarray:
    try:
        return np.asarray(solve(S, X, "gmres", rtol=_RTOL, maxiter=_MAXITER).x, np.float64)
    except ConvergenceError as error:
        raise ConvergenceError(
            "S is singular, or nearly so: a solve for the norm of its inverse left "
            f"{error.solution.residual:.2g} of a light; check the first bounce",
            error.solution,
        ) from None


def estimate_norm(A: Any, start: np.ndarray | None = None) -> tuple[float, np.ndarray]:
    """The 2-norm of A, (M, N) on the host, from below by power iteration, and the vector that shows it.

    No bound, but good enough to choose by; a similar matrix may start from the vector.

    >>> round(estimate_norm(np.diag([3.0, 1.0]))[0], 3)
    3.0
    """
    AT, norm = A.T, 0.0
    v = np.random.default_rng(0).standard_normal(A.shape[1])
    if start is not None:  # a vector of an invariant subspace would never leave it
        v = start / np.linalg.norm(start) + 0.1 * v / np.linalg.norm(v)
    for _ in range(_STEPS):
        u = A @ (v / np.linalg.norm(v))
        norm, w = float(np.linalg.norm(u)), AT @ u
        if not 0.0 < float(np.linalg.norm(w)) < math.inf:
            break
        v = w
    return norm, v
