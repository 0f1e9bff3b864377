# SPDX-License-Identifier: BSD-3-Clause
"""Southwell relaxes the rows that the textbook relaxes; in sets it still finds the solution."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import InputError
from ltcl.operators import CSR, Dense, IdentityPlus
from ltcl.operators.steps import Steps
from ltcl.solvers import Status
from tests import gallery, reference
from tests.problems import enclosure, lambertian, residual

FORMATS = {"csr": lambda device, M: CSR(device, scipy.sparse.csr_array(M)), "dense": Dense}
MATRICES = {
    "1x1": np.array([[0.25]], np.float32),
    "53": gallery.signed(53, 53, 3) / 20,
    "empty rows": np.where(np.arange(40)[:, None] % 3 == 1, gallery.signed(40, 40) / 20, np.float32(0)),
    "130, sparse": gallery.sparse(130, 130, 0.1).toarray() / 9,
}
random = np.random.default_rng(5)


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("parts", [1, 7, 1000])
@pytest.mark.parametrize("name", MATRICES)
@pytest.mark.parametrize("form", FORMATS)
def test_steps_meet_their_twins(device, form, name, parts, k):
    M = MATRICES[name]
    n, parts = len(M), min(parts, len(M))
    A, x, r = FORMATS[form](device, M), gallery.vectors(n, k, 1), gallery.vectors(n, k, 2)
    steps = Steps(IdentityPlus(A, -1), "southwell", device.upload(x), device.upload(r), parts)
    steps.step()
    diagonal = 1.0 - M.diagonal().astype(np.float64)
    x, r, picked, delta = reference.southwell_pick(n, parts, 1.0, diagonal, x, r)
    T = scipy.sparse.csr_array(M.T)
    entries = (T.indptr, T.indices, T.data) if form == "csr" else (M,)
    r = getattr(reference, f"southwell_{form}")(*entries, -1.0, picked, delta, r)
    np.testing.assert_array_equal(steps._picked.get(), picked)
    np.testing.assert_allclose(steps.x.get(), x, rtol=0, atol=1e-5)
    np.testing.assert_allclose(steps.r.get(), r, rtol=0, atol=1e-5)


@pytest.mark.parametrize("form", FORMATS)
def test_slabs_give_the_same(small_device, form):
    M = gallery.signed(53, 53, 4) / 20
    A = FORMATS[form](small_device, M)
    assert len(A.slabs) > 1
    b = gallery.vectors(53, 2)
    s = ltcl.solve(IdentityPlus(A), b, "southwell", rtol=1e-4)
    assert residual(np.eye(53) + M.astype(np.float64), s.x, b) <= 1e-4 * (1 + 1e-3)


@pytest.mark.parametrize("dual", ["inverse", "forward"])
def test_one_row_a_step_is_the_textbook(device, dual):
    scene = lambertian(20, 0.8, seed=3)
    S = scene.S if dual == "inverse" else np.eye(20) - scene.A
    b = random.uniform(0.0, 1.0, (20, 2))
    s = ltcl.solve(S, b, "southwell", rows=1, maxiter=2, rtol=1e-6, throw=False)
    x, r = np.zeros_like(b), b.copy()
    for _ in range(2 * 20):
        x, _, picked, delta = reference.southwell_pick(20, 1, 0.0, S.diagonal(), x, r)
        r = reference.southwell_dense(S, 1.0, picked, delta, r)
    np.testing.assert_allclose(s.x, x, rtol=0, atol=1e-5)
    np.testing.assert_allclose(s.residuals[-1], residual(S, x, b), rtol=1e-2)


@pytest.mark.parametrize("rho", [1.5, 4.0, 9.0])
@pytest.mark.parametrize(
    "make", [lambda rho: enclosure(40, rho / (1 + rho)), lambda rho: lambertian(40, rho)]
)
def test_it_converges_where_jacobi_diverges(device, make, rho):
    scene = make(rho)
    b = scene.S @ random.uniform(0.0, 1.0, scene.n)
    S = IdentityPlus(Dense(device, scene.R))
    s = ltcl.solve(S, b, "southwell", rtol=1e-3, rows=1)
    assert residual(scene.S, s.x, b) <= 1e-3 * (1 + 1e-3)
    assert s.products == s.iterations + 1  # which confirms the last residual


def test_sets_of_rows_converge(device):
    scene = lambertian(400, 4.0, seed=7, density=0.3)
    b = scene.S @ random.uniform(0.0, 1.0, scene.n)
    s = ltcl.solve(IdentityPlus(CSR(device, scipy.sparse.csr_array(scene.R))), b, "southwell", rtol=1e-3)
    assert residual(scene.S, s.x, b) <= 1e-3 * (1 + 1e-3)


def test_all_rows_at_once_is_jacobi(device):
    scene = enclosure(30, 0.8)
    S, b = IdentityPlus(Dense(device, scene.R - np.diag(scene.R.diagonal()))), random.uniform(size=30)
    one = ltcl.solve(S, b, "southwell", rows=30, maxiter=3, rtol=1e-6, throw=False)
    other = ltcl.solve(S, b, "jacobi", maxiter=3, rtol=1e-6, throw=False)
    np.testing.assert_allclose(one.residuals, other.residuals, rtol=1e-4)
    assert ltcl.solve(S, b, "southwell", rows=30, throw=False).status is Status.DIVERGED


@pytest.mark.parametrize("rows", [0, -1, 2.5, "all", np.nan])
def test_an_unusable_number_of_rows_is_refused(rows):
    with pytest.raises(InputError, match=r"rows is .*; it must be a whole number of at least 1"):
        ltcl.solve(np.eye(3), np.ones(3), "southwell", rows=rows)


def test_a_zero_on_the_diagonal_is_refused(device):
    with pytest.raises(InputError, match=r"method='southwell' divides by the diagonal .* first in row 1"):
        ltcl.solve(np.diag([1.0, 0.0]), np.ones(2), "southwell")
