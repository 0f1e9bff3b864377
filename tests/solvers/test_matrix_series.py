# SPDX-License-Identifier: BSD-3-Clause
"""The matrix series against dense inverses and powers."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl.errors import ConvergenceError, InputError, MemoryLimitError
from ltcl.operators import IdentityPlus, as_operator
from ltcl.solvers import Status, matrix_series
from tests.problems import enclosure, lambertian


def inverse_light(device, scene, form=np.asarray):
    """S = I + R, and S^-1 = I - A."""
    return IdentityPlus(as_operator(form(scene.R), device)), np.eye(scene.n) - scene.A


def forward_light(device, scene, form=np.asarray):
    """I - A, and its inverse S."""
    return IdentityPlus(as_operator(form(scene.A), device), sign=-1), scene.S


@pytest.mark.parametrize("form", [np.asarray, scipy.sparse.csr_array])
@pytest.mark.parametrize("direction", [inverse_light, forward_light])
@pytest.mark.parametrize("n", [1, 7, 130])  # one and three chunks of columns
def test_both_ways_to_the_dense_inverse(device, direction, form, n):
    scene = lambertian(n, 0.6 if n > 1 else 0.0, seed=n)
    S, wanted = direction(device, scene, form)
    found = matrix_series(S, rtol=1e-5)
    assert found.converged
    assert found.residual <= 1e-5
    assert np.linalg.norm(np.eye(n) - S.to_dense() @ found.x, axis=0).max() <= 1.1e-5
    np.testing.assert_allclose(found.x, wanted, rtol=0, atol=1e-4)


@pytest.mark.parametrize("k", [0, 1, 2, 5])
def test_k_steps_are_the_k_term_series(device, k):
    """Eq. 10 and eq. 8 to rounding, also where they diverge."""
    scene = lambertian(30, 1.5)
    for (S, _), M in (
        (inverse_light(device, scene), -scene.R),
        (forward_light(device, scene), scene.A),
    ):
        wanted = sum((np.linalg.matrix_power(M, i) for i in range(k + 1)), np.zeros_like(M))
        found = matrix_series(S, steps=k)
        assert found.status is Status.MAXITER
        assert (found.iterations, found.products, len(found.residuals)) == (k, k + 1, k + 1)
        np.testing.assert_allclose(found.x, wanted, rtol=0, atol=1e-5 * np.abs(wanted).max())
        left = np.linalg.norm(np.linalg.matrix_power(M, k + 1), axis=0).max()
        assert found.residuals[-1] == pytest.approx(left, rel=1e-3)


def test_divergence_is_detected_and_the_forward_dual_converges(device):
    """A closed box of albedo 0.51: rho(R) = 1.04, rho(A) = 0.51."""
    scene = enclosure(20, 0.51)
    with pytest.raises(ConvergenceError, match="diverged") as caught:
        matrix_series(inverse_light(device, scene)[0])
    assert caught.value.solution.status is Status.DIVERGED
    assert np.isfinite(caught.value.solution.x).all()
    with np.errstate(all="ignore"):
        assert (
            matrix_series(np.full((2, 2), 1e38), throw=False).status is Status.DIVERGED
        )  # infinite from the start
    assert matrix_series(forward_light(device, scene)[0]).converged


def test_maxiter_ends_it_and_need_not_throw(device):
    S, _ = inverse_light(device, enclosure(20, 0.48))
    assert matrix_series(S, maxiter=3, throw=False).status is Status.MAXITER
    with pytest.raises(ConvergenceError, match="maxiter after 3 iterations"):
        matrix_series(S, maxiter=3)


def test_what_does_not_fit_is_refused_before_allocation(device, monkeypatch):
    S, _ = inverse_light(device, lambertian(40, 0.5))
    monkeypatch.setattr(device, "memory", 2 * 4 * 40 * 40)
    with pytest.raises(MemoryLimitError, match="a matrix series for N = 40, two N x N iterates"):
        matrix_series(S)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"rtol": 0.0}, "rtol is 0.0"),
        ({"steps": -1}, "steps is -1"),
        ({"maxiter": 0}, "maxiter is 0"),
        ({"S": np.ones((2, 3))}, r"S has shape \(2, 3\); it must be square"),
    ],
)
def test_bad_input(options, says):
    with pytest.raises(InputError, match=says):
        matrix_series(**{"S": np.eye(2), **options})
