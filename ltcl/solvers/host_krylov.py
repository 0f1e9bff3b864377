# SPDX-License-Identifier: BSD-3-Clause
"""Krylov methods on the host, in float64, for a few steps with many right-hand sides.

`least_squares` runs each column by itself, `block_gmres` all columns in one space. Algorithm and
section numbers: Saad, Iterative Methods for Sparse Linear Systems, 2nd ed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ltcl.errors import ConvergenceError
from ltcl.operators import Operator
from ltcl.solvers.column_reductions import safe_ratio

# Relative singular values that count in the least squares problem of `block_gmres`.
MIN_SINGULAR_VALUE = 1e-6


def block_gmres(
    product: Callable[[np.ndarray], np.ndarray], b: np.ndarray, *, steps: int
) -> np.ndarray:
    """Solve S x = b, (N, k), for the least residual in one block Krylov space (Saad, section 6.12).

    Parameters
    ----------
    product : callable
        (N, k) -> S times it, (N, k) float64.
    b : (N, k)
    steps : int
        Products; there is no restart.

    Examples
    --------
    >>> S = np.diag([1.0, 2.0])
    >>> block_gmres(lambda x: S @ x, np.ones((2, 1)), steps=2).round(6).tolist()
    [[1.0], [0.5]]
    """
    block, first = np.linalg.qr(b)
    k = len(first)
    basis = block
    # S basis = (basis and one more block) H
    H = np.zeros((k, 0))
    for _ in range(steps):
        # 1. One product.
        x = product(block)
        # 2. The parts of it outside of the basis are the next block.
        h = basis.T @ x
        block, r = np.linalg.qr(x - basis @ h)
        basis = np.hstack([basis, block])
        below = np.zeros((k, H.shape[1]))
        H = np.block([[H, h], [below, r]])
    # 3. The combination of the basis with the least residual.
    e = np.pad(first, ((0, len(H) - k), (0, 0)))
    coefficients = np.linalg.lstsq(H, e, rcond=MIN_SINGULAR_VALUE)[0]
    return basis[:, :-k] @ coefficients


def least_squares(
    A: Operator,
    b: np.ndarray,
    free: np.ndarray,
    weights: np.ndarray,
    *,
    rtol: float,
    maxiter: int = 100,
) -> np.ndarray:
    """Find the x (N, ...), 0 but where `free`, for which w A x is nearest to w b (M, ...).

    Each column has free entries and weights of its own, which broadcast to x and b. Done when the
    gradient of every column is at most rtol times the first one, or after `maxiter` steps of two
    products.
    """

    def gradient(Ax: np.ndarray) -> np.ndarray:
        return free * _product(A.T, weights**2 * (b - Ax))

    x, _, _ = _conjugate_gradients(A, gradient, b.shape, weights, rtol=rtol, maxiter=maxiter)
    return x


def normal_equations(
    A: Operator,
    v: np.ndarray,
    free: np.ndarray,
    weights: np.ndarray,
    *,
    rtol: float,
    maxiter: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Solve P A^T w^2 A x = P v for an x (N, k) that is 0 but where P, `free`, lets it be.

    Returns x and A x, (M, k). v, free and w are of each column. ConvergenceError if `maxiter` steps
    of two products are not enough for `rtol`.
    """

    def gradient(Ax: np.ndarray) -> np.ndarray:
        if not Ax.any():
            return free * v
        return free * (v - _product(A.T, weights**2 * Ax))

    shape = (A.shape[0], *v.shape[1:])
    x, Ax, reached = _conjugate_gradients(A, gradient, shape, weights, rtol=rtol, maxiter=maxiter)
    if not reached <= rtol:
        raise ConvergenceError(
            f"the derivative reached a relative residual of {reached:.2g} in {maxiter} steps; "
            f"rtol is {rtol:g}: free pixels may not be told apart by what the camera sees",
            None,
        )
    return x, Ax


def _conjugate_gradients(
    A: Operator,
    gradient: Callable[[np.ndarray], np.ndarray],
    shape: tuple[int, ...],
    weights: np.ndarray,
    *,
    rtol: float,
    maxiter: int,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Conjugate gradients on normal equations, whose gradient (N, ...) follows from A x.

    Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithm 8.4, whose names these
    are. Returns x, A x, of that shape, and the largest relative gradient.
    """
    x = np.zeros((A.shape[1], *shape[1:]))
    Ax = np.zeros(shape)
    p = x
    z_squared = np.ones(shape[1:])
    first_squared = z_squared
    reached = np.inf
    for step in range(maxiter + 1):
        z = gradient(Ax)
        previous = z_squared
        z_squared = np.sum(z**2, axis=0)
        if step == 0:
            first_squared = z_squared
        ratio = safe_ratio(z_squared, first_squared, first_squared > 0.0)
        reached = float(np.sqrt(np.max(ratio)))
        if reached <= rtol or step == maxiter:
            break
        beta = safe_ratio(z_squared, previous, previous > 0.0)
        p = z + beta * p
        w = _product(A, p)
        curvature = np.sum((weights * w) ** 2, axis=0)
        alpha = safe_ratio(z_squared, curvature, curvature > 0.0)
        x = x + alpha * p
        Ax = Ax + alpha * w
    return x, Ax, reached


def _product(matrix: Any, a: np.ndarray) -> np.ndarray:
    """A product on the device with columns (N, ...)."""
    columns = a.reshape(len(a), -1).astype(np.float32)
    product = matrix @ columns
    return product.reshape(len(product), *a.shape[1:])
