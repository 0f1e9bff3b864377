# SPDX-License-Identifier: BSD-3-Clause
"""Chebyshev with the free bounds: every albedo below one, in no more products than theory says."""

from __future__ import annotations

import numpy as np
import pytest

import ltcl
from ltcl import theory
from ltcl.errors import ConvergenceError, InputError
from ltcl.operators import Dense, IdentityPlus, as_operator
from ltcl.solvers import Status
from tests.problems import enclosure, lambertian, residual

random = np.random.default_rng(8)


@pytest.mark.parametrize("rtol", [1e-2, 1e-4])
@pytest.mark.parametrize("rho", [0.5, 1.5, 4.0, 9.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_closed_room_takes_no_more_products_than_the_bound(device, seed, rho, rtol):
    """S is symmetric with spectrum in [1 / (1 + m), 1 + rho], so the bound on the residual is strict."""
    scene = enclosure(40, rho / (1 + rho), seed)
    S, b = IdentityPlus(Dense(device, scene.R)), random.normal(size=(scene.n, 3))
    s = ltcl.solve(S, b, "chebyshev", rtol=rtol)
    assert residual(scene.S, s.x, b) <= rtol * (1 + 1e-3)
    assert s.products <= theory.chebyshev_products(0.5, 1 + rho, rtol) + 1  # one for rounding at the edge
    if rho == 4.0 and rtol == 1e-2:
        assert s.products <= 8


@pytest.mark.parametrize("rtol", [1e-2, 1e-5])
@pytest.mark.parametrize("rho", [50.0, 200.0])
@pytest.mark.parametrize("seed", range(8))
def test_residuals_that_swing_are_not_taken_for_trouble(device, seed, rho, rtol):
    """Up to an albedo of 0.995; a residual close to 0 by chance is neither a floor nor a start of growth."""
    scene = lambertian(60, rho, seed, density=0.3)
    S = IdentityPlus(Dense(device, scene.R))
    b = scene.S @ random.uniform(0.0, 1.0, scene.n)
    s = ltcl.solve(S, b, "chebyshev", rtol=rtol)
    # The bound holds in the area / albedo norm, whose weights differ by 3 at most.
    assert s.products <= theory.chebyshev_products(*theory.free_bounds(S), rtol / np.sqrt(3)) + 1


def test_the_forward_dual_has_bounds_of_its_own(device):
    """I - A of a closed room of albedo m has its spectrum in [1 - m, 1 + m]."""
    scene = enclosure(30, 0.8)
    forward, b = IdentityPlus(Dense(device, scene.A), sign=-1), random.uniform(0.0, 1.0, scene.n)
    assert theory.free_bounds(forward) == pytest.approx((0.2, 1.8), rel=1e-5)
    s = ltcl.solve(forward, b, "chebyshev", rtol=1e-4)
    np.testing.assert_allclose(s.x, scene.S @ b, rtol=1e-3)


def test_true_bounds_help(device):
    scene = enclosure(30, 0.9)
    S, b = IdentityPlus(Dense(device, scene.R)), random.normal(size=scene.n)
    spectrum = np.linalg.eigvalsh(scene.S)
    b -= b.mean()  # nothing of the dominant eigenvector, whose eigenvalue is ten times the next
    free = ltcl.solve(S, b, "chebyshev", rtol=1e-3)
    tight = ltcl.solve(S, b, "chebyshev", rtol=1e-3, spectrum=(spectrum[0], spectrum[-2]))
    assert tight.products < free.products
    assert tight.products <= theory.chebyshev_products(spectrum[0], spectrum[-2], 1e-3) + 1


def test_one_point_spectrum_is_met_at_once(device):
    s = ltcl.solve(np.eye(5) * 3.0, np.ones(5), "chebyshev", spectrum=(3.0, 3.0), rtol=1e-5)
    assert s.iterations == 1
    np.testing.assert_allclose(s.x, 1 / 3, rtol=1e-6)


@pytest.mark.parametrize("spectrum", [(0.5, 1.0), (0.5, 3.0), (2.0, 4.0), (3.0, 5.0)])
def test_bounds_that_leave_out_the_spectrum_are_widened(device, spectrum):
    """The spectrum reaches from 0.8 to 5."""
    scene = enclosure(30, 0.8)
    S, b = IdentityPlus(Dense(device, scene.R)), random.uniform(size=(30, 2))
    s = ltcl.solve(S, b, "chebyshev", spectrum=spectrum, rtol=1e-3)
    assert residual(scene.S, s.x, b) <= 1e-3 * (1 + 1e-2)
    assert [k for k, _ in enumerate(s.residuals)] == list(range(s.iterations + 1))


def test_where_no_interval_helps_it_diverges(device):
    """A one-way ring of gain 3: eigenvalues all around the origin."""
    S = np.eye(30) + 3.0 * np.roll(np.eye(30), 1, axis=1)
    with pytest.raises(ConvergenceError) as caught:
        ltcl.solve(as_operator(S, device), random.uniform(size=30), "chebyshev")
    assert caught.value.solution.status is Status.DIVERGED


@pytest.mark.parametrize("rho", [0.8, 4.0, 9.0])
@pytest.mark.parametrize("arnoldi", [2, 3, 5])
@pytest.mark.parametrize("rtol", [1e-2, 1e-4])
def test_a_few_arnoldi_steps_lose_no_products(device, arnoldi, rho, rtol):
    """They solve as well as they measure; one product more where their iterate is formed."""
    scene = lambertian(60, rho, 9, density=0.3)
    S, b = IdentityPlus(Dense(device, scene.R)), random.uniform(size=(60, 2))
    free = ltcl.solve(S, b, "chebyshev", rtol=rtol, arnoldi=0)
    refined = ltcl.solve(S, b, "chebyshev", rtol=rtol, arnoldi=arnoldi)
    assert residual(scene.S, refined.x, b) <= rtol * (1 + 1e-2)
    assert refined.products <= free.products + 1


@pytest.mark.parametrize("rho", [0.8, 4.0, 9.0])
def test_by_default_free_bounds_are_refined_and_given_ones_are_not(device, rho):
    scene = enclosure(40, rho / (1 + rho))
    S, b = IdentityPlus(Dense(device, scene.R)), scene.S @ random.uniform(size=scene.n)
    default, free = ltcl.solve(S, b, "chebyshev"), ltcl.solve(S, b, "chebyshev", arnoldi=0)
    np.testing.assert_array_equal(default.x, ltcl.solve(S, b, "chebyshev", arnoldi=2).x)
    assert default.products < free.products
    given = ltcl.solve(S, b, "chebyshev", spectrum=theory.free_bounds(S))
    np.testing.assert_array_equal(given.x, free.x)


@pytest.mark.parametrize("arnoldi", [-1, 1, 1.5, "few"])
def test_an_unusable_number_of_arnoldi_steps_is_refused(arnoldi):
    with pytest.raises(InputError, match=r"arnoldi is .*; it must be .* at least [02]"):
        ltcl.solve(np.eye(3), np.ones(3), "chebyshev", arnoldi=arnoldi)


@pytest.mark.parametrize(
    "bounds",
    [(0.0, 1.0), (-1.0, 1.0), (2.0, 1.0), (1.0,), 3.0, "ab", (0.5, np.inf), (np.nan, 1.0), (1.0, "b")],
)
def test_unusable_bounds_are_refused(bounds):
    with pytest.raises(InputError, match="spectrum"):
        ltcl.solve(np.eye(3), np.ones(3), "chebyshev", spectrum=bounds)
