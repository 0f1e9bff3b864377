# SPDX-License-Identifier: BSD-3-Clause
"""Pixels and S-matrices: what is decoded is what was lit, with the least variance there is."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.scanning import Hadamard, Pixels
from ltcl.acquisition.scanning.codes import patterns
from ltcl.acquisition.scanning.pictures import UNKNOWN
from ltcl.errors import InputError


@pytest.mark.parametrize("pixels", [1, 2, 3, 5, 8, 15, 16, 20, 63])
@pytest.mark.parametrize("code", [Pixels(), Hadamard()], ids=["pixel", "hadamard"])
def test_columns_come_back_without_noise(code, pixels):
    T = np.random.default_rng(pixels).random((pixels, 4))
    P = code.patterns(pixels)
    assert P.shape == (code.count(pixels), pixels)
    assert P.any(axis=1).all()  # no pattern is black
    found, variance = code.decode(P @ T, np.full((len(P), 4), 1e-4), np.zeros(4))
    np.testing.assert_allclose(found[:pixels], T, atol=1e-12)
    assert variance[:pixels].shape == T.shape


def test_one_at_a_time_is_generalised_least_squares():
    """Of all linear estimates with y = A x + n - e 1, cov n = diag(v), var e = a: (A' K A)^-1 A' K y."""
    rng = np.random.default_rng(3)
    B, a = 6, 0.3
    A, v, y = Pixels(B).patterns(B).astype(float), rng.random(B + 1) + 0.1, rng.random(B + 1)
    K = np.linalg.inv(np.diag(v) + a)
    C = np.linalg.inv(A.T @ K @ A)
    found, variance = Pixels(B).decode(y[:, None], v[:, None], np.array([a]))
    np.testing.assert_allclose(found[:, 0], C @ A.T @ K @ y, rtol=1e-9)
    np.testing.assert_allclose(variance[:, 0], np.diag(C), rtol=1e-9)


def test_a_column_that_no_photograph_tells_is_told_by_the_sum():
    x, v = np.array([0.3, 0.0, 0.1]), np.array([1e-6, UNKNOWN, 1e-6, 4e-6])
    found, variance = Pixels(3).decode(np.append(x, 0.9)[:, None], v[:, None], np.zeros(1))
    assert found[1, 0] == pytest.approx(0.9 - 0.3 - 0.1, rel=1e-6)
    assert variance[1, 0] == pytest.approx(6e-6, rel=1e-6)


@pytest.mark.parametrize("pixels", [3, 7, 31])
def test_variance_of_s_matrices(pixels):
    rng = np.random.default_rng(pixels)
    S = Hadamard().patterns(pixels).astype(float)
    v, a = rng.random(pixels), 0.2
    inverse = np.linalg.inv(S)
    _, variance = Hadamard().decode(np.zeros((pixels, 1)), v[:, None], np.array([a]))
    of_each = (inverse**2 @ v) + a * inverse.sum(axis=1) ** 2
    np.testing.assert_allclose(variance[:, 0], of_each, rtol=1e-6)


def test_multiplexing_wins_under_constant_noise_and_loses_under_photons():
    """The factors of theory: 4 n / (n + 1)^2 for constant noise, 2 n / (n + 1) for light spread evenly."""
    rng, n, x = np.random.default_rng(0), 63, np.full((63, 400), 0.01)
    S = Hadamard().patterns(n).astype(float)
    for by_light in (False, True):
        v = S @ x if by_light else np.full((n, 400), 1.0)
        y = S @ x + np.sqrt(v) * rng.standard_normal(v.shape)
        found, _ = Hadamard().decode(y, v, np.zeros(400))
        single = 0.01 if by_light else 1.0
        wanted = (2 * n / (n + 1) if by_light else 4 * n / (n + 1) ** 2) * single
        assert np.var(found - x) == pytest.approx(wanted, rel=0.05)


def test_patterns_are_counted():
    assert patterns(Pixels(64), 4096) == 4096 + 64
    assert patterns(Pixels(64), 65) == 65 + 1
    assert patterns(Hadamard(63), 128) == 63 + 63 + 3
    assert patterns(Hadamard(7), 3) == 3


@pytest.mark.parametrize("size", [0, 2, 64, 1.5])
def test_other_sizes_are_refused(size):
    with pytest.raises(InputError, match="size is"):
        Hadamard(size)
