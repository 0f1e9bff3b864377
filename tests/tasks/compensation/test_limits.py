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
from ltcl.errors import ConvergenceError, LtclError
from ltcl.solvers import Status
from tests.problems import lambertian

GRID = (4, 6)
N = 24
random = np.random.default_rng(70)


def least_error(
    T: np.ndarray, target: np.ndarray, weights: np.ndarray | float = 1.0, bounds=(0.0, 1.0)
) -> float:
    """min ||W (T p - target)|| / ||W target|| of one column."""
    w = np.broadcast_to(weights, target.shape)
    p = lsq_linear(w[:, None] * T, w * target, bounds, tol=1e-14).x
    return error(T @ p, target, w)


def error(seen: np.ndarray, target: np.ndarray, weights: np.ndarray | float = 1.0) -> float:
    return float(np.linalg.norm(weights * (seen - target)) / np.linalg.norm(weights * target))


@pytest.mark.slow
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
    """The claim of `compensate`, and of its certificate, over random scenes."""
    rng = np.random.default_rng(seed)
    scene = lambertian(N, rho, seed=seed % 50, density=rng.choice([0.1, 1.0]))
    low, high = bounds
    desired = bright * high * rng.uniform(0, 1, N) ** rng.choice([1, 3]) * scene.T.sum(axis=1)
    background = ambient * rng.uniform(0, 1, N)
    T = ltcl.Transport(scene.T, GRID, device=device)
    c = ltcl.compensate(
        T, desired, background=background, bounds=bounds, method="direct", rtol=rtol
    )
    clamped = scene.T @ np.clip(np.linalg.solve(scene.T, desired - background), low, high)
    found = scene.T @ c.pattern.astype(float)
    target = desired - background
    size = np.linalg.norm(desired)
    assert np.linalg.norm(found - target) <= np.linalg.norm(clamped - target) + 2e-5 * size
    best = least_error(scene.T, target, bounds=bounds)
    # Error and gap are relative to desired.
    share = np.linalg.norm(target) / size
    assert c.error - c.gap <= best * share + 1e-5
    assert c.gap <= max(rtol * share, 1e-4) * (1 + 1e-5)
    assert low <= c.pattern.min() <= c.pattern.max() <= high
    at_bound = (c.pattern == np.float32(low)) | (c.pattern == np.float32(high))
    assert c.clipped <= at_bound.mean() + 1e-12
    assert c.error == pytest.approx(np.linalg.norm(found - target) / size, abs=1e-5)


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
    best = least_error(matrix[:, lit], desired)
    assert error(counted.appearance, desired) == pytest.approx(best, abs=2e-4)
    assert counted.pattern[5] == silent.pattern[5] == 0.0


@pytest.mark.parametrize("form", [np.asarray, scipy.sparse.csr_array, aslinearoperator])
@pytest.mark.parametrize("camera", [(6, 10), (3, 4)])
def test_rectangular_T_in_the_least_squares_sense(device, camera, form):
    """More camera pixels than projector pixels, and fewer; one projector pixel lights nothing."""
    matrix = random.uniform(0, 1, (camera[0] * camera[1], N)) * random.uniform(0.01, 1, N)
    matrix[:, 7] = 0.0
    T = ltcl.Transport(form(matrix), GRID, camera_grid=camera, device=device)
    desired = random.uniform(0, 1, (*camera, 3)) * matrix.sum(axis=1).reshape(*camera, 1)
    c = ltcl.compensate(T, desired, rtol=1e-4)
    assert c.pattern.shape == (*GRID, 3)
    assert c.appearance.shape == c.target.shape == c.out_of_reach.shape == desired.shape
    for target, pattern in zip(desired.reshape(-1, 3).T, c.pattern.reshape(N, 3).T, strict=True):
        assert error(matrix @ pattern.astype(float), target) == pytest.approx(
            least_error(matrix, target), abs=2e-4
        )
        assert pattern[7] == 0.0
    assert c.solution is c.limited[0]
    flat = ltcl.compensate(T, desired[..., 0].ravel(), bounds=(0.1, 1))
    assert flat.pattern.shape == (N,)
    assert flat.pattern[7] == np.float32(0.1)


@pytest.mark.parametrize(
    ("desired", "options", "says"),
    [
        ((2, 3), {"method": "jacobi"}, "method"),
        ((2, 3), {"clamp": True}, "clamp"),
        ((2, 3), {"x0": 0}, "x0"),
        (GRID, {}, r"desired .*\(4, 6\).*\(2, 3\)"),
    ],
)
def test_a_rectangular_T_has_no_method_of_solve(desired, options, says):
    T = ltcl.Transport(np.ones((6, N)), GRID, camera_grid=(2, 3), device="there is no such device")
    with pytest.raises(LtclError, match=says):
        ltcl.compensate(T, np.ones(desired), **options)


def test_a_limit_of_steps_raises_or_leaves_a_gap(device):
    T = ltcl.Transport(lambertian(N, 4.0, seed=2).T, GRID, device=device)
    desired = 3 * random.uniform(0, 1, N)
    with pytest.raises(ConvergenceError):
        ltcl.compensate(T, desired, method="direct", rtol=1e-4, maxiter=1)
    c = ltcl.compensate(T, desired, method="direct", rtol=1e-4, maxiter=1, throw=False)
    assert c.gap > 1e-4
    assert not c.limited[0].converged


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bounds", "gain"), [((0.1, 0.6), 1.0), ((0.0, 1.0), 2.0), ((0.0, 1.0), 1.0)]
)
def test_clipped_is_of_the_pattern_that_comes_back(device, bounds, gain):
    """Against the gradient in float64: at a bound, and the error falls beyond it."""
    closed = ltcl.scenes.box(8, sides=6, albedo=0.8).transport(device=device)
    desired = 0.05 + 1.5 * np.random.default_rng(1).random(closed.grid)
    c = ltcl.compensate(closed, desired, bounds=bounds, gain=gain)
    T = np.asarray(closed.matrices[0], np.float64)
    p = c.pattern.ravel().astype(np.float64)
    slope = T.T @ (T @ p - gain * desired.ravel())
    is_low = p == np.float32(bounds[0])
    is_high = p == np.float32(bounds[1])
    is_clipped = (is_low & (slope > 0)) | (is_high & (slope < 0))
    assert c.clipped == pytest.approx(is_clipped.mean(), abs=0.01)
    assert 0.1 < c.clipped <= (is_low | is_high).mean() + 1e-12


def test_nothing_clipped_is_nothing_out_of_reach(device):
    """The solve leaves an error up to its tolerance, here a few pixels of far more."""
    scene = lambertian(N, 2.0, seed=9)
    T = ltcl.Transport(scene.T, GRID, device=device)
    c = ltcl.compensate(
        T, scene.T @ random.uniform(0.2, 0.8, N), method="jacobi", rtol=0.5, throw=False
    )
    assert c.clipped == 0.0
    assert c.error > 1e-3
    assert not c.out_of_reach.any()


def test_out_of_reach_leaves_out_what_the_tolerance_explains(device):
    scene = lambertian(N, 0.5, seed=9)
    T = ltcl.Transport(scene.T, GRID, device=device)
    desired = 0.5 * scene.T.sum(axis=1)
    desired[3] *= 4
    explained = 3 * 1e-2 * np.sqrt(np.mean(desired**2))
    c = ltcl.compensate(T, desired, rtol=1e-2)
    weights = np.ones(N)
    weights[3] = 0.0
    silent = ltcl.compensate(T, desired, weights=weights, rtol=1e-2)
    missing = c.target.astype(float) - c.appearance
    expected = np.where(np.abs(missing) > explained, missing, 0)
    np.testing.assert_allclose(c.out_of_reach, expected, atol=1e-5 * desired.max())
    assert c.out_of_reach[3] > 0.0 == silent.out_of_reach[3]
    assert silent.clipped > 0.0
    assert abs(silent.target[3] - silent.appearance[3]) > explained


# Methods that sample: what is reported holds, noise included.

NOISY = lambertian(N, 0.6, seed=90)
PATTERN = np.random.default_rng(91).uniform(0.3, 0.9, N)


@pytest.mark.parametrize("method", ["monte_carlo", "hybrid"])
def test_noise_is_reported_and_falls_with_the_samples(device, method):
    """Within bounds, the noisy light without them is only where the search begins."""
    T = ltcl.Transport(NOISY.T, GRID, device=device)
    desired = NOISY.T @ PATTERN
    few = ltcl.compensate(T, desired, bounds=(-9, 9), method=method, samples=8)
    many = ltcl.compensate(T, desired, bounds=(-9, 9), method=method, samples=2048)
    for c in (few, many):
        assert c.error == pytest.approx(error(NOISY.T @ c.pattern.astype(float), desired), rel=1e-3)
        # An error of 0 is within reach.
        assert c.gap == pytest.approx(c.error, rel=1e-3)
        assert c.limited == ()
    # 16 is expected.
    assert many.error < few.error / 6
    assert isinstance(few.solution, ltcl.Solution)
    assert few.solution.status is Status.SAMPLED

    desired = NOISY.T @ np.where(PATTERN > 0.5, 1.6 * PATTERN, 0.0)
    c = ltcl.compensate(T, desired, method=method, samples=4, rtol=1e-3)
    best = least_error(NOISY.T, desired)
    assert best > 0.01
    assert len(c.limited) == 1
    assert best * (1 - 1e-4) <= error(NOISY.T @ c.pattern.astype(float), desired) <= best + 1e-3


def test_the_standard_error_at_a_gain_covers_both_parts(device):
    """Desired and background share their walks: errors add at worst, and never cancel by more."""
    T = ltcl.Transport(NOISY.T, GRID, device=device)
    desired = NOISY.T @ PATTERN
    background = np.full(N, 0.05)
    deviations = 0.0
    variances = 0.0
    for seed in range(40):
        c = ltcl.compensate(
            T,
            desired,
            background=background,
            bounds=(-9, 1),
            gain="auto",
            method="monte_carlo",
            samples=64,
            seed=seed,
        )
        assert isinstance(c.solution, ltcl.Solution)
        assert c.solution.standard_error is not None
        exact = np.linalg.solve(NOISY.S, c.gain * desired - background)
        deviations += np.sum((c.solution.x[:, 0] - exact) ** 2)
        variances += np.sum(c.solution.standard_error[:, 0] ** 2)
    assert 0.6 < np.sqrt(deviations / variances) < 1.15


@pytest.mark.parametrize("largest", [1.0, 0.99, 0.3, 5.0, 1e-6])
@pytest.mark.parametrize("frames", [None, 2])
def test_the_error_of_a_black_target_is_not_relative(device, largest, frames):
    """No pattern has an error below error - gap, whatever the unit of the weights."""
    T = ltcl.Transport(0.5 * np.eye(6) + 0.02, (2, 3), device=device)
    shape = (2, 3) if frames is None else (frames, 2, 3)
    weights = largest * np.linspace(0.5, 1.0, 6).reshape(2, 3)
    c = ltcl.compensate(T, np.zeros(shape), background=0.02, weights=weights)
    errors = weights * (T @ c.pattern + 0.02)
    assert c.error == pytest.approx(np.linalg.norm(errors), rel=1e-4)
    expected = np.linalg.norm(errors.reshape(-1, 6), axis=1)
    np.testing.assert_allclose(c.frame_errors, expected, rtol=1e-4)
    assert 0 <= c.gap < 1e-3 * c.error


def equal_columns(T: np.ndarray) -> np.ndarray:
    T[:, 5] = T[:, 6]
    return T


def equal_rows(T: np.ndarray) -> np.ndarray:
    T[5] = T[6]
    return T


def low_rank(T: np.ndarray) -> np.ndarray:
    return T[:, :8] @ T[:8]


@pytest.mark.parametrize("damage", [equal_columns, equal_rows, low_rank])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("throw", [True, False])
def test_a_singular_T_has_a_best_pattern_within_the_bounds(device, damage, channels, throw):
    matrix = damage(ltcl.scenes.dihedral(4, albedo=0.5).transport().to_numpy().astype(float))
    matrices = [matrix, 0.5 * matrix, 0.3 * matrix][:channels]
    T = ltcl.Transport(matrices, (4, 8), device=device)
    shape = (4, 8) if channels == 1 else (4, 8, 3)
    desired = np.random.default_rng(0).uniform(0.05, 0.2, shape)
    c = ltcl.compensate(T, desired, throw=throw)
    squares = 0.0
    for M, d in zip(matrices, desired.reshape(32, channels).T, strict=True):
        squares += 2.0 * lsq_linear(M, d, (0, 1)).cost
    best = np.sqrt(squares) / np.linalg.norm(desired)
    assert best * (1 - 1e-4) <= c.error <= best + c.rtol
    assert c.error - c.gap <= best * (1 + 1e-4)
    largest = ltcl.compensate(T, desired, gain="auto", loss=0.95)
    assert largest.error <= 0.95 * (1 + 1e-4)
    with pytest.raises(ConvergenceError):
        ltcl.compensate(T, desired, clamp=True)


def test_light_that_rounding_leaves_beside_a_bound_is_clipped(device):
    """All values are at a bound, beyond which the error would fall."""
    random = np.random.default_rng(0)
    T = 0.04 * random.random((3, 12, 12)) + np.diag(random.uniform(0.3, 0.9, 12))
    mixing = np.array([[1.0, 0.1, 0.05], [0.1, 1.0, 0.1], [0.02, 0.1, 1.0]])
    transport = ltcl.Transport(T, grid=(3, 4), mixing=mixing, device=device)
    desired = random.uniform(0.2, 0.9, (3, 4, 3))
    desired[..., 0] *= 1e4
    c = ltcl.compensate(transport, desired, bounds=(-0.5, 1.0), rtol=1e-6)
    missing = desired.reshape(12, 3) - c.appearance.reshape(12, 3)
    gradient = np.einsum("cmn,mc->nc", T, missing) @ mixing
    assert gradient.min() > 0.0
    assert np.all(c.pattern == 1.0)
    assert c.clipped == 1.0


def test_a_black_target_and_bounds_below_0_say_nothing_of_units(device, caplog):
    T = ltcl.Transport(np.eye(4) + 0.1, grid=(2, 2), device=device)
    ltcl.compensate(T, np.zeros((2, 2)), bounds=(-1.0, -0.2))
    assert "desired reaches" not in caplog.text
