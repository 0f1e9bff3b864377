# SPDX-License-Identifier: BSD-3-Clause
"""Iterative refinement: a compressed S makes the steps, the exact one judges."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import ConvergenceError, InputError, InputTypeError
from ltcl.operators import Compressed, Dense, IdentityPlus, as_operator
from ltcl.solvers import Status
from tests.bases import Given, stands_for, two_sided
from tests.problems import enclosure, residual
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


def test_products_of_both_are_counted(device):
    made = []

    def act(x: np.ndarray) -> np.ndarray:
        made.append(x)
        return S_EXACT @ x

    exact = scipy.sparse.linalg.LinearOperator((N, N), matvec=act, matmat=act, dtype=np.float64)
    s = ltcl.solve(_compressed(device), rng.uniform(0.0, 1.0, (N, 2)), "chebyshev", rtol=1e-5, exact=exact)
    assert len(made) == s.iterations  # the start costs none
    assert s.products >= 2 * s.iterations


def test_a_start_and_units_are_kept(device):
    S, b = _compressed(device), rng.uniform(0.5, 1.0, (N, 2)) * (1e-30, 1e30)
    x = np.linalg.solve(S_EXACT, b)
    s = ltcl.solve(S, b, "gmres", rtol=1e-5, exact=S_EXACT, x0=x)
    assert s.iterations == 0
    s = ltcl.solve(S, b, "gmres", rtol=1e-5, exact=S_EXACT)
    np.testing.assert_allclose(s.x / (1e-30, 1e30), x / (1e-30, 1e30), rtol=0, atol=1e-4)


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
    """Against the numbers that were given; of an operator those that it has, float32."""
    given = EXACT[kind](device)
    S = np.eye(N) + SCENE.R.astype(np.float32) if kind == "operator" else S_EXACT
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
    x = np.linalg.solve(S_EXACT, b)
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
def test_below_what_rounding_leaves_it_stagnates(device, make, rtol, most, method):
    b, exact = rng.uniform(0.0, 1.0, N), make(device)
    S = _compressed(device)
    s = ltcl.solve(S, b, method, rtol=rtol, exact=exact, throw=False)
    assert s.status is Status.STAGNATED
    assert s.residual < most


def test_maxiter_is_of_steps(device):
    b = rng.uniform(0.0, 1.0, N)
    s = ltcl.solve(_compressed(device), b, "gmres", rtol=1e-6, exact=S_EXACT, maxiter=1, throw=False)
    assert s.status is Status.MAXITER
    assert s.iterations == 1


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
            "exact is a Transport; .*T.interreflection",
        ),
    ],
)
def test_unfit_exact_operators_are_refused(device, exact, method, kind, part):
    with pytest.raises(kind, match=part):
        ltcl.solve(_compressed(device), np.ones(N), method, exact=exact)


def test_exact_on_another_device_is_refused(device, small_device):
    with pytest.raises(InputError, match="exact is on another device"):
        ltcl.solve(_compressed(device), np.ones(N), exact=Dense(small_device, np.eye(N)))
