# SPDX-License-Identifier: BSD-3-Clause
"""gain="auto" finds the largest gain, against closed forms and brute force in float64."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import lsq_linear

import ltcl
from ltcl.errors import InputError
from tests.problems import lambertian

GRID = (3, 5)
N = 15
SCENE = lambertian(N, 1.0, seed=80)
random = np.random.default_rng(81)


@pytest.fixture(scope="module")
def T(device):
    return ltcl.Transport(SCENE.T, GRID, device=device)


def within_reach(frames: int = 1) -> np.ndarray:
    """Pictures of patterns without black or white, (frames, h, w)."""
    return (random.uniform(0.3, 0.9, (frames, N)) @ SCENE.T.T).reshape(-1, *GRID)


def least_error(
    gain: float, desired: np.ndarray, background: Any, bounds: Any, matrix=SCENE.T
) -> float:
    """Least relative error at this gain over all frames (k, N), by brute force."""
    left = sum(
        2 * lsq_linear(matrix, gain * d - background, bounds, tol=1e-14).cost for d in desired
    )
    return float(np.sqrt(left) / (gain * np.linalg.norm(desired)))


@pytest.mark.parametrize("bounds", [(0.0, 1.0), (0.1, 0.7), (-0.5, 3.0)])
@pytest.mark.parametrize("ambient", [0.0, 0.05])
@pytest.mark.parametrize("frames", [1, 3])
def test_the_largest_gain_within_reach_exactly(T, bounds, ambient, frames):
    desired = within_reach(frames)
    background = ambient * random.uniform(0, 1, GRID)
    options = {"gain": "auto", "method": "direct", "rtol": 1e-4}
    c = ltcl.compensate(T, desired, bounds=bounds, background=background, **options)
    flat = desired.reshape(frames, N)
    u, v = np.linalg.solve(SCENE.T, flat.T), np.linalg.solve(SCENE.T, background.ravel())[:, None]
    assert (u > 0).all()
    wanted = np.min((bounds[1] + v) / u)
    assert c.gain == pytest.approx(wanted, rel=1e-4)
    assert c.clipped == 0.0
    assert c.error < 1e-3
    assert c.pattern.max() == pytest.approx(bounds[1], rel=1e-4)
    assert c.limited == ()
    assert not c.out_of_reach.any()
    np.testing.assert_allclose(c.target, c.gain * desired, rtol=1e-5)
    assert isinstance(c.solution, ltcl.Solution)
    np.testing.assert_allclose(
        c.solution.x, np.diag(SCENE.T)[:, None] * (c.gain * u - v), rtol=1e-3
    )
    least = ltcl.compensate(
        T, desired, bounds=bounds, background=background, gain="auto", loss=1e-6
    )
    assert least.gain == pytest.approx(wanted, rel=0.011)
    assert least.error < 2e-6


@pytest.mark.parametrize("bounds", [(0.0, 1.0), (0.1, 0.6)])
@pytest.mark.parametrize("ambient", [0.0, 0.1])
@pytest.mark.parametrize("allowed", [0.01, 0.1, 0.3, 0.9, 0.99])
def test_the_gain_is_the_largest_within_the_loss(T, bounds, ambient, allowed):
    """Against bisection: at losses near 1 the error hardly changes with the gain."""
    desired, background = 0.05 + random.random((2, N)), ambient * random.random(N)
    at = lambda gain: least_error(gain, desired, background, bounds)  # noqa: E731
    options = {
        "bounds": bounds,
        "background": background.reshape(GRID),
        "gain": "auto",
        "loss": allowed,
    }
    low, high = min(np.geomspace(0.1, 10, 60), key=at), 1e4
    if at(low) > allowed:
        with pytest.raises(InputError, match=f"gain .*{allowed}"):
            ltcl.compensate(T, desired.reshape(2, *GRID), **options)
        return
    for _ in range(30):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if at(middle) <= allowed else (low, middle)
    c = ltcl.compensate(T, desired.reshape(2, *GRID), **options)
    assert low / 1.0101 <= c.gain <= low * 1.0001
    assert c.error <= allowed * (1 + 1e-5)
    assert c.clipped > 0.0


@pytest.mark.parametrize("rtol", [1e-3, 1e-2])
@pytest.mark.parametrize(
    ("bounds", "contrast"),
    [((0.0, 1.0), 8.0), ((0.3, 0.9), 8.0), ((0.3, 0.9), 1.0), ((0.3, 0.9), 0.2)],
)
def test_without_a_loss_a_tenth_above_the_least(T, bounds, rtol, contrast):
    """Where no gain is in reach exactly, against the least over a fine net of gains."""
    desired = (1.0 + contrast * np.random.default_rng(2).random(GRID)).reshape(1, N)
    at = lambda gain: least_error(gain, desired, 0.0, bounds)  # noqa: E731
    light = np.linalg.solve(SCENE.T, desired[0])
    assert (light < 0).any() or light.max() / max(light.min(), 1e-9) > bounds[1] / max(
        bounds[0], 1e-9
    )
    least = min(map(at, np.geomspace(0.001, 10, 400)))
    allowed = max(rtol, 1.1 * least)
    c = ltcl.compensate(T, desired.reshape(GRID), bounds=bounds, gain="auto", rtol=rtol)
    assert at(c.gain) <= c.error + 1e-5 <= 1.011 * allowed + 2e-5
    assert at(1.0101 * c.gain) > 0.999 * allowed


def test_weights_allow_a_larger_gain(T):
    """Where one bright pixel does not matter, it does not hold the others back."""
    desired = within_reach(1)[0]
    desired[1, 1] *= 1.5
    weights = np.ones(GRID)
    weights[1, 1] = 0.0
    held, free = (
        ltcl.compensate(T, desired, gain="auto", loss=0.02, weights=w) for w in (None, weights)
    )
    assert free.gain > 1.2 * held.gain
    assert free.error <= 0.02 * (1 + 1e-4)


@pytest.mark.parametrize("loss", [None, 1e-3, 0.05])
@pytest.mark.parametrize("camera", [(2, 5), (5, 7), (6, 7)])
def test_fewer_and_more_camera_than_projector_pixels(device, camera, loss):
    """Many patterns make one picture, so that certificates take thousands of steps on the device."""
    rng = np.random.default_rng(119)
    matrix = rng.normal(size=(camera[0] * camera[1], 36))
    T = ltcl.Transport(matrix, (6, 6), camera_grid=camera, device=device)
    desired = (rng.uniform(0.2, 0.9, (2, 36)) @ matrix.T).reshape(2, *camera)
    c = ltcl.compensate(T, desired, gain="auto", loss=loss)
    assert c.limited[0].products < 400  # 8000, and up to 40 s, where the device does it all
    allowed = 1e-2 if loss is None else loss
    least, more = (
        least_error(g, desired.reshape(2, -1), 0.0, (0, 1), matrix) for g in (c.gain, 1.03 * c.gain)
    )
    assert least <= c.error <= allowed * (1 + 1e-4)
    assert more > allowed * 0.999


def test_a_loss_out_of_reach_is_refused_soon_where_colours_mix(device):
    matrices, before = [lambertian(24, 1.0, seed=c).T for c in range(3)], device.launches.total()
    T = ltcl.Transport(matrices, (4, 6), mixing=0.75 * np.eye(3) + 0.05, device=device)
    with pytest.raises(InputError, match=r"loss.*0\.001"):
        ltcl.compensate(T, random.uniform(0, 1, (4, 6, 3)), gain="auto", loss=1e-3)
    assert device.launches.total() - before < 1000
