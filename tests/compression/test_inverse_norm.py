# SPDX-License-Identifier: BSD-3-Clause
"""Bounds on ||S^-1|| against the smallest singular value in float64."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ltcl.compression import inverse_norm
from ltcl.errors import ConvergenceError
from ltcl.operators import CSR, Compressed, Dense, IdentityPlus, Wavelet
from tests import gallery
from tests.problems import enclosure, lambertian


def truth(S: np.ndarray) -> float:
    return float(1.0 / np.linalg.svd(S, compute_uv=False).min())


@settings(max_examples=20, deadline=None)
@given(n=st.integers(1, 60), size=st.sampled_from([0.1, 0.5, 0.9]), seed=st.integers(0, 999))
def test_the_bound_is_never_below(device, n, size, seed):
    R = gallery.signed(n, n, seed).astype(np.float64)
    R *= size / max(np.linalg.norm(R, 2), 1e-9)
    found = inverse_norm(IdentityPlus(Dense(device, R)), seed=seed)
    wanted = truth(np.eye(n) + R)
    assert wanted <= found.upper <= 1.25 * wanted
    assert found.estimate <= 1.01 * wanted


@pytest.mark.parametrize("albedo", [0.3, 0.5, 0.8])
def test_a_closed_room(device, albedo):
    R = enclosure(60, albedo).R
    found = inverse_norm(IdentityPlus(Dense(device, R)), factor=1.05)
    assert truth(np.eye(60) + R) <= found.upper <= 1.1 * truth(np.eye(60) + R)


def test_one_bounce_instead_of_all(device):
    A = lambertian(50, 1.0).A
    found = inverse_norm(IdentityPlus(Dense(device, A), sign=-1))
    assert truth(np.eye(50) - A) <= found.upper


def test_coefficients_have_the_norm_of_pixels(device):
    W = Wavelet(device, (5, 9), "db2")
    core = 0.1 * gallery.sparse(45, 45)
    S = IdentityPlus(Compressed(CSR(device, core), W, W))
    assert truth(np.eye(45) + core.toarray()) <= inverse_norm(S).upper
    np.testing.assert_allclose(truth(np.eye(45) + core.toarray()), truth(S.to_dense()), rtol=1e-5)


def test_a_singular_system_is_no_bound(device):
    R = -np.eye(8)
    R[0, 1] = 1.0
    with pytest.raises(ConvergenceError, match=r"^S is singular, or nearly so: .*; check the first bounce$"):
        inverse_norm(IdentityPlus(Dense(device, R)))
