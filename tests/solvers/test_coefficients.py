# SPDX-License-Identifier: BSD-3-Clause
"""Solves on the coefficients of a compressed S, all of them or some, against float64 and solves in pixels."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.compression import inverse_norm
from ltcl.errors import InputError
from ltcl.operators import CSR, Compressed, Dense, IdentityPlus, SubsetBasis, Tiles, Wavelet
from tests.bases import Given, rotation, stands_for, two_sided
from tests.problems import enclosure, lambertian, residual
from tests.solvers.helpers import ITERATIVE, METHODS

N, M = 43, 19
SCENE = enclosure(N, 0.4)  # self-adjoint in the plain inner product, and so on coefficients
SKEW = lambertian(N, rho=0.5, density=0.7)  # in that of its weights only
ROWS = rotation(N, 6)[:M]  # row sums are near the spectrum, as the free bounds of Richardson suppose
rng = np.random.default_rng(5)


def _system(device, scene=SCENE, keep=0.6, **options):
    R = two_sided(device, scene.R, keep)
    return IdentityPlus(R, **options), np.eye(N) + stands_for(R)


def _active(device, sign=1.0):
    """S = I + sign V^T C V with 19 of 43 coefficients, and its float64 matrix."""
    V = Given(device, ROWS)
    scene = enclosure(M, 0.4)
    R = Compressed(CSR(device, scipy.sparse.csr_array(scene.R if sign > 0 else scene.A)), V, V)
    return IdentityPlus(R, sign), np.eye(N) + sign * stands_for(R)


SYSTEMS = {"all": _system, "some": _active, "some, forward": lambda device: _active(device, -1.0)}


def _counted(monkeypatch, W):
    """The transforms that are made from here on, one entry each."""
    made, original = [], W._product
    monkeypatch.setattr(W, "_product", lambda *arguments: made.append(original(*arguments)))
    return made


def _into(S: IdentityPlus):
    assert isinstance(S.R, Compressed)
    return S.R.into


def _products(launches) -> int:
    """Products and steps that were launched, of at most eight right-hand sides."""
    return sum(count for name, count in launches.items() if name.startswith(("csr_matvec", "tile_matvec")))


@pytest.mark.parametrize("columns", [(), (1,), (5,)])
@pytest.mark.parametrize("coefficients", SYSTEMS)
@pytest.mark.parametrize("method", METHODS)
def test_every_method_on_coefficients(device, method, coefficients, columns):
    S, truth = SYSTEMS[coefficients](device)
    b = rng.uniform(0.0, 1.0, (N, *columns))
    s = ltcl.solve(S, b, method, rtol=1e-4)
    assert s.x.shape == b.shape
    assert residual(truth, s.x, b) <= 1e-4 * (1 + 2e-2)  # the slack is rounding of both transforms


@pytest.mark.parametrize("method", ITERATIVE)
def test_one_transform_at_each_end(device, method, monkeypatch):
    """Every product of the solve is one by the core; the bases act on b, x0 and x alone."""
    S, truth = _system(device)
    S.row_sums()  # made once in the life of an operator, in pixels
    b, x0 = rng.uniform(0.0, 1.0, (2, N, 3))
    made = _counted(monkeypatch, _into(S))
    before = device.launches.copy()
    s = ltcl.solve(S, b, method, rtol=1e-3)
    launches = device.launches - before
    assert len(made) == 2
    if method not in ("gauss_seidel", "sor", "block_gauss_seidel", "southwell", "cg"):  # those sweep
        assert _products(launches) == s.products
    made.clear()
    s = ltcl.solve(S, b, method, rtol=1e-3, x0=x0)
    assert len(made) == 3
    assert residual(truth, s.x, b) <= 1e-3 * (1 + 1e-2)


@pytest.mark.parametrize("method", ITERATIVE)
def test_residuals_are_relative_to_the_whole_of_b(device, method):
    """The last one is that of x in pixels, by float64; both tolerances are those of pixels."""
    S, truth = _active(device)
    b = rng.uniform(size=(N, 3)) * np.array([1.0, 10.0, 0.1])
    norms = np.linalg.norm(b, axis=0)
    for rtol, atol in ((1e-2, 0.0), (0.0, 0.02), (1e-3, 0.02)):
        s = ltcl.solve(S, b, method, rtol=rtol, atol=atol)
        left = np.linalg.norm(b - truth @ s.x, axis=0)
        np.testing.assert_allclose(s.residual, np.max(left / norms), rtol=1e-2, atol=1e-6)
        assert np.all(left <= np.maximum(rtol * norms, atol) * (1 + 1e-3))
        first = np.max(np.linalg.norm(ROWS @ b, axis=0) / norms)
        np.testing.assert_allclose(s.residuals[0], first, rtol=1e-5)


def test_cg_keeps_its_inner_product(device, monkeypatch):
    """diag(w) in pixels is W diag(w) W^T in coefficients: no diagonal, so cg stays in pixels there."""
    S, truth = _system(device, SKEW, keep=1.0, weights=SKEW.weights)
    b = rng.uniform(0.0, 1.0, (N, 3))
    made = _counted(monkeypatch, _into(S))
    s = ltcl.solve(S, b, "cg", rtol=1e-5)
    assert len(made) > 2
    assert residual(truth, s.x, b) <= 1e-5 * (1 + 5e-2)
    dense = IdentityPlus(Dense(device, truth - np.eye(N)), weights=SKEW.weights)
    assert s.iterations == ltcl.solve(dense, b, "cg", rtol=1e-5).iterations


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
    with pytest.raises(InputError, match="inf"):
        ltcl.solve(_system(device, solution_error=np.inf)[0], b, rtol=0.9)


def _ordered_wavelet(device, grid):
    n = grid[0] * grid[1]
    return SubsetBasis(device, grid, np.arange(n)[::-1], of=Wavelet(device, grid, "haar"))


@pytest.mark.parametrize(("kind", "columns"), [(CSR, ()), (Tiles, (3,))])
@pytest.mark.parametrize("basis", [Wavelet, _ordered_wavelet])
def test_auto_plans_in_pixels_and_runs_on_coefficients(device, basis, kind, columns, monkeypatch):
    """Two walls in wavelets, 578 pixels: too many for a direct solve of `auto`."""
    scene = ltcl.scenes.dihedral(17, albedo=0.7)
    T = scene.transport(first_bounce=scene.first_bounce, device=device)
    R = T.systems[0].to_dense() - np.eye(T.shape[0])
    W = basis(device, T.grid)
    C = W.apply(device.upload(W.apply(device.upload(R)).get().T)).get().T
    core = kind(device, scipy.sparse.csr_array(np.where(np.abs(C) > 2e-3, C, 0.0)))
    S = IdentityPlus(Compressed(core, W, W))
    truth = np.eye(len(R)) + W.to_dense().T @ core.to_dense() @ W.to_dense()
    b = rng.uniform(0.0, 1.0, (len(R), *columns))
    first = ltcl.solve(S, b, rtol=1e-3)  # makes the survey
    assert first.method != "direct"
    assert residual(truth, first.x, b) <= 1e-3 * (1 + 1e-2)
    made = _counted(monkeypatch, W)
    before = device.launches.copy()
    again = ltcl.solve(S, b, rtol=1e-3)
    launches = device.launches - before
    assert (again.method, len(made), _products(launches)) == (first.method, 2, again.products)
    exact = np.eye(len(R)) + R
    refined = ltcl.solve(S, b, rtol=1e-5, exact=exact)
    assert residual(exact, refined.x, b) <= 1e-5 * (1 + 5e-2)


def test_the_norm_of_the_inverse_knows_the_rest(device):
    """S is the identity beside the active coefficients: no norm of its inverse is below 1."""
    V = Given(device, ROWS)
    for C in (np.eye(M) * 3.0, -0.5 * np.eye(M)):
        R = Compressed(Dense(device, C), V, V)
        exact = np.linalg.norm(np.linalg.inv(np.eye(N) + stands_for(R)), 2)
        norm = inverse_norm(IdentityPlus(R))
        assert norm.upper >= exact * (1 - 1e-6)
        np.testing.assert_allclose(norm.estimate, exact, rtol=1e-2)
