# SPDX-License-Identifier: BSD-3-Clause
"""Bounds on ||S^-1|| against the smallest singular value in float64."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ltcl.compression import inverse_norm
from ltcl.errors import ConvergenceError
from ltcl.operators import Compressed, Dense, IdentityPlus, SubsetBasis
from tests import gallery


def truth(S: np.ndarray) -> float:
    return float(1.0 / np.linalg.svd(S, compute_uv=False).min())


@settings(max_examples=20, deadline=None)
@given(n=st.integers(1, 60), size=st.sampled_from([0.1, 0.5, 0.9]), seed=st.integers(0, 999))
def test_the_bound_is_never_below(device, n, size, seed):
    R = gallery.signed(n, n, seed).astype(np.float64)
    R *= size / max(np.linalg.norm(R, 2), 1e-9)
    bound = inverse_norm(IdentityPlus(Dense(device, R)), seed=seed)
    exact = truth(np.eye(n) + R)
    assert exact <= bound.upper <= 1.25 * exact
    assert bound.estimate <= 1.01 * exact


@pytest.mark.parametrize("seed", range(12))
def test_solves_that_end_early_widen_the_bound(device, seed):
    """Steps that span all pixels leave no other slack, and solves stop short of the largest x."""
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.standard_normal((5, 5)))[0]
    R = Q @ np.diag(0.1 * rng.standard_normal(5)) @ Q.T
    bound = inverse_norm(IdentityPlus(Dense(device, R)), factor=1.00001)
    assert truth(np.eye(5) + R.astype(np.float32)) <= bound.upper


def test_coefficients_that_are_left_out_have_the_norm_of_the_identity(device):
    """The core alone, I + 0.5, has an inverse of norm 2/3."""
    V = SubsetBasis(device, (1, 5), [1, 3])
    S = IdentityPlus(Compressed(Dense(device, 0.5 * np.eye(2)), V, V))
    bound = inverse_norm(S)
    assert truth(S.to_dense()) == pytest.approx(1.0)
    assert 1.0 <= bound.upper <= 1.1


def test_a_singular_system_has_no_bound(device):
    R = -np.eye(8)
    R[0, 1] = 1.0
    with pytest.raises(ConvergenceError, match="S is singular"):
        inverse_norm(IdentityPlus(Dense(device, R)))
