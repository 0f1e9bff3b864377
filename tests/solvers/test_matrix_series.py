# SPDX-License-Identifier: BSD-3-Clause
"""The matrix series against dense inverses and powers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse

from ltcl.errors import ConvergenceError, MemoryLimitError
from ltcl.operators import IdentityPlus, as_operator
from ltcl.solvers import Status, matrix_series
from tests.problems import Scene, enclosure, lambertian


def both_ways(device, scene: Scene, form: Any = np.asarray) -> list[tuple[IdentityPlus, Any, Any]]:
    """S = I + R and then I - A, the inverse of each, and what the series is of."""
    inverse = IdentityPlus(as_operator(form(scene.R), device)), np.eye(scene.n) - scene.A, -scene.R
    return [inverse, (IdentityPlus(as_operator(form(scene.A), device), sign=-1), scene.S, scene.A)]


@pytest.mark.parametrize("form", [np.asarray, scipy.sparse.csr_array])
@pytest.mark.parametrize("n", [1, 7, 130])  # one and three chunks of columns
def test_both_ways_to_the_dense_inverse(device, form, n):
    for S, inverse, _ in both_ways(device, lambertian(n, 0.6 if n > 1 else 0.0, seed=n), form):
        s = matrix_series(S, rtol=1e-5)
        assert s.converged
        assert s.residual <= 1e-5
        assert np.linalg.norm(np.eye(n) - S.to_dense() @ s.x, axis=0).max() <= 1.1e-5
        np.testing.assert_allclose(s.x, inverse, rtol=0, atol=1e-4)


@pytest.mark.parametrize("k", [0, 1, 2, 5])
def test_k_steps_are_the_k_term_series(device, k):
    """Eq. 10 and eq. 8 to rounding, also where they diverge."""
    for S, _, M in both_ways(device, lambertian(30, 1.5)):
        wanted = sum((np.linalg.matrix_power(M, i) for i in range(k + 1)), np.zeros_like(M))
        found = matrix_series(S, steps=k)
        assert found.status is Status.MAXITER
        assert (found.iterations, found.products, len(found.residuals)) == (k, k + 1, k + 1)
        np.testing.assert_allclose(found.x, wanted, rtol=0, atol=1e-5 * np.abs(wanted).max())
        left = np.linalg.norm(np.linalg.matrix_power(M, k + 1), axis=0).max()
        assert found.residuals[-1] == pytest.approx(left, rel=1e-3)


def test_divergence_is_detected_and_the_forward_dual_converges(device):
    """A closed box of albedo 0.51: rho(R) = 1.04, rho(A) = 0.51."""
    (S, *_), (forward, *_) = both_ways(device, enclosure(20, 0.51))
    with pytest.raises(ConvergenceError) as caught:
        matrix_series(S)
    assert caught.value.solution.status is Status.DIVERGED
    assert np.isfinite(caught.value.solution.x).all()
    with np.errstate(all="ignore"):  # infinite from the start
        assert matrix_series(np.full((2, 2), 1e38), throw=False).status is Status.DIVERGED
    assert matrix_series(forward).converged
    with pytest.raises(ConvergenceError) as caught:
        matrix_series(forward, maxiter=3)
    assert (caught.value.solution.status, caught.value.solution.iterations) == (Status.MAXITER, 3)


def test_what_does_not_fit_is_refused_before_allocation(device, monkeypatch):
    (S, *_), _ = both_ways(device, lambertian(40, 0.5))
    monkeypatch.setattr(device, "memory", 2 * 4 * 40 * 40)
    with pytest.raises(MemoryLimitError, match="N = 40"):
        matrix_series(S)
