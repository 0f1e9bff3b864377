# SPDX-License-Identifier: BSD-3-Clause
"""What can be said before solving: spectrum of R, bounds on that of S, products each method will need.

Notation of the paper: A one bounce, R = A + A^2 + ..., S = I + R; m bounds the albedo.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ltcl.device import vectors
from ltcl.operators import Operator


@dataclass(frozen=True)
class SpectralRadius:
    """rho(R) by power iteration; `change` is the relative change in the last step, `products` the cost."""

    value: float
    change: float
    products: int

    @property
    def albedo(self) -> float:
        """The uniform albedo m of a closed scene with this radius: rho(R) = m / (1 - m) (eq. 14)."""
        return self.value / (1.0 + self.value)


def spectral_radius(R: Operator, *, rtol: float = 1e-3, maxiter: int = 200, seed: int = 0) -> SpectralRadius:
    """Largest modulus of the eigenvalues of R, (N, N), by power iteration from a positive random start.

    R of a real scene is nonnegative up to noise, so that its dominant eigenvalue is real and positive
    (Perron) and a positive start cannot miss it. Growth is averaged over two steps, which also settles
    where -rho is an eigenvalue as well.

    >>> from ltcl.operators import as_operator
    >>> round(spectral_radius(as_operator([[0.0, 0.5], [0.5, 0.0]])).value, 3)
    0.5
    """
    start = np.random.default_rng(seed).uniform(0.5, 1.5, R.shape[0])
    v = R.device.upload(start / np.linalg.norm(start))
    w = v.like()
    growth, value, change = [], 0.0, math.inf
    for _ in range(maxiter):
        R.apply(v, w)
        growth.append(float(vectors.norm(w)[0]))
        if growth[-1] == 0.0:  # nilpotent up to rounding: no light comes back for ever
            return SpectralRadius(0.0, 0.0, len(growth))
        vectors.axpby(1.0 / growth[-1], w, 0.0, w, v)
        if len(growth) > 1:
            previous, value = value, math.sqrt(growth[-1] * growth[-2])
            change = abs(value - previous) / value
            if change < rtol / 10:  # one step's change is a fraction of the distance still to go
                break
    return SpectralRadius(value, change, len(growth))


def free_bounds(S: Operator) -> tuple[float, float]:
    """Bounds on the spectrum of S that cost one product with a vector of ones, at the first call only.

    Of a Lambertian scene, S = (I - A)^-1 is self-adjoint in the area/albedo inner product and its
    eigenvalues lie in [1 / (1 + m), 1 / (1 - m)], m < 1: above 1/2, and below the largest row sum of S
    since S >= 0. The dual I - A has its own in [1 - g, 1 + g], g the largest row sum of A.

    >>> from ltcl.operators import as_operator
    >>> free_bounds(as_operator([[1.0, 0.5], [0.5, 1.0]]))
    (0.5, 1.5)
    """
    sums = S.row_sums()
    if float(np.mean(sums)) >= 1.0:
        return 0.5, float(np.max(sums))
    g = float(np.max(1.0 - sums))
    return max(1.0 - g, 1e-3), 1.0 + g


def series_products(rho: float, rtol: float) -> float:
    """Products of the Neumann series or the Jacobi iteration to `rtol`: rho^k <= rtol (eq. 10, 20).

    >>> series_products(0.5, 1e-2), series_products(1.0, 1e-2)
    (7, inf)
    """
    if rho >= 1.0:
        return math.inf
    return 1 if rho <= rtol else math.ceil(math.log(rtol) / math.log(rho))


def richardson_products(lower: float, upper: float, rtol: float) -> int:
    """Products of the Richardson iteration to `rtol` with the spectrum in [lower, upper].

    Each step with omega = 2 / (lower + upper) shrinks the residual by (upper - lower) / (upper + lower)
    (Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., example 4.1).

    >>> richardson_products(0.5, 5.0, 1e-2)
    23
    """
    factor = (upper - lower) / (upper + lower)
    return 1 if factor <= rtol else math.ceil(math.log(rtol) / math.log(factor))


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
