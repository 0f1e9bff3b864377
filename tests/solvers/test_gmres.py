# SPDX-License-Identifier: BSD-3-Clause
"""GMRES: the smallest residual of all methods, at any S that is not singular."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import ltcl
from ltcl.errors import ConvergenceError, InputError
from ltcl.operators import Dense, IdentityPlus, as_operator
from ltcl.solvers import Status
from tests.problems import lambertian, residual
from tests.solvers.helpers import ITERATIVE, READS_ROWS

random = np.random.default_rng(23)


def smallest_residual(S: np.ndarray, b: np.ndarray, k: int) -> float:
    """min ||b - S x|| / ||b|| over the Krylov space of dimension k, in float64 on an orthonormal basis."""
    basis = b[:, None] / np.linalg.norm(b)
    for _ in range(k - 1):
        basis = np.linalg.qr(np.column_stack([basis, S @ basis[:, -1]]))[0]
    x = basis @ np.linalg.lstsq(S @ basis, b)[0]
    return residual(S, x, b)


@pytest.mark.parametrize(
    "make", [lambda: lambertian(40, 4.0, 24).S, lambda: np.eye(40) + random.normal(size=(40, 40)) / 8]
)
@pytest.mark.parametrize("k", [1, 2, 3, 5])
def test_no_polynomial_of_that_degree_has_a_smaller_residual(device, make, k):
    S, b = make(), random.normal(size=40)
    s = ltcl.solve(as_operator(S, device), b, "gmres", maxiter=k, rtol=1e-6, throw=False)
    assert s.iterations == k
    assert residual(S, s.x, b) == pytest.approx(smallest_residual(S, b, k), rel=1e-3, abs=1e-7)


@pytest.mark.parametrize("restart", [1, 2, 3, 20])
def test_the_residual_never_grows(device, restart):
    scene = lambertian(60, 9.0, 25, density=0.2)
    b = random.normal(size=(60, 3))
    s = ltcl.solve(as_operator(scene.S, device), b, "gmres", restart=restart, rtol=1e-4)
    assert residual(scene.S, s.x, b) <= 1e-4 * (1 + 1e-2)
    assert all(after <= before * (1 + 1e-4) for before, after in itertools.pairwise(s.residuals))
    cycles = -(-s.iterations // restart)
    assert (
        cycles <= s.products - s.iterations <= cycles + 1
    )  # one more where the end was not confirmed at once


@pytest.mark.parametrize("rho", [0.8, 4.0])
def test_no_polynomial_in_S_takes_fewer_steps(device, rho):
    scene = lambertian(40, rho, 26)
    S, b = IdentityPlus(Dense(device, scene.R)), random.normal(size=scene.n)
    s = ltcl.solve(S, b, "gmres", rtol=1e-3)
    for method in set(ITERATIVE) - set(READS_ROWS):  # these see rows, not products
        other = ltcl.solve(S, b, method, rtol=1e-3, throw=False)
        degree = other.iterations * (2 if method == "bicgstab" else 1)  # of its polynomial in S
        assert s.iterations <= degree or not other.converged


def test_it_solves_where_no_eigenvalue_bound_holds(device):
    """A one-way ring of gain 3: eigenvalues all around the origin."""
    S = np.eye(20) + 3.0 * np.roll(np.eye(20), 1, axis=1)
    b = random.uniform(size=(20, 2))
    s = ltcl.solve(as_operator(S, device), b, "gmres", rtol=1e-4)
    assert residual(S, s.x, b) <= 1e-4 * (1 + 1e-2)


@pytest.mark.parametrize(
    ("S", "b"), [(np.diag([0.0, 1.0]), [1.0, 1.0]), ([[0.0, 1.0], [0.0, 0.0]], [1.0, 0.0])]
)
def test_a_singular_system_breaks_down(device, S, b):
    with pytest.raises(ConvergenceError, match="the system is singular") as caught:
        ltcl.solve(as_operator(S, device), np.array(b), "gmres")
    s = caught.value.solution
    assert s.status is Status.BREAKDOWN
    assert np.isfinite(s.x).all()
    assert residual(np.array(S), s.x, np.array(b)) <= 1.0


def test_a_singular_system_with_a_solution_is_solved(device):
    b = np.array([1.0, 2.0, 0.0])
    s = ltcl.solve(as_operator(np.diag([1.0, 4.0, 0.0]), device), b, "gmres", rtol=1e-5)
    np.testing.assert_allclose(s.x, [1.0, 0.5, 0.0], atol=1e-5)


@pytest.mark.parametrize("restart", [0, -1, 2.5, "all", None])
def test_an_unusable_restart_is_refused(restart):
    with pytest.raises(InputError, match=r"restart is .*; it must be a whole number of at least 1"):
        ltcl.solve(np.eye(3), np.ones(3), "gmres", restart=restart)
