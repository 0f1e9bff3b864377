# SPDX-License-Identifier: BSD-3-Clause
"""`separate`: each bounce is A^k F p where F is true, and nothing of the picture is lost whatever F is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ltcl
from ltcl.errors import ConvergenceError, InputError, InputTypeError, MemoryLimitError
from ltcl.solvers import Status
from tests.problems import lambertian

GRID = (4, 7)
N = 28
SCENES = [lambertian(N, rho, seed=60 + channel) for channel, rho in enumerate((0.8, 2.0, 0.3))]
SCENE = SCENES[0]
random = np.random.default_rng(61)


def transport(device, scene=SCENE, **arguments):
    return ltcl.Transport(scene.T, GRID, **({"first_bounce": scene.F, "device": device} | arguments))


def close(picture: np.ndarray, exact: np.ndarray, tolerance: Any) -> bool:
    return bool(np.linalg.norm(np.asarray(picture, float).ravel() - np.ravel(exact)) <= tolerance)


@pytest.mark.parametrize("first_bounce", ["given", "exact"])
@pytest.mark.parametrize("method", ["auto", "jacobi", "neumann", "chebyshev", "direct"])
def test_the_bounces_are_powers_of_A(device, method, first_bounce):
    """Eq. 27 against A^k F p in float64. A solve is off by rtol |b|, the next by 1 + m times as much."""
    p, rtol = random.uniform(0.0, 1.0, N), 1e-4
    T = transport(device, first_bounce=SCENE.F if first_bounce == "given" else "exact")
    image = SCENE.T @ p
    b = ltcl.separate(T, image.reshape(GRID), bounces=5, method=method, rtol=rtol)
    assert b.bounces.shape == (5, *GRID)
    assert all(isinstance(solution, ltcl.Solution) and solution.converged for solution in b.solutions)
    for k, bounce in enumerate([b.direct, *b.bounces]):
        assert close(bounce, SCENE.bounce(k, p), 2 * (k + 1) * rtol * np.linalg.norm(image))
    assert close(b.indirect, image - SCENE.F * p, 2 * rtol * np.linalg.norm(image))
    later = image - sum(SCENE.bounce(k, p) for k in range(6))
    assert close(b.rest, later, 12 * rtol * np.linalg.norm(image))


def test_where_the_series_diverges_bounces_come_all_the_same(device):
    scene, p = lambertian(N, 4.0, seed=62), random.uniform(0.0, 1.0, N)
    b = ltcl.separate(transport(device, scene), (scene.T @ p).reshape(GRID), method="chebyshev", rtol=1e-5)
    for k, bounce in enumerate([b.direct, *b.bounces]):
        assert close(bounce, scene.bounce(k, p), 1e-3 * np.linalg.norm(scene.T @ p))
    with pytest.raises(ConvergenceError) as caught:
        ltcl.separate(transport(device, scene), (scene.T @ p).reshape(GRID), method="jacobi")
    assert caught.value.solution.status is Status.DIVERGED


@pytest.fixture(scope="module")
def transports(device):
    return {
        "exact": transport(device),
        "diagonal": transport(device, first_bounce="diagonal"),
        "colour": ltcl.Transport([scene.T for scene in SCENES], GRID, device=device),
    }


@settings(max_examples=50, deadline=None)
@given(
    st.sampled_from(["exact", "diagonal", "colour"]),
    st.sampled_from([GRID, (*GRID, 3), (2, *GRID), (3, *GRID, 3), (N,)]),
    st.integers(0, 6),
    st.floats(1e-5, 0.5),
    st.sampled_from(["chebyshev", "direct"]),
    st.integers(0, 1000),
)
def test_nothing_of_the_picture_is_lost(transports, name, shape, bounces, rtol, method, seed):
    """Direct, bounces and rest sum to the picture to rounding, for any tolerance and any first bounce."""
    image = np.random.default_rng(seed).normal(size=shape)
    b = ltcl.separate(transports[name], image, bounces, method=method, rtol=rtol)
    wanted = image if shape[-1] == 3 or name != "colour" else np.repeat(image[..., None], 3, axis=-1)
    assert b.direct.shape == b.indirect.shape == b.rest.shape == wanted.shape
    assert b.bounces.shape == (bounces, *wanted.shape)
    parts = [b.direct, *b.bounces, b.rest]
    assert all(part.dtype == np.float32 for part in parts)
    size = sum(np.abs(part, dtype=np.float64) for part in parts)
    assert np.all(np.abs(np.sum(parts, axis=0, dtype=np.float64) - wanted) <= 2.0**-23 * size)
    assert np.all(np.abs(b.direct.astype(float) + b.indirect - wanted) <= 2.0**-22 * size)


def test_negative_values_are_not_clipped(device):
    """A picture that no pattern makes has bounces below zero; so has noise."""
    image = random.normal(size=N)
    b = ltcl.separate(transport(device), image, bounces=3, rtol=1e-6, method="direct")
    assert b.direct.min() < 0
    for bounce in [b.direct, *b.bounces]:
        np.testing.assert_allclose(bounce, image - SCENE.A @ image, rtol=0, atol=1e-5)
        image = SCENE.A @ image


FINE = np.ones(GRID)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"image": np.ones((7, 4))}, InputError, r"image has shape \(7, 4\); .*\(4, 7\)"),
        ({"image": FINE * np.nan}, InputError, "image has 28 NaN"),
        ({"bounces": -1}, InputError, "bounces is -1"),
        ({"bounces": 1.5}, InputError, "bounces is 1.5"),
        ({"bounces": True}, InputError, "bounces is True"),
        ({"bounces": 10**12}, MemoryLimitError, "1000000000000 bounces"),
        ({"method": "magic"}, InputError, "method is 'magic'"),
        ({"omega": 1}, InputTypeError, "option 'omega'"),
        ({"rtol": 2.0}, InputError, "rtol is 2.0"),
    ],
)
def test_bad_input_is_refused_by_name(device, change, error, words):
    with pytest.raises(error, match=words) as caught:
        ltcl.separate(transport(device), **{"image": FINE, **change})
    assert "\n" not in str(caught.value)


def test_bounces_are_sampled_with_random_numbers_of_their_own(device):
    """Bounce k takes seed + k: the same as solves of its own, to the bit."""
    T = ltcl.Transport(lambertian(N, 0.5, seed=64).T, GRID, device=device)
    image = T @ np.ones(GRID)
    b = ltcl.separate(T, image, bounces=1, method="monte_carlo", samples=64, seed=7)
    left = image.ravel().astype(np.float64)
    for seed, found in ((7, b.direct), (8, b.bounces[0])):
        x = ltcl.solve(T.interreflection, left, "monte_carlo", rtol=1e-3, samples=64, seed=seed).x
        np.testing.assert_array_equal(found.ravel(), x.astype(np.float32))
        left = left - x.astype(np.float64)


# What one camera cannot know (section 8.4).


def test_a_diffuse_scene_carries_no_warning(device, caplog):
    T = transport(device)
    b = ltcl.separate(T, T @ np.ones(GRID), bounces=1)
    assert b.reciprocity_defect < 1e-5
    assert b.negative_bounce < 1e-5
    assert b.warning == ""
    assert not caplog.records


def test_a_view_dependent_scene_carries_a_warning(device, caplog):
    """Light that leaves in each direction its own way: R times a factor of the pair of pixels."""
    shine = np.random.default_rng(0).lognormal(sigma=0.5, size=SCENE.R.shape)
    matrix = (np.eye(SCENE.n) + 0.3 * SCENE.R * shine) * SCENE.F
    T = ltcl.Transport(matrix, GRID, device=device)
    b = ltcl.separate(T, T @ np.ones(GRID), bounces=1)
    assert b.reciprocity_defect > 0.1
    assert "T is not reciprocal" in b.warning
    assert "section 8.4" in b.warning
    assert [record.message for record in caplog.records] == [b.warning]
