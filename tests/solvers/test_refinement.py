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


ENDS = {  # S~, S, method
    "grows by Jacobi": (np.diag([1.5, 0.8, 0.8]), np.diag([6.0, 0.8, 0.8]), "jacobi", Status.DIVERGED),
    "grows": (np.diag([2.0, 0.8, 0.8]), np.diag([6.0, 0.8, 0.8]), "gmres", Status.DIVERGED),
    "grows by LU": (np.diag([2.0, 0.8, 0.8]), np.diag([6.0, 0.8, 0.8]), "direct", Status.DIVERGED),
    "a step diverges": (np.diag([1.0, 3.5]), np.diag([1.0, 3.4]), "jacobi", Status.DIVERGED),
    "a step is singular": (np.diag([1.0, 0.0]), np.eye(2), "direct", Status.BREAKDOWN),
}


@pytest.mark.parametrize("case", ENDS)
def test_an_S_that_is_too_far_off_is_seen(device, case):
    """I - S S~^-1 = 1 - 6 / 2 at one pixel leaves twice the residual; Jacobi grows by 2.5 a step."""
    S, exact, method, status = ENDS[case]
    with pytest.raises(ConvergenceError) as caught:
        ltcl.solve(as_operator(S, device), np.ones(len(S)), method, rtol=1e-4, exact=exact)
    assert caught.value.solution.status is status


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


UNFIT = [
    (np.eye(N + 1), "auto", InputError, rf"exact.*\({N + 1}, {N + 1}\)"),
    (np.full((N, N), np.nan), "auto", InputError, "NaN"),
    (S_EXACT, "monte_carlo", InputTypeError, "'monte_carlo'"),
    ("T.npz", "auto", InputTypeError, "exact is"),
    (ltcl.Transport(S_EXACT, (1, N)), "auto", InputTypeError, "exact.*T.interreflection"),
]


@pytest.mark.parametrize(("exact", "method", "error", "says"), UNFIT)
def test_unfit_exact_operators_are_refused(device, exact, method, error, says):
    with pytest.raises(error, match=says):
        ltcl.solve(_compressed(device), np.ones(N), method, exact=exact)


def test_exact_on_another_device_is_refused(device, small_device):
    with pytest.raises(InputError, match=r"exact.*another device"):
        ltcl.solve(_compressed(device), np.ones(N), exact=Dense(small_device, np.eye(N)))
