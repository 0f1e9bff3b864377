# SPDX-License-Identifier: BSD-3-Clause
"""Iterative refinement: a compressed S makes the steps, the exact one judges."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import ConvergenceError, InputError, InputTypeError
from ltcl.operators import CSR, Compressed, Dense, IdentityPlus, as_operator
from ltcl.solvers import Status
from tests.bases import Given, stands_for, two_sided
from tests.problems import enclosure, lambertian, residual
from tests.solvers.helpers import METHODS

N = 43
SCENE = enclosure(N, 0.4)
S_EXACT = np.eye(N) + SCENE.R
rng = np.random.default_rng(6)


def _compressed(device, keep=0.5):
    R = two_sided(device, SCENE.R, keep)
    truth = np.eye(N) + stands_for(R)
    error = float(np.linalg.norm(np.linalg.inv(truth), 2) * np.linalg.norm(truth - S_EXACT, 2))
    assert 1e-3 < error < 0.5
    return IdentityPlus(R, solution_error=error)


@pytest.mark.parametrize("columns", [(), (1,), (3,), (5,)])
@pytest.mark.parametrize("method", METHODS)
def test_every_method_reaches_what_a_compressed_S_cannot(device, method, columns):
    S, b = _compressed(device), rng.uniform(0.0, 1.0, (N, *columns))
    s = ltcl.solve(S, b, method, rtol=1e-5, exact=S_EXACT)
    assert s.converged
    assert s.method == ("direct" if method == "auto" else method)
    assert residual(S_EXACT, s.x, b) <= 1e-5 * (1 + 5e-2)
    assert s.residuals[0] == pytest.approx(1.0, rel=1e-5)
    assert len(s.residuals) == s.iterations + 1


EXACT = {
    "array": lambda device: S_EXACT,
    "sparse": lambda device: scipy.sparse.csr_array(S_EXACT),
    "operator": lambda device: IdentityPlus(Dense(device, SCENE.R)),
    "LinearOperator": lambda device: scipy.sparse.linalg.aslinearoperator(S_EXACT),
}


@pytest.mark.parametrize("kind", EXACT)
def test_exact_may_be_anything_that_S_may(device, kind):
    b = rng.uniform(0.0, 1.0, N)
    s = ltcl.solve(_compressed(device), b, "gmres", rtol=1e-5, exact=EXACT[kind](device))
    assert residual(S_EXACT, s.x, b) <= 1e-5 * (1 + 5e-2)


def test_products_of_both_are_counted(device, monkeypatch):
    S, exact = _compressed(device), CSR(device, scipy.sparse.csr_array(S_EXACT))
    S.row_sums()
    made = []
    assert isinstance(S.R, Compressed)
    for operator in (S.R.core, exact):
        original = operator._product
        monkeypatch.setattr(
            operator, "_product", lambda *a, original=original: (made.append(original), original(*a))
        )
    s = ltcl.solve(S, rng.uniform(0.0, 1.0, (N, 2)), "chebyshev", rtol=1e-5, exact=exact)
    assert s.products == len(made)
    assert sum(which.__self__ is exact for which in made) == s.iterations  # the start costs none


def test_a_start_and_units_are_kept(device):
    S, b = _compressed(device), rng.uniform(0.5, 1.0, (N, 2)) * (1e-30, 1e30)
    x = np.linalg.solve(S_EXACT, b)
    s = ltcl.solve(S, b, "gmres", rtol=1e-5, exact=S_EXACT, x0=x)
    assert s.iterations == 0
    s = ltcl.solve(S, b, "gmres", rtol=1e-5, exact=S_EXACT)
    np.testing.assert_allclose(s.x / (1e-30, 1e30), x / (1e-30, 1e30), rtol=0, atol=1e-4)


def test_an_S_without_an_error_is_a_preconditioner(device):
    """Any S near enough will do, not only compressed ones."""
    near = lambertian(N, rho=0.5)
    S = as_operator(near.S * 1.02, device)
    b = rng.uniform(0.0, 1.0, N)
    assert residual(near.S, ltcl.solve(S, b, "gmres", rtol=1e-5, exact=near.S).x, b) <= 1.1e-5


def test_dark_columns_stay_dark(device):
    b = rng.uniform(0.5, 1.0, (N, 3)) * (1.0, 0.0, 1.0)
    s = ltcl.solve(_compressed(device), b, "chebyshev", rtol=1e-5, exact=S_EXACT)
    assert not s.x[:, 1].any()
    assert not ltcl.solve(_compressed(device), 0 * b, "jacobi", exact=S_EXACT).x.any()


@pytest.mark.parametrize("method", ["jacobi", "gmres", "direct"])
def test_an_S_that_is_too_far_off_is_seen(device, method):
    """Each step leaves twice the residual: I - S S~^-1 = 1 - 6 / 2 at one pixel."""
    S, exact = as_operator(np.diag([2.0, 0.8, 0.8]), device), np.diag([6.0, 0.8, 0.8])
    S = S if method != "jacobi" else as_operator(np.diag([1.5, 0.8, 0.8]), device)
    s = ltcl.solve(S, np.ones(3), method, rtol=1e-4, exact=exact, throw=False)
    assert s.status is Status.DIVERGED
    with pytest.raises(ConvergenceError, match="diverged"):
        ltcl.solve(S, np.ones(3), method, rtol=1e-4, exact=exact)


def test_a_step_that_fails_ends_the_solve_and_says_why(device):
    S = as_operator(np.diag([1.0, 3.5]), device)  # Jacobi grows by 2.5 a step
    s = ltcl.solve(S, np.ones(2), "jacobi", exact=np.diag([1.0, 3.4]), throw=False)
    assert s.status is Status.DIVERGED
    singular = as_operator(np.diag([1.0, 0.0]), device)
    s = ltcl.solve(singular, np.ones(2), "direct", exact=np.eye(2), throw=False)
    assert s.status is Status.BREAKDOWN


@pytest.mark.parametrize("rtol", [5e-7, 1e-7, 1e-9, 1e-13])
@pytest.mark.parametrize("kind", EXACT)
def test_below_float32_it_refines_in_float64(device, kind, rtol):
    """Against the operator as it stands: its numbers are float32, but for those of a LinearOperator."""
    given = EXACT[kind](device)
    S = {"LinearOperator": S_EXACT, "operator": np.eye(N) + SCENE.R.astype(np.float32)}.get(
        kind, S_EXACT.astype(np.float32).astype(np.float64)
    )
    for b in (rng.uniform(0.0, 1.0, N), rng.uniform(0.0, 1.0, (N, 5)) * 10.0 ** np.arange(-20, 5, 5)):
        for method in ("auto", "gmres"):
            s = ltcl.solve(_compressed(device), b, method, rtol=rtol, exact=given)
            assert s.converged
            assert s.x.dtype == np.float64
            left = np.linalg.norm(b - S @ s.x, axis=0) / np.linalg.norm(b, axis=0)
            assert np.all(left <= rtol * (1 + 1e-2))
            assert s.residual == pytest.approx(np.max(left), rel=1e-2, abs=1e-16)


@pytest.mark.parametrize("columns", [(), (1,), (5,)])
def test_a_start_in_float64_is_kept(device, columns):
    b = rng.uniform(0.5, 1.0, (N, *columns))
    x = np.linalg.solve(S_EXACT.astype(np.float32).astype(np.float64), b)
    s = ltcl.solve(_compressed(device), b, "gmres", rtol=1e-12, exact=S_EXACT, x0=x)
    assert s.iterations == 0
    np.testing.assert_array_equal(s.x, x)


def _on_the_device(device):
    """An S whose numbers are nowhere on the host: pixels, but in a basis."""
    W = Given(device, np.eye(N))
    return IdentityPlus(Compressed(Dense(device, SCENE.R), W, W))


@pytest.mark.parametrize(
    ("make", "rtol", "most"), [(_on_the_device, 1e-9, 1e-6), (lambda device: S_EXACT, 1e-17, 1e-15)]
)
@pytest.mark.parametrize("method", ["gmres", "auto"])
def test_what_rounding_leaves_is_told_with_a_tolerance_that_works(device, make, rtol, most, method):
    b, exact = rng.uniform(0.0, 1.0, N), make(device)
    S = _compressed(device)
    s = ltcl.solve(S, b, method, rtol=rtol, exact=exact, throw=False)
    assert s.status is Status.STAGNATED
    assert s.residual < most
    with pytest.raises(ConvergenceError) as refused:
        ltcl.solve(S, b, method, rtol=rtol, exact=exact)
    text = str(refused.value)
    assert text.startswith(f"rtol is {rtol:g}, but products with exact= are rounded, which left ")
    least = float(text.rpartition("; the least that can be asked is ")[2])
    assert rtol < least < most
    assert ltcl.solve(S, b, method, rtol=least, exact=exact).converged


def test_maxiter_is_of_steps(device):
    b = rng.uniform(0.0, 1.0, N)
    s = ltcl.solve(_compressed(device), b, "gmres", rtol=1e-6, exact=S_EXACT, maxiter=1, throw=False)
    assert s.status is Status.MAXITER
    assert s.iterations == 1


def test_the_callback_sees_true_residuals(device):
    seen = []
    s = ltcl.solve(
        _compressed(device),
        rng.uniform(0.0, 1.0, N),
        "gmres",
        rtol=1e-5,
        exact=S_EXACT,
        callback=lambda *step: seen.append(step),
    )
    assert seen == list(enumerate(s.residuals))


@pytest.mark.parametrize(
    ("exact", "method", "kind", "part"),
    [
        (np.eye(N + 1), "auto", InputError, rf"exact has shape \({N + 1}, {N + 1}\); it must be that of S"),
        (np.full((N, N), np.nan), "auto", InputError, "NaN"),
        (S_EXACT, "monte_carlo", InputTypeError, "'monte_carlo' samples; leave it out"),
        (S_EXACT, "hybrid", InputTypeError, "'hybrid' samples"),
        ("T.npz", "auto", InputTypeError, "exact holds .*; it must hold real numbers"),
        (
            ltcl.Transport(S_EXACT, (1, N)),
            "auto",
            InputTypeError,
            "exact is a Transport; it must be like S: give exact=T.interreflection of the uncompressed T",
        ),
    ],
)
def test_unfit_exact_operators_are_refused(device, exact, method, kind, part):
    with pytest.raises(kind, match=part):
        ltcl.solve(_compressed(device), np.ones(N), method, exact=exact)


def test_one_of_three_colours_is_to_be_chosen(device):
    three = [Dense(device, S_EXACT)] * 3
    with pytest.raises(InputTypeError, match="exact is 3 operators, S is one; give that of the same colour"):
        ltcl.solve(_compressed(device), np.ones(N), exact=three)


def test_exact_on_another_device_is_refused(device, small_device):
    with pytest.raises(InputError, match="exact is on another device"):
        ltcl.solve(_compressed(device), np.ones(N), exact=Dense(small_device, np.eye(N)))
