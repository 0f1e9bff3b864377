# SPDX-License-Identifier: BSD-3-Clause
"""Chebyshev iteration written out as a polynomial in R, for methods that sample its terms one by one."""

from __future__ import annotations

import math

import numpy as np

from ltcl.errors import InputError


def chebyshev_coefficients(
    degree: int, bounds: tuple[float, float], lower: str = "lower degree="
) -> np.ndarray:
    """c_0 .. c_degree of p(R) = sum c_k R^k near (I + R)^-1 for a spectrum of S = I + R within `bounds`.

    It is the iterate after degree + 1 steps from zero: Saad, Iterative Methods for Sparse Linear Systems, 2nd
    ed., algorithm 12.1, carried out on the coefficients. Refused as soon as one is beyond float32;
    `lower` tells how the degree is made lower.

    >>> chebyshev_coefficients(0, (0.5, 1.5)).tolist()
    [1.0]
    """
    centre, radius, sigma = _interval(bounds)
    x, rho = np.zeros(0), 1.0 / sigma
    d = np.array([1.0 / centre])
    for k in range(degree + 1):
        x = np.append(x, 0.0) + d
        if not np.all(np.abs(x) <= np.finfo(np.float32).max):
            raise InputError(
                f"degree is {degree}; over a spectrum within {_shown(bounds)} coefficients are beyond "
                f"float32 from degree {k} on: {lower}, or use method='chebyshev'"
            )
        r = -np.append(x, 0.0) - np.append(0.0, x)  # 1 - (1 + R) x
        r[0] += 1.0
        previous, rho = rho, 1.0 / (2.0 * sigma - rho)
        d = 2.0 * rho / radius * r + rho * previous * np.append(d, 0.0)
    return x


def chebyshev_bias(degree: int, bounds: tuple[float, float]) -> float:
    """The largest relative residual p leaves, 1 / T_(degree + 1)(centre / radius), where S is self-adjoint.

    Of any other S it is the largest share that p leaves of an eigenvector, if its spectrum is real.

    >>> round(chebyshev_bias(0, (0.5, 1.5)), 9)
    0.5
    """
    return 1.0 / math.cosh(min((degree + 1) * math.acosh(_interval(bounds)[2]), 700.0))


def chebyshev_degree(rtol: float, bounds: tuple[float, float]) -> int:
    """The least degree whose bias is at most `rtol`.

    >>> chebyshev_degree(0.5, (0.5, 1.5)), chebyshev_degree(1e-2, (0.5, 1.5))
    (0, 4)
    """
    steps = math.acosh(1.0 / max(rtol, 1e-7)) / math.acosh(_interval(bounds)[2])
    return max(0, math.ceil(steps - 1e-9) - 1)


def _interval(bounds: tuple[float, float]) -> tuple[float, float, float]:
    """Centre, radius, and their ratio sigma."""
    lower, upper = bounds
    centre = (upper + lower) / 2.0
    radius = max((upper - lower) / 2.0, 1e-6 * centre)
    sigma = centre / radius if math.isfinite(centre) else 1.0
    if not sigma > 1.0:
        raise InputError(
            f"the spectrum of S is bounded by {_shown(bounds)}, too wide for a polynomial; rescale S"
        )
    return centre, radius, sigma


def bias_in_words(degree: int, bounds: tuple[float, float]) -> str:
    """What p leaves, and on what that rests."""
    bias = chebyshev_bias(degree, bounds)
    return f"{bias:.2g} of a residual, if the spectrum of S is real and within {_shown(bounds)}"


def _shown(bounds: tuple[float, float]) -> str:
    return f"[{bounds[0]:.3g}, {bounds[1]:.3g}]"
