# SPDX-License-Identifier: BSD-3-Clause
"""Solves on coefficients of a compressed S, and refinement judged by the exact S."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.operators import CSR, Compressed, Dense, IdentityPlus, SubsetBasis, Tiles, Wavelet
from ltcl.solvers import Status
from tests.bases import MatrixBasis, rotation
from tests.problems import lambertian, residual
from tests.solvers.helpers import (
    CLOSED,
    ITERATIVE,
    READS_ROWS,
    SOME,
    N,
    by_products,
    compressed,
    subset,
)

SKEW = lambertian(N, rho=0.5, density=0.7)  # self-adjoint in the inner product of its weights only
EXACT = np.eye(N) + CLOSED.R
rng = np.random.default_rng(5)


def transforms(monkeypatch, W):
    """The list of transforms from here on, one entry each."""
    made = []
    original = W._bind_transform
    monkeypatch.setattr(
        W, "_bind_transform", lambda *arguments: made.append(1) or original(*arguments)
    )
    return made


def products(launches) -> int:
    """Products and steps that were launched, of at most eight right-hand sides."""
    return sum(
        count for name, count in launches.items() if name.startswith(("csr_matvec", "tile_matvec"))
    )


@pytest.mark.parametrize("method", ITERATIVE)
def test_one_transform_at_each_end(device, method, monkeypatch):
    """Every product of the solve is one by the core; the bases act on b, x0 and x alone."""
    S, truth = compressed(device)
    S.row_sums()  # made once in the life of an operator, in pixels
    b, x0 = rng.uniform(0.0, 1.0, (2, N, 3))
    made = transforms(monkeypatch, S.R.into)  # pyright: ignore[reportAttributeAccessIssue]
    before = device.launches.copy()
    s = ltcl.solve(S, b, method, rtol=1e-3)
    launches = device.launches - before
    assert len(made) == 2
    if method not in (*READS_ROWS, "cg"):  # those sweep
        assert products(launches) == s.products
    made.clear()
    s = ltcl.solve(S, b, method, rtol=1e-3, x0=x0)
    assert len(made) == 3
    assert residual(truth, s.x, b) <= 1e-3 * (1 + 1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("method", ITERATIVE)
def test_residuals_are_relative_to_the_whole_of_b(device, method):
    """The last one is that of x in pixels, by float64; both tolerances are those of pixels."""
    S, truth = subset(device)
    b = rng.uniform(size=(N, 3)) * np.array([1.0, 10.0, 0.1])
    norms = np.linalg.norm(b, axis=0)
    for rtol, atol in ((1e-2, 0.0), (0.0, 0.02), (1e-3, 0.02)):
        s = ltcl.solve(S, b, method, rtol=rtol, atol=atol)
        left = np.linalg.norm(b - truth @ s.x, axis=0)
        np.testing.assert_allclose(s.residual, np.max(left / norms), rtol=1e-2, atol=1e-6)
        assert np.all(left <= np.maximum(rtol * norms, atol) * (1 + 1e-3))
        first = np.max(np.linalg.norm(rotation(N, 6)[:SOME] @ b, axis=0) / norms)
        np.testing.assert_allclose(s.residuals[0], first, rtol=1e-5)


def test_cg_keeps_its_inner_product(device, monkeypatch):
    """diag(w) in pixels is not diagonal in coefficients, W diag(w) W^T: cg stays in pixels."""
    S, truth = compressed(device, SKEW, keep=1.0, weights=SKEW.weights)
    b = rng.uniform(0.0, 1.0, (N, 3))
    made = transforms(monkeypatch, S.R.into)  # pyright: ignore[reportAttributeAccessIssue]
    s = ltcl.solve(S, b, "cg", rtol=1e-5)
    assert len(made) > 2
    assert residual(truth, s.x, b) <= 1e-5 * (1 + 5e-2)
    dense = IdentityPlus(Dense(device, truth - np.eye(N)), weights=SKEW.weights)
    # Rounding may decide whether the last iteration is needed.
    assert abs(s.iterations - ltcl.solve(dense, b, "cg", rtol=1e-5).iterations) <= 1


@pytest.mark.parametrize("method", ["chebyshev", "gmres"])
def test_a_compressed_operator_without_identity_stays_in_pixels(device, method):
    """W^T C W is singular if W leaves coefficients out; their light is not claimed as solved."""
    S, _ = subset(device)
    b = rng.uniform(0.5, 1.0, N)
    s = ltcl.solve(S.R, b, method, rtol=1e-2, throw=False)
    assert not s.converged


def ordered_wavelet(device, grid):
    n = grid[0] * grid[1]
    return SubsetBasis(device, grid, np.arange(n)[::-1], of=Wavelet(device, grid, "haar"))


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "columns"), [(CSR, ()), (Tiles, (3,))])
@pytest.mark.parametrize("basis", [Wavelet, ordered_wavelet])
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
    ltcl.solve(S, b, rtol=1e-3)
    first = ltcl.solve(S, b, rtol=1e-3)  # makes the survey
    assert first.method != "direct"
    assert residual(truth, first.x, b) <= 1e-3 * (1 + 1e-2)
    made = transforms(monkeypatch, W)
    before = device.launches.copy()
    again = ltcl.solve(S, b, rtol=1e-3)
    launches = device.launches - before
    assert (again.method, len(made), products(launches)) == (first.method, 2, again.products)
    exact = np.eye(len(R)) + R
    refined = ltcl.solve(S, b, rtol=1e-5, exact=exact)
    assert residual(exact, refined.x, b) <= 1e-5 * (1 + 5e-2)


# Refinement.


def test_products_of_both_are_counted(device):
    made: list[np.ndarray] = []
    exact = by_products(N, lambda x: made.append(x) or EXACT @ x)
    S = compressed(device)[0]
    b = rng.uniform(0.0, 1.0, (N, 2))
    s = ltcl.solve(S, b, "chebyshev", rtol=1e-5, exact=exact)
    assert len(made) == s.iterations  # the start costs none
    assert s.products >= 2 * s.iterations


def test_a_start_and_units_are_kept(device):
    (S, _) = compressed(device)
    b = rng.uniform(0.5, 1.0, (N, 2)) * (1e-30, 1e30)
    x = np.linalg.solve(EXACT, b)
    s = ltcl.solve(S, b, "gmres", rtol=1e-5, exact=EXACT, x0=x)
    assert s.iterations == 0
    s = ltcl.solve(S, b, "gmres", rtol=1e-5, exact=EXACT)
    np.testing.assert_allclose(s.x / (1e-30, 1e30), x / (1e-30, 1e30), rtol=0, atol=1e-4)


def on_the_device(device):
    """An S whose numbers are nowhere on the host: pixels, but in a basis."""
    W = MatrixBasis(device, np.eye(N))
    return IdentityPlus(Compressed(Dense(device, CLOSED.R), W, W))


KINDS = {
    "array": lambda device: EXACT,
    "sparse": lambda device: scipy.sparse.csr_array(EXACT),
    "operator": lambda device: IdentityPlus(Dense(device, CLOSED.R)),
    "LinearOperator": lambda device: scipy.sparse.linalg.aslinearoperator(EXACT),
}


@pytest.mark.parametrize("rtol", [5e-7, 1e-7, 1e-9, 1e-13])
@pytest.mark.parametrize("kind", KINDS)
def test_below_float32_it_refines_in_float64(device, kind, rtol):
    """Against the numbers that were given; of an operator those that it has, float32."""
    exact = KINDS[kind](device)
    S = np.eye(N) + CLOSED.R.astype(np.float32) if kind == "operator" else EXACT
    for b in (
        rng.uniform(0.0, 1.0, N),
        rng.uniform(0.0, 1.0, (N, 5)) * 10.0 ** np.arange(-20, 5, 5),
    ):
        for method in ("auto", "gmres"):
            s = ltcl.solve(compressed(device)[0], b, method, rtol=rtol, exact=exact)
            assert s.converged
            assert s.x.dtype == np.float64
            left = np.linalg.norm(b - S @ s.x, axis=0) / np.linalg.norm(b, axis=0)
            assert np.all(left <= rtol * (1 + 1e-2))
            assert s.residual == pytest.approx(np.max(left), rel=1e-2, abs=5e-16)  # rounding


@pytest.mark.parametrize(
    ("make", "rtol", "most"), [(on_the_device, 1e-9, 1e-6), (KINDS["array"], 1e-20, 1e-15)]
)
@pytest.mark.parametrize("method", ["gmres", "auto"])
def test_below_what_rounding_leaves_it_stagnates(device, make, rtol, most, method):
    S = compressed(device)[0]
    b = rng.uniform(0.0, 1.0, N)
    s = ltcl.solve(S, b, method, rtol=rtol, exact=make(device), throw=False)
    assert s.status is Status.STAGNATED
    assert s.residual < most
