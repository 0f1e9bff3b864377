# SPDX-License-Identifier: BSD-3-Clause
"""Gauss-Seidel and SOR are those of the textbook, and converge where the paper's iteration does not."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import ConvergenceError, InputError
from ltcl.operators import CSR, Dense, IdentityPlus
from ltcl.solvers import Status
from tests import reference
from tests.problems import enclosure, lambertian, residual

FORMATS = {"csr": lambda device, M: CSR(device, scipy.sparse.csr_array(M)), "dense": Dense}
SCENE = lambertian(53, rho=0.8, seed=2, density=0.6)
OPTIONS = {"gauss_seidel": {}, "sor": {"omega": 1.2}}
random = np.random.default_rng(3)


@pytest.mark.parametrize("block", [1, 7, None])
@pytest.mark.parametrize("sweeps", [1, 2, 5])
@pytest.mark.parametrize(("matrix", "sign"), [(SCENE.R, 1), (SCENE.A, -1)], ids=["inverse", "forward"])
@pytest.mark.parametrize("method", OPTIONS)
@pytest.mark.parametrize("form", FORMATS)
def test_k_iterations_are_k_sweeps(device, form, method, matrix, sign, sweeps, block):
    b = random.uniform(0.0, 1.0, (SCENE.n, 5))
    x0 = random.normal(size=b.shape)
    S = np.eye(SCENE.n) + sign * matrix
    s = ltcl.solve(
        IdentityPlus(FORMATS[form](device, matrix), sign),
        b,
        method,
        **OPTIONS[method],
        block=block,
        x0=x0,
        rtol=1e-6,
        maxiter=sweeps,
        throw=False,
    )
    wanted = reference.sor(S, x0, b, OPTIONS[method].get("omega", 1.0), sweeps)
    assert s.iterations == sweeps
    # Each sweep rounds a sum of n float32 products.
    np.testing.assert_allclose(s.x, wanted, rtol=0, atol=sweeps * SCENE.n * 2**-24 * np.abs(wanted).max())
    assert s.residuals[-1] == pytest.approx(residual(S, wanted, b), rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("method", OPTIONS)
@pytest.mark.parametrize("rho", [1.5, 4.0, 9.0])
@pytest.mark.parametrize(
    "make", [lambda rho: enclosure(40, rho / (1 + rho)), lambda rho: lambertian(40, rho)]
)
def test_it_converges_where_jacobi_diverges(device, make, rho, method):
    scene = make(rho)
    S, b = IdentityPlus(Dense(device, scene.R)), scene.S @ random.uniform(0.0, 1.0, scene.n)
    assert ltcl.solve(S, b, "jacobi", throw=False).status is Status.DIVERGED
    s = ltcl.solve(S, b, method, rtol=1e-3, **OPTIONS[method])
    assert residual(scene.S, s.x, b) <= 1e-3 * (1 + 1e-3)


@pytest.mark.parametrize("rho", [0.5, 4.0])
def test_the_forward_dual_converges(device, rho):
    scene = lambertian(40, rho, seed=5)
    l_d = random.uniform(0.0, 1.0, scene.n)
    s = ltcl.solve(IdentityPlus(Dense(device, scene.A), -1), l_d, "gauss_seidel", rtol=1e-5)
    np.testing.assert_allclose(s.x, scene.S @ l_d, rtol=1e-3)


def test_a_sweep_is_worth_more_than_a_step_of_jacobi(device):
    S, b = IdentityPlus(Dense(device, SCENE.R)), SCENE.S @ random.uniform(0.0, 1.0, SCENE.n)
    sweeps, steps = (ltcl.solve(S, b, method, rtol=1e-3) for method in ("gauss_seidel", "jacobi"))
    assert sweeps.iterations < steps.iterations / 2


def test_products_are_sweeps_one_to_look_back_and_one_to_confirm(device):
    S, b = IdentityPlus(Dense(device, SCENE.R)), random.uniform(0.0, 1.0, SCENE.n)
    s = ltcl.solve(S, b, "gauss_seidel", rtol=1e-3)
    assert s.products == s.iterations + 2


def test_below_the_diagonal_alone_one_sweep_solves(device):
    L = np.tril(random.uniform(0.0, 1.0, (30, 30)), -1) / 30
    s = ltcl.solve(IdentityPlus(Dense(device, L)), np.ones(30), "gauss_seidel", rtol=1e-6, block=4)
    assert s.iterations == 1


def test_with_omega_1_sor_is_gauss_seidel(device):
    S, b = IdentityPlus(Dense(device, SCENE.R)), random.uniform(0.0, 1.0, (SCENE.n, 2))
    one, other = ltcl.solve(S, b, "sor"), ltcl.solve(S, b, "gauss_seidel")
    np.testing.assert_array_equal(one.x, other.x)
    assert one.residuals == other.residuals


def test_growth_is_noticed(device):
    """S of spectral radius far beyond what any splitting takes, and not self-adjoint."""
    S = np.eye(6) + np.triu(np.full((6, 6), 9.0), 1) + np.tril(np.full((6, 6), 9.0), -1)
    S[0] *= (1, -1, -1, -1, -1, -1)
    with pytest.raises(ConvergenceError) as caught:
        ltcl.solve(S, np.ones(6), "gauss_seidel")
    assert caught.value.solution.status is Status.DIVERGED
    assert np.isfinite(caught.value.solution.x).all()


@pytest.mark.parametrize("block", [0, -1, 2.5, "all", np.nan])
@pytest.mark.parametrize("method", OPTIONS)
def test_an_unusable_block_is_refused(method, block):
    with pytest.raises(InputError, match=r"block is .*; it must be a whole number of at least 1"):
        ltcl.solve(np.eye(3), np.ones(3), method, block=block)


@pytest.mark.parametrize("omega", [0.0, -1.0, 2.0, np.inf, np.nan, "fast", [1.0]])
def test_an_unusable_omega_is_refused(omega):
    with pytest.raises(InputError, match=r"omega is .*; it must be a finite number"):
        ltcl.solve(np.eye(3), np.ones(3), "sor", omega=omega)
