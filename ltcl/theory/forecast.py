# SPDX-License-Identifier: BSD-3-Clause
"""Products that each method will need, foretold from rho(R) or from bounds on the spectrum of S."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from ltcl import checks
from ltcl.operators import Operator
from ltcl.theory.spectrum import POWER_ITERATION, SpectralRadius

FREE_BOUNDS, SWEEPS, RITZ = "free bounds", "power iteration of sweeps", "ritz values"
NOTHING, BEYOND = "none", "none: float32 cannot confirm this rtol"
_FLOAT32 = 2.0**-23  # relative residual that is rounding
_LARGEST_SWEEP = 4096  # pixels: a sweep on the host takes hundredths of a second
_SETTLING, _SWEEPS = 10, 30  # sweeps before growth is measured, and in all


@dataclass(frozen=True)
class Forecast:
    """Products (sweeps of Gauss-Seidel) a method needs to a tolerance, and what says so.

    Attributes
    ----------
    products : float
        Infinite where the method diverges, NaN where nothing is known.
    certificate : str
        That of rho(R), "collatz-wielandt" or "power iteration"; "free bounds" on the spectrum of S, which
        are those of Lambertian scenes; "power iteration of sweeps" and "ritz values", estimates; or "none",
        with a reason where there is more to say.
    """

    products: float
    certificate: str


def forecasts(
    S: Operator,
    rho: SpectralRadius,
    bounds: tuple[float, float],
    rtol: float,
    spectrum: tuple[float, float] | None = None,
    self_adjoint: bool = True,
) -> dict[str, Forecast]:
    """What each iterative method will need for S x = b to a relative residual of `rtol`, its options default.

    Where 1 lies between certified bounds on rho(R), they do not tell whether the series converges: its
    forecast then rests on the power iteration alone. Krylov methods are foretold by the Chebyshev polynomial
    on `spectrum`, an estimate of the positive interval that holds the eigenvalues of S, where there is one;
    they may well need less. Nothing foretells Southwell's method.

    >>> from ltcl.operators import IdentityPlus, as_operator
    >>> S = IdentityPlus(as_operator([[0.0, 0.5], [0.5, 0.0]]))
    >>> rho = SpectralRadius(0.5, 0.0, 2)
    >>> for name, f in forecasts(S, rho, (0.5, 1.5), 1e-2, (0.5, 1.5)).items():
    ...     print(name, f.products, f.certificate)
    jacobi 7 power iteration
    neumann 7 power iteration
    richardson 7 free bounds
    chebyshev 5 free bounds
    gauss_seidel 4 power iteration of sweeps
    sor 4 power iteration of sweeps
    southwell nan none
    cg 6 ritz values
    gmres 6 ritz values
    bicgstab 7 ritz values
    """
    decided = not rho.lower < 1.0 <= rho.upper
    series = Forecast(series_products(rho.value, rtol), rho.certificate if decided else POWER_ITERATION)
    sweeps = gauss_seidel_forecast(S, rtol)
    degree = chebyshev_products(*spectrum, rtol) if spectrum else math.nan
    krylov = {
        "cg": degree + 1 if self_adjoint else math.nan,  # one to confirm the end, as of the others
        "gmres": degree + 1,
        "bicgstab": 2 * math.ceil(degree / 2) + 1 if spectrum else math.nan,  # two products, two degrees
    }
    found = {
        "jacobi": series,
        "neumann": series,
        "richardson": Forecast(richardson_products(*bounds, rtol), FREE_BOUNDS),
        "chebyshev": Forecast(chebyshev_products(*bounds, rtol), FREE_BOUNDS),
        "gauss_seidel": sweeps,
        "sor": sweeps,  # omega = 1
        "southwell": Forecast(math.nan, NOTHING),
        **{name: Forecast(n, NOTHING if math.isnan(n) else RITZ) for name, n in krylov.items()},
    }
    return found if rtol >= _FLOAT32 else {name: _beyond(one) for name, one in found.items()}


def _beyond(forecast: Forecast) -> Forecast:
    """What diverges does so at any tolerance; of the rest nothing can be said."""
    return forecast if math.isinf(forecast.products) else Forecast(math.nan, BEYOND)


def gauss_seidel_forecast(S: Operator, rtol: float) -> Forecast:
    """Sweeps of Gauss-Seidel, from the growth of errors under -(D + L)^-1 U, S = L + D + U.

    On the host, densely, so for small N only; others have no forecast.

    >>> from ltcl.operators import as_operator
    >>> gauss_seidel_forecast(as_operator([[1.0, 0.5], [0.5, 1.0]]), 1e-2).products  # rho is 1/4
    4
    """
    n = S.shape[0]
    if n > _LARGEST_SWEEP or 2 * 8 * n * n > checks.host_memory():
        return Forecast(math.nan, NOTHING)
    rho = _sweep_radius(S.to_dense())
    return Forecast(series_products(rho, rtol), SWEEPS) if math.isfinite(rho) else Forecast(math.nan, NOTHING)


def _sweep_radius(S: np.ndarray) -> float:
    """rho of -(D + L)^-1 U as the mean growth of an error once it has settled; NaN with a zero on D."""
    if not np.diagonal(S).all():
        return math.nan
    S = np.asfortranarray(S)
    upper = np.triu(S, 1)
    error, growth = np.random.default_rng(0).uniform(0.5, 1.5, len(S)), []
    for _ in range(_SWEEPS):
        error = scipy.linalg.solve_triangular(S, upper @ error, lower=True, check_finite=False)
        growth.append(float(np.linalg.norm(error)))
        if growth[-1] == 0.0 or not math.isfinite(growth[-1]):
            return 0.0 if growth[-1] == 0.0 else math.nan
        error /= -growth[-1]
    return math.exp(float(np.mean(np.log(growth[_SETTLING:]))))


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


def richardson_products(lower: float, upper: float, rtol: float) -> int:
    """Products of the Richardson iteration to `rtol` with the spectrum in [lower, upper].

    Each step with omega = 2 / (lower + upper) shrinks the residual by (upper - lower) / (upper + lower)
    (Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., example 4.1).

    >>> richardson_products(0.5, 5.0, 1e-2)
    23
    """
    factor = (upper - lower) / (upper + lower)
    return 1 if factor <= rtol else math.ceil(math.log(rtol) / math.log(factor))
