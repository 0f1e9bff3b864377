# SPDX-License-Identifier: BSD-3-Clause
"""Richardson: the damping that theory calls best is, and makes every albedo converge."""

from __future__ import annotations

import numpy as np
import pytest

import ltcl
from ltcl import theory
from ltcl.errors import ConvergenceError, InputError
from ltcl.operators import Dense, IdentityPlus
from ltcl.solvers import Status
from tests.problems import enclosure, lambertian, residual

random = np.random.default_rng(14)


@pytest.mark.parametrize("rho", [0.5, 1.5, 4.0, 9.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_closed_room_takes_no_more_products_than_the_bound(device, seed, rho):
    """S is symmetric with its spectrum inside the free bounds, so each step shrinks the residual so much."""
    scene = enclosure(40, rho / (1 + rho), seed)
    S, b = IdentityPlus(Dense(device, scene.R)), random.normal(size=(scene.n, 3))
    s = ltcl.solve(S, b, "richardson")
    assert residual(scene.S, s.x, b) <= 1e-2 * (1 + 1e-3)
    assert s.products == s.iterations <= theory.richardson_products(0.5, 1 + rho, 1e-2)


@pytest.mark.parametrize("albedo", [0.3, 0.6, 0.9])
def test_one_albedo_has_the_damping_1_minus_m_squared(device, albedo):
    """Its factor is m a step: exactly so on even light, with its eigenvalue 1 / (1 - m) at one end."""
    scene = enclosure(30, albedo)
    S, b = IdentityPlus(Dense(device, scene.R)), np.ones(30)
    s = ltcl.solve(S, b, "richardson", omega=1 - albedo**2, rtol=1e-3)
    np.testing.assert_allclose(s.residuals, albedo ** np.arange(len(s.residuals)), rtol=1e-2)


@pytest.mark.parametrize("rho", [1.5, 9.0])
def test_any_diffuse_scene_converges(device, rho):
    scene = lambertian(40, rho, seed=15)
    S, b = IdentityPlus(Dense(device, scene.R)), random.uniform(size=scene.n)
    lower, upper = theory.free_bounds(S)
    s = ltcl.solve(S, b, "richardson", rtol=1e-3)
    assert residual(scene.S, s.x, b) <= 1e-3 * (1 + 1e-3)
    # The bound holds in the area / albedo norm, whose weights differ by 3 at most.
    assert s.products <= theory.richardson_products(lower, upper, 1e-3 / np.sqrt(3))


def test_with_omega_1_it_is_jacobi(device):
    scene = lambertian(40, 0.8, seed=16)
    S, b = IdentityPlus(Dense(device, scene.R)), random.uniform(size=(scene.n, 2))
    one, other = ltcl.solve(S, b, "richardson", omega=1.0), ltcl.solve(S, b, "jacobi")
    np.testing.assert_array_equal(one.x, other.x)
    assert one.residuals == other.residuals


def test_too_large_a_step_diverges_and_says_so(device):
    scene = enclosure(30, 0.8)
    with pytest.raises(ConvergenceError) as caught:
        ltcl.solve(IdentityPlus(Dense(device, scene.R)), np.ones(30), "richardson", omega=0.5)  # 2/5 at most
    assert caught.value.solution.status is Status.DIVERGED


@pytest.mark.parametrize("omega", [0.0, -1.0, np.inf, np.nan, "fast", [1.0]])
def test_an_unusable_omega_is_refused(omega):
    with pytest.raises(InputError, match=r"omega is .*; it must be a finite number above 0"):
        ltcl.solve(np.eye(3), np.ones(3), "richardson", omega=omega)
