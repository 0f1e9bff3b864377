# SPDX-License-Identifier: BSD-3-Clause
"""`separate`: each bounce is A^k F p if F is true; no light is lost whatever F is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ltcl
from ltcl.errors import ConvergenceError, InputError, InputTypeError, MemoryLimitError
from ltcl.solvers import Status
from ltcl.transport.noise import Noise
from tests.problems import lambertian

GRID = (4, 7)
N = 28
SCENES = [lambertian(N, rho, seed=60 + channel) for channel, rho in enumerate((0.8, 2.0, 0.3))]
SCENE = SCENES[0]
random = np.random.default_rng(61)


def transport(device, scene=SCENE, first_bounce: Any = None) -> ltcl.Transport:
    """T of a scene, with its own first bounce if no other is given."""
    if first_bounce is None:
        first_bounce = scene.F
    return ltcl.Transport(scene.T, GRID, first_bounce, device=device)


def close(picture: np.ndarray, exact: np.ndarray, tolerance: Any) -> bool:
    return bool(np.linalg.norm(np.asarray(picture, float).ravel() - np.ravel(exact)) <= tolerance)


@pytest.mark.parametrize(
    ("rho", "method"),
    [
        (0.8, "auto"),
        (0.8, "jacobi"),
        (0.8, "neumann"),
        (0.8, "chebyshev"),
        (0.8, "direct"),
        (4.0, "chebyshev"),
    ],
)
@pytest.mark.parametrize("first_bounce", [None, "exact"])
def test_the_bounces_are_powers_of_A(device, method, first_bounce, rho):
    """Eq. 27 against A^k F p in float64.

    A solve deviates by rtol |b|, the next one by 1 + m times as much. With rho = 4 the series
    diverges, and bounces are found all the same. Negative light is not clipped.
    """
    scene = lambertian(N, rho, seed=60)
    p = random.normal(size=N)
    rtol = 1e-4 / rho**2
    T = transport(device, scene, first_bounce)
    image = scene.T @ p
    b = ltcl.separate(T, image.reshape(GRID), bounces=5, method=method, rtol=rtol)
    assert b.bounces.shape == (5, *GRID)
    for solution in b.solutions:
        assert isinstance(solution, ltcl.Solution)
        assert solution.converged
    unit = 2 * (1 + rho) * rtol * np.linalg.norm(image)
    for k, bounce in enumerate([b.direct, *b.bounces]):
        assert close(bounce, scene.bounce(k, p), (k + 1) * unit)
    assert close(b.indirect, image - scene.F * p, unit)
    found = sum(scene.bounce(k, p) for k in range(6))
    assert close(b.rest, image - found, 6 * unit)
    if rho == 4.0:
        with pytest.raises(ConvergenceError) as caught:
            ltcl.separate(T, image.reshape(GRID), method="jacobi")
        assert caught.value.solution.status is Status.DIVERGED


GREY_TRANSPORTS = [(SCENE.T, SCENE.F), (SCENE.T, "diagonal")]
COLOUR_TRANSPORT = ([scene.T for scene in SCENES], "diagonal")


@pytest.mark.slow
@settings(max_examples=50, deadline=None)
@given(
    st.sampled_from([*GREY_TRANSPORTS, COLOUR_TRANSPORT]),
    st.sampled_from([GRID, (*GRID, 3), (2, *GRID), (3, *GRID, 3), (N,)]),
    st.integers(0, 6),
    st.floats(1e-5, 0.5),
    st.sampled_from(["chebyshev", "direct"]),
    st.integers(0, 1000),
)
def test_nothing_of_the_picture_is_lost(device, matrix_and_F, shape, bounces, rtol, method, seed):
    """Direct, bounces and rest sum to the picture to rounding, whatever T and the tolerance."""
    image = np.random.default_rng(seed).normal(size=shape)
    matrix, first_bounce = matrix_and_F
    T = ltcl.Transport(matrix, GRID, first_bounce, device=device)
    b = ltcl.separate(T, image, bounces, method=method, rtol=rtol)
    if T.channels == 3 and shape[-1] != 3:
        image = np.repeat(image[..., None], 3, axis=-1)
    assert b.direct.shape == b.indirect.shape == b.rest.shape == image.shape
    assert b.bounces.shape == (bounces, *image.shape)
    parts = np.stack([b.direct, *b.bounces, b.rest])
    assert parts.dtype == np.float32
    parts = parts.astype(np.float64)
    size = np.abs(parts).sum(axis=0)
    assert np.all(np.abs(parts.sum(axis=0) - image) <= 2.0**-23 * size)
    assert np.all(np.abs(b.direct.astype(float) + b.indirect - image) <= 2.0**-22 * size)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"image": np.ones((7, 4))}, InputError, r"image has shape \(7, 4\); .*\(4, 7\)"),
        ({"image": np.full(GRID, np.nan)}, InputError, "image has 28 NaN"),
        ({"bounces": -1}, InputError, "bounces is -1"),
        ({"bounces": 1.5}, InputError, "bounces is 1.5"),
        ({"bounces": True}, InputError, "bounces is True"),
        ({"bounces": 10**12}, MemoryLimitError, "1000000000000 bounces"),
        ({"method": "magic"}, InputError, "method is 'magic'"),
        ({"method": []}, InputError, r"method is \[\]"),
        ({"omega": 1}, InputTypeError, "option 'omega'"),
        ({"method": "jacobi", "samples": 3}, InputTypeError, "samples.*'jacobi'"),
        ({"method": "monte_carlo", "pixels": [1, 2]}, InputTypeError, "pixels"),
        ({"rtol": 2.0}, InputError, "rtol is 2.0"),
    ],
)
def test_bad_input_is_refused_by_name(device, change, error, words):
    with pytest.raises(error, match=words) as caught:
        ltcl.separate(transport(device), **{"image": np.ones(GRID), **change})
    assert "\n" not in str(caught.value)


def test_bounces_are_sampled_with_random_numbers_of_their_own(device):
    """Bounce k takes seed + k, and is the same as a solve of its own, to the bit."""
    T = ltcl.Transport(lambertian(N, 0.5, seed=64).T, GRID, device=device)
    image = T @ np.ones(GRID)
    b = ltcl.separate(T, image, bounces=1, method="monte_carlo", samples=64, seed=7)
    left = image.ravel().astype(np.float64)
    for seed, found in ((7, b.direct), (8, b.bounces[0])):
        x = ltcl.solve(T.interreflection, left, "monte_carlo", rtol=1e-3, samples=64, seed=seed).x
        np.testing.assert_array_equal(found.ravel(), x.astype(np.float32))
        left = left - x.astype(np.float64)


# Light that one camera cannot tell apart (section 8.4).


@pytest.mark.parametrize("glossy", [False, True])
def test_a_view_dependent_scene_carries_a_warning(device, caplog, glossy):
    """A glossy surface multiplies R by a factor of each pair of pixels."""
    shine = 1.0
    if glossy:
        shine = 0.3 * np.random.default_rng(0).lognormal(sigma=0.5, size=SCENE.R.shape)
    matrix = (np.eye(SCENE.n) + SCENE.R * shine) * SCENE.F
    T = ltcl.Transport(matrix, GRID, SCENE.F, device=device)
    b = ltcl.separate(T, T @ np.ones(GRID), bounces=1)
    messages = [record.message for record in caplog.records]
    if glossy:
        (message,) = messages
        assert b.warning.startswith(message)
        assert b.reciprocity_defect > 0.1
        assert "T is not reciprocal" in b.warning
        assert "section 8.4" in b.warning
    else:
        assert messages == []
        assert b.reciprocity_defect < 1e-5
        assert b.negative_bounce < 1e-5
        assert "T is not reciprocal" not in b.warning
    # What T does not show is said of every scene.
    for word in ("unlit", "gloss", "returns to its own pixel", "noise in T alone"):
        assert word in b.warning


SMALL_SCENES = {
    "dihedral": ltcl.scenes.dihedral(8, albedo=0.7),
    "trihedral": ltcl.scenes.trihedral(8, albedo=0.7),
    "room": ltcl.scenes.box(8, sides=5, albedo=0.8),
    "closed": ltcl.scenes.box(6, albedo=0.9),
}


@pytest.mark.parametrize("name", SMALL_SCENES)
@pytest.mark.parametrize(
    ("ambient", "noise"), [(0.01, 0.0), (0.01, 1e-3), (0.0, 0.0), (0.0, 1e-3), (0.0, 1e-2)]
)
def test_ambient_light_left_in_T_is_warned_of_and_no_clean_scene_is(
    device, caplog, name, ambient, noise
):
    scene = SMALL_SCENES[name]
    T = scene.transport().to_numpy()
    error = np.random.default_rng(5).standard_normal(T.shape)
    error *= noise * np.median(T.diagonal())
    black = ambient * T.sum(axis=1).mean()
    measured = ltcl.Transport(T + black + error, scene.grid, device=device)
    # The second separation takes what the first one has found of T.
    for _ in range(2):
        caplog.clear()
        b = ltcl.separate(measured, measured @ np.ones(measured.grid), bounces=1)
        assert ("ambient light" in caplog.text) == (ambient > 0)
        assert ("ambient light" in b.warning) == (ambient > 0)
        assert len(caplog.records) <= 1


def test_light_by_way_of_unlit_walls_is_not_called_ambient(device):
    """Three walls of a closed room are seen and lit; nothing is left of black."""
    full = ltcl.scenes.box(8, albedo=0.7)
    height, width = full.grid
    seen = np.arange(height * width).reshape(full.grid)[:, :24].ravel()
    matrix = full.transport().to_numpy()[np.ix_(seen, seen)]
    grid = (8, 24)
    T = ltcl.Transport(matrix, grid, device=device)
    b = ltcl.separate(T, T @ np.ones(grid), bounces=1)
    assert "surfaces that the projector does not light" in b.warning
    # A scan has subtracted black.
    noise = Noise.uniform(matrix.shape, 1e-8, source="acquired")
    scanned = ltcl.Transport(matrix, grid, noise=noise, device=device)
    b = ltcl.separate(scanned, scanned @ np.ones(grid), bounces=1)
    assert "ambient" not in b.warning
    assert "ambient" not in ltcl.analyze(scanned).verdict.causes
