# SPDX-License-Identifier: BSD-3-Clause
"""The spectrum of R by power iteration, and bounds on that of S that cost nothing."""

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
