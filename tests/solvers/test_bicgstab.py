# SPDX-License-Identifier: BSD-3-Clause
"""BiCGStab: the textbook's iterates, breakdowns that are survived, and those that are named."""

from __future__ import annotations

import numpy as np
import pytest

import ltcl
from ltcl.errors import ConvergenceError
from ltcl.operators import Dense, IdentityPlus, as_operator
from ltcl.solvers import Status
from tests.problems import lambertian, residual

random = np.random.default_rng(28)


def textbook(S: np.ndarray, b: np.ndarray, steps: int) -> np.ndarray:
    """van der Vorst's algorithm in float64, from 0 with r_0* = b."""
    x, r, p = np.zeros_like(b), b.copy(), b.copy()
    for _ in range(steps):
        rho, v = r @ b, S @ p
        alpha = rho / (v @ b)
        s = r - alpha * v
        t = S @ s
        omega = (t @ s) / (t @ t)
        x += alpha * p + omega * s
        r = s - omega * t
        p = r + (r @ b) / rho * alpha / omega * (p - omega * v)
    return x


@pytest.mark.parametrize("steps", [1, 2, 4])
@pytest.mark.parametrize("skew", [0.0, 0.1])
def test_its_iterates_are_the_textbooks(device, skew, steps):
    random = np.random.default_rng(1)  # the residual falls at every step: the best iterate is the last one
    S = lambertian(40, 4.0, 29).S + skew * random.normal(size=(40, 40))
    b = random.normal(size=(40, 2))
    s = ltcl.solve(as_operator(S, device), b, "bicgstab", maxiter=steps, rtol=1e-6, throw=False)
    assert s.iterations == steps
    for column in range(2):
        wanted = textbook(S, b[:, column], steps)
        np.testing.assert_allclose(s.x[:, column], wanted, rtol=0, atol=1e-3 * np.abs(wanted).max())


@pytest.mark.parametrize("rho", [0.8, 4.0, 9.0])
@pytest.mark.parametrize("seed", range(3))
def test_any_diffuse_scene_converges(device, seed, rho):
    scene = lambertian(60, rho, seed, density=0.3)
    S, b = IdentityPlus(Dense(device, scene.R)), random.uniform(size=(scene.n, 3))
    s = ltcl.solve(S, b, "bicgstab", rtol=1e-3)
    assert residual(scene.S, s.x, b) <= 1e-3 * (1 + 1e-2)
    assert s.products == 2 * s.iterations + 2  # S^T r* at the start, and the residual at the end


def test_a_vanished_rho_starts_anew(device):
    """Made so that r_1 is orthogonal to r_0* = b: the textbook's second step would divide by 0."""
    S, b = _orthogonal_after_one_step()
    s = ltcl.solve(as_operator(S, device), b, "bicgstab", rtol=1e-4)
    assert residual(S, s.x, b) <= 1e-4 * (1 + 1e-2)


def _orthogonal_after_one_step() -> tuple[np.ndarray, np.ndarray]:
    """<r_1, b> = <s, b> - omega <S s, b>, where <s, b> = 0: 0 if <s, S^T b> = 0 as well.

    b = e_1 and S = [[1, 0, 0], [1, 1, 0], [0, 1, 1]]: s = b - S b = -e_2 and S^T b = e_1.
    """
    return np.array([[1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 1.0]]), np.array([1.0, 0.0, 0.0])


@pytest.mark.parametrize("S", [[[0.0, 1.0], [-1.0, 0.0]], np.diag([1.0, -1.0])], ids=["turn", "signs"])
def test_where_no_step_exists_it_says_what_to_try(device, S):
    """<b, S b> = 0 for b = (1, 1)."""
    with pytest.raises(ConvergenceError, match=r"no next step.*gmres.*normal=True") as caught:
        ltcl.solve(as_operator(S, device), np.ones(2), "bicgstab")
    s = caught.value.solution
    assert s.status is Status.NO_STEP
    assert not s.x.any()  # the best there was
    assert ltcl.solve(as_operator(S, device), np.ones(2), "gmres").converged
    assert ltcl.solve(as_operator(S, device), np.ones(2), "cg", normal=True).converged


def test_a_broken_column_leaves_the_others_their_solution(device):
    S = np.array([[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.5], [0.0, 0.0, 0.0, 2.0]])
    b = np.array([[0.0, 1.0], [0.0, 1.0], [1.5, 0.0], [2.0, 0.0]])
    s = ltcl.solve(as_operator(S, device), b, "bicgstab", throw=False, rtol=1e-5)
    assert s.status is Status.NO_STEP
    np.testing.assert_allclose(s.x[:, 0], [0.0, 0.0, 1.0, 1.0], atol=1e-4)
    assert not s.x[:, 1].any()
