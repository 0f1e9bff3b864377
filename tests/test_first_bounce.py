# SPDX-License-Identifier: BSD-3-Clause
"""F from T, in closed form where nothing sees itself; what it leaves of T; pixels that it leaves dark."""

from __future__ import annotations

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
    for F in (scenes[0].F, [scene.F for scene in scenes]):
        T = ltcl.Transport([scene.T for scene in scenes], GRID, first_bounce=F)
        np.testing.assert_array_equal(T.first_bounce, np.broadcast_to(F, (3, N)))


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
THREE = r"3 of 24 pixels.*: \(0, 2\), \(1, 3\), \(3, 5\)"
AROUND_0 = np.random.default_rng(5).normal(size=(N, N))  # eigenvalues
np.fill_diagonal(AROUND_0, 1.0)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("matrix", "options", "words"),
    [
        *[(darkened(lambertian(N, 0.8), how), {}, THREE) for how in HOW],
        ([lambertian(N, 0.5).T, darkened(lambertian(N, 0.5), "row"), np.eye(N)], {}, THREE),
        (np.zeros((N, N)), {"on_dark": "mask"}, "zero or negative at every pixel"),
        (
            aslinearoperator(np.eye(N)),
            {"first_bounce": np.arange(N), "on_dark": "mask"},
            "first_bounce .*LinearOperator",
        ),
        *[
            (np.ones((N, N)) + defect * np.eye(N), {"first_bounce": "exact"}, "first_bounce is 'exact'")
            for defect in (0.0, 1e-17, 1e-16)
        ],
        (AROUND_0, {"first_bounce": "estimate"}, "first_bounce is 'estimate'"),
    ],
)
def test_refusals(matrix, options, words):
    with pytest.raises(InputError, match=words) as caught:
        ltcl.Transport(matrix, GRID, **options)
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


# An estimate: inside its error, which falls as theory says.

MANY, WIDE = 200, (10, 20)


def estimated(device, scene, form=np.asarray, how="estimate", **options) -> tuple[np.ndarray, np.ndarray]:
    """F and its standard error."""
    T = ltcl.Transport(form(scene.T), WIDE, how, device=device, **options)
    assert T.first_bounce_error is not None
    return T.first_bounce, T.first_bounce_error


@pytest.mark.parametrize("form", [np.asarray, np.float32, scipy.sparse.csr_array])
@pytest.mark.parametrize("rho", [0.1, 0.9, 5.0])
def test_the_estimate_is_within_four_standard_errors(device, form, rho):
    """And scatters as they say: 1 +- 0.2 of 200 pixels, which share their probes, is not too much."""
    scene = lambertian(MANY, rho)
    F, error = estimated(device, scene, form)
    deviations = (F - scene.F) / error
    assert np.abs(deviations).max() <= 4.0
    assert np.sqrt(np.mean(deviations**2)) == pytest.approx(1.0, abs=0.2)


def test_the_error_is_that_of_the_rest_of_the_row(device):
    """Bekas et al.: the variance of one probe is the sum of squares beside the diagonal."""
    scene = lambertian(MANY, 0.9)
    inverse = np.linalg.inv(scene.T / np.diag(scene.T))
    rest = np.sqrt((inverse**2).sum(axis=1) - np.diag(inverse) ** 2)
    _, error = estimated(device, scene, probes=400)
    np.testing.assert_allclose(error, scene.F * rest / np.diag(inverse) / np.sqrt(400), rtol=0.2)


def test_colour_and_masked_pixels(device):
    matrices = [lambertian(MANY, rho).T * (np.arange(MANY) != 5) for rho in (0.3, 0.9, 2.0)]
    T, exact = (
        ltcl.Transport(matrices, WIDE, how, device=device, on_dark="mask") for how in ("estimate", "exact")
    )
    np.testing.assert_array_equal(np.flatnonzero(T.masked), [5])
    deviations = np.abs(T.first_bounce - exact.first_bounce)[:, ~T.masked]
    assert T.first_bounce_error is not None
    assert np.all(deviations <= 4.5 * T.first_bounce_error[:, ~T.masked])


@pytest.mark.parametrize("known", [True, False])
def test_exact_becomes_an_estimate_where_a_dense_inverse_does_not_fit(device, monkeypatch, caplog, known):
    """As the host says before, or SciPy of a limit that nobody knew."""

    def inv(*_: object, **__: object) -> None:
        raise RuntimeError("Memory error in scipy.linalg.inv.")

    if known:
        monkeypatch.setattr(checks, "host_memory", lambda: 3 * 8 * MANY * MANY - 1)
    else:
        monkeypatch.setattr("scipy.linalg.inv", inv)
    scene = lambertian(MANY, 0.9)
    F, error = estimated(device, scene, how="exact")
    assert "too large for a dense inverse" in caplog.text
    assert np.abs((F - scene.F) / error).max() <= 4.0
