# SPDX-License-Identifier: BSD-3-Clause
"""Jacobi and Neumann: steps are partial sums of the series (eq. 10, 18, 20); and Richardson."""

from __future__ import annotations

import numpy as np
import pytest

import ltcl
from ltcl import theory
from ltcl.errors import ConvergenceError, InputError
from ltcl.operators import Dense, IdentityPlus
from ltcl.solvers import Status
from tests.problems import enclosure, lambertian, residual

SCENE = lambertian(31, rho=0.8, seed=2)
random = np.random.default_rng(3)


def series(matrix: np.ndarray, b: np.ndarray, terms: int) -> np.ndarray:
    """b + M b + M^2 b + ..., `terms` of them."""
    total, term = np.zeros_like(b), b
    for _ in range(terms):
        total, term = total + term, matrix @ term
    return total


@pytest.mark.parametrize("terms", [1, 2, 7, 12])
@pytest.mark.parametrize(("matrix", "sign"), [(SCENE.R, 1), (SCENE.A, -1)], ids=["inverse", "forward"])
@pytest.mark.parametrize(
    ("method", "options"), [("jacobi", {}), ("neumann", {}), ("richardson", {"omega": 1.0})]
)
def test_k_steps_are_k_terms(device, method, options, matrix, sign, terms):
    """Of I - R + R^2 - ... (eq. 10) on S = I + R, and of I + A + A^2 + ... (eq. 4) on I - A."""
    b = random.uniform(0.0, 1.0, (SCENE.n, 2))
    S = IdentityPlus(Dense(device, matrix), sign)
    s = ltcl.solve(S, b, method, rtol=1e-6, maxiter=terms, throw=False, **options)
    assert (s.iterations, len(s.residuals)) == (terms, terms + 1)
    exact = series(-sign * matrix, b, terms)
    # Each step rounds a sum of n float32 products.
    np.testing.assert_allclose(s.x, exact, rtol=0, atol=terms * SCENE.n * 2**-24 * np.abs(exact).max())
    assert residual(np.eye(SCENE.n) + sign * matrix, s.x, b) == pytest.approx(s.residual, rel=1e-2, abs=1e-6)


@pytest.mark.parametrize("columns", [(), (3,)])
@pytest.mark.parametrize("rho", [1.05, 4.0, 9.0])
@pytest.mark.parametrize("method", ["jacobi", "neumann"])
def test_past_radius_one_it_diverges_with_its_best_iterate(device, method, rho, columns):
    scene = lambertian(30, rho)
    b = scene.S @ random.uniform(0.0, 1.0, (scene.n, *columns))
    S = IdentityPlus(Dense(device, scene.R))
    with pytest.raises(ConvergenceError, match="chebyshev") as caught:
        ltcl.solve(S, b, method)
    s = caught.value.solution
    assert s.status is Status.DIVERGED
    assert min(s.residuals) <= s.residual <= 1.0 + 1e-6
    assert residual(scene.S, s.x, b) == pytest.approx(s.residual, rel=1e-3)
    np.testing.assert_array_equal(ltcl.solve(S, b, method, throw=False).x, s.x)


@pytest.mark.parametrize("rho", [0.5, 0.9])
def test_the_residual_falls_by_the_radius(device, rho):
    """In a closed room of one albedo even light is the dominant eigenvector: r_k = rho^k r_0."""
    scene, seen = enclosure(25, rho / (1 + rho)), []
    S = IdentityPlus(Dense(device, scene.R))
    s = ltcl.solve(S, np.ones(scene.n), "jacobi", rtol=1e-2, callback=lambda *step: seen.append(step))
    np.testing.assert_allclose(s.residuals, rho ** np.arange(len(s.residuals)), rtol=1e-3)
    assert s.products == s.iterations <= theory.series_products(rho, 1e-2) + 1
    assert seen == list(enumerate(s.residuals))


@pytest.mark.parametrize("rho", [0.5, 1.5, 4.0, 9.0])
@pytest.mark.parametrize("seed", range(3))
def test_richardson_takes_no_more_products_than_the_bound(device, seed, rho):
    """S is symmetric with its spectrum inside the free bounds, so each step shrinks the residual so much."""
    scene = enclosure(40, rho / (1 + rho), seed)
    S, b = IdentityPlus(Dense(device, scene.R)), random.normal(size=(scene.n, 3))
    s = ltcl.solve(S, b, "richardson")
    assert residual(scene.S, s.x, b) <= 1e-2 * (1 + 1e-3)
    assert s.products <= theory.richardson_products(0.5, 1 + rho, 1e-2) + 1


@pytest.mark.parametrize("albedo", [0.3, 0.6, 0.9])
def test_one_albedo_has_the_damping_1_minus_m_squared(device, albedo):
    """Its factor is m a step: exactly so on even light, with its eigenvalue 1 / (1 - m) at one end."""
    S, b = IdentityPlus(Dense(device, enclosure(30, albedo).R)), np.ones(30)
    s = ltcl.solve(S, b, "richardson", omega=1 - albedo**2, rtol=1e-3)
    np.testing.assert_allclose(s.residuals, albedo ** np.arange(len(s.residuals)), rtol=1e-2)


def test_too_large_a_step_diverges_and_says_so(device):
    S = IdentityPlus(Dense(device, enclosure(30, 0.8).R))
    s = ltcl.solve(S, np.ones(30), "richardson", omega=0.5, throw=False)  # 2/5 at most
    assert s.status is Status.DIVERGED


@pytest.mark.parametrize("omega", [0.0, -1.0, np.inf, np.nan, "fast", [1.0]])
def test_an_unusable_omega_is_refused(omega):
    with pytest.raises(InputError, match=r"omega is .*above 0"):
        ltcl.solve(np.eye(3), np.ones(3), "richardson", omega=omega)


@pytest.mark.parametrize("columns", [(), (3,)])
@pytest.mark.parametrize(
    ("method", "rho", "options"),
    [("jacobi", 0.9, {}), ("neumann", 0.9, {}), ("richardson", 9.0, {}), ("chebyshev", 50.0, {"arnoldi": 0})],
)
def test_residuals_are_read_together(device, monkeypatch, method, rho, options, columns):
    """Far less than once a step; no step is lost of the history."""
    scene = enclosure(40, rho / (1 + rho))
    S, b = IdentityPlus(Dense(device, scene.R)), scene.S @ random.uniform(size=(40, *columns))
    ltcl.solve(S, b, method, rtol=1e-4, **options)
    reads, read = [], ltcl.device.Array.get
    monkeypatch.setattr(ltcl.device.Array, "get", lambda array: reads.append(array) or read(array))
    s = ltcl.solve(S, b, method, rtol=1e-4, **options)
    assert s.iterations >= 25
    assert len(reads) < s.iterations / 2
    assert len(s.residuals) == s.iterations + 1
    assert residual(scene.S, s.x, b) <= 1e-4 * (1 + 1e-2)
