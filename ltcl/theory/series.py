# SPDX-License-Identifier: BSD-3-Clause
"""Errors of a series of n terms: bounce by bounce in integers, and a bound by the albedo.

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

    Parameters
    ----------
    n, bounces : int
        Whole numbers of at least 0, else an InputError.

    Returns
    -------
    tuple of int
        ``bounces + 1`` coefficients.

    Examples
    --------
    >>> bounce_coefficients(3, 6)  # I - A, bounces 2 and 3 gone, higher ones not yet
    (1, -1, 0, 0, -1, -3, -6)
    """
    checks.count("n", n, least=0)
    checks.count("bounces", bounces, least=0)
    coefficients = [1]
    for j in range(1, bounces + 1):
        # R^0 = I holds no bounce.
        signed = ((-1) ** k * math.comb(j - 1, k - 1) for k in range(1, min(j, n) + 1))
        coefficients.append(sum(signed))
    return tuple(coefficients)


@dataclass(frozen=True)
class Terms:
    """Errors after n terms in a scene whose bounces keep at most a share m of the light.

    Attributes
    ----------
    n : int
    next_bounce : int
        Coefficient of bounce n + 1 in the inverse, which has no bounces 2 to n: (-1)^n (eq. 13).
    forward, inverse : float
        Bounds on the errors of S_n (eq. 15) and S_n^-1 (eq. 16); NaN if m >= 1/2, for which eq. 16
        has no bound.
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
    m = _check_albedo(m)
    terms = []
    for n in orders:
        checks.count("orders", n)
        inverse = inverse_error_bound(m, n) if m < 0.5 else math.nan
        terms.append(
            Terms(
                n=n,
                next_bounce=bounce_coefficients(n, n + 1)[-1],
                forward=forward_error_bound(m, n),
                inverse=inverse,
            )
        )
    return tuple(terms)


def forward_error_bound(m: float, n: int) -> float:
    """||S - S_n|| <= m^(n+1) / (1 - m) for n bounces (eq. 15); m in [0, 1), n at least 0.

    >>> forward_error_bound(0.5, 3)
    0.125
    """
    m = _check_albedo(m)
    n = checks.count("n", n, least=0)
    return m ** (n + 1) / (1.0 - m)


def inverse_error_bound(m: float, n: int) -> float:
    """||S^-1 - S_n^-1|| <= m^(n+1) / ((1 - m)^n (1 - 2 m)) for n terms (eq. 16).

    m must be in [0, 1/2): beyond, ||R|| < 1 is not certain and no bound follows; n at least 0.

    >>> inverse_error_bound(0.25, 1)
    0.16666666666666666
    """
    m = _check_albedo(m)
    n = checks.count("n", n, least=0)
    if m >= 0.5:
        raise InputError(
            f"m is {m:g}; the bound of the inverse series (eq. 16) needs an albedo m below 1/2: "
            "above, use method 'chebyshev', which converges for every albedo"
        )
    # m^(n+1) on its own would underflow before the quotient does.
    return m * (m / (1.0 - m)) ** n / (1.0 - 2.0 * m)


def _check_albedo(m: float) -> float:
    return checks.number("m", m, least=0.0, below=1.0)
