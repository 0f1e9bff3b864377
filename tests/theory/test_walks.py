# SPDX-License-Identifier: BSD-3-Clause
"""Second moments of walks, against the eigenvalues of what they are said to be, and against walks."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl.errors import InputError
from ltcl.operators import CSR, Dense
from ltcl.operators.alias import tables, tables_of_columns
from ltcl.operators.links import links
from ltcl.operators.walks import Walker, geometric
from ltcl.theory.walks import chance_to_go_on, noise_of_terms, second_moment_radius
from tests import gallery

SIGNED = gallery.sparse(37, 37, 0.4, seed=4).toarray() / 8


def radius(Q: np.ndarray) -> float:
    return float(np.abs(np.linalg.eigvals(Q)).max())


@pytest.mark.parametrize("form", ["csr", "dense"])
@pytest.mark.parametrize("R", [SIGNED, gallery.bounces(29, 0.8)])
def test_radii_are_those_of_the_matrices_of_moments(device, R, form):
    M = CSR(device, scipy.sparse.csr_array(R)) if form == "csr" else Dense(device, R)
    R = R.astype(np.float64)
    drawn = np.abs(R).sum(axis=1)[:, None] * np.abs(R)
    assert second_moment_radius(M, tables(M)) == pytest.approx(radius(drawn), rel=1e-3)
    entries = (R != 0).sum(axis=1) if form == "csr" else np.full(len(R), R.shape[1])
    uniform = entries[:, None] * R**2
    assert second_moment_radius(M, tables(M, "uniform")) == pytest.approx(radius(uniform), rel=1e-3)
    columns = np.abs(R).sum(axis=0)[:, None] * np.abs(R).T
    assert second_moment_radius(M, tables_of_columns(M), True) == pytest.approx(radius(columns), rel=1e-3)
    assert radius(np.abs(R)) ** 2 <= radius(drawn) * (1 + 1e-9)  # Cauchy and Schwarz


def test_the_variance_of_walks_is_what_the_moments_say(device):
    """Of the end-point score with b = 1: E[score^2] = sum over k of (Q^k 1) q / (1 - q)."""
    R, q = gallery.bounces(11, 0.5, seed=3), 0.6
    M = Dense(device, R)
    R = R.astype(np.float64)
    Q = np.abs(R).sum(axis=1)[:, None] * np.abs(R) / q
    squares = np.linalg.solve(np.eye(11) - Q, Q @ np.ones(11)) * q / (1 - q)
    found = Walker(tables(M), geometric(q, -1.0), "endpoint", 0).rows(
        device.upload(np.ones(11)), np.arange(11), 0, 200_000
    )
    np.testing.assert_allclose(found.squares / found.samples, squares, rtol=0.05)


def test_each_channel_of_shared_walks_has_the_variance_that_its_moments_say(device):
    """The same with three R, whose Q are R^2 / p; the radius is the largest of all."""
    dense = [gallery.sparse(11, 11, 0.7, seed).toarray() / (14 + seed) for seed in range(3)]
    Rs, q = [CSR(device, scipy.sparse.csr_array(R)) for R in dense], 0.6
    made = links(Rs, (1.0, 1.0, 1.0))
    walker = Walker(made, geometric(q, -1.0), "endpoint", 0)
    found = walker.rows(device.upload(np.ones((11, 3))), np.arange(11), 0, 200_000)
    units = [np.abs(R.astype(float)).sum(axis=1, keepdims=True) for R in dense]
    P = np.sqrt(sum((R / unit) ** 2 for R, unit in zip(dense, units, strict=True)))
    p = P / P.sum(axis=1, keepdims=True)
    moments = [np.divide(R.astype(float) ** 2, p, out=np.zeros((11, 11)), where=p > 0) for R in dense]
    for Q, squares in zip(moments, found.squares.T, strict=True):
        wanted = np.linalg.solve(np.eye(11) - Q / q, Q / q @ np.ones(11)) * q / (1 - q)
        np.testing.assert_allclose(squares / found.samples, wanted, rtol=0.05)
    assert second_moment_radius(Rs[0], made) == pytest.approx(max(map(radius, moments)), rel=1e-3)


@pytest.mark.parametrize("m", [-0.1, 0.0, 0.5, 0.7, np.nan, "dark"])
def test_albedos_that_no_length_fits_are_refused(m):
    with pytest.raises(InputError, match="albedo is ") as caught:
        chance_to_go_on(0.1, m)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("moments", [1.0, 4.0, np.inf, np.nan])
def test_an_infinite_variance_is_refused(moments):
    with pytest.raises(InputError, match=r"no finite variance: .*; use series='chebyshev' or method="):
        chance_to_go_on(moments, None)
    with pytest.raises(InputError, match=r"albedo is 0.4; .* variance of walks is infinite whatever"):
        chance_to_go_on(moments, 0.4)


def test_an_albedo_too_low_for_R_is_refused_with_the_least():
    with pytest.raises(InputError, match=r"albedo is 0.2; .* is infinite below 0.333: .*leave albedo out"):
        chance_to_go_on(0.5, 0.2)
    assert chance_to_go_on(0.5, 0.34) == pytest.approx(0.34 / 0.66)


def test_walks_are_never_so_short_that_terms_are_left_out():
    assert chance_to_go_on(0.0, None) > 0.01


def test_the_noise_of_terms_is_that_of_independent_steps():
    """Walks of one length over one row that all share, b = -1 or 1 at random: steps are independent."""
    rng, c, rho = np.random.default_rng(0), np.array([1.0, -0.5, 2.0, 0.25]), 0.8
    scores = sum(c[k] * rho**k * rng.choice((-1, 1), 100_000) for k in (1, 2, 3))
    assert noise_of_terms(c, rho**2) == pytest.approx(np.std(scores), rel=0.02)
    assert noise_of_terms(np.full(900, 1e30), 1e6) == np.inf
