# SPDX-License-Identifier: BSD-3-Clause
"""Smooth transports keep the coefficients that their core acts on, and no others."""

from __future__ import annotations

import numpy as np
import pytest

import ltcl
from ltcl.operators import Chained, Compressed, Selected

RNG = np.random.default_rng(3)


@pytest.fixture(scope="module")
def corner():
    T = ltcl.scenes.dihedral(16, albedo=0.8).transport()
    return T, ltcl.compress(T, 0.05, basis="db2")


def _inside(C: ltcl.Transport) -> Compressed:
    R = C.systems[0].R
    assert isinstance(R, Compressed)
    return R


def _exact(T: ltcl.Transport, b: np.ndarray) -> np.ndarray:
    return np.linalg.solve(T.systems[0].to_dense(), b)


def test_smooth_transports_lie_on_few_coefficients(corner):
    T, C = corner
    R = _inside(C)
    assert R.two_sided
    assert isinstance(R.into, Chained)
    assert isinstance(R.into.outer, Selected)  # of wavelets in their own order: the choice is the order
    assert 2 * R.core.shape[0] <= T.shape[0]
    used = np.abs(R.core.to_dense())
    assert np.all(used.max(axis=0) + used.max(axis=1) > 0)
    error = np.linalg.norm(C.systems[0].to_dense() - T.systems[0].to_dense(), 2)
    assert error <= R.error
    assert C.compression.channels[0].basis == "db2"
    np.testing.assert_array_equal(R.diagonal(), T.systems[0].R.diagonal())


def test_their_solutions_are_within_the_bound(corner):
    T, C = corner
    b = RNG.uniform(0.0, 1.0, (T.shape[0], 3))
    found = ltcl.solve(C.systems[0].as_it_stands(), b, "gmres", rtol=1e-5).x
    exact = _exact(T, b)
    off = np.linalg.norm(found - exact, axis=0) / np.linalg.norm(exact, axis=0)
    assert off.max() <= C.error <= 0.05


def test_a_file_holds_the_choice(corner, tmp_path):
    _, C = corner
    ltcl.save(tmp_path / "c.npz", C)
    again = ltcl.load(tmp_path / "c.npz")
    assert _inside(again).core.shape == _inside(C).core.shape
    x = RNG.uniform(0.0, 1.0, C.shape[0])
    np.testing.assert_array_equal(again.systems[0] @ x, C.systems[0] @ x)
    assert again.nbytes == C.nbytes


def test_inverses_have_the_same_choice(corner):
    T, C = corner
    inverse = ltcl.invert(C, 0.12)
    assert isinstance(inverse.A, Compressed)
    assert inverse.A.core.shape == _inside(C).core.shape
    b = RNG.uniform(0.0, 1.0, T.shape[0])
    exact = _exact(T, b)
    assert np.linalg.norm(inverse.solve(b).x - exact) <= inverse.error * np.linalg.norm(exact)
    assert inverse.error <= 0.12
