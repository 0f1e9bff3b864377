# SPDX-License-Identifier: BSD-3-Clause
"""`auto` picks a method before the first step and says why."""

from __future__ import annotations

import re

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

import ltcl
from ltcl.errors import ConvergenceError
from ltcl.operators import CSR, Dense, Host, IdentityPlus
from ltcl.solvers import auto
from tests.problems import residual

N = auto.SMALL + 8


def ring(gain: float, skew: float = 0.0) -> np.ndarray:
    """R that passes light on to both neighbours on a ring, unevenly by `skew`; rho(R) = |gain|."""
    R = np.zeros((N, N))
    i = np.arange(N)
    R[i, (i + 1) % N] = gain * (1 + skew) / 2
    R[i, (i - 1) % N] = gain * (1 - skew) / 2
    return R


def system(device, R):
    return IdentityPlus(CSR(device, scipy.sparse.csr_array(R)))


def normal(eigenvalues: np.ndarray) -> np.ndarray:
    """(N, N), normal, with these real eigenvalues, seen from a random orthonormal basis."""
    Q = np.linalg.qr(np.random.default_rng(1).normal(size=(N, N)))[0]
    return (Q * np.resize(eigenvalues, N)) @ Q.T


def pictures(columns: int | None = None) -> np.ndarray:
    return np.random.default_rng(0).uniform(size=N if columns is None else (N, columns))


@pytest.mark.parametrize(
    ("S", "rtol", "method", "why"),
    [
        (np.eye(20) + 0.01, 1e-2, "direct", "^direct: 20 pixels are few enough for a dense factorization$"),
        (np.eye(N) + ring(0.01), 1e-9, "direct", "^direct: rtol=1e-09 is below what float32 products reach$"),
        (
            np.eye(N) + ring(0.01),
            1e-2,
            "jacobi",
            r"^jacobi: 1 product .*, chebyshev: 4 products .*row sums of R are at most 0.01$",
        ),
        (
            np.eye(N) + ring(0.5),
            1e-2,
            "chebyshev",
            r"^chebyshev: \d products .*cg: .*; .* of R is not self-adjoint, .*by 3 products$",
        ),
        (
            np.eye(N) + ring(0.5, 0.3),
            1e-2,
            "chebyshev",
            r"^chebyshev: \d products .*gmres: .* of R is not self-adjoint",
        ),
        (
            normal(np.where(np.arange(N) < 2, [3.0, 6.0] * (N // 2), 1.0)),
            1e-2,
            "cg",
            r"^cg: 4 products .*chebyshev: \d+ .* seen between 1 and 6 by 3 products$",
        ),
        (
            normal(np.linspace(-1, 3, N)),
            0.2,
            "gmres",
            r"^gmres: \d+ products .*seen between -",
        ),
        (
            np.eye(N) + ring(0.7, 1.0),
            1e-2,
            "gmres",
            r"0.5\d of R is not self-adjoint, .* with imaginary parts up to 0.\d+ by 3",
        ),
    ],
    ids=["small", "precise", "weak", "strong", "lopsided", "three eigenvalues", "indefinite", "one-way"],
)
def test_the_choice_and_its_reason(device, S, rtol, method, why):
    b = np.random.default_rng(0).uniform(size=len(S))
    s = ltcl.solve(system(device, S - np.eye(len(S))), b, rtol=rtol)
    assert s.method == method, s.reason
    assert re.search(why, s.reason), s.reason
    assert residual(S, s.x, b) <= max(rtol, 1e-6) * (1 + 1e-3)


def test_what_was_found_stays_with_the_operator(device):
    """Three products of a survey count in the solve that made it, and no other."""
    S = system(device, ring(0.9))
    first, second = (ltcl.solve(S, pictures()) for _ in range(2))
    assert first.products == second.products + auto.STEPS
    np.testing.assert_array_equal(first.x, second.x)
    assert second.reason == f"{first.reason} made before"


@pytest.fixture
def usual_speeds(monkeypatch):
    """Those that are assumed where nothing is timed."""
    monkeypatch.setenv("LTCL_TUNE", "0")
    monkeypatch.setattr(auto, "_machines", {})


@pytest.mark.usefixtures("usual_speeds")
@pytest.mark.parametrize("columns", [1, 4000])
def test_many_right_hand_sides_are_worth_a_factorization(device, columns):
    """Of a dense R: one is not, four thousand are."""
    choice = next(auto.plan(IdentityPlus(Dense(device, ring(0.9))), 1e-2, columns))
    assert (choice.method.name == "direct") == (columns > 1)
    assert choice.why.startswith(choice.method.name)


@pytest.mark.usefixtures("usual_speeds")
def test_factors_that_are_there_are_used(device):
    S = IdentityPlus(Dense(device, ring(0.97)))
    ltcl.solve(S, pictures(), "direct")
    assert ltcl.solve(S, pictures(3), rtol=1e-5).method == "direct"


def test_atol_alone_sets_the_tolerance(device):
    """As much light as is left to 1 % of the picture."""
    b = pictures()
    s = ltcl.solve(system(device, ring(0.5)), b, rtol=0.0, atol=float(1e-2 * np.linalg.norm(b)))
    assert s.method == "chebyshev"


def test_where_the_choice_fails_the_normal_equations_take_over(device, monkeypatch):
    """A one-way ring of gain 3 has eigenvalues all around the origin, where no polynomial in S converges."""
    monkeypatch.setattr(auto, "LARGEST_DIRECT", N - 1)
    R, b = ring(3.0, skew=1.0), pictures()
    s = ltcl.solve(system(device, R), b)
    assert s.method == "cg"
    assert re.search(r"^gmres: .*; gmres ended stagnated; cg: next, on the normal equations$", s.reason)
    assert residual(np.eye(N) + R, s.x, b) <= 1e-2


class OneWay(scipy.sparse.linalg.LinearOperator):
    """A matrix that gives products alone."""

    def __init__(self, R: np.ndarray) -> None:
        super().__init__(R.dtype, R.shape)
        self.R = R

    def _matvec(self, x: np.ndarray) -> np.ndarray:
        return self.R @ x


def test_without_a_transpose_a_factorization_does(device):
    R, b = ring(3.0, skew=1.0), pictures()
    S = IdentityPlus(Host(device, OneWay(R)))
    s = ltcl.solve(S, b)
    assert s.method == "direct"
    assert residual(np.eye(N) + R, s.x, b) <= 1e-2


def test_row_sums_that_cancel_mislead_it_only_once(device):
    """R with rows that sum to 0 and rho(R) = 3: the plain iteration is tried first, and its end is told."""
    R = 3.0 * np.outer((-1.0) ** np.arange(N), (-1.0) ** np.arange(N)) / N
    b = pictures()
    s = ltcl.solve(system(device, R), b)
    assert s.reason.startswith("jacobi: ")
    assert "; jacobi ended diverged; " in s.reason
    assert residual(np.eye(N) + R, s.x, b) <= 1e-2


def test_where_nothing_converges_it_raises_with_the_best_iterate(device, monkeypatch):
    """A singular S that the picture is not in the range of."""
    monkeypatch.setattr(auto, "LARGEST_DIRECT", N - 1)
    S = normal(np.linspace(-1.0, 3.0, 9) * (np.arange(9) != 4))
    b = pictures()
    with pytest.raises(ConvergenceError) as caught:
        ltcl.solve(system(device, S - np.eye(N)), b)
    s = caught.value.solution
    assert not s.converged
    assert "gmres ended" in s.reason
    assert "cg ended" in s.reason
    assert residual(S, s.x, b) == pytest.approx(s.residual, rel=1e-2)
    assert s.residual < 0.6  # 1/3 of the light is out of reach
