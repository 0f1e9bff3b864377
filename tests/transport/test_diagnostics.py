# SPDX-License-Identifier: BSD-3-Clause
"""Reciprocity, negative bounces, energy: against matrices in float64 and known scenes."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import scipy.sparse
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.sparse.linalg import aslinearoperator

import ltcl
from ltcl.scenes import box, glossy
from ltcl.transport import diagnostics
from tests.problems import enclosure, lambertian

FORMS = pytest.mark.parametrize("form", [np.asarray, scipy.sparse.csr_array])


def check(device, T, F, form=np.asarray):
    transport = ltcl.Transport(form(T), (1, len(F)), first_bounce=F, device=device)
    return diagnostics.check_energy(transport.matrices[0], F, transport.systems[0])


@pytest.mark.slow
@pytest.mark.parametrize("form", [np.asarray, scipy.sparse.csr_array, aslinearoperator])
@pytest.mark.parametrize("rho", [0.2, 0.9, 4.0])
def test_row_sums_are_those_of_A(device, form, rho):
    scene = lambertian(50, rho)
    energy = check(device, scene.T, scene.F, form)
    sums = scene.A.sum(axis=1)
    column = scene.R.sum(axis=0).max()
    extremes = (energy.bounce_lowest, energy.bounce_highest)
    assert extremes == pytest.approx((sums.min(), sums.max()), abs=2e-3 * (1 + rho))
    from_entries = [energy.albedo_from_columns, energy.negative_entries, energy.negative_light]
    if form is aslinearoperator:
        # Entries are hidden.
        defect = diagnostics.reciprocity_defect(form(scene.T), scene.F)
        assert np.isnan([*from_entries, defect]).all()
    else:
        assert from_entries == pytest.approx([column / (1 + column), 0.0, 0.0], rel=1e-5)


def test_a_surface_that_returns_more_than_it_gets_is_found(device):
    room = enclosure(40, 0.6)
    gains = np.where(np.arange(40) == 3, 2.0, 1.0)
    scene = dataclasses.replace(room, A=gains[:, None] * room.A)  # albedo 1.2
    found = check(device, scene.T, scene.F)
    assert found.bounce_highest == pytest.approx(1.2, abs=0.01)
    assert not found.conserved


@FORMS
def test_negative_entries_are_counted_and_weighed(device, form):
    T = np.eye(10)
    T[0, 1] = -0.5
    T[2, 3] = -1.5
    T[4, 5] = 2.0
    found = check(device, T, np.ones(10), form)
    assert (found.negative_entries, found.negative_light) == pytest.approx((0.02, 2.0 / 14.0))


def test_where_the_solve_fails_nothing_is_claimed(device):
    found = check(device, [[1.0, -1.0], [-1.0, 1.0]], np.ones(2))  # singular
    assert math.isnan(found.bounce_highest)
    assert not found.conserved


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
        assert diagnostics.reciprocity_defect(matrix, np.diag(T)) < 1e-5


NOISE = np.random.default_rng(0).normal(size=(300, 300))
DIFFUSE = lambertian(300, 0.8).T
ONE_WAY = np.eye(20) + np.triu(np.abs(NOISE[:20, :20]), 1)


@FORMS
@pytest.mark.parametrize(
    ("T", "defect", "tolerance"),
    [
        (DIFFUSE * (1 + 0.01 * NOISE), 0.01, 0.1),
        (DIFFUSE * (1 + 0.1 * NOISE), 0.1, 0.1),
        (ONE_WAY, 1.0, 1e-6),
        (np.diag(gain(9)), 0.0, 0.0),  # no light
    ],
    ids=["noise of 1 %", "noise of 10 %", "one way", "none"],
)
def test_what_is_not_reciprocal_shows_at_its_size(form, T, defect, tolerance):
    assert diagnostics.reciprocity_defect(form(T), np.diag(T)) == pytest.approx(
        defect, rel=tolerance
    )


def test_noise_is_no_defect() -> None:
    """Noise of known variance is subtracted; light that goes one way is left."""

    def defect(T: np.ndarray, deviation: np.ndarray) -> float:
        return diagnostics.reciprocity_defect(
            T + deviation * NOISE, np.diag(DIFFUSE), variance=lambda i, j, _: deviation[i, j] ** 2
        )

    assert defect(DIFFUSE, 0.5 * DIFFUSE) < 0.15
    glossy = DIFFUSE * np.exp(0.3 * np.random.default_rng(1).normal(size=DIFFUSE.shape))
    expected = diagnostics.reciprocity_defect(glossy, np.diag(DIFFUSE))
    assert expected > 0.2
    assert defect(glossy, 0.1 * DIFFUSE) == pytest.approx(expected, rel=0.1)


@FORMS
def test_a_sample_is_like_the_whole(form):
    T = DIFFUSE * (1 + 0.3 * NOISE)
    whole = diagnostics.reciprocity_defect(form(T), np.diag(T))
    some = diagnostics.reciprocity_defect(form(T), np.diag(T), entries=100**2)
    assert some == pytest.approx(whole, rel=0.1)
    assert some != whole


@FORMS
def test_masked_pixels_and_negative_entries_are_no_obstacle(form):
    scene = lambertian(60, 0.8)
    T = scene.T
    F = scene.F * (np.arange(60) != 7)
    T[:, 7] = 5.0
    T[3, 4] = T[4, 3] = -1e-3
    assert diagnostics.reciprocity_defect(form(T), F) < 0.05


@pytest.mark.parametrize("first_bounce", ["diagonal", "exact"])
@pytest.mark.parametrize(("sides", "albedo"), [(2, 0.9), (3, 0.7), (6, 0.45), (6, 0.8)])
def test_diffuse_boxes_take_nothing(device, sides, albedo, first_bounce):
    T = box(6, sides, albedo).transport(first_bounce=first_bounce, device=device)
    assert max(T.negative_bounces) < 1e-3


def test_negative_light_is_that_of_the_dense_inverse(device):
    """Light between 16 rectangles of an 8 x 8 picture, of a matrix that takes light away."""
    random = np.random.default_rng(3)
    matrix = np.eye(64) + 0.02 * random.normal(size=(64, 64))
    T = ltcl.Transport(matrix, (8, 8), first_bounce=np.ones(64), device=device)
    A = np.eye(64) - np.linalg.inv(matrix)
    parts = A.reshape(4, 2, 4, 2, 4, 2, 4, 2).sum(axis=(1, 3, 5, 7)).reshape(16, 16)
    np.fill_diagonal(parts, 0.0)
    expected = -parts[parts < 0].sum() / np.abs(parts).sum()
    assert T.negative_bounces[0] == pytest.approx(expected, rel=2e-2)


@pytest.mark.slow
def test_gloss_takes_more_the_more_there_is(device, caplog):
    shares = []
    projector = (2.0, 1.4, 1.2)
    camera = (1.5, 1.2, 1.9)
    for gloss in (0.1, 0.3, 0.8):
        scene = glossy(
            box(1, sides=3), 6, gloss=gloss, directions=16, projector=projector, camera=camera
        )
        T = scene.transport(device=device)
        b = ltcl.separate(T, T @ np.ones(T.grid), bounces=1)
        assert "section 8.4" in b.warning
        assert "section 8.4" in caplog.text
        shares.append(b.negative_bounce)
    assert shares == sorted(shares)
