# SPDX-License-Identifier: BSD-3-Clause
"""The spectrum of R by power iteration, and bounds on that of S that cost nothing."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl.device import Array, vectors
from ltcl.errors import InputTypeError
from ltcl.operators import Norms, Operator

_STEPS = 200  # at most
_FLOOR = 1e-12  # of the largest value of a vector: far above what underflows

COLLATZ_WIELANDT, POWER_ITERATION = "collatz-wielandt", "power iteration"


@dataclass(frozen=True)
class SpectralRadius:
    """rho(R) by power iteration.

    Attributes
    ----------
    value : float
    change : float
        Relative change of it in the last step.
    products : int
        What it cost.
    lower, upper : float
        What `certificate` says of rho(R).
    certificate : str
        "collatz-wielandt": rho(R) lies between `lower` and `upper` for certain. "power iteration":
        R has negative entries or hides them, and the two are an estimate, from how fast the value
        settled.
    """

    value: float
    change: float
    products: int
    lower: float = 0.0
    upper: float = math.inf
    certificate: str = POWER_ITERATION

    @property
    def error(self) -> float:
        """The farther of `lower` and `upper` from the value."""
        return max(self.value - self.lower, self.upper - self.value)

    @property
    def albedo(self) -> float:
        """The uniform albedo m of a closed scene with this radius: rho(R) = m / (1 - m) (eq. 14)."""
        return self.value / (1.0 + self.value)


def require_operator(name: str, value: Any) -> Operator:
    """Return `value` if it is an Operator; refuse others."""
    if not isinstance(value, Operator):
        what = f"{name} is a {type(value).__name__}"
        raise InputTypeError(
            f"{what}; it must be an Operator, as ltcl.operators.as_operator makes one"
        )
    return value


def spectral_radius(
    R: Operator, *, rtol: float = 1e-3, norms: Norms | None = None
) -> SpectralRadius:
    """Largest modulus of the eigenvalues of R, (N, N), by power iteration from a positive random start.

    R of a real scene is nonnegative up to noise, so that its dominant eigenvalue is real and
    positive (Perron) and a positive start cannot miss it. Growth is averaged over two steps, which
    also settles where -rho is an eigenvalue as well.

    With ``norms=R.norms()`` the signs of the entries are known, and those of a nonnegative R are
    certified: min (R v)_i / v_i <= rho(R) <= max (R v)_i / v_i for every positive v (Collatz,
    Wielandt; Horn and Johnson, Matrix Analysis, 2nd ed., theorem 8.1.26), here of the last v,
    widened by what rounding can do in a sum of N products. The bounds are of R as it lies on the
    device; noise of the measurement is in R.

    >>> from ltcl.operators import as_operator
    >>> R = as_operator([[0.0, 0.5], [0.5, 0.0]])
    >>> rho = spectral_radius(R, norms=R.norms())
    >>> round(rho.value, 3), rho.certificate, rho.error < 1e-3
    (0.5, 'collatz-wielandt', True)
    """
    require_operator("R", R)
    certificate = POWER_ITERATION if norms is None or norms.lowest < 0.0 else COLLATZ_WIELANDT
    start = np.random.default_rng(0).uniform(0.5, 1.5, R.shape[0])
    v = R.device.upload(start / np.linalg.norm(start))
    w = v.like()
    growth, values, change = [], [], math.inf
    for _ in range(_STEPS):
        R.apply(v, w)
        growth.append(float(vectors.norm(w)[0]))
        if growth[-1] == 0.0:  # nilpotent up to rounding: no light comes back for ever
            return SpectralRadius(0.0, 0.0, len(growth), 0.0, 0.0, certificate)
        vectors.axpby(1.0 / growth[-1], w, 0.0, w, w)
        v, w = w, v
        if len(growth) > 1:
            values.append(math.sqrt(growth[-1] * growth[-2]))
            change = abs(values[-1] - values[-2]) / values[-1] if len(values) > 1 else math.inf
            if change < rtol / 10:  # one step's change is a fraction of the distance still to go
                break
    rho = SpectralRadius(values[-1] if values else growth[-1], change, len(growth))
    if norms is None or certificate is POWER_ITERATION:
        changes = np.abs(np.diff(values[-3:]))
        if len(changes) < 2:
            return rho
        # A geometric approach leaves the last change times q / (1 - q).
        q = min(float(changes[1] / changes[0]), 0.99) if changes[0] > 0.0 else 0.0
        error = float(changes[1]) * max(1.0, q / (1.0 - q))
        return dataclasses.replace(rho, lower=max(rho.value - error, 0.0), upper=rho.value + error)
    # In the sum of two steps a part that belongs to -rho, which would keep ratios apart, cancels.
    return _certified(rho, R, vectors.axpby(1.0, w, growth[-1] / rho.value, v, w), norms)


def _certified(rho: SpectralRadius, R: Operator, v: Array, norms: Norms) -> SpectralRadius:
    """`rho` with the bounds of Collatz and Wielandt from v >= 0."""
    x = v.get().astype(np.float64)
    floor = _FLOOR * x.max()  # of rows that give no light: v is 0 there, but must be positive
    seen, x = x > floor, np.maximum(x, floor).astype(np.float32).astype(np.float64)
    y = R.apply(R.device.upload(x)).get().astype(np.float64)
    rounding = (len(x) + 2) * 2.0**-24
    # Of the pixels seen alone: what the others gave is taken away again.
    others = 0.0 if seen.all() else 2.0 * floor * norms.inf
    lower = float(np.min((y[seen] - others) / x[seen])) * (1.0 - rounding)
    upper = min(float(np.max(y / x)) * (1.0 + rounding), norms.one, norms.inf, norms.frobenius)
    value = min(max(rho.value, lower), upper)
    return SpectralRadius(
        value, rho.change, rho.products + 1, max(lower, 0.0), upper, COLLATZ_WIELANDT
    )


def free_bounds(S: Operator) -> tuple[float, float]:
    """Bounds on the spectrum of S that cost one product with a vector of ones, at the first call only.

    Of a Lambertian scene, S = (I - A)^-1 is self-adjoint in the area/albedo inner product and its
    eigenvalues lie in [1 / (1 + m), 1 / (1 - m)], m < 1: above 1/2, and below the largest row sum
    of S since S >= 0. The dual I - A has its own in [1 - g, 1 + g], g the largest row sum of A.

    >>> from ltcl.operators import as_operator
    >>> free_bounds(as_operator([[1.0, 0.5], [0.5, 1.0]]))
    (0.5, 1.5)
    """
    least, mean, most = row_sum_range(require_operator("S", S))
    if mean >= 1.0:
        return 0.5, most
    return max(least, 1e-3), 2.0 - least


def row_sum_range(S: Operator) -> tuple[float, float, float]:
    """The least, the mean and the largest row sum of S, computed once in its life.

    The mean is the Rayleigh quotient of the even picture, in the inner product of `S.weights`.
    """
    return S.row_sum_range()
