# SPDX-License-Identifier: BSD-3-Clause
"""Products that each method will need, foretold from rho(R) or from bounds on the spectrum of S."""

from __future__ import annotations

import math


def series_products(rho: float, rtol: float) -> float:
    """Products of the Neumann series or the Jacobi iteration to `rtol`: rho^k <= rtol (eq. 10, 20).

    >>> series_products(0.5, 1e-2), series_products(1.0, 1e-2)
    (7, inf)
    """
    if rho >= 1.0:
        return math.inf
    return 1 if rho <= rtol else math.ceil(math.log(rtol) / math.log(rho))


def chebyshev_products(lower: float, upper: float, rtol: float) -> int:
    """Products of the Chebyshev iteration to `rtol` with the spectrum in [lower, upper].

    The residual polynomial has maximum 1 / T_k((upper + lower) / (upper - lower)) there
    (Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., section 6.11).

    >>> chebyshev_products(0.5, 5.0, 1e-2)
    9
    """
    if upper <= lower:
        return 1
    centre = (upper + lower) / (upper - lower)
    return max(1, math.ceil(math.acosh(1.0 / rtol) / math.acosh(centre)))
