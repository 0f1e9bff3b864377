# SPDX-License-Identifier: BSD-3-Clause
"""Norms that compression rests on: bounds from fresh random starts, ||S^-1||, and estimates to choose by.

`ltcl.theory.two_norm` needs an operator that was made without knowledge of its random start. So every one
that may be handed out is measured with a start of its own, and bound k may fail with miss / (k (k + 1)),
which add up to `miss`. Starts are pseudo-random and always the same, so that results have the same bits.
"""

from __future__ import annotations

import dataclasses
import functools
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
_PURPOSES = ("compress", "rewrite", "sparse inverse", "invert", "pictures")
_RTOL, _MAXITER = 1e-3, 400  # of the solves behind ||S^-1||
_STEPS = 8  # of the power iteration

Starts = Iterator[dict[str, Any]]


def fresh_starts(purpose: str, miss: float = MISS) -> Starts:
    """`seed` and `confidence` of one bound after the other, as keywords of `two_norm`.

    What builds on each other takes starts of different `purpose`.
    """
    first = (1 + _PURPOSES.index(purpose)) << 32
    for k in itertools.count(1):
        yield {"seed": first + k, "confidence": 1.0 - miss / (k * (k + 1))}


def inverse_norm(
    S: IdentityPlus, *, confidence: float = CONFIDENCE, factor: float = 1.1, seed: int = 0
) -> TwoNorm:
    """||S^-1||_2 = 1 / smallest singular value of S = I + R, with an upper bound.

    Products with S^-1 and S^-T are solves. A solve to the relative residual t gives S^-1 (v - d) with
    ||d|| <= t ||v||: the steps see S^-1 + D, with ||D|| <= t sqrt(products) ||S^-1||, each right-hand side
    being orthogonal to those before, and the bound is widened by that.

    Between two equal orthonormal bases, the solves are with the core; options are those of `two_norm`. An S
    that is singular, or nearly so, raises ConvergenceError.

    Examples
    --------
    >>> from ltcl.operators import as_operator
    >>> n = inverse_norm(IdentityPlus(as_operator([[0.0, 0.5], [0.5, 0.0]])))
    >>> round(n.estimate, 2), n.upper < 2.3  # eigenvalues of S are 1/2 and 3/2
    (2.0, True)
    """
    operator: Any = scipy.sparse.linalg.LinearOperator
    core = S.R.core if isinstance(S.R, Compressed) and S.R.two_sided else S.R
    times, transposed = (functools.partial(solve_columns, IdentityPlus(A, S.sign)) for A in (core, core.T))
    inverse = operator(core.shape, times, transposed, times, dtype=np.float64, rmatmat=transposed)
    norm = two_norm(Host(core.device, inverse), confidence=confidence, factor=factor, seed=seed)
    upper = norm.upper / (1.0 - _RTOL * math.sqrt(norm.products))
    # Of some coefficients: S is the identity on the others.
    least = 1.0 if core.shape[0] < S.shape[0] else 0.0
    return dataclasses.replace(norm, estimate=max(norm.estimate, least), upper=max(upper, least))


def solve_columns(S: IdentityPlus, X: np.ndarray, rtol: float = _RTOL) -> np.ndarray:
    """S^-1 X in float64, or a ConvergenceError."""
    try:
        return np.asarray(solve(S, X, "gmres", rtol=rtol, maxiter=_MAXITER).x, np.float64)
    except ConvergenceError as error:
        raise ConvergenceError(
            "S is singular, or nearly so: a solve for the norm of its inverse left "
            f"{error.solution.residual:.2g} of a light; check the first bounce",
            error.solution,
        ) from None


def estimate_norm(A: Any, start: np.ndarray | None = None) -> tuple[float, np.ndarray]:
    """||A||_2 from below, by power iteration on the host, and the vector, a start for similar matrices."""
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
