# SPDX-License-Identifier: BSD-3-Clause
"""Conjugate gradients: the inner product of Lambertian scenes, the textbook bounds, columns on their own."""

from __future__ import annotations

import numpy as np
import pytest

import ltcl
from ltcl import theory
from ltcl.errors import ConvergenceError, InputError, InputTypeError
from ltcl.operators import Dense, IdentityPlus, as_operator
from ltcl.solvers import Status
from tests.problems import enclosure, lambertian, residual

random = np.random.default_rng(17)


def energy(S: np.ndarray, weights: np.ndarray, error: np.ndarray) -> float:
    """<e, S e> in the weighted inner product, square-rooted."""
    return float(np.sqrt((weights * error) @ (S @ error)))


@pytest.mark.parametrize("rho", [0.8, 4.0, 50.0])
@pytest.mark.parametrize("seed", range(3))
def test_the_energy_of_the_error_falls_as_the_condition_number_tells(device, seed, rho):
    """||e_k|| <= 2 ((sqrt(c) - 1) / (sqrt(c) + 1))^k ||e_0|| in the energy norm (Saad, eq. 6.128)."""
    scene = lambertian(40, rho, seed)
    S, b = IdentityPlus(Dense(device, scene.R)), random.uniform(size=scene.n)
    eigenvalues = np.linalg.eigvals(scene.S).real
    root = np.sqrt(eigenvalues.max() / eigenvalues.min())
    exact = np.linalg.solve(scene.S, b)
    first = energy(scene.S, scene.weights, exact)
    for k in (1, 2, 4, 6):
        s = ltcl.solve(S, b, "cg", weights=scene.weights, maxiter=k, rtol=1e-6, throw=False)
        bound = 2 * ((root - 1) / (root + 1)) ** s.iterations
        assert energy(scene.S, scene.weights, exact - s.x) <= (bound + 1e-5 * root) * first


@pytest.mark.parametrize("rho", [0.8, 4.0, 9.0])
def test_it_takes_no_more_steps_than_chebyshev_and_one_product_to_confirm(device, rho):
    scene = enclosure(40, rho / (1 + rho))
    S, b = IdentityPlus(Dense(device, scene.R)), random.normal(size=scene.n)
    s = ltcl.solve(S, b, "cg")
    assert residual(scene.S, s.x, b) <= 1e-2 * (1 + 1e-3)
    assert s.products == s.iterations + 1
    assert s.iterations <= theory.chebyshev_products(0.5, 1 + rho, 1e-2) + 1  # least energy, not residual


@pytest.mark.parametrize("options", [{}, {"normal": True}], ids=["symmetric", "normal"])
@pytest.mark.parametrize("distinct", [1, 2, 4])
def test_as_many_steps_as_distinct_eigenvalues(device, distinct, options):
    Q = np.linalg.qr(random.normal(size=(30, 30)))[0]
    S = (Q * np.resize(np.linspace(1.0, 3.0, distinct), 30)) @ Q.T
    s = ltcl.solve(as_operator(S, device), random.normal(size=30), "cg", rtol=1e-5, **options)
    assert s.iterations == distinct


def test_the_weights_are_what_makes_it_converge(device):
    """Weights spread over two decades: in the plain inner product S is far from symmetric."""
    scene = lambertian(40, 4.0, seed=19)
    d = np.logspace(-0.5, 0.5, 40)
    S = d[:, None] * scene.S / d  # still self-adjoint, with other weights
    b = random.uniform(size=40)
    s = ltcl.solve(as_operator(S, device), b, "cg", weights=scene.weights / d**2, rtol=1e-3)
    assert residual(S, s.x, b) <= 1e-3 * (1 + 1e-2)
    plain = ltcl.solve(as_operator(S, device), b, "cg", rtol=1e-3, throw=False)
    assert not plain.converged or plain.products > s.products


def test_the_unit_of_the_weights_does_not_matter(device):
    scene = lambertian(40, 0.8, seed=20)
    S, b = as_operator(scene.S, device), random.uniform(size=40)
    one, other = (ltcl.solve(S, b, "cg", weights=scene.weights * unit) for unit in (1.0, 2.0**200))
    np.testing.assert_array_equal(one.x, other.x)


@pytest.mark.parametrize("rtol", [1e-2, 1e-4])
def test_the_normal_equations_ask_for_no_symmetry(device, rtol):
    """A one-way ring of gain 3: eigenvalues all around the origin, singular values between 2 and 4."""
    S = np.eye(30) + 3.0 * np.roll(np.eye(30), 1, axis=1)
    b = random.uniform(size=(30, 2))
    s = ltcl.solve(as_operator(S, device), b, "cg", normal=True, rtol=rtol)
    assert residual(S, s.x, b) <= rtol * (1 + 1e-3)
    assert s.products == 2 * s.iterations + 1
    assert all(b <= a * (1 + 1e-5) for a, b in zip(s.residuals, s.residuals[1:], strict=False))


@pytest.mark.parametrize(
    "S", [np.diag([-1.0, -2.0, -3.0]), np.diag([0.0, 1.0, 2.0]), [[0.0, 1.0], [-1.0, 0.0]]]
)
def test_without_a_positive_curvature_it_says_what_to_try(device, S):
    b = np.ones(len(S)) if not np.array_equal(S, np.diag([0.0, 1.0, 2.0])) else np.array([1.0, 0.0, 0.0])
    with pytest.raises(
        ConvergenceError, match=r"not positive definite.*weights=.*normal=True.*gmres"
    ) as caught:
        ltcl.solve(as_operator(S, device), b, "cg")
    assert caught.value.solution.status is Status.INDEFINITE
    assert not caught.value.solution.x.any()  # the best there was


def test_a_broken_column_leaves_the_others_their_solution(device):
    S = np.diag([1.0, 2.0, 0.0, 4.0])
    b = np.stack([np.ones(4) * (1, 1, 0, 1), np.eye(4)[2]], axis=1)
    s = ltcl.solve(as_operator(S, device), b, "cg", throw=False, rtol=1e-5)
    assert s.status is Status.INDEFINITE
    np.testing.assert_allclose(s.x[:, 0], [1.0, 0.5, 0.0, 0.25], rtol=1e-5)


def test_normal_equations_of_a_singular_system_break_down(device):
    S = as_operator(np.diag([1.0, 0.0]), device)
    with pytest.raises(ConvergenceError, match="the system is singular") as caught:
        ltcl.solve(S, np.array([0.0, 1.0]), "cg", normal=True)
    assert caught.value.solution.status is Status.BREAKDOWN


@pytest.mark.parametrize("seed", range(3))
def test_normal_equations_of_a_singular_system_end_at_its_least_squares(device, seed):
    """Beyond them all steps are rounding, and x would grow without end."""
    values = np.linspace(-1.0, 3.0, 9)[np.arange(60) % 9] * (np.arange(60) % 9 != 4)
    Q = np.linalg.qr(np.random.default_rng(seed).standard_normal((60, 60)))[0]
    S, b = (Q * values) @ Q.T, np.random.default_rng(seed).random(60)
    s = ltcl.solve(as_operator(S, device), b, "cg", normal=True, throw=False)
    least = np.linalg.lstsq(S, b, rcond=1e-6)[0]
    assert s.status is Status.BREAKDOWN
    np.testing.assert_allclose(s.x, least, atol=1e-3 * np.abs(least).max())
    assert residual(S, s.x, b) == pytest.approx(s.residual, rel=1e-4)


@pytest.mark.parametrize(
    ("options", "error", "says"),
    [
        ({"weights": np.ones(4)}, InputError, r"weights has shape \(4,\); it must be \(3,\)"),
        ({"weights": [1.0, 0.0, -1.0]}, InputError, "weights has 2 value.* not positive"),
        ({"weights": [1.0, np.nan, 1.0]}, InputError, "weights has 1 NaN"),
        ({"weights": "area"}, InputTypeError, "weights holds"),
        ({"weights": np.ones(3), "normal": True}, InputError, "weights.*normal=True"),
        ({"normal": "yes"}, InputTypeError, "normal is 'yes'; it must be True or False"),
    ],
)
def test_unusable_options_are_refused(options, error, says):
    with pytest.raises(error, match=says):
        ltcl.solve(np.eye(3), np.ones(3), "cg", **options)


def test_a_transport_brings_its_weights(device):
    """A box of walls from dark to white: self-adjoint with 1 / F, and far from it without."""
    scene = ltcl.scenes.box(6, sides=5, albedo=(0.1, 0.9, 0.3, 0.95, 0.6))
    T = scene.transport(device=device)
    (S,) = T.systems
    dense = S.to_dense()
    assert S.weights is not None
    np.testing.assert_allclose(S.weights, 1.0 / T.first_bounce)
    b = dense @ random.uniform(size=T.shape[1])
    s = ltcl.solve(S, b, "cg", rtol=1e-4)
    assert residual(dense, s.x, b) <= 1e-4 * (1 + 1e-2)
    np.testing.assert_array_equal(ltcl.solve(S, b, "cg", rtol=1e-4, weights=1.0 / T.first_bounce).x, s.x)
    plain = ltcl.solve(S, b, "cg", rtol=1e-4, weights=np.ones(T.shape[1]), throw=False)
    assert not plain.converged or plain.products > s.products
