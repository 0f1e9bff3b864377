# SPDX-License-Identifier: BSD-3-Clause
"""Products that each method will need, foretold from rho(R) or from bounds on the spectrum of S."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg

from ltcl import checks
from ltcl.errors import InputTypeError
from ltcl.operators import Compressed, IdentityPlus, Operator
from ltcl.theory.spectrum import POWER_ITERATION, SpectralRadius, require_operator

FREE_BOUNDS, SWEEPS, RITZ = "free bounds", "trial sweeps", "ritz values"
NOTHING = "none"
LEAST_RTOL = 2.0**-23  # a relative residual below is rounding
_LARGEST_SWEEP = 4096  # pixels: a sweep on the host takes hundredths of a second
_LATE = 30  # trial sweeps at least, the later half of which tells the growth
_TRIAL = 300_000_000  # entries that trial sweeps read at most, beyond those: about a second
_DIVERGED = 1e30


@dataclass(frozen=True)
class Forecast:
    """Products (sweeps of Gauss-Seidel) a method needs to a tolerance, and what says so.

    Attributes
    ----------
    products : float
        Infinite where the method diverges, NaN where nothing is known.
    certificate : str
        That of rho(R), "collatz-wielandt" or "power iteration"; "free bounds" on the spectrum of S,
        which are those of Lambertian scenes; "trial sweeps" and "ritz values", estimates; or
        "none".
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

    Where 1 lies between certified bounds on rho(R), they do not tell whether the series converges:
    its forecast then rests on the power iteration alone. Krylov methods are foretold by the
    Chebyshev polynomial on `spectrum`, an estimate of the positive interval that holds the
    eigenvalues of S, where there is one; they may well need less. Nothing foretells Southwell's
    method, nor the blocks of block_gauss_seidel. InputError where rtol is below what float32
    products confirm, 1.2e-7.

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
        raise InputTypeError(
            f"rho is a {type(rho).__name__}; it must be what theory.spectral_radius returns"
        )
    checks.number("rtol", rtol, least=LEAST_RTOL, below=1.0)
    decided = not rho.lower < 1.0 <= rho.upper
    series = Forecast(
        series_products(rho.value, rtol), rho.certificate if decided else POWER_ITERATION
    )
    sweeps = gauss_seidel_forecast(S, rtol)
    degree = chebyshev_products(*spectrum, rtol) if spectrum else math.nan
    krylov = {
        "cg": degree + 1 if self_adjoint else math.nan,  # one to confirm the end, as of the others
        "gmres": degree + 1,
        "bicgstab": 2 * math.ceil(degree / 2) + 2
        if spectrum
        else math.nan,  # and one by S^T to begin
    }
    return {
        "jacobi": series,
        "neumann": series,
        "richardson": Forecast(richardson_products(*bounds, rtol), FREE_BOUNDS),
        "chebyshev": Forecast(chebyshev_products(*bounds, rtol), FREE_BOUNDS),
        "gauss_seidel": sweeps,
        "sor": sweeps,  # omega = 1
        "block_gauss_seidel": Forecast(math.nan, NOTHING),
        "southwell": Forecast(math.nan, NOTHING),
        **{name: Forecast(n, NOTHING if math.isnan(n) else RITZ) for name, n in krylov.items()},
    }


def gauss_seidel_forecast(S: Operator, rtol: float) -> Forecast:
    """Sweeps of Gauss-Seidel until the residual of a random positive picture is below `rtol`.

    The first ones are made, in float64; from there on errors grow as under -(D + L)^-1 U, S = L + D
    + U. On the host, densely, so for small N only; others have no forecast.

    >>> from ltcl.operators import as_operator
    >>> gauss_seidel_forecast(as_operator([[1.0, 0.5], [0.5, 1.0]]), 1e-2).products  # rho is 1/4
    3
    """
    n = require_operator("S", S).shape[0]
    compressed = isinstance(S, IdentityPlus) and isinstance(
        S.R, Compressed
    )  # sweeps go over coefficients
    if compressed or n > _LARGEST_SWEEP or 2 * 8 * n * n > checks.host_memory():
        return Forecast(math.nan, NOTHING)
    residuals = _trial_sweeps(S.to_dense(), rtol)
    sweeps, last = len(residuals) - 1, residuals[-1]
    if last <= rtol:
        return Forecast(sweeps, SWEEPS)
    if not math.isfinite(last) or not sweeps:
        return Forecast(math.nan, NOTHING)
    late = residuals[-_LATE // 2 :]
    rate = (last / late[0]) ** (1.0 / max(1, len(late) - 1))
    return Forecast(sweeps + series_products(rate, rtol / last), SWEEPS)


def _trial_sweeps(S: np.ndarray, rtol: float) -> list[float]:
    """Relative residuals before and after each sweep, to `rtol` at best; 1 alone without a diagonal."""
    residuals = [1.0]
    if not np.diagonal(S).all():
        return residuals
    S = np.asfortranarray(S)
    upper, error = np.triu(S, 1), np.random.default_rng(0).uniform(0.5, 1.5, len(S))
    first, right = float(np.linalg.norm(S @ error)), upper @ error
    while rtol < residuals[-1] < _DIVERGED and len(residuals) <= max(_LATE, _TRIAL // S.size):
        error = -scipy.linalg.solve_triangular(S, right, lower=True, check_finite=False)
        before, right = right, upper @ error
        residuals.append(float(np.linalg.norm(right - before)) / first)  # S e = (D + L) e + U e
    return residuals


def series_products(rho: float, rtol: float) -> float:
    """Products of the Neumann series or the Jacobi iteration to `rtol`: rho^k <= rtol (eq. 10, 20).

    >>> series_products(0.5, 1e-2), series_products(1.0, 1e-2)
    (7, inf)
    """
    rho, rtol = checks.number("rho", rho), checks.number("rtol", rtol)
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
    lower, upper, rtol = _numbers(lower, upper, rtol)
    if upper <= lower:
        return 1
    angle = 2.0 * math.asinh(
        math.sqrt(lower / (upper - lower))
    )  # acosh of the centre, which may round to 1
    return max(1, math.ceil(math.acosh(1.0 / rtol) / angle))


def richardson_products(lower: float, upper: float, rtol: float) -> int:
    """Products of the Richardson iteration to `rtol` with the spectrum in [lower, upper].

    Each step with omega = 2 / (lower + upper) shrinks the residual by (upper - lower) / (upper +
    lower) (Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., example 4.1).

    >>> richardson_products(0.5, 5.0, 1e-2)
    23
    """
    lower, upper, rtol = _numbers(lower, upper, rtol)
    factor = (upper - lower) / (upper + lower)
    return (
        1
        if factor <= rtol
        else math.ceil(math.log(rtol) / math.log1p(-2.0 * lower / (upper + lower)))
    )


def _numbers(lower: Any, upper: Any, rtol: Any) -> tuple[float, float, float]:
    return checks.number("lower", lower), checks.number("upper", upper), checks.number("rtol", rtol)
