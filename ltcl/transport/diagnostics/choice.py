# SPDX-License-Identifier: BSD-3-Clause
"""The change of bounces by the choice of the first bounce, which T alone does not decide.

diag(T) holds light that returned to its own pixel; 1 / diag(T^-1) does not, if all light went
between lit, matt surfaces. With m = diag(S^-1) and d = diag(S), S = T F^-1 of the F at hand, both
choices need S^-1 alone:

    F'  = 1 / diag(T^-1):    S'^-1 = m^-1 S^-1
    F'' = diag(T):           S''^-1 = d S^-1

m is exact up to 256 pixels, and beyond the mean of z (S^-1 z) over random signs z, as in
`ltcl.transport.first_bounce`. With R = S - I, the means of z (R z) and z (R R z) are known, diag(R)
and diag(R R): a regression on both takes most of the scatter away (control variates).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse

from ltcl.errors import ConvergenceError, MemoryLimitError
from ltcl.operators import IdentityPlus
from ltcl.solvers import solve
from ltcl.transport.diagnostics.resolution import resolution_spread

# Pixels whose m is computed column by column.
MAX_EXACT_PIXELS = 256
PROBES = 32
BOUNCES = 3
# Solves on the device.
SOLVE_RTOL = 1e-3
# Part of the larger control below which one that is all but a multiple of it is left out.
MIN_CONTROL_SHARE = 1e-12
# m of a T is hardly smaller.
MIN_INVERSE_DIAGONAL = 0.1


class SolvedSystem(NamedTuple):
    """S of one channel: its products and inverse of (N, k), diag(S), and diag(R R) or None."""

    product: Callable[[np.ndarray], Any]
    inverse: Callable[[np.ndarray], Any]
    diagonal: np.ndarray
    second_diagonal: np.ndarray | None

    @property
    def has_diagonal_of_T(self) -> bool:
        """True if the first bounce is diag(T)."""
        return bool(np.allclose(self.diagonal, 1.0, rtol=1e-6))


class BounceSpreads(NamedTuple):
    """Relative changes of bounces 1 to 3 under white, (3,) each; NaN if unknown.

    By the `choice` of the first bounce, and by pixels of twice the size (`resolution`).
    """

    choice: np.ndarray
    resolution: np.ndarray


def bounce_spreads_of_system(
    T: Any, F: np.ndarray, S: IdentityPlus, grid: tuple[int, int]
) -> BounceSpreads:
    """`bounce_spreads` of T (N, N) with first bounce F and its S on the device."""
    system = S.as_it_stands()

    def inverse(light: np.ndarray) -> np.ndarray:
        return solve(system, light, rtol=SOLVE_RTOL).x

    try:
        solved = solved_system(T, F, system.matmat, inverse)
        return bounce_spreads(T, F, solved, grid)
    except (ConvergenceError, MemoryLimitError):
        unknown = np.full(BOUNCES, np.nan)
        return BounceSpreads(unknown, unknown)


def solved_system(
    T: Any,
    F: np.ndarray,
    product: Callable[[np.ndarray], Any],
    inverse: Callable[[np.ndarray], Any],
) -> SolvedSystem:
    """S = T F^-1 with its diagonals; F (N,) is 0 at masked pixels, where S is the identity."""
    is_lit = F > 0
    inverse_F = 1.0 / np.where(is_lit, F, np.inf)
    diagonal = np.ones(len(F))
    if hasattr(T, "diagonal"):
        diagonal = np.where(is_lit, np.asarray(T.diagonal()) * inverse_F, 1.0)
    return SolvedSystem(product, inverse, diagonal, second_diagonal(T, inverse_F, diagonal))


def second_diagonal(T: Any, inverse_F: np.ndarray, diagonal: np.ndarray) -> np.ndarray | None:
    """diag(R R) of R = T F^-1 - I, (N,); None if T does not show its entries."""
    if isinstance(T, np.ndarray):
        squares = np.einsum("ij,ji,j->i", T, T, inverse_F)
    elif isinstance(T, scipy.sparse.csr_array):
        squares = T.multiply(T.T) @ inverse_F
    else:
        return None
    # diag(S S) - 2 diag(S) + 1
    return inverse_F * squares - 2.0 * diagonal + 1.0


def bounce_spreads(T: Any, F: np.ndarray, S: SolvedSystem, grid: tuple[int, int]) -> BounceSpreads:
    """Relative changes of bounces under white; F, (N,), is 0 at masked pixels.

    Examples
    --------
    >>> T = np.array([[1.0, 0.2], [0.2, 1.0]])
    >>> S = SolvedSystem(T.dot, lambda b: np.linalg.solve(T, b), np.ones(2), None)
    >>> bounce_spreads(T, np.ones(2), S, (1, 2)).choice.round(2).tolist()
    [0.13, 0.28, 0.4]
    """
    is_lit = F > 0
    exact, diagonal = _bounces_by_choice(S, is_lit, F)
    choice = np.zeros(BOUNCES)
    for number in range(BOUNCES):
        bounce = exact[number + 1, is_lit]
        size = max(float(np.linalg.norm(bounce)), 1e-300)
        choice[number] = np.linalg.norm(bounce - diagonal[number + 1, is_lit]) / size
    is_exact = not S.has_diagonal_of_T
    bounces = exact if is_exact else diagonal
    return BounceSpreads(choice, resolution_spread(T, F, bounces, grid, is_exact))


def _bounces_by_choice(
    S: SolvedSystem, is_lit: np.ndarray, F: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Direct light and bounces under white, S F, by 1 / diag(T^-1) and by diag(T), (4, N) each."""
    m = np.maximum(_inverse_diagonal(S), MIN_INVERSE_DIAGONAL)
    white = np.where(is_lit, S.product(F[:, None])[:, 0], 0.0)
    # Both sequences side by side.
    scales = np.stack([1.0 / m, S.diagonal], axis=1)
    remaining = np.repeat(white[:, None], 2, axis=1).astype(np.float64)
    pictures = []
    for _ in range(BOUNCES + 1):
        bounces = scales * S.inverse(remaining)
        remaining -= bounces
        pictures.append(bounces)
    exact, diagonal = np.stack(pictures, axis=0).transpose(2, 0, 1)
    return exact, diagonal


def _inverse_diagonal(S: SolvedSystem) -> np.ndarray:
    """diag(S^-1), (N,)."""
    pixels = len(S.diagonal)
    if pixels <= MAX_EXACT_PIXELS:
        return np.diagonal(S.inverse(np.eye(pixels)))
    z = np.random.default_rng(0).choice([-1.0, 1.0], (pixels, PROBES))
    samples = z * S.inverse(z)
    once = S.product(z) - z
    control_samples = [z * once - (S.diagonal - 1.0)[:, None]]
    if S.second_diagonal is not None:
        twice = S.product(once) - once
        control_samples.append(z * twice - S.second_diagonal[:, None])
    controls = np.stack(control_samples)
    scatter = samples - samples.mean(axis=1, keepdims=True)
    # Least squares by the equations of the one or two factors.
    regressors = controls.reshape(len(controls), -1)
    products = regressors @ regressors.T
    inverse = np.linalg.pinv(products, rcond=MIN_CONTROL_SHARE, hermitian=True)
    factors = inverse @ (regressors @ scatter.ravel())
    means = controls.mean(axis=2)
    return samples.mean(axis=1) - factors @ means
