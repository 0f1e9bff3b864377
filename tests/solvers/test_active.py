# SPDX-License-Identifier: BSD-3-Clause
"""Solves on the coefficients that C acts on alone, against float64 and against solves in pixels."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.compression import inverse_norm
from ltcl.operators import CSR, Compressed, Dense, IdentityPlus
from tests.bases import Given, rotation, stands_for
from tests.problems import enclosure, residual
from tests.solvers.helpers import ITERATIVE, METHODS

N, M = 53, 19
rng = np.random.default_rng(6)


def _system(device, sign=1.0):
    """S = I + sign V^T C V with 19 of 53 coefficients, and its float64 matrix."""
    V = Given(device, rotation(N)[:M])
    scene = enclosure(M, 0.4)
    C = scipy.sparse.csr_array(scene.R if sign > 0 else scene.A)
    R = Compressed(CSR(device, C), V, V)
    return IdentityPlus(R, sign), np.eye(N) + sign * stands_for(R)


def _inside(S: IdentityPlus) -> Compressed:
    assert isinstance(S.R, Compressed)
    return S.R


def _light(*shape):
    """Pictures, of which about half is beside all active coefficients."""
    return rng.uniform(0.0, 1.0, shape)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["undo", "add"])
@pytest.mark.parametrize("columns", [(), (1,), (3,), (5,)])
@pytest.mark.parametrize("method", METHODS)
def test_every_method_on_active_coefficients(device, method, columns, sign):
    S, truth = _system(device, sign)
    b = _light(N, *columns)
    s = ltcl.solve(S, b, method, rtol=1e-4)
    assert s.converged
    assert s.x.shape == b.shape
    assert residual(truth, s.x, b) <= 1e-4 * (1 + 2e-2)
    exact = np.linalg.solve(truth, b)
    assert np.linalg.norm(s.x - exact) <= 2e-4 * np.linalg.cond(truth) * np.linalg.norm(exact)


@pytest.mark.parametrize("method", ITERATIVE)
def test_residuals_are_relative_to_the_whole_of_b(device, method):
    """The last one is that of x in pixels, by float64; both tolerances are those of pixels."""
    S, truth = _system(device)
    b = _light(N, 3) * np.array([1.0, 10.0, 0.1])
    norms = np.linalg.norm(b, axis=0)
    for rtol, atol in ((1e-2, 0.0), (0.0, 0.02), (1e-3, 0.02)):
        s = ltcl.solve(S, b, method, rtol=rtol, atol=atol)
        left = np.linalg.norm(b - truth @ s.x, axis=0)
        np.testing.assert_allclose(s.residual, np.max(left / norms), rtol=1e-2, atol=1e-6)
        assert np.all(left <= np.maximum(rtol * norms, atol) * (1 + 1e-3))
        first = np.max(np.linalg.norm(rotation(N)[:M] @ b, axis=0) / norms)
        np.testing.assert_allclose(s.residuals[0], first, rtol=1e-5)


@pytest.mark.parametrize("method", ["chebyshev", "gmres", "direct"])
def test_refinement_steps_on_active_coefficients(device, method):
    S, truth = _system(device)
    exact = truth + rng.normal(size=(N, N)) * 1e-4
    b = _light(N, 3)
    compressed = IdentityPlus(S.R, solution_error=1e-2)
    s = ltcl.solve(compressed, b, method, rtol=1e-5, exact=Dense(device, exact))
    assert residual(exact, s.x, b) <= 1.05e-5


def test_the_norm_of_the_inverse_knows_the_rest(device):
    """S is the identity beside the active coefficients: no norm of its inverse is below 1."""
    V = Given(device, rotation(N)[:M])
    for C in (np.eye(M) * 3.0, -0.5 * np.eye(M)):
        S = IdentityPlus(Compressed(Dense(device, C), V, V))
        found = inverse_norm(S)
        exact = np.linalg.norm(np.linalg.inv(np.eye(N) + stands_for(_inside(S))), 2)
        assert found.upper >= exact * (1 - 1e-6)
        np.testing.assert_allclose(found.estimate, exact, rtol=1e-2)
