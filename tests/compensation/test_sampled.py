# SPDX-License-Identifier: BSD-3-Clause
"""Compensation by methods that sample: what is reported holds, noise included."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear

import ltcl
from ltcl.errors import InputTypeError
from ltcl.solvers import Status
from tests.problems import lambertian

GRID = (4, 5)
SCENE = lambertian(20, 0.6, seed=90)
METHODS = ["monte_carlo", "hybrid"]
random = np.random.default_rng(91)
PATTERN = random.uniform(0.3, 0.9, 20)


@pytest.fixture(scope="module")
def T(device):
    return ltcl.Transport(SCENE.T, GRID, device=device)


def off(c: ltcl.Compensation) -> float:
    """The relative error, in float64."""
    target = c.target.ravel().astype(float)
    return float(np.linalg.norm(SCENE.T @ c.pattern.ravel().astype(float) - target) / np.linalg.norm(target))


@pytest.mark.parametrize("method", METHODS)
def test_noise_is_told_and_falls_with_the_samples(T, method):
    desired = (SCENE.T @ PATTERN).reshape(GRID)
    few, many = (ltcl.compensate(T, desired, bounds=(-9, 9), method=method, samples=n) for n in (8, 2048))
    for c in (few, many):
        assert c.error == pytest.approx(off(c), rel=1e-3)
        assert c.gap == pytest.approx(c.error, rel=1e-3)  # an error of 0 is within reach
        assert c.limited == ()
    assert many.error < few.error / 6  # 16 expected
    assert isinstance(few.solution, ltcl.Solution)
    assert few.solution.status is Status.SAMPLED


@pytest.mark.parametrize("method", METHODS)
def test_where_bounds_hold_the_pattern_is_the_best_within_them(T, method):
    """Whatever the noise of the light without bounds: it is only where the search begins."""
    desired = (SCENE.T @ np.where(PATTERN > 0.5, 1.6 * PATTERN, 0.0)).reshape(GRID)
    c = ltcl.compensate(T, desired, method=method, samples=4, rtol=1e-3)
    best = np.sqrt(2 * lsq_linear(SCENE.T, desired.ravel(), (0, 1), tol=1e-14).cost) / np.linalg.norm(desired)
    assert best > 0.01
    assert len(c.limited) == 1
    assert best * (1 - 1e-4) <= off(c) <= best + 1e-3
    assert c.error == pytest.approx(off(c), rel=1e-3)


def test_the_standard_error_at_a_gain_covers_both_parts(T):
    """Desired and background share their walks: their errors add at worst, and never cancel by more."""
    desired, background = (SCENE.T @ PATTERN).reshape(GRID), np.full(GRID, 0.05)
    runs = [
        ltcl.compensate(
            T,
            desired,
            background=background,
            bounds=(-9, 1),
            gain="auto",
            method="monte_carlo",
            samples=64,
            seed=s,
        )
        for s in range(40)
    ]
    residuals, allowed = [], []
    for c in runs:
        assert isinstance(c.solution, ltcl.Solution)
        assert c.solution.standard_error is not None
        exact = np.linalg.solve(SCENE.S, c.gain * desired.ravel() - background.ravel())
        residuals.append(c.solution.x[:, 0] - exact)
        allowed.append(c.solution.standard_error[:, 0])
    ratio = np.sqrt(np.mean(np.square(residuals)) / np.mean(np.square(allowed)))
    assert 0.6 < ratio < 1.15


@pytest.mark.parametrize("task", [ltcl.compensate, ltcl.separate])
@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"method": "monte_carlo", "pixels": [1, 2]}, "pixels"),
        ({"method": "jacobi", "samples": 3}, "samples.*'jacobi'"),
        ({"method": "jacobi", "seed": 3}, "seed.*'jacobi'"),
    ],
)
def test_options_that_fit_no_picture_or_no_method_are_refused(T, task, options, says):
    with pytest.raises(InputTypeError, match=says):
        task(T, np.full(GRID, 0.2), **options)
