# SPDX-License-Identifier: BSD-3-Clause
"""Three colours solved as one: each channel to its own tolerance, or one by one."""

from __future__ import annotations

import importlib

import numpy as np
import pytest

from ltcl.operators import IdentityPlus
from ltcl.solvers import joined, solve_each
from tests.bases import rotation, two_sided

# The module, whose name the function takes.
SOLVE = importlib.import_module("ltcl.solvers.solve")
N = 600
rng = np.random.default_rng(6)


@pytest.fixture(scope="module")
def systems(device):
    """S of three colours between the coefficients of one basis."""
    Q = rotation(N, seed=1)
    found = []
    for scale in (0.8, 0.5, 0.1):
        R = (Q * rng.uniform(0.0, scale, N)) @ Q.T
        found.append(IdentityPlus(two_sided(device, R)))
    return found


def relative_residual(S, solution, b) -> float:
    dense = S.to_dense()
    return float(np.linalg.norm(b - dense @ solution.x) / np.linalg.norm(b))


def test_each_channel_to_its_own_tolerance(systems, monkeypatch):
    """Also one that is far dimmer than the others, and one without light."""
    used = []
    original = joined.solve_joined
    monkeypatch.setattr(SOLVE, "solve_joined", lambda *a: used.append(original(*a)) or used[-1])
    for sizes in ((1.0, 1.0, 1.0), (1.0, 1e-6, 1e3), (1.0, 0.0, 1.0)):
        sides = [size * rng.uniform(size=N) for size in sizes]
        solutions = solve_each(systems, sides, rtol=1e-3, with_residual=True)
        for S, solution, b in zip(systems, solutions, sides, strict=True):
            assert solution.converged
            assert solution.x.shape == b.shape
            if b.any():
                assert relative_residual(S, solution, b) < 1.1e-3
                assert solution.residual == pytest.approx(
                    relative_residual(S, solution, b), rel=0.05, abs=1e-6
                )
            else:
                assert not solution.x.any()
    assert len(used) == 3
    assert None not in used


@pytest.mark.parametrize(
    "settings",
    [{"rtol": 1e-5}, {"method": "gmres"}, {"callback": lambda *_: None}, {"atol": 1e-3}],
    ids=["a fine tolerance", "a method", "a callback", "atol"],
)
def test_channels_that_are_solved_alone(systems, settings, monkeypatch):
    monkeypatch.setattr(SOLVE, "solve_joined", pytest.fail)
    sides = [rng.uniform(size=N) for _ in systems]
    solutions = solve_each(systems, sides, **{"rtol": 1e-3, **settings})
    assert all(solution.converged for solution in solutions)


def test_what_does_not_converge_is_solved_alone(systems, monkeypatch):
    monkeypatch.setattr(SOLVE, "solve_joined", lambda *_: None)
    sides = [rng.uniform(size=N) for _ in systems]
    for S, solution, b in zip(systems, solve_each(systems, sides, rtol=1e-3), sides, strict=True):
        assert relative_residual(S, solution, b) < 1.1e-3
