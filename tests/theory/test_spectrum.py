# SPDX-License-Identifier: BSD-3-Clause
"""The spectrum of R and bounds on that of S against eigenvalues in float64."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st

from ltcl import theory
from ltcl.errors import InputError
from ltcl.operators import CSR, Dense, IdentityPlus, as_operator
from ltcl.transport.diagnostics import reciprocity_defect
from tests.problems import enclosure, lambertian

random = np.random.default_rng(40)


@pytest.mark.parametrize("density", [1.0, 0.3, 0.1])
@pytest.mark.parametrize("rho", [0.01, 0.9, 30.0])
def test_the_radius_is_that_of_the_eigenvalues(device, rho, density):
    R = lambertian(50, rho, seed=41, density=density).R
    wanted = np.abs(np.linalg.eigvals(R)).max()
    found = theory.spectral_radius(as_operator(R, device), rtol=1e-3)
    assert found.value == pytest.approx(wanted, rel=5e-3)
    assert found.albedo == pytest.approx(wanted / (1 + wanted), rel=5e-3)  # eq. 14
    assert found.change < 1e-3


@pytest.mark.parametrize("call", [theory.two_norm, reciprocity_defect])
def test_a_seed_is_checked(device, call):
    F = {"F": np.ones(4), "entries": 4} if call is reciprocity_defect else {}
    with pytest.raises(InputError, match="seed is -1"):
        call(as_operator(np.eye(4), device), **F, seed=-1)


@pytest.mark.parametrize("m", [0.1, 0.5, 0.9])
def test_a_closed_room_has_the_radius_of_eq_14_at_once(device, m):
    found = theory.spectral_radius(Dense(device, enclosure(40, m).R))
    assert found.value == pytest.approx(m / (1 - m), rel=1e-3)
    assert found.products < 20


@pytest.mark.parametrize(
    "R", [np.zeros((5, 5)), np.triu(np.ones((5, 5)), 1)], ids=["zero", "nilpotent"]
)
def test_light_that_never_returns_has_radius_zero(device, R):
    found = theory.spectral_radius(as_operator(R, device))
    assert (found.value, found.albedo) == (0.0, 0.0)
    assert found.products <= 6


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 10_000),
    st.floats(0.01, 50.0),
    st.floats(0.05, 1.0),
    st.integers(2, 30),
    st.booleans(),
)
def test_free_bounds_hold_the_spectrum_of_any_diffuse_scene(device, seed, rho, density, n, forward):
    scene = lambertian(n, rho, seed, density)
    if forward:
        spectrum = np.linalg.eigvals(np.eye(n) - scene.A)
        S = IdentityPlus(CSR(device, scipy.sparse.csr_array(scene.A)), sign=-1)
    else:
        spectrum = np.linalg.eigvals(scene.S)
        S = IdentityPlus(Dense(device, scene.R))
    # S is self-adjoint in the area / albedo product.
    assert np.abs(spectrum.imag).max() < 1e-6 * (1 + rho)
    lower, upper = theory.free_bounds(S)
    room = 1e-5 * (1 + rho)
    assert lower - room <= spectrum.real.min()
    assert spectrum.real.max() <= upper + room


# Certified bounds on rho(R).


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 10_000),
    st.floats(0.01, 50.0),
    st.floats(0.0, 1.0),
    st.integers(1, 30),
    st.booleans(),
)
def test_collatz_and_wielandt_hold_rho_of_any_nonnegative_matrix(
    device, seed, scale, density, n, directed
):
    """Reducible, nilpotent, periodic ones as well, whose eigenvalues have errors of eps^(1/n)."""
    rng = np.random.default_rng(seed)
    R = (scale * rng.random((n, n)) * (rng.random((n, n)) < density)).astype(np.float32)
    if directed:
        R = np.tril(R)
        exact = float(R.diagonal().max())
        room = 1e-12 * scale
    else:
        exact = float(np.abs(np.linalg.eigvals(np.float64(R))).max())
        room = 2e-2 * scale * (exact < 1e-2 * scale) + 1e-9 * scale
    operator = Dense(device, R)
    found = theory.spectral_radius(operator, norms=operator.norms())
    assert found.certificate == "collatz-wielandt"
    assert found.lower <= exact + room
    assert exact <= found.upper + room
    assert found.lower <= found.value <= found.upper


WALLS = np.zeros((20, 20))  # -rho lies beside rho
WALLS[:10, 10:] = np.random.default_rng(0).random((10, 10))
WALLS[10:, :10] = 0.1 * WALLS[:10, 10:].T
DARK = lambertian(30, 0.8).R
DARK[[3, 7]] = 0.0  # which must not loosen the lower bound


@pytest.mark.parametrize(
    "R", [np.array([[0.8]]), lambertian(10, 0.8).R, lambertian(300, 0.8).R, WALLS, DARK]
)
@pytest.mark.parametrize("form", [Dense, CSR])
def test_the_bounds_close_on_rho(device, form, R):
    rho = np.abs(np.linalg.eigvals(R)).max()
    operator = form(device, scipy.sparse.csr_array(R) if form is CSR else R)
    assert theory.spectral_radius(operator).value == pytest.approx(rho, rel=1e-3)
    found = theory.spectral_radius(operator, norms=operator.norms())
    assert 0.98 * rho < found.lower <= rho <= found.upper < 1.02 * rho
    assert found.error < 0.01 * rho


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
