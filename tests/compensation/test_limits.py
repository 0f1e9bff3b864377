# SPDX-License-Identifier: BSD-3-Clause
"""Compensation within the projector's limits, against `scipy.optimize.lsq_linear` in float64."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear
from scipy.sparse.linalg import aslinearoperator

import ltcl
from ltcl.errors import ConvergenceError, InputError, InputTypeError
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
    low=st.sampled_from([0.0, 0.1]),
    ambient=st.sampled_from([0.0, 0.3]),
)
def test_never_worse_than_clamping_and_never_far_from_the_least(
    device, seed, rho, rtol, bright, low, ambient
):
    """Over random scenes: the claim of `compensate`, and of the certificate that comes with it."""
    rng = np.random.default_rng(seed)
    scene = lambertian(N, rho, seed=seed % 50, density=rng.choice([0.1, 1.0]))
    desired = bright * rng.uniform(0, 1, N) ** rng.choice([1, 3]) * scene.T.sum(axis=1)
    background = ambient * rng.uniform(0, 1, N)
    T = ltcl.Transport(scene.T, GRID, device=device)
    c = ltcl.compensate(T, desired, background=background, bounds=(low, 1.0), method="direct", rtol=rtol)
    clamped = np.clip(np.linalg.solve(scene.T, desired - background), low, 1.0)
    found, target = scene.T @ c.pattern.astype(float), desired - background
    assert np.linalg.norm(found - target) <= np.linalg.norm(
        scene.T @ clamped - target
    ) + 2e-5 * np.linalg.norm(desired)
    best = least(scene.T, target, bounds=(low, 1.0))
    assert error(found, target) - c.gap <= best + 1e-5
    assert c.gap <= max(rtol, 1e-4) * (1 + 1e-6)
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


def test_weights_say_where_it_matters(device):
    scene = lambertian(N, 2.0, seed=9)
    T = ltcl.Transport(scene.T, GRID, device=device)
    desired = 1.5 * random.uniform(0, 1, N) * scene.T.sum(axis=1)
    face = np.where(np.arange(N) < 6, 1.0, 0.01)
    alike, told = (ltcl.compensate(T, desired, weights=w, rtol=1e-3) for w in (None, face))
    there = np.arange(N) < 6
    errors = [np.linalg.norm((c.appearance - desired)[there]) for c in (alike, told)]
    assert errors[1] < errors[0]
    assert told.error == pytest.approx(error(told.appearance, desired, face), rel=1e-4)
    assert told.error == pytest.approx(least(scene.T, desired, face), abs=1e-3)


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
    with pytest.raises(InputError, match=r"method is 'jacobi', but this T has no S .* must be 'auto'"):
        ltcl.compensate(T, np.ones((2, 3)), method="jacobi")
    with pytest.raises(
        InputTypeError, match=r"unknown option 'omega'; for a T without S there are atol, maxiter"
    ):
        ltcl.compensate(T, np.ones((2, 3)), omega=1.5)
    with pytest.raises(InputError, match=r"desired has shape \(4, 6\); it must be \(2, 3\)"):
        ltcl.compensate(T, np.ones(GRID))


def test_a_limit_of_steps_is_told(device):
    scene = lambertian(N, 4.0, seed=2)
    T = ltcl.Transport(scene.T, GRID, device=device)
    desired = 3 * random.uniform(0, 1, N)
    with pytest.raises(ConvergenceError, match="bounded: maxiter after 1 iterations"):
        ltcl.compensate(T, desired, method="direct", rtol=1e-4, maxiter=1)
    c = ltcl.compensate(T, desired, method="direct", rtol=1e-4, maxiter=1, throw=False)
    assert c.gap > 1e-4
    assert not c.limited[0].converged
