# SPDX-License-Identifier: BSD-3-Clause
"""Residuals wait on the device: few readings, nearly no product in vain, and nothing lost of the history."""

from __future__ import annotations

import numpy as np
import pytest

import ltcl
from ltcl.device import Array
from ltcl.operators import Dense, IdentityPlus
from ltcl.solvers import Status
from ltcl.solvers.stopping import Monitor
from tests.problems import enclosure, lambertian, residual

LAZY = ("jacobi", "neumann", "richardson", "chebyshev")
random = np.random.default_rng(40)


@pytest.fixture
def reads(monkeypatch):
    """Every transfer to the host that waits for the device."""
    seen: list[Array] = []
    read = Array.get
    monkeypatch.setattr(Array, "get", lambda array: seen.append(array) or read(array))
    return seen


@pytest.fixture
def eager(monkeypatch):
    """Solve with every residual read as soon as it is made."""

    def solve(*arguments, **options):
        with monkeypatch.context() as patch:
            patch.setattr(Monitor, "_may_wait", lambda *_: False)
            return ltcl.solve(*arguments, **options)

    return solve


@pytest.mark.parametrize("columns", [(), (3,)])
@pytest.mark.parametrize(
    ("method", "rho", "options"),
    [("jacobi", 0.9, {}), ("neumann", 0.9, {}), ("richardson", 9.0, {}), ("chebyshev", 50.0, {"arnoldi": 0})],
)
def test_a_long_solve_reads_far_less_than_once_a_step(device, reads, method, rho, options, columns):
    scene = enclosure(40, rho / (1 + rho))
    S, b = IdentityPlus(Dense(device, scene.R)), scene.S @ random.uniform(size=(40, *columns))
    S.row_sums()
    reads.clear()
    s = ltcl.solve(S, b, method, rtol=1e-4, **options)
    assert s.iterations >= 25
    assert len(reads) < s.iterations / 2
    assert len(s.residuals) == s.iterations + 1
    assert residual(scene.S, s.x, b) <= 1e-4 * (1 + 1e-2)


@pytest.mark.parametrize("method", LAZY)
@pytest.mark.parametrize("rtol", [0.3, 1e-2, 1e-5])
@pytest.mark.parametrize("rho", [0.1, 0.5, 0.8, 0.95, 4.0, 50.0])
@pytest.mark.parametrize("seed", range(4))
def test_at_most_one_product_is_made_in_vain(device, eager, seed, rho, rtol, method):
    if rho > 1.0 and method in ("jacobi", "neumann"):
        rho = 1.0 - 1.0 / rho
    scene = lambertian(50, rho, seed, density=0.4)
    S = IdentityPlus(Dense(device, scene.R))
    b = np.random.default_rng(seed).normal(size=(50, 3)) if seed % 2 else scene.S @ np.ones((50, 3))
    every, few = eager(S, b, method, rtol=rtol), ltcl.solve(S, b, method, rtol=rtol)
    assert every.products <= few.products <= every.products + 1
    assert few.residuals[: len(every.residuals) - 1] == every.residuals[:-1]
    assert residual(scene.S, few.x, b) <= rtol * (1 + 1e-2) + 2**-22


@pytest.mark.parametrize("method", LAZY)
@pytest.mark.parametrize("maxiter", [1, 2, 3, 5, 11, 30])
def test_maxiter_is_kept_to_the_step(device, eager, method, maxiter):
    scene = lambertian(50, 0.98, 41)
    S, b = IdentityPlus(Dense(device, scene.R)), random.normal(size=50)
    every, few = (go(S, b, method, rtol=1e-6, maxiter=maxiter, throw=False) for go in (eager, ltcl.solve))
    assert (few.status, few.iterations) == (every.status, every.iterations)
    assert few.residuals == every.residuals
    np.testing.assert_array_equal(few.x, every.x)


@pytest.mark.parametrize("columns", [(), (3,)])
@pytest.mark.parametrize("rho", [1.05, 1.5, 4.0])
@pytest.mark.parametrize("method", ["jacobi", "neumann"])
def test_the_best_iterate_is_found_between_readings(device, eager, reads, method, rho, columns):
    """The residual falls first and then grows: the least is seldom among those read at once."""
    scene = lambertian(50, rho, 42)
    top = np.linalg.eig(scene.S)
    dominant = np.real(top.eigenvectors[:, np.argmax(np.real(top.eigenvalues))])
    b = random.normal(size=(50, *columns))
    b = b + 0.02 * (dominant if not columns else dominant[:, None])
    S = IdentityPlus(Dense(device, scene.R))
    every = eager(S, b, method, rtol=1e-6, throw=False)
    reads.clear()
    few = ltcl.solve(S, b, method, rtol=1e-6, throw=False)
    assert few.status is every.status is Status.DIVERGED
    assert few.residual == every.residual == min(few.residuals)
    np.testing.assert_array_equal(few.x, every.x)
    assert residual(scene.S, few.x, b) == pytest.approx(few.residual, rel=1e-3)
    if rho < 1.1:
        assert len(reads) < few.iterations / 2


def test_the_callback_is_told_every_step_in_order(device):
    scene, seen = enclosure(40, 0.45), []
    S = IdentityPlus(Dense(device, scene.R))
    s = ltcl.solve(S, np.ones(40), "jacobi", rtol=1e-4, callback=lambda *step: seen.append(step))
    assert seen == list(enumerate(s.residuals))
