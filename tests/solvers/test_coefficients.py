# SPDX-License-Identifier: BSD-3-Clause
"""Solves on the coefficients of a compressed S, and what compressed operators may be asked for."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import InputError
from ltcl.operators import CSR, Chained, Compressed, Dense, IdentityPlus, SubsetBasis, Tiles, Wavelet
from tests.bases import stands_for, two_sided
from tests.problems import enclosure, lambertian, residual
from tests.solvers.helpers import ITERATIVE, METHODS

N = 43
SCENE = enclosure(N, 0.4)  # self-adjoint in the plain inner product, and so on coefficients
SKEW = lambertian(N, rho=0.5, density=0.7)  # in that of its weights only
rng = np.random.default_rng(5)


def _system(device, scene=SCENE, keep=0.6, **options):
    R = two_sided(device, scene.R, keep)
    return IdentityPlus(R, **options), np.eye(N) + stands_for(R)


def _inside(S: IdentityPlus) -> Compressed:
    assert isinstance(S.R, Compressed)
    return S.R


def _counted(monkeypatch, W):
    """The transforms that are made from here on, one entry each."""
    made, original = [], W._product
    monkeypatch.setattr(W, "_product", lambda *arguments: made.append(original(*arguments)))
    return made


def _products(profile) -> int:
    """Products and steps that were launched, of at most eight right-hand sides."""
    return sum(
        count for name, count in profile.launches.items() if name.startswith(("csr_matvec", "tile_matvec"))
    )


@pytest.mark.parametrize("columns", [(), (1,), (3,), (5,)])
@pytest.mark.parametrize("method", METHODS)
def test_every_method_on_coefficients(device, method, columns):
    S, truth = _system(device)
    b = rng.uniform(0.0, 1.0, (N, *columns))
    s = ltcl.solve(S, b, method, rtol=1e-4)
    assert s.converged
    assert s.x.shape == b.shape
    assert residual(truth, s.x, b) <= 1e-4 * (1 + 2e-2)  # the slack is rounding of both transforms
    exact = np.linalg.solve(truth, b)
    assert np.linalg.norm(s.x - exact) <= 2e-4 * np.linalg.cond(truth) * np.linalg.norm(exact)


@pytest.mark.parametrize("method", ITERATIVE)
def test_one_transform_at_each_end(device, method, monkeypatch):
    """Every product of the solve is one by the core; the bases act on b, x0 and x alone."""
    S, truth = _system(device)
    S.row_sums()  # made once in the life of an operator, in pixels
    b, x0 = rng.uniform(0.0, 1.0, (2, N, 3))
    made = _counted(monkeypatch, _inside(S).into)
    with device.profile() as profile:
        s = ltcl.solve(S, b, method, rtol=1e-3)
    assert len(made) == 2
    if method not in ("gauss_seidel", "sor", "block_gauss_seidel", "southwell", "cg"):  # those sweep
        assert _products(profile) == s.products
    made.clear()
    s = ltcl.solve(S, b, method, rtol=1e-3, x0=x0)
    assert len(made) == 3
    assert residual(truth, s.x, b) <= 1e-3 * (1 + 1e-2)


@pytest.mark.parametrize("method", ["jacobi", "richardson", "chebyshev", "cg", "gmres", "bicgstab"])
def test_residuals_are_those_of_pixels(device, method):
    """W keeps lengths, so that a solve on pixels with the same S has the same history."""
    S, truth = _system(device)
    b = rng.uniform(0.0, 1.0, (N, 3))
    on_coefficients = ltcl.solve(S, b, method, rtol=1e-3)
    in_pixels = ltcl.solve(IdentityPlus(Dense(device, truth - np.eye(N))), b, method, rtol=1e-3)
    assert on_coefficients.iterations == in_pixels.iterations
    assert on_coefficients.products == in_pixels.products
    np.testing.assert_allclose(on_coefficients.residuals, in_pixels.residuals, rtol=1e-2)


def test_cg_keeps_its_inner_product(device, monkeypatch):
    """diag(w) in pixels is W diag(w) W^T in coefficients: no diagonal, so cg stays in pixels there."""
    S, truth = _system(device, SKEW, keep=1.0, weights=SKEW.weights)
    b = rng.uniform(0.0, 1.0, (N, 3))
    made = _counted(monkeypatch, _inside(S).into)
    s = ltcl.solve(S, b, "cg", rtol=1e-5)
    assert len(made) > 2
    assert residual(truth, s.x, b) <= 1e-5 * (1 + 5e-2)
    dense = IdentityPlus(Dense(device, truth - np.eye(N)), weights=SKEW.weights)
    assert s.iterations == ltcl.solve(dense, b, "cg", rtol=1e-5).iterations
    plain, _ = _system(device, SKEW, keep=1.0)
    given = ltcl.solve(plain, b, "cg", rtol=1e-5, weights=SKEW.weights)
    assert given.residuals == s.residuals


def test_a_tolerance_below_the_error_of_solutions_is_refused(device):
    S, _ = _system(device, solution_error=0.00421)
    b = np.ones((N, 2))
    with pytest.raises(InputError, match=r"rtol is 1e-05; .* 0.0043.*exact="):
        ltcl.solve(S, b, "jacobi", rtol=1e-5)
    assert ltcl.solve(S, b, rtol=0.0043).converged  # what the message asks for
    with pytest.raises(InputError, match=r"rtol is 0 and atol 0.001; "):
        ltcl.solve(S, b, rtol=0.0, atol=1e-3)
    assert ltcl.solve(S, b, rtol=0.0, atol=1.0).converged
    assert not ltcl.solve(S, 0 * b, rtol=1e-5).x.any()
    unknown, _ = _system(device, solution_error=np.inf)
    with pytest.raises(InputError, match="off by inf"):
        ltcl.solve(unknown, b, rtol=0.9)


def _corner(device, basis):
    """Two walls in wavelets, 578 pixels: too many for a direct solve of `auto`."""
    scene = ltcl.scenes.dihedral(17, albedo=0.7)
    T = scene.transport(first_bounce=scene.first_bounce, device=device)
    R = T.systems[0].to_dense() - np.eye(T.shape[0])
    W = basis(device, T.grid)
    C = W.apply(device.upload(W.apply(device.upload(R)).get().T)).get().T
    return R, W, scipy.sparse.csr_array(np.where(np.abs(C) > 2e-3, C, 0.0))


def _ordered_wavelet(device, grid):
    n = grid[0] * grid[1]
    return Chained(SubsetBasis(device, (1, n), np.arange(n)[::-1]), Wavelet(device, grid, "haar"))


@pytest.mark.parametrize("columns", [(), (3,)])
@pytest.mark.parametrize("kind", [CSR, Tiles])
@pytest.mark.parametrize("basis", [Wavelet, _ordered_wavelet])
def test_auto_plans_in_pixels_and_runs_on_coefficients(device, basis, kind, columns, monkeypatch):
    R, W, C = _corner(device, basis)
    core = kind(device, C)
    S = IdentityPlus(Compressed(core, W, W))
    truth = np.eye(len(R)) + W.to_dense().T @ core.to_dense() @ W.to_dense()
    b = rng.uniform(0.0, 1.0, (len(R), *columns))
    first = ltcl.solve(S, b, rtol=1e-3)  # makes the survey
    assert first.method != "direct"
    assert residual(truth, first.x, b) <= 1e-3 * (1 + 1e-2)
    made = _counted(monkeypatch, W)
    with device.profile() as profile:
        again = ltcl.solve(S, b, rtol=1e-3)
    assert again.method == first.method
    assert (len(made), _products(profile)) == (2, again.products)
    exact = np.eye(len(R)) + R
    refined = ltcl.solve(S, b, rtol=1e-5, exact=exact)
    assert residual(exact, refined.x, b) <= 1e-5 * (1 + 5e-2)
