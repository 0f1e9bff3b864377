# SPDX-License-Identifier: BSD-3-Clause
"""Arnoldi: an orthonormal basis of what products reach, S V = V H, each right-hand side with its own."""

from __future__ import annotations

import numpy as np

from ltcl.device import Array
from ltcl.operators import as_operator
from ltcl.solvers import arnoldi

random = np.random.default_rng(22)
N, STEPS, K = 30, 6, 3


def test_the_basis_is_orthonormal_and_carries_S(device):
    S = np.eye(N) + random.normal(size=(N, N)) / 10
    start = random.normal(size=(N, K))
    basis = [device.upload(start / np.linalg.norm(start, axis=0))]
    H = np.zeros((K, STEPS + 1, STEPS))
    for j in range(STEPS):
        H[:, : j + 2, j] = arnoldi.extend(basis, as_operator(S, device).apply(basis[j]), np.ones(K, bool))
    V = np.stack([v.get() for v in basis]).astype(np.float64)  # (STEPS + 1, N, K)
    for c in range(K):
        np.testing.assert_allclose(V[:, :, c] @ V[:, :, c].T, np.eye(STEPS + 1), atol=1e-5)
        np.testing.assert_allclose(S @ V[:STEPS, :, c].T, V[:, :, c].T @ H[c], atol=1e-5)


def test_a_complete_space_and_a_resting_column_get_no_direction(device):
    """The first column starts at an eigenvector, the second rests."""
    S = as_operator(np.diag([2.0, 1.0, 3.0]), device)
    basis = [device.upload(np.array([[1.0, 0.6, 0.6], [0.0, 0.8, 0.8], [0.0, 0.0, 0.0]]))]
    h = arnoldi.extend(basis, S.apply(basis[0]), np.array([True, False, True]))
    np.testing.assert_allclose(h, [[2.0, 0.0], [0.0, 0.0], [1.36, 0.48]], rtol=1e-5)
    np.testing.assert_allclose(basis[1].get(), [[0, 0, 0.8], [0, 0, -0.6], [0, 0, 0]], atol=1e-5)


def test_a_step_waits_for_the_device_twice(device, monkeypatch):
    S = as_operator(np.eye(N) + random.normal(size=(N, N)) / 10, device)
    reads, read = [], Array.get
    monkeypatch.setattr(Array, "get", lambda array: reads.append(array) or read(array))
    basis = [device.upload(np.eye(N)[:, :2])]
    for _ in range(5):
        arnoldi.extend(basis, S.apply(basis[-1]), np.ones(2, bool))
    assert len(reads) == 10
