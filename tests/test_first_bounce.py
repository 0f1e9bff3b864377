# SPDX-License-Identifier: BSD-3-Clause
"""F from T, in closed form where nothing sees itself; what it leaves of T; pixels that it leaves dark."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.linalg import aslinearoperator

import ltcl
from ltcl import checks
from ltcl.errors import InputError
from ltcl.operators import CSR
from tests.problems import Scene, lambertian

GRID = (4, 6)
N = 24
random = np.random.default_rng(30)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.01, 20.0), st.floats(0.1, 1.0))
def test_exact_is_exact_where_nothing_sees_itself(seed, rho, density):
    """(T^-1)_ii = (1 - A_ii) / F_i with A_ii = 0; diag(T) holds returned light and so is larger."""
    scene = lambertian(N, rho, seed, density)
    for matrix in (scene.T, scipy.sparse.csr_array(scene.T)):
        exact, diagonal = (
            ltcl.Transport(matrix, GRID, first_bounce=how).first_bounce for how in ("exact", "diagonal")
        )
        np.testing.assert_allclose(exact, scene.F, rtol=1e-9 * (1 + rho))
        np.testing.assert_array_equal(diagonal, np.diag(scene.T))
        assert np.all(diagonal >= exact * (1 - 1e-9 * (1 + rho)))


def test_colour_has_one_F_a_channel():
    scenes = [lambertian(N, rho) for rho in (0.5, 1.0, 2.0)]
    T = ltcl.Transport([scene.T for scene in scenes], GRID, first_bounce="exact")
    np.testing.assert_allclose(T.first_bounce, [scene.F for scene in scenes], rtol=1e-9)
    for given_F in (scenes[0].F, [scene.F for scene in scenes]):
        T = ltcl.Transport([scene.T for scene in scenes], GRID, first_bounce=given_F)
        np.testing.assert_array_equal(T.first_bounce, np.broadcast_to(given_F, (3, N)))


# What F leaves of T: R = T F^-1 - I.


@pytest.mark.parametrize("form", [np.asarray, np.float32, scipy.sparse.csr_array])
@pytest.mark.parametrize("first_bounce", ["diagonal", "exact"])
def test_S_F_is_T(device, form, first_bounce):
    """R is rounded once: no junk on the diagonal, none beside it."""
    scene = lambertian(N, 0.9)
    T = ltcl.Transport(form(scene.T), GRID, first_bounce, device=device)
    (S,) = T.systems
    assert np.all(np.abs(S.to_dense() * T.first_bounce - scene.T) <= 2.0**-22 * scene.T)
    if first_bounce == "diagonal":
        assert not S.R.diagonal().any()


@pytest.mark.parametrize("gain", [1.0, 49.0, 0.1])
def test_a_sparse_R_stores_nothing_where_F_took_all(device, gain):
    """x * (1 / x) is not always 1; junk of 1e-16 must not keep a diagonal alive."""
    T = ltcl.Transport(scipy.sparse.csr_array(lambertian(N, 0.9).T * gain), GRID, device=device)
    (S,) = T.systems
    assert isinstance(S.R, CSR)
    assert S.R.nnz == N * (N - 1)


# Dark pixels.

DARK = [2, 9, 23]
LIT = np.setdiff1d(np.arange(N), DARK)


def darkened(scene: Scene, how: str) -> np.ndarray:
    """T whose projector pixels DARK light nothing, whose camera pixels DARK see nothing, or both."""
    T = scene.T
    if "column" in how:
        T[:, DARK] = 0.0
    if "row" in how:
        T[DARK] = 0.0
    if "negative" in how:
        T[DARK, DARK] = -1e-3
    return T


HOW = ["column", "row", "column and row", "negative"]


@pytest.mark.parametrize("how", HOW)
def test_dark_pixels_are_refused_with_a_list(how):
    T = darkened(lambertian(N, 0.8), how)
    says = (
        r"first_bounce is zero or negative at 3 of 24 pixels \(row, column\): \(0, 2\), \(1, 3\), \(3, 5\); "
        "it must be positive; give on_dark='mask' to leave these pixels unlit"
    )
    with pytest.raises(InputError, match=says) as caught:
        ltcl.Transport(T, GRID)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("form", [np.asarray, scipy.sparse.csr_array])
@pytest.mark.parametrize("first_bounce", ["diagonal", "exact"])
@pytest.mark.parametrize("how", HOW[:3])
def test_masked_pixels_stay_unlit_and_the_others_are_right(device, how, first_bounce, form):
    T64 = darkened(lambertian(N, 0.8), how)
    T = ltcl.Transport(form(T64), GRID, first_bounce, device=device, on_dark="mask")
    np.testing.assert_array_equal(np.flatnonzero(T.masked), DARK)
    assert not T.first_bounce[DARK].any()

    p = random.uniform(0.1, 0.9, N)
    p[DARK] = 0.0
    np.testing.assert_allclose((T @ p.reshape(GRID)).ravel(), T64 @ p, rtol=1e-6)
    desired = T64 @ p
    desired[DARK] = 0.5  # what is wanted there cannot matter
    c = ltcl.compensate(T, desired.reshape(GRID), rtol=1e-5)
    np.testing.assert_allclose(c.pattern.ravel(), p, rtol=0, atol=1e-3)
    assert not c.pattern.ravel()[DARK].any()
    assert c.clipped == 0.0
    np.testing.assert_allclose(c.appearance.ravel()[LIT], desired[LIT], rtol=1e-3)


def test_a_pixel_dark_in_one_channel_is_masked_in_all(device):
    matrices = [lambertian(N, 0.5).T, darkened(lambertian(N, 0.5), "column"), lambertian(N, 0.5).T]
    T = ltcl.Transport(matrices, GRID, device=device, on_dark="mask")
    np.testing.assert_array_equal(np.flatnonzero(T.masked), DARK)
    assert not T.first_bounce[:, DARK].any()
    dim = ltcl.compensate(T, np.full(GRID, 0.1), bounds=(0.2, 1.0)).pattern.reshape(N, 3)
    assert not dim[DARK].any()
    assert dim[LIT].min() >= np.float32(0.2)
    with pytest.raises(InputError, match=r"at 3 of 24 pixels \(row, column\): \(0, 2\), \(1, 3\), \(3, 5\)"):
        ltcl.Transport(matrices, GRID)


@pytest.mark.parametrize(
    ("matrix", "F", "says"),
    [
        (np.zeros((N, N)), "diagonal", "zero or negative at every pixel; it must be positive"),
        (aslinearoperator(np.eye(N)), np.arange(N), "a LinearOperator cannot be masked here"),
    ],
)
def test_what_cannot_be_masked_is_refused(matrix, F, says):
    with pytest.raises(InputError, match=says):
        ltcl.Transport(matrix, GRID, first_bounce=F, on_dark="mask")


# An estimate: inside its error, which falls as theory says.

MANY, WIDE = 200, (10, 20)


def estimated(device, scene, form=np.asarray, **options):
    return ltcl.Transport(form(scene.T), WIDE, "estimate", device=device, **options)


def error_of(T: ltcl.Transport) -> np.ndarray:
    assert T.first_bounce_error is not None
    return T.first_bounce_error


@pytest.mark.parametrize("form", [np.asarray, np.float32, scipy.sparse.csr_array])
@pytest.mark.parametrize("rho", [0.1, 0.9, 5.0])
def test_the_estimate_is_within_four_standard_errors(device, form, rho):
    """And scatters as they say: 1 +- 0.2 of 200 pixels, which share their probes, is not too much."""
    scene = lambertian(MANY, rho)
    T = estimated(device, scene, form)
    off = (T.first_bounce - scene.F) / error_of(T)
    assert np.abs(off).max() <= 4.0
    assert np.sqrt(np.mean(off**2)) == pytest.approx(1.0, abs=0.2)


def test_the_error_is_that_of_the_rest_of_the_row(device):
    """Bekas et al.: the variance of one probe is the sum of squares beside the diagonal."""
    scene = lambertian(MANY, 0.9)
    inverse = np.linalg.inv(scene.T / np.diag(scene.T))
    rest = np.sqrt((inverse**2).sum(axis=1) - np.diag(inverse) ** 2)
    wanted = scene.F * rest / np.diag(inverse) / np.sqrt(400)
    np.testing.assert_allclose(error_of(estimated(device, scene, probes=400)), wanted, rtol=0.2)


def test_a_seed_gives_the_same_again(device):
    scene = lambertian(MANY, 0.9)
    first, again, other = (estimated(device, scene, seed=seed).first_bounce for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)


def test_colour_and_masked_pixels(device):
    scenes = [lambertian(MANY, rho) for rho in (0.3, 0.9, 2.0)]
    matrices = [scene.T for scene in scenes]
    for matrix in matrices:
        matrix[:, 5] = 0.0
    T = ltcl.Transport(matrices, WIDE, "estimate", device=device, on_dark="mask")
    assert T.first_bounce.shape == error_of(T).shape == (3, MANY)
    np.testing.assert_array_equal(np.flatnonzero(T.masked), [5])
    exact = ltcl.Transport(matrices, WIDE, "exact", device=device, on_dark="mask")
    lit = ~T.masked
    assert np.all(np.abs(T.first_bounce - exact.first_bounce)[:, lit] <= 4.5 * error_of(T)[:, lit])


def test_exact_becomes_an_estimate_where_a_dense_inverse_does_not_fit(device, monkeypatch, caplog):
    scene = lambertian(MANY, 0.9)
    needed = 3 * 8 * MANY * MANY
    monkeypatch.setattr(checks, "host_memory", lambda: needed - 1)
    with caplog.at_level(logging.WARNING):
        T = ltcl.Transport(scene.T, WIDE, "exact", device=device)
    assert "too large for a dense inverse" in caplog.text
    assert np.abs((T.first_bounce - scene.F) / error_of(T)).max() <= 4.0


def test_what_the_iteration_cannot_invert_is_refused(device):
    T = np.random.default_rng(5).normal(size=(MANY, MANY))  # eigenvalues all around 0
    np.fill_diagonal(T, 1.0)
    with pytest.raises(InputError, match="first_bounce is 'estimate'"):
        ltcl.Transport(T, WIDE, "estimate", device=device)


@pytest.mark.parametrize("options", [{"probes": 1}, {"probes": 2.5}, {"seed": -1}])
def test_bad_options_are_refused(options):
    with pytest.raises(InputError, match="must be a whole number of at least"):
        ltcl.Transport(np.eye(MANY), WIDE, "estimate", **options)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("defect", [0.0, 1e-17, 1e-16])
def test_a_nearly_singular_T_has_no_exact_first_bounce(defect):
    T = np.ones((MANY, MANY)) + defect * np.eye(MANY)
    with pytest.raises(InputError, match="first_bounce is 'exact'"):
        ltcl.Transport(T, WIDE, "exact")
