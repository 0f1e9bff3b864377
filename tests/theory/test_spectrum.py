# SPDX-License-Identifier: BSD-3-Clause
"""The spectrum of R and bounds on that of S against eigenvalues in float64."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st

from ltcl import theory
from ltcl.operators import CSR, Dense, IdentityPlus, as_operator
from tests.problems import enclosure, lambertian

random = np.random.default_rng(40)


@pytest.mark.parametrize("albedo", [0.1, 0.45, 0.5, 0.62, 0.9])
def test_a_closed_room_has_the_radius_of_eq_14(device, albedo):
    """rho(R) = ||R||_inf = m / (1 - m) where every row of form factors sums to one."""
    R = Dense(device, enclosure(40, albedo).R)
    rho = theory.spectral_radius(R)
    assert rho.value == pytest.approx(albedo / (1 - albedo), rel=1e-3)
    assert rho.albedo == pytest.approx(albedo, rel=1e-3)
    assert R.norms().inf == pytest.approx(albedo / (1 - albedo), rel=1e-5)
    assert rho.products < 20


@pytest.mark.parametrize("density", [1.0, 0.3, 0.1])
@pytest.mark.parametrize("rho", [0.01, 0.9, 30.0])
def test_the_radius_is_that_of_the_eigenvalues(device, rho, density):
    R = lambertian(50, rho, seed=41, density=density).R
    wanted = np.abs(np.linalg.eigvals(R)).max()
    found = theory.spectral_radius(as_operator(R, device), rtol=1e-3)
    assert found.value == pytest.approx(wanted, rel=5e-3)
    assert found.change < 1e-3


@pytest.mark.parametrize("R", [np.zeros((5, 5)), np.triu(np.ones((5, 5)), 1)], ids=["zero", "nilpotent"])
def test_light_that_never_returns_has_radius_zero(device, R):
    found = theory.spectral_radius(as_operator(R, device))
    assert (found.value, found.albedo) == (0.0, 0.0)
    assert found.products <= 6


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.01, 50.0), st.floats(0.05, 1.0), st.integers(2, 30))
def test_free_bounds_hold_the_spectrum_of_any_diffuse_scene(device, seed, rho, density, n):
    scene = lambertian(n, rho, seed, density)
    spectrum = np.linalg.eigvals(scene.S)
    assert np.abs(spectrum.imag).max() < 1e-6 * (1 + rho)  # self-adjoint in the area / albedo product
    lower, upper = theory.free_bounds(IdentityPlus(Dense(device, scene.R)))
    room = 1e-5 * (1 + rho)
    assert lower - room <= spectrum.real.min()
    assert spectrum.real.max() <= upper + room


@pytest.mark.parametrize("albedo", [0.3, 0.8])
def test_free_bounds_of_the_forward_dual(device, albedo):
    scene = enclosure(30, albedo)
    spectrum = np.linalg.eigvalsh(np.eye(30) - scene.A)
    lower, upper = theory.free_bounds(IdentityPlus(CSR(device, scipy.sparse.csr_array(scene.A)), sign=-1))
    assert lower <= spectrum[0] * (1 + 1e-5)
    assert spectrum[-1] <= upper


# What is certain of rho(R).


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.01, 50.0), st.floats(0.0, 1.0), st.integers(1, 30), st.booleans())
def test_collatz_and_wielandt_hold_rho_of_any_nonnegative_matrix(device, seed, scale, density, n, directed):
    """Reducible, nilpotent and periodic ones included; eigenvalues of those are good to eps^(1/n) only."""
    rng = np.random.default_rng(seed)
    R = (scale * rng.random((n, n)) * (rng.random((n, n)) < density)).astype(np.float32)
    R = np.tril(R) if directed else R
    wanted = (
        float(np.diagonal(R).max()) if directed else np.abs(np.linalg.eigvals(R.astype(np.float64))).max()
    )
    operator = Dense(device, R)
    found = theory.spectral_radius(operator, norms=operator.norms())
    assert found.certificate == "collatz-wielandt"
    room = 1e-12 * scale if directed else 2e-2 * scale * (wanted < 1e-2 * scale) + 1e-9 * scale
    assert found.lower <= wanted + room
    assert wanted <= found.upper + room
    assert found.lower <= found.value <= found.upper


@pytest.mark.parametrize("n", [1, 10, 300])
def test_the_bounds_close_on_rho_where_light_reaches_everywhere(device, n):
    scene = lambertian(n, 0.8) if n > 1 else None
    matrix = np.array([[0.8]]) if scene is None else scene.R
    for R in (Dense(device, matrix), CSR(device, scipy.sparse.csr_array(matrix))):
        found = theory.spectral_radius(R, norms=R.norms())
        assert found.lower <= 0.8 <= found.upper
        assert found.error < 0.01 * 0.8


def test_the_bounds_close_between_two_walls_too(device):
    """A of a dihedral has -rho beside rho; its mean growth is rho all the same."""
    A = np.zeros((20, 20))
    A[:10, 10:] = random.random((10, 10))
    A[10:, :10] = 0.1 * A[:10, 10:].T
    R, rho = Dense(device, A), np.abs(np.linalg.eigvals(A)).max()
    assert theory.spectral_radius(R).value == pytest.approx(rho, rel=1e-3)
    found = theory.spectral_radius(R, norms=R.norms())
    assert found.lower <= rho <= found.upper
    assert found.error < 0.01 * found.value


def test_pixels_that_get_no_light_do_not_loosen_the_lower_bound(device):
    R = lambertian(30, 0.8).R
    R[[3, 7]] = 0.0
    operator = Dense(device, R)
    wanted = np.abs(np.linalg.eigvals(R)).max()
    found = theory.spectral_radius(operator, norms=operator.norms())
    assert wanted * 0.98 < found.lower <= wanted <= found.upper < wanted * 1.02


@pytest.mark.parametrize("noise", [1e-3, 1e-2])
def test_a_signed_matrix_gets_an_estimate_and_says_so(device, noise):
    scene = lambertian(80, 0.8, density=0.3)
    R = scene.R + noise * random.normal(size=(80, 80)) / 80
    R[0, 1] = -1e-3
    operator = Dense(device, R)
    wanted = np.abs(np.linalg.eigvals(R)).max()
    for norms in (operator.norms(), None):
        found = theory.spectral_radius(operator, norms=norms)
        assert found.certificate == "power iteration"
        assert abs(found.value - wanted) <= 3 * found.error + 1e-4 * wanted
        assert found.error < 0.01
