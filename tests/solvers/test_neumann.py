# SPDX-License-Identifier: BSD-3-Clause
"""The series keeps its residual by recursion, so its convergence has to be confirmed."""

from __future__ import annotations

import numpy as np
import pytest

import ltcl
from ltcl.errors import ConvergenceError
from ltcl.operators import Dense, IdentityPlus
from ltcl.solvers import Status
from tests.problems import lambertian, residual

random = np.random.default_rng(4)


def test_it_agrees_with_jacobi_to_rounding(device):
    scene = lambertian(50, rho=0.9, seed=5)
    S, b = IdentityPlus(Dense(device, scene.R)), random.uniform(0.0, 1.0, (scene.n, 5))
    for k in (1, 4, 30):
        one, other = (
            ltcl.solve(S, b, method, rtol=1e-6, maxiter=k, throw=False) for method in ("jacobi", "neumann")
        )
        np.testing.assert_allclose(one.x, other.x, rtol=0, atol=1e-5)
        np.testing.assert_allclose(one.residuals, other.residuals, rtol=0, atol=1e-5)


def test_it_pays_one_product_to_confirm(device):
    scene = lambertian(50, rho=0.5, seed=6)
    b = random.uniform(0.0, 1.0, scene.n)
    s = ltcl.solve(IdentityPlus(Dense(device, scene.R)), b, "neumann", rtol=1e-3)
    assert s.products == s.iterations + 1
    assert residual(scene.S, s.x, b) == pytest.approx(s.residual, rel=1e-2)


@pytest.mark.parametrize("rtol", [1e-8, 3e-8, 1e-9])
def test_its_claims_below_the_floor_are_those_of_the_iterate(device, rtol):
    """The recursion falls for ever; what is told must be the residual of x itself."""
    scene = lambertian(50, rho=0.5, seed=7)
    b = random.uniform(0.0, 1.0, scene.n)
    s = ltcl.solve(IdentityPlus(Dense(device, scene.R)), b, "neumann", rtol=rtol, throw=False)
    R = scene.R.astype(np.float32).astype(np.float64)  # what the device holds
    assert s.status is Status.STAGNATED
    assert residual(np.eye(scene.n) + R, s.x, b) <= 3 * s.residual


def test_it_diverges_where_jacobi_does(device):
    scene = lambertian(30, rho=1.5)
    with pytest.raises(ConvergenceError) as caught:
        ltcl.solve(IdentityPlus(Dense(device, scene.R)), scene.S @ np.ones(scene.n), "neumann")
    assert caught.value.solution.status is Status.DIVERGED
