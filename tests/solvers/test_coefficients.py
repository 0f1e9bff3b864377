# SPDX-License-Identifier: BSD-3-Clause
"""Solves on the coefficients of a compressed S, and what compressed operators may be asked for."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import InputError
from ltcl.operators import CSR, Chained, Compressed, Dense, IdentityPlus, Ordered, Sum, Tiles, Wavelet
from ltcl.solvers import coefficients
from ltcl.solvers.cg import CG
from ltcl.solvers.jacobi import Jacobi
from tests import gallery
from tests.bases import Given, rotation, stands_for, two_sided
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


def _counted(monkeypatch, *operators):
    """The products that each operator makes from here on, one entry a product."""
    made = {name: 0 for name, _ in operators}
    for name, operator in operators:
        original = operator._product

        def product(*arguments, original=original, name=name):
            made[name] += 1
            original(*arguments)

        monkeypatch.setattr(operator, "_product", product)
    return made


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


@pytest.mark.parametrize("method", METHODS)
def test_the_dual_runs_on_coefficients_too(device, method):
    """(I - A)^-1 adds bounces (eq. 4): the sign is part of the solve."""
    A = two_sided(device, SCENE.A, 0.7)
    b = rng.uniform(0.0, 1.0, (N, 2))
    s = ltcl.solve(IdentityPlus(A, -1), b, method, rtol=1e-4)
    assert residual(np.eye(N) - stands_for(A), s.x, b) <= 1e-4 * (1 + 2e-2)


@pytest.mark.parametrize("method", ITERATIVE)
def test_one_transform_at_each_end(device, method, monkeypatch):
    """Every product of the solve is one by the core; the bases act on b, x0 and x alone."""
    S, truth = _system(device)
    S.row_sums()  # made once in the life of an operator, in pixels
    b, x0 = rng.uniform(0.0, 1.0, (2, N, 3))
    made = _counted(monkeypatch, ("core", _inside(S).core), ("W", _inside(S).into))
    s = ltcl.solve(S, b, method, rtol=1e-3)
    assert made["W"] == 2
    if method not in ("gauss_seidel", "sor", "block_gauss_seidel", "southwell", "cg"):  # those sweep
        assert made["core"] == s.products
    made["W"] = 0
    s = ltcl.solve(S, b, method, rtol=1e-3, x0=x0)
    assert made["W"] == 3
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


@pytest.mark.parametrize("method", METHODS)
def test_a_start_at_the_solution_ends_there(device, method):
    S, truth = _system(device)
    b = rng.uniform(0.0, 1.0, (N, 3))
    exact = np.linalg.solve(truth, b)
    s = ltcl.solve(S, b, method, x0=exact, rtol=1e-4)
    assert s.converged
    assert method in ("direct", "auto") or s.iterations == 0
    np.testing.assert_allclose(s.x, exact, rtol=0, atol=1e-4)


def test_cg_keeps_its_inner_product(device, monkeypatch):
    """diag(w) in pixels is W diag(w) W^T in coefficients: no diagonal, so cg stays in pixels there."""
    S, truth = _system(device, SKEW, keep=1.0, weights=SKEW.weights)
    b = rng.uniform(0.0, 1.0, (N, 3))
    made = _counted(monkeypatch, ("W", _inside(S).into))
    s = ltcl.solve(S, b, "cg", rtol=1e-5)
    assert made["W"] > 2
    assert residual(truth, s.x, b) <= 1e-5 * (1 + 5e-2)
    dense = IdentityPlus(Dense(device, truth - np.eye(N)), weights=SKEW.weights)
    assert s.iterations == ltcl.solve(dense, b, "cg", rtol=1e-5).iterations
    plain, _ = _system(device, SKEW, keep=1.0)
    given = ltcl.solve(plain, b, "cg", rtol=1e-5, weights=SKEW.weights)
    assert given.residuals == s.residuals


@pytest.mark.parametrize(
    ("method", "weights", "moves"),
    [
        (Jacobi(), None, True),
        (Jacobi(), SKEW.weights, True),
        (CG(), None, True),
        (CG(), SKEW.weights, False),
        (CG(weights=SKEW.weights), None, False),
        (CG(normal=True), SKEW.weights, True),
    ],
)
def test_where_a_method_runs(device, method, weights, moves):
    S, _ = _system(device, weights=weights)
    where = coefficients.space(S, method)
    assert (where.W is _inside(S).into) == moves
    assert (where.S is S) != moves


def test_other_operators_stay_where_they_are(device):
    W = Given(device, rotation(N))
    core = CSR(device, scipy.sparse.csr_array(SCENE.R))
    tall = Given(device, gallery.signed(N + 2, N))
    wide = CSR(device, gallery.sparse(N + 2, N + 2))
    for R in (
        core,
        Compressed(core, None, None),
        Compressed(core, W, None),
        Compressed(core, W, Given(device, rotation(N, 1))),
        Compressed(wide, tall, tall),
        Sum(core, Compressed(core, W, W)),
    ):
        assert coefficients.space(IdentityPlus(R), Jacobi()).W is None
    assert coefficients.space(Compressed(core, W, W), Jacobi()).W is None  # S itself, not I + R
    S = IdentityPlus(Sum(core, two_sided(device, SCENE.A)))
    b = rng.uniform(0.0, 1.0, N)
    assert residual(np.eye(N) + SCENE.R + SCENE.A, ltcl.solve(S, b, "gmres", rtol=1e-4).x, b) < 1.1e-4


def test_bounds_on_the_spectrum_are_those_of_pixels(device):
    S, truth = _system(device)
    on = coefficients.space(S, Jacobi()).S
    np.testing.assert_allclose(on.row_sums(), truth.sum(axis=1), rtol=1e-4)
    assert ltcl.theory.free_bounds(on) == ltcl.theory.free_bounds(S)


@pytest.mark.parametrize("method", ["monte_carlo", "hybrid"])
def test_what_samples_rows_of_R_refuses(device, method):
    S, _ = _system(device)
    with pytest.raises(InputError, match=f"method='{method}' reads S row by row, which Compressed does not"):
        ltcl.solve(S, np.ones(N), method)


def test_a_tolerance_below_the_error_of_solutions_is_refused(device):
    S, _ = _system(device, solution_error=0.00421)
    b = np.ones((N, 2))
    text = (
        "rtol is 1e-05; S is compressed and its solutions may be off by 0.0043: "
        "ask for no less, or give exact=T.interreflection of the uncompressed T"
    )
    with pytest.raises(InputError) as caught:
        ltcl.solve(S, b, "jacobi", rtol=1e-5)
    assert str(caught.value) == text
    assert ltcl.solve(S, b, rtol=0.0043).converged  # what the message asks for
    with pytest.raises(InputError, match=r"rtol is 0 and atol 0.001; "):
        ltcl.solve(S, b, rtol=0.0, atol=1e-3)
    assert ltcl.solve(S, b, rtol=0.0, atol=1.0).converged
    assert not ltcl.solve(S, 0 * b, rtol=1e-5).x.any()
    unknown, _ = _system(device, solution_error=np.inf)
    with pytest.raises(InputError, match="off by inf"):
        ltcl.solve(unknown, b, rtol=0.9)


@pytest.mark.parametrize("seed", range(6))
def test_solutions_are_off_by_no_more_than_they_say(device, seed):
    """||x~ - x|| / ||x|| <= ||S~^-1|| ||E||, with both norms from singular values; here E is random."""
    random = np.random.default_rng(seed)
    E = random.normal(size=(N, N)) * 10.0 ** random.uniform(-5, -1.5)
    R = two_sided(device, SKEW.R + E, keep=1.0, seed=seed)
    truth = np.eye(N) + stands_for(R)
    exact = np.eye(N) + SKEW.R
    error = float(np.linalg.norm(np.linalg.inv(truth), 2) * np.linalg.norm(truth - exact, 2))
    S = IdentityPlus(R, solution_error=error)
    b = np.column_stack([random.normal(size=(N, 3)), exact @ np.linalg.svd(truth - exact)[2][0]])
    found = ltcl.solve(IdentityPlus(R), b, "direct", rtol=1e-6).x  # to rounding
    x = np.linalg.solve(exact, b)
    off = np.linalg.norm(found - x, axis=0) / np.linalg.norm(x, axis=0)
    assert np.all(off <= error * (1 + 1e-3) + 1e-6)
    assert off.max() > 0.05 * error  # the worst right-hand side is near it
    if error < 0.5:
        assert ltcl.solve(S, b, rtol=error).converged


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
    return Chained(Ordered(device, (1, n), np.arange(n)[::-1]), Wavelet(device, grid, "haar"))


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
    made = _counted(monkeypatch, ("W", W), ("core", core))
    again = ltcl.solve(S, b, rtol=1e-3)
    assert again.method == first.method
    assert made == {"W": 2, "core": again.products}
    exact = np.eye(len(R)) + R
    refined = ltcl.solve(S, b, rtol=1e-5, exact=exact)
    assert residual(exact, refined.x, b) <= 1e-5 * (1 + 5e-2)


def test_sweeps_over_coefficients_need_rows(device):
    _, W, C = _corner(device, Wavelet)
    b = rng.uniform(0.0, 1.0, len(C.indptr) - 1)
    assert ltcl.solve(IdentityPlus(Compressed(CSR(device, C), W, W)), b, "gauss_seidel").converged
    with pytest.raises(InputError, match="reads S row by row, which Tiles does not allow"):
        ltcl.solve(IdentityPlus(Compressed(Tiles(device, C), W, W)), b, "gauss_seidel")
