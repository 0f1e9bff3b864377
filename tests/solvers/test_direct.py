# SPDX-License-Identifier: BSD-3-Clause
"""The reference: float64, factors kept as long as their operator, singular systems named as such."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest

import ltcl
from ltcl.errors import ConvergenceError
from ltcl.operators import Dense, IdentityPlus, as_operator
from ltcl.solvers import Status, auto
from tests.problems import lambertian

random = np.random.default_rng(9)
whole = np.random.default_rng(0).integers(-9, 9, (6, 6)).astype(float)  # float32 holds these to the bit
SINGULAR = {
    "to the bit": np.array([[1.0, 2.0], [2.0, 4.0]]),
    "a zero row": np.diag([1.0, 0.0, 1.0]),
    "to rounding": np.vstack([whole[:5], whole[0] + whole[1] - whole[2]]),  # the last pivot is 1e-15, not 0
}


@pytest.mark.parametrize("matrix", SINGULAR.values(), ids=SINGULAR.keys())
@pytest.mark.parametrize("method", ["direct", "auto"])
def test_a_singular_system_breaks_down(device, method, matrix):
    b = random.uniform(0.5, 1.0, len(matrix))
    with pytest.raises(ConvergenceError, match="the system is singular") as caught:
        ltcl.solve(as_operator(matrix, device), b, method)
    assert caught.value.solution.status is Status.BREAKDOWN
    assert caught.value.solution.x.shape == b.shape
    assert not ltcl.solve(as_operator(matrix, device), b, method, throw=False).converged


def test_what_is_kept_lives_as_long_as_the_operator(device):
    S = IdentityPlus(Dense(device, np.full((3, 3), 0.1)))
    for method in ("direct", "jacobi"):
        ltcl.solve(S, np.ones(3), method, rtol=1e-6)
    assert auto.survey(S) is auto.survey(S)
    gone = weakref.ref(S)
    del S
    gc.collect()
    assert gone() is None


def test_a_tolerance_below_float64_is_not_claimed(device):
    s = ltcl.solve(as_operator(lambertian(60, 4.0).S, device), np.ones(60), "direct", rtol=1e-30, throw=False)
    assert s.status is Status.STAGNATED
