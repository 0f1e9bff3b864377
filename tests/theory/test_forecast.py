# SPDX-License-Identifier: BSD-3-Clause
"""Forecasts against closed forms."""

from __future__ import annotations

import math
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
@pytest.mark.parametrize("rho", [0.0, 1e-3, 0.3, 0.77, 0.99, 1.0, 4.0])
def test_the_series_takes_the_first_power_below_the_tolerance(rho, rtol):
    k = theory.series_products(rho, rtol)
    assert math.isinf(k) == (rho >= 1.0)
    if rho < 1.0:
        assert k >= 1
        assert rho**k <= rtol * (1 + 1e-12)
        assert k == 1 or rho ** (k - 1) > rtol * (1 - 1e-12)


@pytest.mark.parametrize("rtol", [0.3, 1e-2, 1e-5])
@pytest.mark.parametrize(("lower", "upper"), [(0.5, 1.5), (0.5, 5.0), (0.5, 50.0), (0.2, 1.8), (2.0, 2.0)])
def test_products_over_an_interval_are_the_first_below_the_tolerance(lower, upper, rtol):
    """Richardson's polynomial is a power; that of Chebyshev has the maximum 1 / T_k(centre / radius)."""
    k, centre = theory.richardson_products(lower, upper, rtol), (upper + lower) / 2
    factor = (upper - lower) / 2 / centre
    assert factor**k <= rtol * (1 + 1e-9)
    assert k == 1 or factor ** (k - 1) > rtol * (1 - 1e-9)
    degree = theory.chebyshev_products(lower, upper, rtol)
    assert degree <= k
    assert factor == 0 or 1 / Chebyshev.basis(degree)(1 / factor) <= rtol * (1 + 1e-9)
    assert degree == 1 or 1 / Chebyshev.basis(degree - 1)(1 / factor) > rtol * (1 - 1e-9)


@pytest.mark.parametrize("upper", [1e3, 1e16, 1e30])
def test_products_of_the_widest_spectra_are_counted(upper):
    """As sqrt(upper) and as upper, also where (upper + lower) / (upper - lower) rounds to 1."""
    chebyshev = theory.chebyshev_products(1.0, upper, 1e-2)
    assert chebyshev == pytest.approx(np.arccosh(100.0) / 2.0 * np.sqrt(upper), rel=0.02)
    richardson = theory.richardson_products(1.0, upper, 1e-2)
    assert richardson == pytest.approx(np.log(100.0) / 2.0 * upper, rel=0.02)


def sweeps(S: np.ndarray, b: np.ndarray, rtol: float) -> int:
    """Gauss-Seidel as eq. 17-20 have it, until the residual is below rtol."""
    x, lower, count = np.zeros(len(b)), np.tril(S), 0
    while np.linalg.norm(b - S @ x) > rtol * np.linalg.norm(b):
        x += np.linalg.solve(lower, b - S @ x)
        count += 1
    return count


@pytest.mark.parametrize("rtol", [1e-2, 1e-4])
@pytest.mark.parametrize("rho", [0.3, 0.9, 4.0, 9.0])
@pytest.mark.parametrize("seed", range(3))
def test_gauss_seidel_takes_the_sweeps_foreseen(device, seed, rho, rtol):
    scene = lambertian(40, rho, seed)
    S = IdentityPlus(Dense(device, scene.R))
    found = theory.gauss_seidel_forecast(S, rtol)
    assert found.certificate == "trial sweeps"
    b = scene.S @ np.random.default_rng(seed + 5).uniform(0.5, 1.5, 40)
    assert abs(found.products - sweeps(scene.S, b, rtol)) <= 1
    assert abs(found.products - ltcl.solve(S, b, "gauss_seidel", rtol=rtol).iterations) <= 1


def test_sweeps_beyond_those_tried_go_on_at_their_rate(device, monkeypatch):
    S = IdentityPlus(Dense(device, enclosure(40, 0.97).R))
    every = theory.gauss_seidel_forecast(S, 1e-5).products
    monkeypatch.setattr(forecast, "_TRIAL", 0)
    assert every > 2 * forecast._LATE
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
    found = theory.gauss_seidel_forecast(Host(ltcl.open_device(), aslinearoperator(np.array(S))), 1e-2)
    assert found.products == pytest.approx(products, nan_ok=True)
    assert found.certificate == certificate


@pytest.mark.parametrize("albedo", [0.45, 0.51, 0.8])
def test_gauss_seidel_converges_where_jacobi_does_not(device, albedo):
    scene = enclosure(40, albedo)
    R = Dense(device, scene.R)
    S, rho = IdentityPlus(R), theory.spectral_radius(R, norms=R.norms())
    found = theory.forecasts(S, rho, theory.free_bounds(S), 1e-2)
    assert math.isinf(found["jacobi"].products) == (albedo > 0.5)
    assert found["gauss_seidel"].products < 60
    assert found["jacobi"].certificate == "collatz-wielandt"
    assert found["chebyshev"].products <= found["richardson"].products < math.inf


def test_bounds_on_both_sides_of_one_leave_the_series_uncertified(device):
    S = IdentityPlus(Dense(device, [[0.0, 0.5], [0.5, 0.0]]))
    rho = SpectralRadius(0.9, 0.0, 1, lower=0.8, upper=1.1, certificate="collatz-wielandt")
    assert theory.forecasts(S, rho, (0.5, 2.0), 1e-2)["jacobi"].certificate == "power iteration"


@pytest.mark.parametrize("rtol", [1e-2, 1e-4])
@pytest.mark.parametrize("rho", [0.8, 4.0, 9.0])
@pytest.mark.parametrize("method", ["cg", "gmres", "bicgstab"])
def test_krylov_methods_take_no_more_than_foreseen(device, method, rho, rtol):
    """With the true spectrum of a symmetric S the bound is strict; least energy is not least residual."""
    scene = enclosure(60, rho / (1 + rho))
    S = IdentityPlus(Dense(device, scene.R))
    eigenvalues = np.linalg.eigvalsh(scene.S)
    radius = theory.spectral_radius(S.R, norms=S.R.norms())
    spectrum = float(eigenvalues[0]), float(eigenvalues[-1])
    found = theory.forecasts(S, radius, theory.free_bounds(S), rtol, spectrum)[method]
    assert found.certificate == "ritz values"
    s = ltcl.solve(S, np.random.default_rng(4).normal(size=60), method, rtol=rtol)
    assert s.products <= found.products + (method == "cg")


def test_what_nothing_foretells_is_said(device):
    S = IdentityPlus(Dense(device, enclosure(40, 0.6).R))
    radius = theory.spectral_radius(S.R)
    found = theory.forecasts(S, radius, theory.free_bounds(S), 1e-2, spectrum=None)
    for name in ("block_gauss_seidel", "southwell", "cg", "gmres", "bicgstab"):
        assert math.isnan(found[name].products)
        assert found[name].certificate == "none"
    lopsided = theory.forecasts(S, radius, theory.free_bounds(S), 1e-2, (0.5, 3.0), self_adjoint=False)
    assert math.isnan(lopsided["cg"].products)
    assert math.isfinite(lopsided["gmres"].products)
    assert found["sor"] == found["gauss_seidel"]  # omega is 1


def test_float32_confirms_no_tolerance_below_its_rounding(device):
    S = IdentityPlus(Dense(device, enclosure(40, 0.6).R))
    with pytest.raises(InputError, match="rtol is 1e-08"):
        theory.forecasts(S, theory.spectral_radius(S.R), theory.free_bounds(S), 1e-8, (0.5, 3.0))


BAD: Any = "x"
WRONG = {
    "R": lambda: theory.spectral_radius(BAD),
    "S of bounds": lambda: theory.free_bounds(BAD),
    "S of sweeps": lambda: theory.gauss_seidel_forecast(BAD, 1e-2),
    "rho": lambda: theory.series_products(BAD, 1e-2),
    "rtol": lambda: theory.series_products(0.5, BAD),
    "lower": lambda: theory.chebyshev_products(BAD, 1.0, 1e-2),
    "upper": lambda: theory.richardson_products(0.5, BAD, 1e-2),
    "rho of forecasts": lambda: theory.forecasts(IdentityPlus(as_operator(np.eye(2))), BAD, (0.5, 2.0), 1e-2),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_type_is_refused_by_name(name):
    with pytest.raises(InputTypeError, match=f"^{name.split()[0]} is .*; it must be "):
        WRONG[name]()
