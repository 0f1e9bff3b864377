# SPDX-License-Identifier: BSD-3-Clause
"""Jacobi is the paper's iteration: its steps are partial sums of the series (eq. 10, 18, 20)."""

from __future__ import annotations

import numpy as np
import pytest

import ltcl
from ltcl.errors import ConvergenceError
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


@pytest.mark.parametrize("terms", [1, 2, 3, 7, 12])
@pytest.mark.parametrize(("matrix", "sign"), [(SCENE.R, 1), (SCENE.A, -1)], ids=["inverse", "forward"])
@pytest.mark.parametrize("method", ["jacobi", "neumann"])
def test_k_steps_are_k_terms(device, method, matrix, sign, terms):
    """Of I - R + R^2 - ... (eq. 10) on S = I + R, and of I + A + A^2 + ... (eq. 4) on I - A."""
    b = random.uniform(0.0, 1.0, (SCENE.n, 2))
    S = IdentityPlus(Dense(device, matrix), sign)
    s = ltcl.solve(S, b, method, rtol=1e-6, maxiter=terms, throw=False)
    assert s.iterations == terms
    wanted = series(-sign * matrix, b, terms)
    # Each step rounds a sum of n float32 products.
    np.testing.assert_allclose(s.x, wanted, rtol=0, atol=terms * SCENE.n * 2**-24 * np.abs(wanted).max())


@pytest.mark.parametrize("rho", [1.5, 4.0, 9.0])
@pytest.mark.parametrize(
    "make", [lambda rho: enclosure(30, rho / (1 + rho)), lambda rho: lambertian(30, rho)]
)
def test_past_radius_one_it_diverges_and_says_so(device, make, rho):
    scene = make(rho)
    b = scene.S @ random.uniform(0.0, 1.0, scene.n)
    S = IdentityPlus(Dense(device, scene.R))
    with pytest.raises(ConvergenceError, match=r"the residual grew.*chebyshev") as caught:
        ltcl.solve(S, b, "jacobi")
    s = caught.value.solution
    assert s.status is Status.DIVERGED
    assert not s.converged
    # The best iterate is the one of the smallest residual seen.
    assert s.residual == min(s.residuals)
    assert residual(scene.S, s.x, b) == pytest.approx(min(s.residuals), rel=1e-3)
    quiet = ltcl.solve(S, b, "jacobi", throw=False)
    np.testing.assert_array_equal(quiet.x, s.x)
    assert quiet.status is Status.DIVERGED


@pytest.mark.parametrize("rho", [0.5, 0.9])
def test_the_residual_falls_by_the_radius(device, rho):
    """In a closed room of one albedo even light is the dominant eigenvector: r_k = rho^k r_0."""
    scene = enclosure(25, rho / (1 + rho))
    s = ltcl.solve(IdentityPlus(Dense(device, scene.R)), np.ones(scene.n), "jacobi", rtol=1e-2)
    np.testing.assert_allclose(s.residuals, rho ** np.arange(len(s.residuals)), rtol=1e-3)
    assert s.products == s.iterations
