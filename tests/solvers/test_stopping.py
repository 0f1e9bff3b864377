# SPDX-License-Identifier: BSD-3-Clause
"""One stopping rule: what is claimed was computed from x itself, and no failure comes back quietly."""

from __future__ import annotations

import re

import numpy as np
import pytest

import ltcl
from ltcl.errors import ConvergenceError, LtclError
from ltcl.operators import Dense, IdentityPlus, as_operator
from ltcl.solvers import Solution, Status
from tests.problems import enclosure, lambertian, residual
from tests.solvers.helpers import ITERATIVE, small_blocks

random = np.random.default_rng(10)


@pytest.mark.parametrize("method", ITERATIVE)
@pytest.mark.parametrize("rtol", [0.3, 1e-2, 1e-5])
@pytest.mark.parametrize("rho", [0.1, 0.9])
def test_converged_is_true_of_x(device, method, rtol, rho):
    scene = lambertian(64, rho, seed=11)
    b = random.uniform(0.0, 1.0, (64, 5)) * np.logspace(-4, 4, 5)
    s = ltcl.solve(IdentityPlus(Dense(device, scene.R)), b, method, rtol=rtol)
    assert s.converged
    assert residual(scene.S, s.x, b) <= rtol * (1 + 1e-3) + 2**-22
    assert s.residual <= rtol
    if method not in ("cg", "bicgstab"):  # whose residuals rise and fall between two readings
        assert all(value > rtol for value in s.residuals[:-1])


@pytest.mark.parametrize("method", ITERATIVE)
def test_maxiter_ends_it_with_the_best_iterate(device, method):
    scene = lambertian(64, 0.9, seed=12)
    S, b = IdentityPlus(Dense(device, scene.R)), random.uniform(0.0, 1.0, 64)
    with pytest.raises(ConvergenceError, match="maxiter was reached") as caught:
        ltcl.solve(S, b, method, rtol=1e-6, maxiter=2, **small_blocks(method))
    s = caught.value.solution
    assert s.status is Status.MAXITER
    assert s.iterations == 2
    assert len(s.residuals) == 3
    assert residual(scene.S, s.x, b) == pytest.approx(min(s.residuals), rel=1e-2)
    assert isinstance(caught.value, (LtclError, ArithmeticError))


@pytest.mark.parametrize("method", ITERATIVE)
def test_below_the_floor_of_float32_it_stagnates(device, method):
    scene = lambertian(64, 0.5, seed=13)
    b = random.uniform(0.0, 1.0, 64)
    s = ltcl.solve(IdentityPlus(Dense(device, scene.R)), b, method, rtol=1e-10, throw=False)
    assert s.status is Status.STAGNATED
    assert s.iterations < 200
    assert residual(scene.S, s.x, b) < 1e-5
    with pytest.raises(ConvergenceError, match="loosen rtol or try method='direct'"):
        ltcl.solve(IdentityPlus(Dense(device, scene.R)), b, method, rtol=1e-10)


def test_between_falling_and_growing_it_stagnates(device):
    """In a closed room of albedo 1/2, rho(R) = 1: even light swings for ever (fig. 5c)."""
    scene = enclosure(30, 0.5)
    s = ltcl.solve(IdentityPlus(Dense(device, scene.R)), np.ones(30), "jacobi", throw=False)
    assert s.status is Status.STAGNATED
    np.testing.assert_allclose(s.residuals, 1.0, rtol=1e-3)


@pytest.mark.parametrize("signs", [1.0, (-1.0) ** np.arange(8)], ids=["Inf", "NaN"])
@pytest.mark.parametrize("method", ITERATIVE)
def test_overflow_is_divergence(device, method, signs):
    """Products that leave float32 give Inf, or Inf - Inf, which no comparison may take for small."""
    S = np.where(np.eye(8) == 1, 1.0, 3e38 * signs * np.ones((8, 8)))
    options = small_blocks(method, 1)  # of two rows and more, blocks are singular in float64
    s = ltcl.solve(as_operator(S, device), np.full(8, 1.9), method, throw=False, **options)
    # GMRES multiplies S with unit directions only; with signs that cancel, those products stay in float32.
    assert s.status is Status.DIVERGED or (method == "gmres" and np.ndim(signs))
    assert np.isfinite(s.x).all()


@pytest.mark.parametrize("method", ITERATIVE)
def test_overflow_midway_leaves_the_best_iterate(device, method):
    """The second step multiplies the first by 3.3e38: the residual falls to a half, then leaves float32."""
    S = np.eye(8)
    S[1, 2], S[0, 1], S[4, 5] = 0.9, 3.3e38, 0.2
    b = 1.9 * np.eye(8)[2] + 1.5 * np.eye(8)[5]
    with pytest.raises(ConvergenceError) as caught:
        ltcl.solve(as_operator(S, device), b, method, **small_blocks(method, 1))
    s = caught.value.solution
    assert s.status in (Status.DIVERGED, Status.STAGNATED)  # damped by 1e-38, nothing moves at all
    assert s.status is Status.DIVERGED or method == "richardson"
    assert np.isfinite(s.x).all()
    assert residual(S, s.x, b) == pytest.approx(s.residual, rel=1e-5)
    if method in ("jacobi", "neumann", "gauss_seidel", "sor"):
        assert s.residual < 0.9
    assert "\n" not in str(caught.value)


FAILURES = [status for status in Status if status not in (Status.CONVERGED, Status.PRECOMPUTED)]


@pytest.mark.parametrize("status", FAILURES)
def test_every_failure_says_what_to_try(status):
    s = Solution(np.zeros(3), status, 3, 4, (1.0, 0.5, 0.7), 0.0, "jacobi")
    text = str(s)
    assert re.search(f"jacobi.*{status.name.lower()}.* 3 .* 4 .* 0.5", text)
    assert any(word in text for word in ("try ", "check ", "loosen "))
    assert "\n" not in text
