# SPDX-License-Identifier: BSD-3-Clause
"""Relaxation is the textbook's, by rows and by blocks, and converges where Jacobi does not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse

import ltcl
from ltcl.operators import Dense, IdentityPlus, as_operator
from ltcl.solvers import Status
from tests import reference
from tests.problems import enclosure, lambertian, residual

FORMS = pytest.mark.parametrize("form", [np.asarray, scipy.sparse.csr_array])
SCENE = lambertian(53, rho=0.8, seed=2, density=0.6)
DUALS = {"inverse": (SCENE.R, 1), "forward": (SCENE.A, -1)}
OPTIONS: dict[str, tuple[str, dict[str, Any]]] = {  # method and its options
    "gauss_seidel": ("gauss_seidel", {}),
    "rows of 7": ("gauss_seidel", {"block": 7}),
    "sor": ("sor", {"omega": 1.2}),
    "sor, rows of 1": ("sor", {"omega": 0.8, "block": 1}),
    "blocks of 1": ("block_gauss_seidel", {"block": 1}),
    "blocks of 7": ("block_gauss_seidel", {"block": 7}),
}
random = np.random.default_rng(3)


@pytest.mark.parametrize("sweeps", [1, 5])
@pytest.mark.parametrize("dual", DUALS)
@pytest.mark.parametrize("name", OPTIONS)
@FORMS
def test_k_iterations_are_k_sweeps(device, form, name, dual, sweeps):
    (method, options) = OPTIONS[name]
    (matrix, sign) = DUALS[dual]
    b = random.uniform(0.0, 1.0, (SCENE.n, 5))
    x0 = random.normal(size=b.shape)
    S = np.eye(SCENE.n) + sign * matrix
    A = IdentityPlus(as_operator(form(matrix), device), sign)
    s = ltcl.solve(
        A, b, method, **options, x0=x0, rtol=1e-7, atol=1e-30, maxiter=sweeps, throw=False
    )
    if method == "block_gauss_seidel":
        wanted = reference.block_gauss_seidel(S, x0, b, options["block"], s.iterations)
    else:
        wanted = reference.sor(S, x0, b, options.get("omega", 1.0), s.iterations)
    assert s.iterations == sweeps or s.residual < 1e-6
    # Each sweep rounds a sum of n float32 products; inverses of blocks are no larger than S^-1
    # here.
    np.testing.assert_allclose(
        s.x, wanted, rtol=0, atol=sweeps * SCENE.n * 2**-24 * np.abs(wanted).max()
    )
    assert s.residuals[-1] == pytest.approx(residual(S, wanted, b), rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("rho", [1.5, 4.0, 9.0])
@pytest.mark.parametrize(
    "make", [lambda rho: enclosure(40, rho / (1 + rho)), lambda rho: lambertian(40, rho)]
)
def test_they_converge_where_jacobi_diverges(device, make, rho):
    scene = make(rho)
    S = IdentityPlus(Dense(device, scene.R))
    b = scene.S @ random.uniform(0.0, 1.0, scene.n)
    assert ltcl.solve(S, b, "jacobi", throw=False).status is Status.DIVERGED
    table: list[tuple[str, dict[str, Any]]] = [*OPTIONS.values(), ("southwell", {"rows": 1})]
    for method, options in table:
        s = ltcl.solve(S, b, method, rtol=1e-3, **options)
        assert residual(scene.S, s.x, b) <= 1e-3 * (1 + 1e-3)
        # k sweeps, one that tells the residual of the last, and a product that confirms it.
        assert s.products == s.iterations + (1 if method == "southwell" else 2)


@pytest.mark.slow
@FORMS
def test_what_one_sweep_solves(device, form):
    """Rows that need none below them, one block, and blocks that do not see each other."""
    lower = np.eye(30) + np.tril(random.uniform(0.0, 1.0, (30, 30)), -1) / 30
    apart = scipy.linalg.block_diag(*(lambertian(8, 4.0, seed).S for seed in range(4)))
    block_method = "block_gauss_seidel"
    table = [(lower, "gauss_seidel", 4), (SCENE.S, block_method, 1000), (apart, block_method, 8)]
    for S, method, block in table:
        b = random.uniform(0.0, 1.0, (len(S), 3))
        s = ltcl.solve(as_operator(form(S), device), b, method, block=block, rtol=1e-5)
        assert s.iterations == 1
        np.testing.assert_allclose(
            s.x, np.linalg.solve(S, b), rtol=0, atol=1e-5 * float(np.linalg.norm(b))
        )
    b = random.uniform(0.0, 1.0, (4 * 8, 3))
    assert ltcl.solve(as_operator(form(apart), device), b, "gauss_seidel", rtol=1e-5).iterations > 5


@pytest.mark.parametrize("dual", DUALS)
def test_one_row_a_step_is_the_textbook_of_southwell(device, dual):
    matrix, sign = DUALS[dual]
    S = np.eye(SCENE.n) + sign * matrix
    b = random.uniform(0.0, 1.0, (SCENE.n, 2))
    s = ltcl.solve(S, b, "southwell", rows=1, maxiter=2, rtol=1e-6, throw=False)
    x = np.zeros_like(b)
    r = b
    for _ in range(2 * SCENE.n):
        x, r = reference.southwell_step(S, 1, x, r)
    np.testing.assert_allclose(s.x, x, rtol=0, atol=1e-5)
    np.testing.assert_allclose(s.residuals[-1], residual(S, x, b), rtol=1e-2)


@pytest.mark.parametrize("exponent", [3, 5, 20, 37])
@pytest.mark.parametrize("n", [2, 100, 200])
@pytest.mark.parametrize("name", ["gauss_seidel", "sor", "rows of 7"])
@FORMS
def test_what_overflows_has_diverged(shaped, form, n, name, exponent):
    """A triangle with a diagonal is not singular, however large its inverse is."""
    method, options = OPTIONS[name]
    R = np.random.default_rng(n).random((n, n)) * 10.0**exponent
    S = IdentityPlus(as_operator(form(R), shaped))
    solution = ltcl.solve(S, np.ones(n), method, throw=False, maxiter=50, **options)
    assert solution.status is Status.DIVERGED
    assert np.all(np.isfinite(solution.x))
