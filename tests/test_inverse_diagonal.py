# SPDX-License-Identifier: BSD-3-Clause
"""The estimated first bounce against the dense one: inside its error, which falls as theory says."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl import checks
from ltcl.errors import InputError
from tests.problems import lambertian

N, GRID = 200, (10, 20)


def estimated(device, scene, form=np.asarray, **options):
    return ltcl.Transport(form(scene.T), GRID, "estimate", device=device, **options)


def error_of(T: ltcl.Transport) -> np.ndarray:
    assert T.first_bounce_error is not None
    return T.first_bounce_error


@pytest.mark.parametrize("form", [np.asarray, np.float32, scipy.sparse.csr_array])
@pytest.mark.parametrize("rho", [0.1, 0.9, 5.0])
def test_the_estimate_is_within_four_standard_errors(device, form, rho):
    """And scatters as they say: 1 +- 0.2 of 200 pixels, which share their probes, is not too much."""
    scene = lambertian(N, rho)
    T = estimated(device, scene, form)
    off = (T.first_bounce - scene.F) / error_of(T)
    assert np.abs(off).max() <= 4.0
    assert np.sqrt(np.mean(off**2)) == pytest.approx(1.0, abs=0.2)


def test_the_error_falls_as_one_over_the_root_of_the_probes(device):
    scene = lambertian(N, 0.9)
    few, many = (estimated(device, scene, probes=k) for k in (20, 500))
    ratio = np.linalg.norm(error_of(few)) / np.linalg.norm(error_of(many))
    assert ratio == pytest.approx(5.0, rel=0.1)
    errors = [np.sqrt(np.mean((T.first_bounce - scene.F) ** 2)) for T in (few, many)]
    assert errors[0] / errors[1] == pytest.approx(5.0, rel=0.3)


def test_the_error_is_that_of_the_rest_of_the_row(device):
    """Bekas et al.: the variance of one probe is the sum of squares beside the diagonal."""
    scene = lambertian(N, 0.9)
    inverse = np.linalg.inv(scene.T / np.diag(scene.T))
    rest = np.sqrt((inverse**2).sum(axis=1) - np.diag(inverse) ** 2)
    wanted = scene.F * rest / np.diag(inverse) / np.sqrt(400)
    np.testing.assert_allclose(error_of(estimated(device, scene, probes=400)), wanted, rtol=0.2)


def test_it_is_better_than_the_diagonal(device):
    scene = lambertian(N, 5.0)
    T = estimated(device, scene, probes=256)
    biased = np.linalg.norm(np.diag(scene.T) - scene.F)
    assert np.linalg.norm(T.first_bounce - scene.F) < 0.25 * biased


def test_a_seed_gives_the_same_again(device):
    scene = lambertian(N, 0.9)
    first, again, other = (estimated(device, scene, seed=seed).first_bounce for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)


def test_colour_and_masked_pixels(device):
    scenes = [lambertian(N, rho) for rho in (0.3, 0.9, 2.0)]
    matrices = [scene.T for scene in scenes]
    for matrix in matrices:
        matrix[:, 5] = 0.0
    T = ltcl.Transport(matrices, GRID, "estimate", device=device, on_dark="mask")
    assert T.first_bounce.shape == error_of(T).shape == (3, N)
    np.testing.assert_array_equal(np.flatnonzero(T.masked), [5])
    exact = ltcl.Transport(matrices, GRID, "exact", device=device, on_dark="mask")
    lit = ~T.masked
    assert np.all(np.abs(T.first_bounce - exact.first_bounce)[:, lit] <= 4.5 * error_of(T)[:, lit])


def test_exact_becomes_an_estimate_where_a_dense_inverse_does_not_fit(device, monkeypatch, caplog):
    scene = lambertian(N, 0.9)
    needed = 3 * 8 * N * N
    monkeypatch.setattr(checks, "host_memory", lambda: needed - 1)
    with caplog.at_level(logging.WARNING):
        T = ltcl.Transport(scene.T, GRID, "exact", device=device)
    assert "too large for a dense inverse" in caplog.text
    assert np.abs((T.first_bounce - scene.F) / error_of(T)).max() <= 4.0


def test_others_have_no_error():
    for how in ("diagonal", "exact"):
        assert ltcl.Transport(np.eye(N), GRID, how).first_bounce_error is None


def test_what_the_iteration_cannot_invert_is_refused(device):
    T = np.eye(N)
    T[:2, :2] = [[1.0, 30.0], [-30.0, 1.0]]  # eigenvalues 1 +- 30i
    with pytest.raises(InputError, match="first_bounce is 'estimate', whose solves ended"):
        ltcl.Transport(T, GRID, "estimate", device=device)


@pytest.mark.parametrize("options", [{"probes": 1}, {"probes": 2.5}, {"seed": -1}])
def test_bad_options_are_refused(options):
    with pytest.raises(InputError, match="must be a whole number of at least"):
        ltcl.Transport(np.eye(N), GRID, "estimate", **options)
