# SPDX-License-Identifier: BSD-3-Clause
"""Forecasts of products against closed forms."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.polynomial.chebyshev import Chebyshev
from scipy.sparse.linalg import aslinearoperator

import ltcl
from ltcl import theory
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Dense, Host, IdentityPlus, as_operator
from ltcl.theory import SpectralRadius, forecast
from tests.problems import enclosure, lambertian


@pytest.mark.parametrize("rtol", [0.3, 1e-2, 1e-5])
@pytest.mark.parametrize("f", [0.0, 1e-3, 0.3, 0.77, 0.99])
def test_products_are_the_first_with_a_polynomial_below_the_tolerance(f, rtol):
    """The series and Richardson have f^k; Chebyshev has the maximum 1 / T_k(centre / radius)."""
    bounds = 2 * (1 - f), 2 * (1 + f), rtol
    table: list[tuple[float, Callable[[Any], Any]]] = [
        (theory.series_products(f, rtol), lambda k: f**k),
        (theory.richardson_products(*bounds), lambda k: f**k),
        (theory.chebyshev_products(*bounds), lambda k: 1 / Chebyshev.basis(k)(1 / f) if f else 0.0),
    ]
    for k, most in table:
        assert k >= 1
        assert most(k) <= rtol * (1 + 1e-9)
        assert k == 1 or most(k - 1) > rtol * (1 - 1e-9)
    assert math.isinf(theory.series_products(1.0 + f, rtol))


@pytest.mark.parametrize("upper", [1e3, 1e16, 1e30])
def test_products_of_the_widest_spectra_are_counted(upper):
    """Products grow as sqrt(upper), and as upper, even if the quotient of both rounds to 1."""
    chebyshev = theory.chebyshev_products(1.0, upper, 1e-2)
    assert chebyshev == pytest.approx(np.arccosh(100.0) / 2.0 * np.sqrt(upper), rel=0.02)
    richardson = theory.richardson_products(1.0, upper, 1e-2)
    assert richardson == pytest.approx(np.log(100.0) / 2.0 * upper, rel=0.02)


@pytest.mark.parametrize("rtol", [1e-2, 1e-4])
@pytest.mark.parametrize("rho", [0.3, 0.9, 4.0, 9.0])
@pytest.mark.parametrize("seed", range(3))
def test_gauss_seidel_takes_the_sweeps_foreseen(device, seed, rho, rtol):
    scene = lambertian(40, rho, seed)
    S = IdentityPlus(Dense(device, scene.R))
    found = theory.gauss_seidel_forecast(S, rtol)
    assert found.certificate == "trial sweeps"
    b = scene.S @ np.random.default_rng(seed + 5).uniform(0.5, 1.5, 40)
    assert abs(found.products - ltcl.solve(S, b, "gauss_seidel", rtol=rtol).iterations) <= 1


def test_sweeps_beyond_those_tried_go_on_at_their_rate(device, monkeypatch):
    S = IdentityPlus(Dense(device, enclosure(40, 0.97).R))
    every = theory.gauss_seidel_forecast(S, 1e-5).products
    monkeypatch.setattr(forecast, "MAX_TRIAL_ENTRIES", 0)
    assert every > 2 * forecast.MIN_TRIAL_SWEEPS
    assert theory.gauss_seidel_forecast(S, 1e-5).products == pytest.approx(every, rel=0.1)


@pytest.mark.parametrize(
    ("S", "products", "certificate"),
    [
        ([[1.0, 2.0], [2.0, 1.0]], math.inf, "trial sweeps"),  # rho is 4
        ([[0.0, 0.5], [0.5, 1.0]], math.nan, "none"),  # divides by 0
        ([[1.0, 0.0], [0.5, 1.0]], 1, "trial sweeps"),  # exact at once
        ([[1e-30, 1e30], [1e30, 1e-30]], math.inf, "trial sweeps"),  # in one sweep
    ],
)
def test_sweeps_that_diverge_or_break_down_are_foreseen(S, products, certificate):
    found = theory.gauss_seidel_forecast(
        Host(ltcl.open_device(), aslinearoperator(np.array(S))), 1e-2
    )
    assert found.products == pytest.approx(products, nan_ok=True)
    assert found.certificate == certificate


@pytest.mark.parametrize("albedo", [0.45, 0.51, 0.8])
def test_methods_with_and_without_a_forecast(device, albedo):
    """Gauss-Seidel converges even if Jacobi does not; cg needs a spectrum and a self-adjoint S."""
    S = IdentityPlus(Dense(device, enclosure(40, albedo).R))
    known = S, theory.spectral_radius(S.R, norms=S.R.norms()), theory.free_bounds(S)
    found = theory.forecasts(*known, 1e-2)
    assert math.isinf(found["jacobi"].products) == (albedo > 0.5)
    assert found["jacobi"].certificate == "collatz-wielandt"
    assert found["sor"] == found["gauss_seidel"]  # omega is 1
    assert found["gauss_seidel"].products < 60
    assert found["chebyshev"].products <= found["richardson"].products < math.inf
    for name in ("block_gauss_seidel", "southwell", "cg", "gmres", "bicgstab"):
        assert math.isnan(found[name].products)
        assert found[name].certificate == "none"
    lopsided = theory.forecasts(*known, 1e-2, (0.5, 3.0), self_adjoint=False)
    assert math.isnan(lopsided["cg"].products)
    assert math.isfinite(lopsided["gmres"].products)
    with pytest.raises(InputError, match="rtol is 1e-08"):  # which float32 cannot confirm
        theory.forecasts(*known, 1e-8, (0.5, 3.0))


def test_bounds_on_both_sides_of_one_leave_the_series_uncertified(device):
    S = IdentityPlus(Dense(device, [[0.0, 0.5], [0.5, 0.0]]))
    rho = SpectralRadius(0.9, 0.0, 1, lower=0.8, upper=1.1, certificate="collatz-wielandt")
    assert theory.forecasts(S, rho, (0.5, 2.0), 1e-2)["jacobi"].certificate == "power iteration"


@pytest.mark.slow
@pytest.mark.parametrize("rtol", [1e-2, 1e-4])
@pytest.mark.parametrize("rho", [0.8, 4.0, 9.0])
@pytest.mark.parametrize("method", ["cg", "gmres", "bicgstab"])
def test_krylov_methods_take_no_more_than_foreseen(device, method, rho, rtol):
    """The bound is strict for the true spectrum of a symmetric S, but for the residual of cg."""
    scene = enclosure(60, rho / (1 + rho))
    S = IdentityPlus(Dense(device, scene.R))
    eigenvalues = np.linalg.eigvalsh(scene.S)
    radius = theory.spectral_radius(S.R, norms=S.R.norms())
    spectrum = float(eigenvalues[0]), float(eigenvalues[-1])
    found = theory.forecasts(S, radius, theory.free_bounds(S), rtol, spectrum)[method]
    assert found.certificate == "ritz values"
    s = ltcl.solve(S, np.random.default_rng(4).normal(size=60), method, rtol=rtol)
    assert s.products <= found.products + (method == "cg")


# Bad input of all of the package.

BAD: Any = "x"
EYE = as_operator(np.eye(3))
REFUSED: list[tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any], str]] = [
    (theory.spectral_radius, (BAD,), {}, "R is"),
    (theory.free_bounds, (BAD,), {}, "S is"),
    (theory.gauss_seidel_forecast, (BAD, 1e-2), {}, "S is"),
    (theory.series_products, (BAD, 1e-2), {}, "rho is 'x'"),
    (theory.series_products, (0.5, BAD), {}, "rtol is 'x'"),
    (theory.chebyshev_products, (BAD, 1.0, 1e-2), {}, "lower is 'x'"),
    (theory.richardson_products, (0.5, BAD, 1e-2), {}, "upper is 'x'"),
    (theory.forecasts, (IdentityPlus(EYE), BAD, (0.5, 2.0), 1e-2), {}, "rho is"),
    (theory.inverse_error_bound, (0.62, 3), {}, r"m is 0\.62.*1/2"),
    (theory.inverse_error_bound, (float("nan"), 2), {}, "m is nan"),
    (theory.forward_error_bound, (-0.1, 2), {}, r"m is -0\.1"),
    (theory.after_terms, (0.3, [0]), {}, "orders is 0"),
    (theory.bounce_coefficients, (-1, 2), {}, "n is -1"),
    (theory.bounce_coefficients, (1.5, 2), {}, r"n is 1\.5"),
    (theory.bounce_coefficients, (2, True), {}, "bounces is True"),
    (theory.two_norm, (EYE, as_operator(np.eye(4))), {}, r"minus has shape \(4, 4\)"),
    (theory.two_norm, (EYE,), {"confidence": 1.0}, "confidence is 1"),
    (theory.two_norm, (EYE,), {"factor": 1.0}, "factor is 1"),
]


@pytest.mark.parametrize(("call", "arguments", "options", "says"), REFUSED)
def test_bad_input_is_refused_by_name(call, arguments, options, says):
    wrong_type = any(value is BAD for value in arguments) and "'x'" not in says
    with pytest.raises(InputTypeError if wrong_type else InputError, match=f"^{says}"):
        call(*arguments, **options)
