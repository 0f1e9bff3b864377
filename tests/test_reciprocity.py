# SPDX-License-Identifier: BSD-3-Clause
"""The reciprocity defect: nothing of a diffuse scene, the noise of a noisy one, much of a glossy one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.sparse.linalg import aslinearoperator

from ltcl import reciprocity
from tests.problems import lambertian

FORMS = pytest.mark.parametrize("form", [np.asarray, scipy.sparse.csr_array])


def gain(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.3, 3.0, n)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.05, 10.0), st.floats(0.05, 1.0), st.integers(1, 40))
@example(seed=1712, rho=2.0, density=0.5, n=7)  # a pixel that hardly shares light with the others
def test_diffuse_scenes_are_reciprocal_whatever_gains_the_pixels_have(seed, rho, density, n):
    """Albedo, area, first bounce, camera and projector pixels are all taken away by the fit."""
    scene = lambertian(n, rho, seed, density)
    T = gain(n, 1)[:, None] * scene.T * gain(n, 2)
    for matrix in (T, scipy.sparse.csr_array(T)):
        assert reciprocity.defect(matrix, np.diag(T)) < 1e-5


@FORMS
@pytest.mark.parametrize("noise", [0.01, 0.1])
def test_independent_noise_shows_at_its_size(form, noise):
    scene = lambertian(150, 0.8)
    T = scene.T * (1 + noise * np.random.default_rng(0).normal(size=(150, 150)))
    assert reciprocity.defect(form(T), scene.F) == pytest.approx(noise, rel=0.1)


@FORMS
def test_light_that_goes_one_way_only_has_defect_one(form):
    T = np.eye(20) + np.triu(np.random.default_rng(0).random((20, 20)), 1)
    assert reciprocity.defect(form(T), np.ones(20)) == pytest.approx(1.0)


@FORMS
def test_no_indirect_light_is_reciprocal(form):
    assert reciprocity.defect(form(np.diag(gain(9))), np.ones(9)) == 0.0


@FORMS
def test_dense_and_sparse_agree_and_a_sample_is_like_the_whole(form):
    rng = np.random.default_rng(5)
    T = lambertian(300, 0.8).T * rng.uniform(0.5, 1.5, (300, 300))
    whole = reciprocity.defect(T, np.diag(T))
    assert reciprocity.defect(form(T), np.diag(T)) == pytest.approx(whole, rel=1e-4)
    assert reciprocity.defect(form(T), np.diag(T), entries=100**2) == pytest.approx(whole, rel=0.1)


@FORMS
def test_masked_pixels_and_negative_entries_are_no_obstacle(form):
    scene = lambertian(60, 0.8)
    T, F = scene.T, scene.F.copy()
    T[:, 7], F[7] = 5.0, 0.0
    T[3, 4] = T[4, 3] = -1e-3
    assert reciprocity.defect(form(T), F) < 0.05


def test_hidden_entries_are_unknown():
    assert np.isnan(reciprocity.defect(aslinearoperator(np.eye(4)), np.ones(4)))


def test_a_path_traced_diffuse_corner_is_reciprocal_up_to_its_noise(shared_data: Path):
    with np.load(shared_data / "transport-dihedral" / "transport.npz") as file:
        T = file["T"]
    assert 0.01 < reciprocity.defect(T, np.diag(T)) < 0.1
