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

# Pixels whose m is computed column by column.
MAX_EXACT_PIXELS = 256
PROBES = 32
BOUNCES = 3
# m of a T is hardly smaller.
MIN_INVERSE_DIAGONAL = 0.1


class SolvedSystem(NamedTuple):
    """S of one channel: its products and inverse of (N, k), diag(S), and diag(R R) or None."""

    product: Callable[[np.ndarray], Any]
    inverse: Callable[[np.ndarray], Any]
    diagonal: np.ndarray
    second_diagonal: np.ndarray | None


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


def bounce_spread(S: SolvedSystem, white: np.ndarray) -> np.ndarray:
    """Relative difference of bounces 1 to 3 under white by both choices, (3,).

    `white`, (N,), is 0 at pixels that are masked.

    Examples
    --------
    >>> matrix = np.array([[1.0, 0.2], [0.2, 1.0]])
    >>> S = SolvedSystem(None, lambda b: np.linalg.solve(matrix, b), np.ones(2), None)
    >>> bounce_spread(S, matrix.sum(axis=1)).round(2).tolist()
    [0.13, 0.28, 0.4]
    """
    m = np.maximum(_inverse_diagonal(S), MIN_INVERSE_DIAGONAL)
    is_lit = white != 0
    # Both sequences side by side.
    scales = np.stack([1.0 / m, S.diagonal], axis=1)
    remaining = np.repeat(white[:, None], 2, axis=1).astype(np.float64)
    remaining -= scales * S.inverse(remaining)
    spread = np.zeros(BOUNCES)
    for number in range(BOUNCES):
        bounces = scales * S.inverse(remaining)
        remaining -= bounces
        exact, diagonal = bounces[is_lit].T
        size = max(float(np.linalg.norm(exact)), 1e-300)
        spread[number] = np.linalg.norm(exact - diagonal) / size
    return spread


def _inverse_diagonal(S: SolvedSystem) -> np.ndarray:
    """diag(S^-1), (N,)."""
    pixels = len(S.diagonal)
    if pixels <= MAX_EXACT_PIXELS:
        return np.diagonal(S.inverse(np.eye(pixels)))
    z = np.random.default_rng(0).choice([-1.0, 1.0], (pixels, PROBES))
    samples = z * S.inverse(z)
    if S.second_diagonal is None:
        return samples.mean(axis=1)
    once = S.product(z) - z
    twice = S.product(once) - once
    first_control = z * once - (S.diagonal - 1.0)[:, None]
    second_control = z * twice - S.second_diagonal[:, None]
    controls = np.stack([first_control.ravel(), second_control.ravel()], axis=1)
    scatter = samples - samples.mean(axis=1, keepdims=True)
    factors, *_ = np.linalg.lstsq(controls, scatter.ravel())
    return (samples - (controls @ factors).reshape(samples.shape)).mean(axis=1)
