# SPDX-License-Identifier: BSD-3-Clause
"""`auto` picks a method before the first step and says why."""

from __future__ import annotations

import re

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import ConvergenceError
from ltcl.operators import CSR, IdentityPlus
from ltcl.solvers import Status, auto
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


@pytest.mark.parametrize(
    ("S", "rtol", "method", "why"),
    [
        (np.eye(20) + 0.01, 1e-2, "direct", "20 pixels are few enough"),
        (np.eye(N) + ring(0.01), 1e-2, "jacobi", r"row sums of R are at most 0.01: 1 products, chebyshev 4"),
        (np.eye(N) + ring(0.9), 1e-2, "chebyshev", r"row sums of R are at most 0.9: \d+ products"),
        (np.eye(N) + ring(0.01), 1e-9, "direct", "rtol=1e-09 is below what float32 products reach"),
    ],
    ids=["small", "weak", "strong", "precise"],
)
def test_the_choice_and_its_reason(device, S, rtol, method, why):
    b = np.random.default_rng(0).uniform(size=len(S))
    s = ltcl.solve(system(device, S - np.eye(len(S))), b, rtol=rtol)
    assert s.method == method
    assert re.search(why, s.reason), s.reason
    assert residual(S, s.x, b) <= max(rtol, 1e-6) * (1 + 1e-3)


def test_a_named_method_needs_no_reason(device):
    assert ltcl.solve(np.eye(4), np.ones(4), "jacobi").reason == ""


def test_where_the_choice_fails_a_factorization_takes_over(device):
    """A one-way ring of gain 3 has eigenvalues all around the origin, where no polynomial in S converges."""
    R, b = ring(3.0, skew=1.0), np.random.default_rng(0).uniform(size=N)
    s = ltcl.solve(system(device, R), b)
    assert s.method == "direct"
    assert s.reason.endswith("; chebyshev ended diverged")
    assert residual(np.eye(N) + R, s.x, b) <= 1e-2


def test_where_the_system_is_too_large_for_that_it_raises(device, monkeypatch):
    monkeypatch.setattr(auto, "LARGEST_DIRECT", N - 1)
    with pytest.raises(ConvergenceError) as caught:
        ltcl.solve(system(device, ring(3.0, skew=1.0)), np.random.default_rng(0).uniform(size=N))
    assert caught.value.solution.status is Status.DIVERGED
