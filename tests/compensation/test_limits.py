# SPDX-License-Identifier: BSD-3-Clause
"""Compensation within the projector's limits, against `scipy.optimize.lsq_linear` in float64."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear
from scipy.sparse.linalg import aslinearoperator

import ltcl
from ltcl.errors import ConvergenceError, InputError, LtclError
from tests.problems import lambertian

GRID = (4, 6)
N = 24
random = np.random.default_rng(70)


def least(T: np.ndarray, target: np.ndarray, weights: np.ndarray | float = 1.0, bounds=(0.0, 1.0)) -> float:
    """min ||W (T p - target)|| / ||W target|| of one column."""
    w = np.broadcast_to(weights, target.shape)
    p = lsq_linear(w[:, None] * T, w * target, bounds, tol=1e-14).x
    return error(T @ p, target, w)


def error(seen: np.ndarray, target: np.ndarray, weights: np.ndarray | float = 1.0) -> float:
    return float(np.linalg.norm(weights * (seen - target)) / np.linalg.norm(weights * target))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    rho=st.sampled_from([0.1, 0.8, 4.0]),
    rtol=st.sampled_from([1e-1, 1e-2, 1e-4]),
    bright=st.floats(0.1, 4.0),
    bounds=st.sampled_from([(0.0, 1.0), (0.1, 1.0), (-0.5, 0.5), (0.0, 255.0)]),
    ambient=st.sampled_from([0.0, 0.3]),
)
def test_never_worse_than_clamping_and_never_far_from_the_least(
    device, seed, rho, rtol, bright, bounds, ambient
):
    """Over random scenes: the claim of `compensate`, and of the certificate that comes with it."""
    rng = np.random.default_rng(seed)
    scene = lambertian(N, rho, seed=seed % 50, density=rng.choice([0.1, 1.0]))
    low, high = bounds
    desired = bright * high * rng.uniform(0, 1, N) ** rng.choice([1, 3]) * scene.T.sum(axis=1)
    background = ambient * rng.uniform(0, 1, N)
    T = ltcl.Transport(scene.T, GRID, device=device)
    c = ltcl.compensate(T, desired, background=background, bounds=bounds, method="direct", rtol=rtol)
    clamped = np.clip(np.linalg.solve(scene.T, desired - background), low, high)
    found, target = scene.T @ c.pattern.astype(float), desired - background
    assert np.linalg.norm(found - target) <= np.linalg.norm(
        scene.T @ clamped - target
    ) + 2e-5 * np.linalg.norm(desired)
    best = least(scene.T, target, bounds=bounds)
    share = np.linalg.norm(target) / np.linalg.norm(desired)  # error and gap are relative to desired
    assert c.error - c.gap <= best * share + 1e-5
    assert c.gap <= max(rtol * share, 1e-4) * (1 + 1e-5)
    assert low <= c.pattern.min() <= c.pattern.max() <= high
    at_bound = (c.pattern == np.float32(low)) | (c.pattern == np.float32(high))
    assert c.clipped <= at_bound.mean() + 1e-12
    assert c.error == pytest.approx(np.linalg.norm(found - target) / np.linalg.norm(desired), abs=1e-5)


@pytest.mark.parametrize("frames", [(), (3,)])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("channels", [1, 3])
def test_colours_and_frames_have_their_own_best(device, channels, weighted, frames):
    scenes = [lambertian(N, 0.5 + rho, seed=rho) for rho in range(3)][:channels]
    T = ltcl.Transport([scene.T for scene in scenes], GRID, device=device)
    desired = random.uniform(0, 2, (*frames, *GRID, 3))
    weights = random.uniform(0.1, 2, (*GRID, 3)) if weighted else np.ones((*GRID, 3))
    c = ltcl.compensate(T, desired, weights=weights if weighted else None, rtol=1e-4)
    assert c.pattern.shape == c.out_of_reach.shape == desired.shape
    flat, patterns = (part.reshape(-1, N, 3) for part in (desired, c.pattern.astype(float)))
    for target, pattern in zip(flat, patterns, strict=True):
        for colour in range(3):
            matrix, w = scenes[colour % channels].T, weights.reshape(N, 3)[:, colour]
            best = least(matrix, target[:, colour], w)
            assert error(matrix @ pattern[:, colour], target[:, colour], w) == pytest.approx(best, abs=2e-4)
    assert len(c.limited) == channels


def test_masked_pixels_stay_dark_and_count_only_where_weights_say_so(device):
    matrix = lambertian(N, 1.0, seed=4).T
    matrix[5, 5] = 0.0
    T = ltcl.Transport(matrix, GRID, device=device, on_dark="mask")
    desired = 0.2 * matrix.sum(axis=1)
    desired[5] = 5.0
    lit = np.delete(np.arange(N), 5)
    silent = ltcl.compensate(T, desired, rtol=1e-4)
    assert silent.clipped == 0.0
    assert error(silent.appearance[lit], desired[lit]) < 1e-3
    counted = ltcl.compensate(T, desired, weights=np.ones(N), rtol=1e-4)
    best = least(matrix[:, lit], desired)
    assert error(counted.appearance, desired) == pytest.approx(best, abs=2e-4)
    assert counted.pattern[5] == silent.pattern[5] == 0.0


@pytest.mark.parametrize("form", [np.asarray, scipy.sparse.csr_array, aslinearoperator])
@pytest.mark.parametrize("camera", [(6, 10), (3, 4)])
def test_rectangular_T_in_the_least_squares_sense(device, camera, form):
    """More camera pixels than projector pixels, and fewer; one projector pixel lights nothing."""
    M = camera[0] * camera[1]
    matrix = random.uniform(0, 1, (M, N)) * random.uniform(0.01, 1, N)
    matrix[:, 7] = 0.0
    T = ltcl.Transport(form(matrix), GRID, camera_grid=camera, device=device)
    desired = random.uniform(0, 1, (*camera, 3)) * matrix.sum(axis=1).reshape(*camera, 1)
    c = ltcl.compensate(T, desired, rtol=1e-4)
    assert c.pattern.shape == (*GRID, 3)
    assert c.appearance.shape == c.target.shape == c.out_of_reach.shape == desired.shape
    for colour in range(3):
        target = desired[..., colour].ravel()
        found = matrix @ c.pattern[..., colour].ravel().astype(float)
        assert error(found, target) == pytest.approx(least(matrix, target), abs=2e-4)
    assert not c.pattern.reshape(N, 3)[7].any()
    assert c.solution is c.limited[0]
    flat = ltcl.compensate(T, desired[..., 0].ravel(), bounds=(0.1, 1))
    assert flat.pattern.shape == (N,)
    assert flat.pattern[7] == np.float32(0.1)


def test_a_rectangular_T_has_no_method_of_solve(device):
    T = ltcl.Transport(np.ones((6, N)), GRID, camera_grid=(2, 3), device="there is no such device")
    refused: list[dict[str, Any]] = [{"method": "jacobi"}, {"clamp": True}, {"x0": 0}]
    for options in refused:
        with pytest.raises(LtclError, match=next(iter(options))):
            ltcl.compensate(T, np.ones((2, 3)), **options)
    with pytest.raises(InputError, match=r"desired .*\(4, 6\).*\(2, 3\)"):
        ltcl.compensate(T, np.ones(GRID))


def test_a_limit_of_steps_raises_or_leaves_a_gap(device):
    scene = lambertian(N, 4.0, seed=2)
    T = ltcl.Transport(scene.T, GRID, device=device)
    desired = 3 * random.uniform(0, 1, N)
    with pytest.raises(ConvergenceError):
        ltcl.compensate(T, desired, method="direct", rtol=1e-4, maxiter=1)
    c = ltcl.compensate(T, desired, method="direct", rtol=1e-4, maxiter=1, throw=False)
    assert c.gap > 1e-4
    assert not c.limited[0].converged


@pytest.fixture(scope="module")
def closed(device):
    return ltcl.scenes.box(8, sides=6, albedo=0.8).transport(device=device)


BRIGHT = 0.05 + 1.5 * np.random.default_rng(1).random((16, 24))


@pytest.mark.parametrize(("bounds", "gain"), [((0.1, 0.6), 1.0), ((0.0, 1.0), 2.0), ((0.0, 1.0), 1.0)])
def test_clipped_is_of_the_pattern_that_comes_back(closed, bounds, gain):
    """Against the gradient in float64: at a bound, and the error falls beyond it."""
    desired = np.resize(BRIGHT, closed.grid)
    c = ltcl.compensate(closed, desired, bounds=bounds, gain=gain)
    T = np.asarray(closed.matrices[0], np.float64)
    p = c.pattern.ravel().astype(np.float64)
    slope = T.T @ (T @ p - gain * desired.ravel())
    low, high = (p == np.float32(bound) for bound in bounds)
    wants = (low & (slope > 0)) | (high & (slope < 0))
    assert c.clipped == pytest.approx(wants.mean(), abs=0.01)
    assert 0.1 < c.clipped <= (low | high).mean() + 1e-12


def test_nothing_clipped_is_nothing_out_of_reach(device):
    """Though the solve leaves an error up to its tolerance, here a few pixels of far more."""
    scene = lambertian(N, 2.0, seed=9)
    T = ltcl.Transport(scene.T, GRID, device=device)
    c = ltcl.compensate(T, scene.T @ random.uniform(0.2, 0.8, N), method="jacobi", rtol=0.5, throw=False)
    assert c.clipped == 0.0
    assert c.error > 1e-3
    assert not c.out_of_reach.any()


def test_out_of_reach_leaves_out_what_the_tolerance_explains(device):
    scene = lambertian(N, 0.5, seed=9)
    T = ltcl.Transport(scene.T, GRID, device=device)
    desired = 0.5 * scene.T.sum(axis=1)
    desired[3] *= 4
    weights = np.ones(N)
    c = ltcl.compensate(T, desired, rtol=1e-2)
    missing = c.target.astype(float) - c.appearance
    explained = 3 * 1e-2 * np.sqrt(np.mean(desired**2))
    np.testing.assert_allclose(
        c.out_of_reach, np.where(np.abs(missing) > explained, missing, 0), atol=1e-5 * desired.max()
    )
    assert c.out_of_reach[3] > 0.0
    weights[3] = 0.0
    silent = ltcl.compensate(T, desired, weights=weights, rtol=1e-2)
    assert silent.clipped > 0.0
    assert silent.out_of_reach[3] == 0.0
    assert abs(silent.target[3] - silent.appearance[3]) > explained
