# SPDX-License-Identifier: BSD-3-Clause
"""What n terms of a series leave undone: bounce by bounce in integers, and as a bound from the albedo.

    forward   S_n    = I + A + ... + A^n             (eq. 8, 11)
    inverse   S_n^-1 = I - R + ... + (-1)^n R^n      (eq. 10)

m bounds the albedo, so that ||A|| <= m; the norm is any induced p-norm (footnote 2 of the paper).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ltcl import checks
from ltcl.errors import InputError


def bounce_coefficients(n: int, bounces: int) -> tuple[int, ...]:
    """Coefficients of A^0, A^1, ..., A^bounces in the n-term inverse series (eq. 12), exactly.

    R^k = (A + A^2 + ...)^k holds A^j binom(j-1, k-1) times; summed with alternating signs over k =
    1 .. min(j, n) these cancel for 2 <= j <= n (eq. 13), so that I - A remains and bounces above n.

    Both are whole numbers of at least 0, else an InputError; ``bounces + 1`` coefficients come
    back.

    >>> bounce_coefficients(3, 6)  # I - A, bounces 2 and 3 gone, higher ones not yet
    (1, -1, 0, 0, -1, -3, -6)
    """
    checks.count("n", n, least=0)
    checks.count("bounces", bounces, least=0)
    return (
        1,
        *(
            sum(
                (-1) ** k * math.comb(j - 1, k - 1) for k in range(1, min(j, n) + 1)
            )  # R^0 = I has none
            for j in range(1, bounces + 1)
        ),
    )


@dataclass(frozen=True)
class Terms:
    """What n terms leave undone of a scene whose bounces keep at most a share m of the light.

    Attributes
    ----------
    n : int
    next_bounce : int
        Coefficient of bounce n + 1 in the inverse, of which bounces 2 to n are gone: (-1)^n (eq.
        13).
    forward, inverse : float
        Bounds on the errors of S_n (eq. 15) and S_n^-1 (eq. 16); NaN where eq. 16 knows none, m >=
        1/2.
    """

    n: int
    next_bounce: int
    forward: float
    inverse: float


def after_terms(m: float, orders: Sequence[int] = (1, 2, 4, 8, 16)) -> tuple[Terms, ...]:
    """Eq. 13, 15 and 16 for several numbers of terms, at least 1; m in [0, 1).

    >>> after_terms(0.25, [1, 2])[1]
    Terms(n=2, next_bounce=1, forward=0.020833333333333332, inverse=0.05555555555555555)
    """
    m = _albedo(m)
    return tuple(
        Terms(
            checks.count("orders", n),
            bounce_coefficients(n, n + 1)[-1],
            forward_error_bound(m, n),
            inverse_error_bound(m, n) if m < 0.5 else math.nan,
        )
        for n in orders
    )


def forward_error_bound(m: float, n: int) -> float:
    """||S - S_n|| <= m^(n+1) / (1 - m) of n bounces (eq. 15); m in [0, 1), n at least 0.

    >>> forward_error_bound(0.5, 3)
    0.125
    """
    m = _albedo(m)
    return m ** (checks.count("n", n, least=0) + 1) / (1.0 - m)


def inverse_error_bound(m: float, n: int) -> float:
    """||S^-1 - S_n^-1|| <= m^(n+1) / ((1 - m)^n (1 - 2 m)) of n terms (eq. 16).

    m must be in [0, 1/2): beyond, ||R|| < 1 is not certain and no bound follows; n at least 0.

    >>> inverse_error_bound(0.25, 1)
    0.16666666666666666
    """
    m, n = _albedo(m), checks.count("n", n, least=0)
    if m >= 0.5:
        raise InputError(
            f"m is {m:g}; the bound of the inverse series (eq. 16) needs an albedo m below 1/2: "
            "above, use method 'chebyshev', which converges for every albedo"
        )
    return (
        m * (m / (1.0 - m)) ** n / (1.0 - 2.0 * m)
    )  # no power on its own, which would underflow first


def _albedo(m: float) -> float:
    return checks.number("m", m, least=0.0, below=1.0)
