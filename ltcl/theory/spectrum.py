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

# Steps of the power iteration.
MAX_STEPS = 200
# Least value of a positive vector, to its largest: far above an underflow.
VECTOR_FLOOR = 1e-12
# Largest reduction of the error by one step that an error estimate believes.
MAX_REDUCTION = 0.99
# Rounding of float32.
FLOAT32_ROUNDING = 2.0**-24

# Certificates of a spectral radius.
COLLATZ_WIELANDT = "collatz-wielandt"
POWER_ITERATION = "power iteration"


@dataclass(frozen=True)
class SpectralRadius:
    """rho(R) by power iteration.

    Attributes
    ----------
    value : float
    change : float
        Relative change of the value in the last step.
    products : int
        Products with R.
    lower, upper : float
        Bounds on rho(R), as good as `certificate` says.
    certificate : str
        "collatz-wielandt": rho(R) lies between `lower` and `upper` for certain. "power iteration":
        R has negative entries or does not show them, and both are an estimate, by the speed at
        which the value settled.
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
        """Uniform albedo m of a closed scene with this radius: rho(R) = m / (1 - m) (eq. 14)."""
        return self.value / (1.0 + self.value)


def require_operator(name: str, value: Any) -> Operator:
    """Return `value` if it is an Operator; refuse others."""
    if not isinstance(value, Operator):
        raise InputTypeError(
            f"{name} is a {type(value).__name__}; it must be an Operator, as "
            "ltcl.operators.as_operator makes one"
        )
    return value


def spectral_radius(
    R: Operator, *, rtol: float = 1e-3, norms: Norms | None = None
) -> SpectralRadius:
    """Largest modulus of the eigenvalues of R, (N, N), by power iteration from a positive start.

    R of a real scene is nonnegative up to noise, so that its dominant eigenvalue is real and
    positive (Perron) and a positive random start cannot miss it. Growth is averaged over two steps,
    which also settles if -rho is an eigenvalue as well.

    With ``norms=R.norms()`` the signs of the entries are known, and the radius of a nonnegative R
    is certified: min (R v)_i / v_i <= rho(R) <= max (R v)_i / v_i for every positive v (Collatz,
    Wielandt; Horn and Johnson, Matrix Analysis, 2nd ed., theorem 8.1.26), here for the last v,
    widened by the rounding of sums of N products. The bounds are those of R as it lies on the
    device; noise of the measurement is in R.

    >>> from ltcl.operators import as_operator
    >>> R = as_operator([[0.0, 0.5], [0.5, 0.0]])
    >>> rho = spectral_radius(R, norms=R.norms())
    >>> round(rho.value, 3), rho.certificate, rho.error < 1e-3
    (0.5, 'collatz-wielandt', True)
    """
    require_operator("R", R)
    is_nonnegative = norms is not None and norms.lowest >= 0.0
    iteration = _PowerIteration(R, rtol)
    iteration.run()
    rho = SpectralRadius(
        value=iteration.value, change=iteration.change, products=len(iteration.growth)
    )
    if iteration.growth[-1] == 0.0:
        # R is nilpotent up to rounding: no light returns for ever.
        certificate = COLLATZ_WIELANDT if is_nonnegative else POWER_ITERATION
        return dataclasses.replace(rho, change=0.0, upper=0.0, certificate=certificate)
    if norms is not None and is_nonnegative:
        return _certify(rho, R, iteration.positive_vector(), norms)
    return _estimate_error(rho, iteration.values)


class _PowerIteration:
    """State of the power iteration v <- R v / ||R v||.

    Attributes
    ----------
    growth : list of float
        ||R v|| of each step.
    values : list of float
        Geometric means of the growth of two steps.
    change : float
        Relative change of them in the last step.
    """

    def __init__(self, R: Operator, rtol: float) -> None:
        self.R = R
        self.rtol = rtol
        start = np.random.default_rng(0).uniform(0.5, 1.5, R.shape[0])
        self.v = R.device.upload(start / np.linalg.norm(start))
        self.previous = self.v.like()
        self.growth: list[float] = []
        self.values: list[float] = []
        self.change = math.inf

    @property
    def value(self) -> float:
        """The radius after the steps so far."""
        if self.growth[-1] == 0.0:
            return 0.0
        return self.values[-1] if self.values else self.growth[-1]

    def run(self) -> None:
        for _ in range(MAX_STEPS):
            self._step()
            # The change of one step is a fraction of the distance still to go.
            if self.growth[-1] == 0.0 or self.change < self.rtol / 10:
                return

    def _step(self) -> None:
        following = self.previous
        self.R.apply(self.v, following)
        growth = float(vectors.norm(following)[0])
        self.growth.append(growth)
        if growth == 0.0:
            return
        vectors.axpby(1.0 / growth, following, 0.0, following, following)
        self.previous = self.v
        self.v = following
        if len(self.growth) < 2:
            return
        self.values.append(math.sqrt(growth * self.growth[-2]))
        if len(self.values) > 1:
            self.change = abs(self.values[-1] - self.values[-2]) / self.values[-1]

    def positive_vector(self) -> Array:
        """The sum of the last two vectors, in which a part that belongs to -rho cancels.

        That part would keep the ratios of Collatz and Wielandt apart.
        """
        weight = self.growth[-1] / self.value
        return vectors.axpby(1.0, self.previous, weight, self.v, self.previous)


def _estimate_error(rho: SpectralRadius, values: list[float]) -> SpectralRadius:
    """`rho` with bounds by the speed at which `values` settled, if there are enough of them."""
    changes = np.abs(np.diff(values[-3:]))
    if len(changes) < 2:
        return rho
    # A geometric approach leaves the last change times q / (1 - q).
    q = 0.0
    if changes[0] > 0.0:
        q = min(float(changes[1] / changes[0]), MAX_REDUCTION)
    error = float(changes[1]) * max(1.0, q / (1.0 - q))
    return dataclasses.replace(rho, lower=max(rho.value - error, 0.0), upper=rho.value + error)


def _certify(rho: SpectralRadius, R: Operator, v: Array, norms: Norms) -> SpectralRadius:
    """`rho` with the bounds of Collatz and Wielandt from v >= 0."""
    x = v.get().astype(np.float64)
    # Rows that give no light have v = 0, which must be positive.
    floor = VECTOR_FLOOR * x.max()
    is_seen = x > floor
    x = np.maximum(x, floor).astype(np.float32).astype(np.float64)
    y = R.apply(R.device.upload(x)).get().astype(np.float64)
    rounding = (len(x) + 2) * FLOAT32_ROUNDING
    # The light that the pixels at the floor gave is subtracted again.
    floor_light = 0.0
    if not is_seen.all():
        floor_light = 2.0 * floor * norms.inf
    lower = float(np.min((y[is_seen] - floor_light) / x[is_seen])) * (1.0 - rounding)
    upper = float(np.max(y / x)) * (1.0 + rounding)
    upper = min(upper, norms.one, norms.inf, norms.frobenius)
    return SpectralRadius(
        value=min(max(rho.value, lower), upper),
        change=rho.change,
        products=rho.products + 1,
        lower=max(lower, 0.0),
        upper=upper,
        certificate=COLLATZ_WIELANDT,
    )


def free_bounds(S: Operator) -> tuple[float, float]:
    """Bounds on the spectrum of S that cost one product with a vector of ones, at the first call.

    In a Lambertian scene, S = (I - A)^-1 is self-adjoint in the area/albedo inner product and its
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
