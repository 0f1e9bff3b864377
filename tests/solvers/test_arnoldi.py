# SPDX-License-Identifier: BSD-3-Clause
"""Arnoldi: an orthonormal basis of what products reach, S V = V H, each right-hand side with its own."""

from __future__ import annotations

import numpy as np

from ltcl.operators import as_operator
from ltcl.solvers.arnoldi import Arnoldi

random = np.random.default_rng(22)
N, STEPS, K = 30, 6, 3


def test_the_basis_is_orthonormal_and_carries_S(device):
    S = np.eye(N) + random.normal(size=(N, N)) / 10
    space = Arnoldi(as_operator(S, device), device.upload(random.normal(size=(N, K))), STEPS)
    H = np.zeros((K, STEPS + 1, STEPS))
    for j in range(STEPS):
        H[:, : j + 2, j] = space.extend()
    V = space.V.get().reshape(STEPS + 1, N, K).astype(np.float64)
    for c in range(K):
        np.testing.assert_allclose(V[:, :, c] @ V[:, :, c].T, np.eye(STEPS + 1), atol=1e-5)
        np.testing.assert_allclose(S @ V[:STEPS, :, c].T, V[:, :, c].T @ H[c], atol=1e-5)


def test_a_complete_space_and_a_dark_column_get_no_direction(device):
    """The first column starts at an eigenvector, the second is 0."""
    S = as_operator(np.diag([2.0, 1.0, 3.0]), device)
    space = Arnoldi(S, device.upload(np.array([[5.0, 0.0, 0.6], [0.0, 0.0, 0.8], [0.0, 0.0, 0.0]])), 2)
    h = space.extend()
    np.testing.assert_allclose(h, [[2.0, 0.0], [0.0, 0.0], [1.36, 0.48]], rtol=1e-5)
    found = space.V.get().reshape(3, 3, 3)[1]
    np.testing.assert_allclose(found, [[0, 0, 0.8], [0, 0, -0.6], [0, 0, 0]], atol=1e-5)
