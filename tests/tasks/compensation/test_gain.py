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
    """Relative error at this gain over all frames (k, N), the least by brute force."""
    square = 0.0
    for d in desired:
        square += 2 * lsq_linear(matrix, gain * d - background, bounds, tol=1e-14).cost
    return float(np.sqrt(square) / (gain * np.linalg.norm(desired)))


@pytest.mark.parametrize("bounds", [(0.0, 1.0), (0.1, 0.7), (-0.5, 3.0)])
@pytest.mark.parametrize("ambient", [0.0, 0.05])
@pytest.mark.parametrize("frames", [1, 3])
def test_the_largest_gain_within_reach_exactly(T, bounds, ambient, frames):
    desired = within_reach(frames)
    background = ambient * random.uniform(0, 1, GRID)
    c = ltcl.compensate(
        T,
        desired,
        bounds=bounds,
        background=background,
        gain="auto",
        method="direct",
        rtol=1e-4,
    )
    u = np.linalg.solve(SCENE.T, desired.reshape(frames, N).T)
    v = np.linalg.solve(SCENE.T, background.ravel())[:, None]
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
    direct = np.diag(SCENE.T)[:, None] * (c.gain * u - v)
    np.testing.assert_allclose(c.solution.x, direct, rtol=1e-3)
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
    desired = 0.05 + random.random((2, N))
    background = ambient * random.random(N)

    def error_at(gain: float) -> float:
        return least_error(gain, desired, background, bounds)

    def compensate() -> ltcl.Compensation:
        return ltcl.compensate(
            T,
            desired.reshape(2, *GRID),
            bounds=bounds,
            background=background.reshape(GRID),
            gain="auto",
            loss=allowed,
        )

    low = min(np.geomspace(0.1, 10, 60), key=error_at)
    if error_at(low) > allowed:
        with pytest.raises(InputError, match=f"gain .*{allowed}"):
            compensate()
        return
    high = 1e4
    for _ in range(30):
        middle = np.sqrt(low * high)
        if error_at(middle) <= allowed:
            low = middle
        else:
            high = middle
    c = compensate()
    assert low / 1.0101 <= c.gain <= low * 1.0001
    assert c.error <= allowed * (1 + 1e-5)
    assert c.clipped > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("rtol", [1e-3, 1e-2])
@pytest.mark.parametrize(
    ("bounds", "contrast"),
    [((0.0, 1.0), 8.0), ((0.3, 0.9), 8.0), ((0.3, 0.9), 1.0), ((0.3, 0.9), 0.2)],
)
def test_without_a_loss_a_tenth_above_the_least(T, bounds, rtol, contrast):
    """No gain is in reach exactly; against the least error over a fine net of gains."""
    desired = (1.0 + contrast * np.random.default_rng(2).random(GRID)).reshape(1, N)

    def error_at(gain: float) -> float:
        return least_error(gain, desired, 0.0, bounds)

    low, high = bounds
    light = np.linalg.solve(SCENE.T, desired[0])
    has_negative_light = (light < 0).any()
    contrast_of_light = light.max() / max(light.min(), 1e-9)
    assert has_negative_light or contrast_of_light > high / max(low, 1e-9)
    least = min(map(error_at, np.geomspace(0.001, 10, 400)))
    allowed = max(rtol, 1.1 * least)
    c = ltcl.compensate(T, desired.reshape(GRID), bounds=bounds, gain="auto", rtol=rtol)
    assert error_at(c.gain) <= c.error + 1e-5 <= 1.011 * allowed + 2e-5
    assert error_at(1.0101 * c.gain) > 0.999 * allowed


def test_weights_allow_a_larger_gain(T):
    """A bright pixel that does not matter does not hold the others back."""
    desired = within_reach(1)[0]
    desired[1, 1] *= 1.5
    weights = np.ones(GRID)
    weights[1, 1] = 0.0
    limited = ltcl.compensate(T, desired, gain="auto", loss=0.02)
    free = ltcl.compensate(T, desired, gain="auto", loss=0.02, weights=weights)
    assert free.gain > 1.2 * limited.gain
    assert free.error <= 0.02 * (1 + 1e-4)


@pytest.mark.parametrize("loss", [None, 1e-3, 0.05])
@pytest.mark.parametrize("camera", [(2, 5), (5, 7), (6, 7)])
def test_fewer_and_more_camera_than_projector_pixels(device, camera, loss):
    """Many patterns make one picture, so certificates take thousands of steps on the device."""
    rng = np.random.default_rng(119)
    rows, columns = camera
    matrix = rng.normal(size=(rows * columns, 36))
    T = ltcl.Transport(matrix, (6, 6), camera_grid=camera, device=device)
    desired = (rng.uniform(0.2, 0.9, (2, 36)) @ matrix.T).reshape(2, *camera)
    c = ltcl.compensate(T, desired, gain="auto", loss=loss)
    # On the device alone it would take 8000 products, and up to 40 s.
    assert c.limited[0].products < 400
    allowed = 1e-2 if loss is None else loss
    flat = desired.reshape(2, -1)
    least = least_error(c.gain, flat, 0.0, (0, 1), matrix)
    assert least <= c.error <= allowed * (1 + 1e-4)
    assert least_error(1.03 * c.gain, flat, 0.0, (0, 1), matrix) > allowed * 0.999


def test_a_loss_out_of_reach_is_refused_soon_where_colours_mix(device):
    matrices = [lambertian(24, 1.0, seed=c).T for c in range(3)]
    before = device.launches.total()
    T = ltcl.Transport(matrices, (4, 6), mixing=0.75 * np.eye(3) + 0.05, device=device)
    with pytest.raises(InputError, match=r"loss.*0\.001"):
        ltcl.compensate(T, random.uniform(0, 1, (4, 6, 3)), gain="auto", loss=1e-3)
    assert device.launches.total() - before < 1000
