# SPDX-License-Identifier: BSD-3-Clause
"""Least squares within bounds: as `scipy.optimize.lsq_linear` finds them, and no certificate that lies."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from ltcl.operators import Dense
from ltcl.solvers import Status
from ltcl.solvers.bounded import minimise
from ltcl.solvers.box import Box
from tests import gallery, reference
from tests.problems import lambertian

random = np.random.default_rng(60)
SHAPES = [(1, 1), (1, 5), (53, 1), (53, 5), (257, 3), (20_001, 1)]


def exact(A: np.ndarray, b: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """The least squares solution of every column in float64, (N, k)."""
    free = lower < upper  # lsq_linear takes no others
    x = np.repeat(lower[:, None], b.shape[1], axis=1).astype(np.float64)
    rest = b - A @ x
    for column, left in zip(x.T, rest.T, strict=True):
        bounds = (np.zeros(free.sum()), (upper - lower)[free])
        column[free] += lsq_linear(A[:, free].astype(np.float64), left, bounds, tol=1e-14).x
    return x


def errors(A: np.ndarray, x: np.ndarray, b: np.ndarray | float, w: np.ndarray | float = 1.0) -> np.ndarray:
    return np.linalg.norm(w * (A.astype(np.float64) @ x.astype(np.float64) - b), axis=0)


def box_of(device, rows: int) -> tuple[np.ndarray, np.ndarray, Box]:
    lower = np.asarray(gallery.vectors(rows, None, 5))
    upper = lower + np.abs(gallery.vectors(rows, None, 6))
    return lower, upper, Box(device.upload(lower), device.upload(upper))


def points(rows: int, k: int, lower: np.ndarray, upper: np.ndarray) -> list[np.ndarray]:
    """x with a third of its entries at each bound; g, d and h of either sign, and 0 here and there."""
    x = lower[:, None] + (upper - lower)[:, None] * random.random((rows, k)).astype(np.float32)
    x = np.where(random.random((rows, k)) < 0.3, lower[:, None], np.minimum(x, upper[:, None]))
    x = np.where(random.random((rows, k)) < 0.3, upper[:, None], x)
    g, d, h = (gallery.vectors(rows, k, seed) for seed in (7, 8, 9))
    g[random.random((rows, k)) < 0.1] = 0
    return [x, g, d, h]


@pytest.mark.parametrize(("rows", "k"), SHAPES)
def test_kernels_meet_their_twins(device, rows, k):
    lower, upper, box = box_of(device, rows)
    x, g, d, h = points(rows, k, lower, upper)
    X, G, D, H = (device.upload(part) for part in (x, g, d, h))
    tolerance = reference.gamma(rows / 4096 + 40) * 4 * rows
    np.testing.assert_allclose(
        box.look(X, G, D, H), reference.bounded_look(lower, upper, x, g, d, h), rtol=0, atol=tolerance
    )
    alpha, beta = np.linspace(0.0, 1.0, k), np.linspace(-1.0, 0.5, k)
    along = box.direction(alpha, beta, X, G, D)
    step, sums = reference.bounded_direction(alpha, beta, lower, upper, x, g, d)
    np.testing.assert_allclose(D.get(), step, rtol=0, atol=1e-6)
    np.testing.assert_allclose(along[:2], sums[:2], rtol=0, atol=tolerance)
    with np.errstate(divide="ignore"):
        np.testing.assert_allclose(along.room, np.maximum(1 / sums[2], 1), rtol=1e-4)
    box.move(beta, D, X)
    np.testing.assert_allclose(
        X.get(), reference.bounded_move(beta, lower, upper, step, x), rtol=0, atol=1e-6
    )
    assert (X.get() >= lower[:, None]).all()
    assert (X.get() <= upper[:, None]).all()


@pytest.mark.parametrize("rho", [0.8, 4.0])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("bright", [0.5, 1.0, 2.0])
def test_it_finds_the_least_squares(device, rho, weighted, bright):
    S = lambertian(60, rho, seed=3).S.astype(np.float32)
    lower, upper = np.zeros(60), random.uniform(0.3, 0.9, 60)
    lower[5] = upper[5] = 0.0  # a masked pixel
    b = bright * (S @ np.clip(random.uniform(-0.5, 1.2, (60, 3)), -0.3, 1.0))
    w = random.uniform(0.0, 2.0, (60, 3)) if weighted else np.ones((60, 3))
    s = minimise(
        Dense(device, S), b, lower, upper, np.zeros((60, 3)), weights=w if weighted else None, rtol=1e-5
    )
    wanted = np.column_stack(
        [exact(w[:, [c]] * S, w[:, [c]] * b[:, [c]], lower, upper)[:, 0] for c in range(3)]
    )
    least = errors(S, wanted, b, w)
    scale = np.linalg.norm(w * b, axis=0)
    assert s.status is Status.CONVERGED
    assert s.gap <= 1e-5
    assert (errors(S, s.x, b, w) <= least + 2e-5 * scale).all()
    np.testing.assert_allclose(s.errors, errors(S, s.x, b, w), rtol=1e-4, atol=1e-6)
    assert (s.least <= least + 1e-6 * scale).all()
    # Held are those that the exact solution leaves at a bound; where w is small it hardly matters.
    outside = np.isclose(wanted, lower[:, None]) | np.isclose(wanted, upper[:, None])
    assert np.mean(s.held != (outside & (lower < upper)[:, None])) < 0.03


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    shape=st.sampled_from([(1, 1), (3, 7), (7, 3), (20, 20), (40, 25)]),
    k=st.integers(1, 3),
    scale=st.sampled_from([1e-12, 1.0, 1e9]),
)
def test_never_above_the_start_and_never_certified_too_low(device, seed, shape, k, scale):
    """Of any matrix: each certificate holds, at whatever step the solve is cut off."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=shape).astype(np.float32)
    b = scale * rng.normal(size=(shape[0], k))
    lower = scale * rng.uniform(-1, 0.5, shape[1])
    upper = lower + scale * rng.uniform(0, 1, shape[1])
    x0 = scale * rng.normal(size=(shape[1], k))
    s = minimise(Dense(device, A), b, lower, upper, x0, rtol=1e-5, maxiter=int(rng.choice([1, 2, 5, 200])))
    found = errors(A, s.x, b)
    rounding = 1e-5 * (np.linalg.norm(b, axis=0) + scale)
    best = errors(A, exact(A / 1.0, b / scale, lower / scale, upper / scale) * scale, b)
    assert (found <= errors(A, np.clip(x0, lower[:, None], upper[:, None]), b) + rounding).all()
    assert (s.least <= best + rounding).all()
    assert (s.x >= lower.astype(np.float32)[:, None]).all()
    assert (s.x <= upper.astype(np.float32)[:, None]).all()


def test_a_target_within_reach_costs_no_step(device):
    S = lambertian(30, 0.8).S.astype(np.float32)
    x = random.uniform(0.1, 0.9, (30, 2))
    s = minimise(Dense(device, S), S @ x, np.zeros(30), np.ones(30), x)
    assert (s.iterations, s.status, s.products) == (0, Status.CONVERGED, 2)
    assert not s.held.any()


@pytest.mark.parametrize("far", [1e3, 1e9, 1e30])
def test_a_bound_that_means_none_hides_nothing(device, far):
    """The certificate is worth little then, the answer is not."""
    S = lambertian(30, 2.0).S.astype(np.float32)
    b = S @ random.uniform(-0.5, 1.0, (30, 1))
    s = minimise(Dense(device, S), b, np.zeros(30), np.full(30, far), np.zeros((30, 1)), rtol=1e-4)
    best = errors(S, exact(S, b, np.zeros(30), np.full(30, 10.0)), b)
    assert (errors(S, s.x, b) <= best * (1 + 1e-4)).all()
    assert (s.least <= best * (1 + 1e-6)).all()


def test_black_is_reached_by_the_darkest_light(device):
    """b = 0 has no norm to be relative to."""
    S = lambertian(30, 0.8).S.astype(np.float32)
    s = minimise(Dense(device, S), np.zeros((30, 1)), np.full(30, 0.1), np.ones(30), np.ones((30, 1)))
    assert s.converged
    assert s.errors[0] <= 1.01 * errors(S, np.full((30, 1), 0.1), 0.0)[0]


def test_what_ends_a_solve(device):
    S = lambertian(40, 4.0).S.astype(np.float32)
    b = S @ random.uniform(-1, 2, (40, 1))
    seen: list[float] = []
    arguments = (Dense(device, S), b, np.zeros(40), np.ones(40), np.zeros((40, 1)))
    s = minimise(*arguments, rtol=1e-4, maxiter=3, callback=lambda i, gap: seen.append(gap))
    assert (s.status, s.iterations, len(seen)) == (Status.MAXITER, 3, 4)
    assert s.residuals[-1] < s.residuals[0]
    s = minimise(*arguments, rtol=1e-12)
    assert s.status is Status.STAGNATED  # float32 cannot certify that
    assert s.gap < 1e-5
    assert (errors(S, s.x, b) <= errors(S, exact(S, b, np.zeros(40), np.ones(40)), b) * (1 + 1e-6)).all()
