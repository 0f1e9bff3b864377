# SPDX-License-Identifier: BSD-3-Clause
"""Forecast of the products that each method needs, by rho(R) or bounds on the spectrum of S."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from ltcl import checks
from ltcl.errors import InputTypeError
from ltcl.operators import Compressed, IdentityPlus, Operator
from ltcl.theory.spectrum import POWER_ITERATION, SpectralRadius, require_operator

# Certificates of a forecast, beside those of a spectral radius.
FREE_BOUNDS = "free bounds"
SWEEPS = "trial sweeps"
RITZ = "ritz values"
NOTHING = "none"

# A relative residual below is rounding.
LEAST_RTOL = 2.0**-23
# Pixels up to which a sweep on the host takes hundredths of a second.
MAX_SWEEP_PIXELS = 4096
# Trial sweeps at least, the later half of which tells the growth.
MIN_TRIAL_SWEEPS = 30
# Entries that trial sweeps read at most, beyond those: about a second.
MAX_TRIAL_ENTRIES = 300_000_000
# Relative residual at which sweeps have diverged.
DIVERGED = 1e30


@dataclass(frozen=True)
class Forecast:
    """Products (sweeps of Gauss-Seidel) that a method needs to a tolerance.

    Attributes
    ----------
    products : float
        Infinite if the method diverges, NaN if nothing is known.
    certificate : str
        Certificate of rho(R), "collatz-wielandt" or "power iteration"; "free bounds" on the
        spectrum of S, which are those of Lambertian scenes; "trial sweeps" and "ritz values",
        estimates; or "none".
    """

    products: float
    certificate: str


UNKNOWN = Forecast(math.nan, NOTHING)


def forecasts(
    S: Operator,
    rho: SpectralRadius,
    bounds: tuple[float, float],
    rtol: float,
    spectrum: tuple[float, float] | None = None,
    self_adjoint: bool = True,
) -> dict[str, Forecast]:
    """Products of each iterative method for S x = b to a relative residual of `rtol`.

    Options of methods are default. If 1 lies between certified bounds on rho(R), they do not tell
    whether the series converges: its forecast then rests on the power iteration alone. Krylov
    methods are forecast by the Chebyshev polynomial on `spectrum`, an estimate of the positive
    interval that holds the eigenvalues of S, if there is one; they may need less. There is no
    forecast for Southwell's method, nor for the blocks of block_gauss_seidel. InputError if rtol is
    below what float32 products confirm, 1.2e-7.

    >>> from ltcl.operators import IdentityPlus, as_operator
    >>> S = IdentityPlus(as_operator([[0.0, 0.5], [0.5, 0.0]]))
    >>> rho = SpectralRadius(0.5, 0.0, 2)
    >>> for name, f in forecasts(S, rho, (0.5, 1.5), 1e-2, (0.5, 1.5)).items():
    ...     print(name, f.products, f.certificate)
    jacobi 7 power iteration
    neumann 7 power iteration
    richardson 7 free bounds
    chebyshev 5 free bounds
    gauss_seidel 3 trial sweeps
    sor 3 trial sweeps
    block_gauss_seidel nan none
    southwell nan none
    cg 6 ritz values
    gmres 6 ritz values
    bicgstab 8 ritz values
    """
    require_operator("S", S)
    if not isinstance(rho, SpectralRadius):
        kind = type(rho).__name__
        raise InputTypeError(
            f"rho is a {kind}; it must be the SpectralRadius of theory.spectral_radius"
        )
    checks.number("rtol", rtol, least=LEAST_RTOL, below=1.0)
    series = _series_forecast(rho, rtol)
    # omega of sor is 1 by default.
    sweeps = gauss_seidel_forecast(S, rtol)
    methods = {
        "jacobi": series,
        "neumann": series,
        "richardson": Forecast(richardson_products(*bounds, rtol), FREE_BOUNDS),
        "chebyshev": Forecast(chebyshev_products(*bounds, rtol), FREE_BOUNDS),
        "gauss_seidel": sweeps,
        "sor": sweeps,
        "block_gauss_seidel": UNKNOWN,
        "southwell": UNKNOWN,
    }
    return methods | _krylov_forecasts(spectrum, rtol, self_adjoint)


def _series_forecast(rho: SpectralRadius, rtol: float) -> Forecast:
    certificate = rho.certificate
    if rho.lower < 1.0 <= rho.upper:
        # The certified bounds do not decide whether the series converges.
        certificate = POWER_ITERATION
    return Forecast(series_products(rho.value, rtol), certificate)


def _krylov_forecasts(
    spectrum: tuple[float, float] | None, rtol: float, self_adjoint: bool
) -> dict[str, Forecast]:
    if spectrum is None:
        return {"cg": UNKNOWN, "gmres": UNKNOWN, "bicgstab": UNKNOWN}
    degree = chebyshev_products(*spectrum, rtol)
    # One product confirms the end.
    gmres = Forecast(degree + 1, RITZ)
    # A product by S^T begins.
    bicgstab = Forecast(2 * math.ceil(degree / 2) + 2, RITZ)
    cg = gmres if self_adjoint else UNKNOWN
    return {"cg": cg, "gmres": gmres, "bicgstab": bicgstab}


def gauss_seidel_forecast(S: Operator, rtol: float) -> Forecast:
    """Sweeps of Gauss-Seidel until the residual of a random positive picture is below `rtol`.

    The first ones are done, in float64; from there on errors grow as under -(D + L)^-1 U, S = L + D
    + U. On the host, densely, so for small N only; others have no forecast.

    >>> from ltcl.operators import as_operator
    >>> gauss_seidel_forecast(as_operator([[1.0, 0.5], [0.5, 1.0]]), 1e-2).products  # rho is 1/4
    3
    """
    n = require_operator("S", S).shape[0]
    # Sweeps of a compressed S go over coefficients.
    is_compressed = isinstance(S, IdentityPlus) and isinstance(S.R, Compressed)
    needed_bytes = 2 * 8 * n * n
    if is_compressed or n > MAX_SWEEP_PIXELS or needed_bytes > checks.host_memory():
        return UNKNOWN
    residuals = _trial_sweeps(S.to_dense(), rtol)
    sweeps = len(residuals) - 1
    last = residuals[-1]
    if last <= rtol:
        return Forecast(sweeps, SWEEPS)
    if not math.isfinite(last) or sweeps == 0:
        return UNKNOWN
    late = residuals[-MIN_TRIAL_SWEEPS // 2 :]
    rate = (last / late[0]) ** (1.0 / max(1, len(late) - 1))
    return Forecast(sweeps + series_products(rate, rtol / last), SWEEPS)


def _trial_sweeps(S: np.ndarray, rtol: float) -> list[float]:
    """Relative residuals before and after each sweep, to `rtol` at best; 1 without a diagonal."""
    residuals = [1.0]
    if not np.diagonal(S).all():
        return residuals
    S = np.asfortranarray(S)
    upper = np.triu(S, 1)
    max_count = max(MIN_TRIAL_SWEEPS, MAX_TRIAL_ENTRIES // S.size)
    error = np.random.default_rng(0).uniform(0.5, 1.5, len(S))
    first_norm = float(np.linalg.norm(S @ error))
    right = upper @ error
    while rtol < residuals[-1] < DIVERGED and len(residuals) <= max_count:
        # (D + L) e' = -U e, so that the residual is S e' = U e' - U e.
        error = -scipy.linalg.solve_triangular(S, right, lower=True, check_finite=False)
        previous = right
        right = upper @ error
        residuals.append(float(np.linalg.norm(right - previous)) / first_norm)
    return residuals


def series_products(rho: float, rtol: float) -> float:
    """Products of the Neumann series or the Jacobi iteration to `rtol`: rho^k <= rtol (eq. 10, 20).

    >>> series_products(0.5, 1e-2), series_products(1.0, 1e-2)
    (7, inf)
    """
    rho = checks.number("rho", rho)
    rtol = checks.number("rtol", rtol)
    if rho >= 1.0:
        return math.inf
    if rho <= rtol:
        return 1
    return math.ceil(math.log(rtol) / math.log(rho))


def chebyshev_products(lower: float, upper: float, rtol: float) -> int:
    """Products of the Chebyshev iteration to `rtol` with the spectrum in [lower, upper].

    The residual polynomial has maximum 1 / T_k((upper + lower) / (upper - lower)) there
    (Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., section 6.11).

    >>> chebyshev_products(0.5, 5.0, 1e-2)
    9
    """
    _check_spectrum(lower, upper, rtol)
    if upper <= lower:
        return 1
    # acosh of the centre, which may round to 1.
    angle = 2.0 * math.asinh(math.sqrt(lower / (upper - lower)))
    return max(1, math.ceil(math.acosh(1.0 / rtol) / angle))


def richardson_products(lower: float, upper: float, rtol: float) -> int:
    """Products of the Richardson iteration to `rtol` with the spectrum in [lower, upper].

    Each step with omega = 2 / (lower + upper) shrinks the residual by (upper - lower) / (upper +
    lower) (Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., example 4.1).

    >>> richardson_products(0.5, 5.0, 1e-2)
    23
    """
    _check_spectrum(lower, upper, rtol)
    factor = (upper - lower) / (upper + lower)
    if factor <= rtol:
        return 1
    log_factor = math.log1p(-2.0 * lower / (upper + lower))
    return math.ceil(math.log(rtol) / log_factor)


def _check_spectrum(lower: float, upper: float, rtol: float) -> None:
    checks.number("lower", lower)
    checks.number("upper", upper)
    checks.number("rtol", rtol)
