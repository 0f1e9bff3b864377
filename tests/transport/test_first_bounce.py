# SPDX-License-Identifier: BSD-3-Clause
"""The first bounce F: closed form, S F against T, dark pixels, and estimates."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st

import ltcl
from ltcl import checks
from ltcl.operators import CSR
from tests.problems import lambertian

GRID = (4, 6)
N = 24
random = np.random.default_rng(30)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.01, 20.0), st.floats(0.1, 1.0))
def test_exact_is_exact_where_nothing_sees_itself(seed, rho, density):
    """(T^-1)_ii = (1 - A_ii) / F_i with A_ii = 0; diag(T) holds returned light and so is larger."""
    scene = lambertian(N, rho, seed, density)
    for matrix in (scene.T, scipy.sparse.csr_array(scene.T)):
        exact = ltcl.Transport(matrix, GRID, first_bounce="exact").first_bounce
        diagonal = ltcl.Transport(matrix, GRID, first_bounce="diagonal").first_bounce
        np.testing.assert_allclose(exact, scene.F, rtol=1e-9 * (1 + rho))
        np.testing.assert_array_equal(diagonal, np.diag(scene.T))
        assert np.all(diagonal >= exact * (1 - 1e-9 * (1 + rho)))


# R = T F^-1 - I.


@pytest.mark.parametrize("form", [np.asarray, np.float32, scipy.sparse.csr_array])
@pytest.mark.parametrize("first_bounce", ["diagonal", "exact"])
@pytest.mark.parametrize("gain", [1.0, 49.0, 0.1])
def test_S_F_is_T(device, form, first_bounce, gain):
    """R is rounded once: x * (1 / x) is not always 1, and 1e-16 must not remain as a diagonal."""
    matrix = lambertian(N, 0.9).T * gain
    T = ltcl.Transport(form(matrix), GRID, first_bounce, device=device)
    (S,) = T.systems
    assert np.all(np.abs(S.to_dense() * T.first_bounce - matrix) <= 2.0**-22 * matrix)
    if first_bounce == "diagonal":
        assert not S.R.diagonal().any()
        assert not isinstance(S.R, CSR) or S.R.nnz == N * (N - 1)


# Dark pixels.

DARK = np.isin(np.arange(N), [2, 9, 23])
LIT = {"column": ~DARK, "row": ~DARK[:, None], "column and row": ~DARK & ~DARK[:, None]}


@pytest.mark.parametrize("form", [np.asarray, scipy.sparse.csr_array])
@pytest.mark.parametrize("first_bounce", ["diagonal", "exact"])
@pytest.mark.parametrize("how", LIT)
def test_masked_pixels_stay_unlit_and_the_others_are_right(device, how, first_bounce, form):
    T64 = lambertian(N, 0.8).T * LIT[how]
    T = ltcl.Transport(form(T64), GRID, first_bounce, device=device, on_dark="mask")
    np.testing.assert_array_equal(T.masked, DARK)
    assert not T.first_bounce[DARK].any()

    p = random.uniform(0.1, 0.9, N) * ~DARK
    np.testing.assert_allclose((T @ p.reshape(GRID)).ravel(), T64 @ p, rtol=1e-6)
    desired = T64 @ p
    # The picture at dark pixels cannot matter.
    desired[DARK] = 0.5
    c = ltcl.compensate(T, desired.reshape(GRID), rtol=1e-5)
    np.testing.assert_allclose(c.pattern.ravel(), p, rtol=0, atol=1e-3)
    assert not c.pattern.ravel()[DARK].any()
    assert c.clipped == 0.0
    np.testing.assert_allclose(c.appearance.ravel(), T64 @ p, rtol=1e-3)


# An estimate: inside its error, which falls as theory says.

MANY = 200
WIDE = (10, 20)


def estimated(
    device, scene, form=np.asarray, how="estimate", **options
) -> tuple[np.ndarray, np.ndarray]:
    """F and its standard error."""
    T = ltcl.Transport(form(scene.T), WIDE, how, device=device, **options)
    assert T.first_bounce_error is not None
    return T.first_bounce, T.first_bounce_error


@pytest.mark.parametrize("form", [np.asarray, np.float32, scipy.sparse.csr_array])
@pytest.mark.parametrize(("rho", "options"), [(0.1, {}), (0.9, {"probes": 400}), (5.0, {})])
def test_the_estimate_is_within_four_standard_errors(device, form, rho, options):
    """Deviations scatter by one standard error, +- 0.2 for 200 pixels that share their probes."""
    scene = lambertian(MANY, rho)
    F, error = estimated(device, scene, form, **options)
    deviations = (F - scene.F) / error
    assert np.abs(deviations).max() <= 4.0
    assert np.sqrt(np.mean(deviations**2)) == pytest.approx(1.0, abs=0.2)


@pytest.mark.slow
def test_a_pixel_dark_in_one_channel_is_masked_in_all(device):
    scenes = [lambertian(MANY, rho) for rho in (0.3, 0.9, 2.0)]
    matrices = [scene.T for scene in scenes]
    matrices[1][:, 5] = 0.0
    T = ltcl.Transport(matrices, WIDE, "estimate", device=device, on_dark="mask")
    exact = ltcl.Transport(matrices, WIDE, "exact", device=device, on_dark="mask")
    np.testing.assert_array_equal(np.flatnonzero(T.masked), [5])
    assert not T.first_bounce[:, 5].any()
    for c in (0, 2):
        np.testing.assert_allclose(exact.first_bounce[c, 6:], scenes[c].F[6:], rtol=1e-6)
    deviations = np.abs(T.first_bounce - exact.first_bounce)[:, ~T.masked]
    assert T.first_bounce_error is not None
    assert np.all(deviations <= 4.5 * T.first_bounce_error[:, ~T.masked])
    c = ltcl.compensate(T, np.full(WIDE, 0.1), bounds=(0.2, 1.0), throw=False)
    dim = c.pattern.reshape(MANY, 3)
    assert not dim[5].any()
    assert dim[~T.masked].min() >= np.float32(0.2)


@pytest.mark.parametrize("known", [True, False])
def test_exact_becomes_an_estimate_where_a_dense_inverse_does_not_fit(
    device, monkeypatch, caplog, known
):
    """The host tells its memory before, or SciPy fails at a limit that was not known."""

    def inv(*_: object, **__: object) -> None:
        raise RuntimeError("Memory error in scipy.linalg.inv.")

    if known:
        monkeypatch.setattr(checks, "host_memory", lambda: 3 * 8 * MANY * MANY - 1)
    else:
        monkeypatch.setattr("scipy.linalg.inv", inv)
    scene = lambertian(MANY, 0.9)
    F, error = estimated(device, scene, how="exact")
    assert "dense inverse" in caplog.text
    assert np.abs((F - scene.F) / error).max() <= 4.0
