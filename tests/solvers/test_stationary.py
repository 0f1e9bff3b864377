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
@pytest.mark.parametrize("rho", [1.05, 9.0])
@pytest.mark.parametrize(
    ("method", "options"), [("jacobi", {}), ("neumann", {}), ("richardson", {"omega": 1})]
)
def test_past_radius_one_it_diverges_with_its_best_iterate(device, method, options, rho, columns):
    scene = lambertian(30, rho)
    b = scene.S @ random.uniform(0.0, 1.0, (scene.n, *columns))
    S = IdentityPlus(Dense(device, scene.R))
    with pytest.raises(ConvergenceError, match="chebyshev") as caught:
        ltcl.solve(S, b, method, **options)
    s = caught.value.solution
    assert s.status is Status.DIVERGED
    assert min(s.residuals) <= s.residual <= 1.0 + 1e-6
    assert residual(scene.S, s.x, b) == pytest.approx(s.residual, rel=1e-3)


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


@pytest.mark.parametrize("omega", [0.0, -1.0, np.inf, np.nan, "fast", [1.0]])
def test_an_unusable_omega_is_refused(omega):
    with pytest.raises(InputError, match=r"omega is .*above 0"):
        ltcl.solve(np.eye(3), np.ones(3), "richardson", omega=omega)
