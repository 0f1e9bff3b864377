# SPDX-License-Identifier: BSD-3-Clause
"""Norms that bound the errors of compressed operators, each with a random start of its own.

`ltcl.theory.two_norm` needs an operator that was made without knowledge of its random start. So
every operator that may be handed out is measured with a start of its own, and bound k may fail with
probability miss / (k (k + 1)), which add up to `miss`. Starts are pseudo-random and always the
same, so that results have the same bits.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.sparse.linalg

from ltcl.errors import ConvergenceError
from ltcl.operators import Compressed, Host, IdentityPlus
from ltcl.solvers import solve
from ltcl.theory.norms import CONFIDENCE, TwoNorm, two_norm

# Rounding of float32.
FLOAT32_UNIT = 2.0**-24
# Probability that some bound of a compression, or of an inverse, fails.
MISS = 2e-6
# What builds on each other takes starts of different purposes.
PURPOSES = ("compress", "rewrite", "sparse inverse", "invert", "pictures")
# Solves behind ||S^-1||.
SOLVE_RTOL = 1e-3
SOLVE_MAXITER = 400
POWER_STEPS = 8
# Share of a random vector in the start of a power iteration, so that no invariant subspace keeps
# it.
START_NOISE = 0.1

Starts = Iterator[dict[str, Any]]
LinearOperator: Any = scipy.sparse.linalg.LinearOperator


def fresh_starts(purpose: str, miss: float = MISS) -> Starts:
    """`seed` and `confidence` of one bound after the other, as keywords of `two_norm`."""
    first_seed = (1 + PURPOSES.index(purpose)) << 32
    for number in itertools.count(1):
        confidence = 1.0 - miss / (number * (number + 1))
        yield {"seed": first_seed + number, "confidence": confidence}


def inverse_norm(
    S: IdentityPlus, *, confidence: float = CONFIDENCE, factor: float = 1.1, seed: int = 0
) -> TwoNorm:
    """||S^-1||_2 = 1 / smallest singular value of S = I + R, with an upper bound.

    Products with S^-1 and S^-T are solves. A solve to the relative residual t gives S^-1 (v - d)
    with ||d|| <= t ||v||: the steps see S^-1 + D, with ||D|| <= t sqrt(products) ||S^-1||, each
    right-hand side being orthogonal to those before, and the bound is widened by that.

    Between two equal orthonormal bases, the solves are with the core; options are those of
    `two_norm`. An S that is singular, or nearly so, raises ConvergenceError.

    Examples
    --------
    >>> from ltcl.operators import as_operator
    >>> n = inverse_norm(IdentityPlus(as_operator([[0.0, 0.5], [0.5, 0.0]])))
    >>> round(n.estimate, 2), n.upper < 2.3  # eigenvalues of S are 1/2 and 3/2
    (2.0, True)
    """
    core = S.R
    if isinstance(core, Compressed) and core.two_sided:
        core = core.core
    system = IdentityPlus(core, S.sign)
    transposed = IdentityPlus(core.T, S.sign)

    def multiply(X: np.ndarray) -> np.ndarray:
        return solve_columns(system, X)

    def multiply_transposed(X: np.ndarray) -> np.ndarray:
        return solve_columns(transposed, X)

    inverse = LinearOperator(
        core.shape,
        matvec=multiply,
        rmatvec=multiply_transposed,
        matmat=multiply,
        rmatmat=multiply_transposed,
        dtype=np.float64,
    )
    operator = Host(core.device, inverse)
    norm = two_norm(operator, confidence=confidence, factor=factor, seed=seed)
    estimate = norm.estimate
    upper = norm.upper / (1.0 - SOLVE_RTOL * math.sqrt(norm.products))
    if core.shape[0] < S.shape[0]:
        # S is the identity on the coefficients that the core leaves out.
        estimate = max(estimate, 1.0)
        upper = max(upper, 1.0)
    return replace(norm, estimate=estimate, upper=upper)


def solve_columns(S: IdentityPlus, X: np.ndarray, rtol: float = SOLVE_RTOL) -> np.ndarray:
    """S^-1 X in float64, or a ConvergenceError."""
    try:
        solution = solve(S, X, "gmres", rtol=rtol, maxiter=SOLVE_MAXITER)
    except ConvergenceError as error:
        residual = f"{error.solution.residual:.2g}"
        raise ConvergenceError(
            "S is singular, or nearly so: a solve for the norm of its inverse ended with "
            f"a relative residual of {residual}; check the first bounce",
            error.solution,
        ) from None
    return np.asarray(solution.x, np.float64)


def estimate_norm(A: Any, start: np.ndarray | None = None) -> tuple[float, np.ndarray]:
    """||A||_2 from below, by power iteration on the host, and the vector, to start others from."""
    A_transposed = A.T
    norm = 0.0
    v = np.random.default_rng(0).standard_normal(A.shape[1])
    if start is not None:
        noise = START_NOISE * v / np.linalg.norm(v)
        v = start / np.linalg.norm(start) + noise
    for _ in range(POWER_STEPS):
        u = A @ (v / np.linalg.norm(v))
        norm = float(np.linalg.norm(u))
        w = A_transposed @ u
        size = float(np.linalg.norm(w))
        if size == 0.0 or not math.isfinite(size):
            break
        v = w
    return norm, v
