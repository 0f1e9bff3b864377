# SPDX-License-Identifier: BSD-3-Clause
"""Second moments against eigenvalues and walks; samples of products against all covariances."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl.operators import CSR, Dense
from ltcl.operators.walks import Lengths, Tables, Walker, linked, tables, tables_of_columns
from ltcl.theory.walks import Weights, chance_to_go_on, enough_samples, has_variance, weights
from tests import gallery

SIGNED = gallery.sparse(37, 37, 0.4, seed=4).toarray() / 8


def radius(Q: np.ndarray) -> float:
    return float(np.abs(np.linalg.eigvals(Q)).max())


@pytest.mark.parametrize("form", ["csr", "dense"])
@pytest.mark.parametrize("R", [SIGNED, gallery.bounces(29, 0.8)])
def test_weights_are_those_of_the_matrices_of_moments(device, R, form):
    M = CSR(device, scipy.sparse.csr_array(R)) if form == "csr" else Dense(device, R)
    R = np.abs(R.astype(np.float64))
    drawn, columns = R.sum(axis=1)[:, None] * R, R.sum(axis=0)[:, None] * R.T
    pairs: list[tuple[Tables, np.ndarray]] = [(tables(M), drawn), (tables_of_columns(M), columns)]
    for made, Q in pairs:
        found = weights(M, made)
        assert found.radius == pytest.approx(radius(Q), rel=1e-3)
        np.testing.assert_allclose(found.mean_square[0], Q.sum(axis=1), rtol=1e-5)
    assert radius(R) ** 2 <= radius(drawn) * (1 + 1e-9)  # Cauchy and Schwarz


def test_each_channel_of_shared_walks_has_the_variance_that_its_moments_say(device):
    """Of a score at step 3 alone with b = 1: E[score^2] = Q^3 1 / q^2, Q = R^2 / p."""
    dense = [gallery.sparse(11, 11, 0.7, seed).toarray() / (14 + seed) for seed in range(3)]
    Rs, q = [CSR(device, scipy.sparse.csr_array(R)) for R in dense], 0.6
    made = linked(Rs, (1.0, 1.0, 1.0))
    walker = Walker(made, Lengths(np.array([0.0, 0.0, 1.0]), q), 0)
    found = walker.rows(device.upload(np.ones((11, 3))), np.arange(11), 200_000)
    units = [np.abs(R.astype(float)).sum(axis=1, keepdims=True) for R in dense]
    P = np.sqrt(sum((R / unit) ** 2 for R, unit in zip(dense, units, strict=True)))
    p = P / P.sum(axis=1, keepdims=True)
    moments = [np.divide(R.astype(float) ** 2, p, out=np.zeros((11, 11)), where=p > 0) for R in dense]
    for Q, squares in zip(moments, found.squares.T, strict=True):
        wanted = np.linalg.matrix_power(Q, 3) @ np.ones(11) / q**2
        np.testing.assert_allclose(squares / found.samples, wanted, rtol=0.05)
    assert weights(Rs[0], made).radius == pytest.approx(max(map(radius, moments)), rel=1e-3)
    for Q, own, unit in zip(moments, weights(Rs[0], made).mean_square, units, strict=True):
        np.testing.assert_allclose(own, Q.sum(axis=1), rtol=1e-4)
        assert np.all(own <= 3 * unit[:, 0] ** 2 * (1 + 1e-6))  # of its own walks


@pytest.mark.parametrize(
    ("moments", "albedo", "finite"),
    [
        (0.25, None, True),
        (0.0, None, True),
        (1.0, None, False),
        (np.inf, None, False),
        (np.nan, None, False),
        (0.5, 0.34, True),
        (0.5, 0.33, False),
    ],
)
def test_a_variance_is_finite_where_moments_grow_less_than_walks_end(moments, albedo, finite):
    q = chance_to_go_on(Weights(moments, np.zeros((1, 3))), albedo)
    assert has_variance(moments, q) is finite
    assert not finite or q > 0.01  # never so short that terms are left out


def normal(n: int, rho: float, power: int = 1) -> np.ndarray:
    R = np.random.default_rng(n).standard_normal((n, n)) ** power
    return R * (rho / np.linalg.norm(R, 2))


@pytest.mark.parametrize(
    "R",
    [normal(11, 0.8), normal(12, 0.6, 3), np.array([[-0.5]]), np.array([[0.0, 0.9], [-0.9, 0.0]])],
)
def test_noise_dies_away_from_enough_samples_on(device, R):
    """By the map of all covariances, C' = R C R^T + diag(Q diag C - diag(R C R^T)) / s, N^2 x N^2."""
    R = R.astype(np.float32).astype(float)
    M, n, both = Dense(device, R), len(R), np.kron(R, R)
    s, growing = enough_samples([M], tables(M)), Dense(device, 1.05 * R / np.linalg.norm(R, 2))
    assert enough_samples([growing], tables(growing)) == np.inf
    own, L = np.arange(n) * (n + 1), both.copy()
    L[own] -= both[own] / s
    L[np.ix_(own, own)] += np.abs(R).sum(axis=1)[:, None] * np.abs(R) / s
    assert np.abs(np.linalg.eigvals(L)).max() < 1
    assert s <= 3 * radius(np.abs(R).sum(axis=1)[:, None] * np.abs(R)) / (1 - np.linalg.norm(R, 2) ** 2) + 1
