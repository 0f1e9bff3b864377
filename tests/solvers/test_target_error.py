# SPDX-License-Identifier: BSD-3-Clause
"""A target error is met at every pixel, without bias, or said to be missed; what is unknown is no zero."""

from __future__ import annotations

import re
import warnings
from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.operators import CSR, Dense, IdentityPlus
from ltcl.operators.alias import tables
from ltcl.operators.walks import Walker, geometric
from ltcl.solvers import Solution, Status
from ltcl.solvers.noise import Noise
from ltcl.solvers.target_error import sample_to
from tests.problems import lambertian

CORNER = ltcl.scenes.box(6, sides=3, albedo=0.4)


def error_of(solution: Solution) -> np.ndarray:
    assert solution.standard_error is not None
    return solution.standard_error.astype(np.float64)


def corner(lights: int) -> tuple[Any, np.ndarray, np.ndarray]:
    """S of a corner, some lights of 108 pixels, and the solution in float64."""
    S = CORNER.transport().systems[0]
    b = np.zeros(108)
    b[np.random.default_rng(5).choice(108, lights, replace=False)] = 1.0
    return S, b, np.linalg.solve(S.to_dense().astype(float), b)


@pytest.mark.parametrize("lights", [1, 4, 108])
def test_the_error_is_met_at_every_pixel_however_few_the_lights(lights):
    S, b, exact = corner(lights)
    found = ltcl.solve(S, b, "monte_carlo", error=2e-3)
    error, off = error_of(found), np.abs(found.x - exact)
    assert np.all((error > 0) & (error <= 2e-3))
    assert np.sqrt(np.mean(off**2)) <= 2e-3
    assert np.mean(off <= 1.96 * error) > 0.88  # 95 % of 108 pixels, less three standard deviations
    assert off.max() <= 5 * 2e-3
    assert "error=0.002 met by " in found.reason


def test_one_dark_pixel_alone_is_as_good_as_the_error_asks_for():
    S, b, exact = corner(1)
    for pixel in range(0, 108, 12):
        found = ltcl.solve(S, b, "monte_carlo", error=1e-3, pixels=[pixel])
        assert 0 < error_of(found)[0] <= 1e-3
        assert abs(found.x[0] - exact[pixel]) <= 5e-3


@pytest.mark.parametrize("samples", [2, 64])
def test_what_no_walk_has_met_is_part_of_the_error(samples):
    S, b, exact = corner(1)
    tried: list[dict[str, Any]] = [{}, {"gather": True}]
    for options in tried:
        found = ltcl.solve(S, b, "monte_carlo", samples=samples, **options)
        off = np.abs(found.x - exact)
        assert off.max() > 10 * np.median(off)  # few have met it
        assert np.mean(off <= 2 * error_of(found)) > 0.93
    assert np.abs(exact).min() > 0


def test_a_single_sample_tells_nothing():
    S, b, _ = corner(1)
    assert not np.isfinite(error_of(ltcl.solve(S, b, "monte_carlo", samples=1))).any()


def test_where_no_light_can_come_the_error_is_zero_and_nothing_is_spent():
    """Two rooms without a door, one of them dark."""
    R = np.zeros((40, 40))
    R[:20, :20] = R[20:, 20:] = lambertian(20, 0.5).R
    b = np.where(np.arange(40) < 20, 1.0, 0.0)
    b[3] = 0.0
    tried: list[dict[str, Any]] = [{}, {"error": 0.01}, {"adjoint": True}, {"estimator": "endpoint"}]
    tried += [{"gather": True}, {"series": "chebyshev"}]
    for one in tried:
        found = ltcl.solve(np.eye(40) + R, b, "monte_carlo", **one)
        assert not error_of(found)[20:].any()
        assert not found.x[20:].any()
        assert np.all(error_of(found)[:20] > 0)
    alone = ltcl.solve(np.eye(40) + R, b, "monte_carlo", error=0.01, pixels=[30])
    assert alone.reason.endswith("512 in all")


def test_a_choiceless_pixel_is_certain_and_a_lucky_one_is_not(device):
    R = CSR(device, scipy.sparse.csr_array([[0.0, 0.5, 0.0], [0.0, 0.0, 0.0], [1e-6, 0.5, 0.0]]))
    b = np.array([1e3, 1.0, 1.0])
    exact = np.linalg.solve(np.eye(3) + R.to_dense(), b)
    found = ltcl.solve(IdentityPlus(R), b, "monte_carlo", samples=64)
    np.testing.assert_allclose(found.x[:2], [999.5, 1.0])
    assert error_of(found)[:2].tolist() == [0.0, 0.0]
    assert abs(found.x[2] - exact[2]) <= 2 * error_of(found)[2]


def test_stopping_by_the_spread_leaves_no_bias(device):
    """Skewed scores: where few have met light, those with the smallest spread have the smallest mean."""
    scene = lambertian(20, rho=0.5)
    b = np.zeros((20, 1))
    b[7] = 1.0
    R = Dense(device, scene.R)
    walker, light = Walker(tables(R), geometric(0.5, -1.0), "collision", 0), device.upload(b)
    noise = Noise([(R, b)], tables(R), walker.lengths, "collision")
    exact = (np.linalg.solve(scene.S, b) - b)[:, 0]
    z = []
    for seed in range(60):
        one = Walker(walker.tables, walker.lengths, "collision", seed)
        found = sample_to(one, light, np.arange(20), np.array([5e-3]), 1 << 20, noise.errors)
        assert found.met.all()
        assert np.all(found.samples > 512)
        z.append((found.mean[:, 0] - exact) / found.standard_error[:, 0])
    assert abs(np.mean(z)) < 4 / len(np.ravel(z)) ** 0.5
    assert np.std(z) == pytest.approx(1.0, abs=4 / (2 * len(np.ravel(z))) ** 0.5 + 0.03)


@pytest.mark.parametrize(("options", "says"), [
    ({"samples": 512}, r"43 of 43 pixels missed error=1e-09 within 512 samples: allow more samples="),
    ({"samples": 100, "pixels": [3, 4]}, r"2 of 2 pixels missed error=1e-09 within 100 samples"),
])  # fmt: skip
def test_a_missed_error_is_told_and_never_converged(options, says):
    scene = lambertian(43, rho=0.6, density=0.7)
    found = ltcl.solve(scene.S, np.ones(43), "monte_carlo", rtol=0.9, error=1e-9, **options)
    assert found.status is Status.SAMPLED
    assert not np.any(error_of(found) <= 1e-9)
    assert ltcl.solve(scene.S, np.ones(43), "monte_carlo", rtol=0.9, error=0.1).converged
    assert re.search(says, found.reason)
    assert re.search(says, str(found))


def test_few_lights_that_missed_are_told_of_the_adjoint():
    S, b, _ = corner(1)
    found = ltcl.solve(S, b, "monte_carlo", error=1e-6, samples=1024)
    assert "108 of 108 pixels missed error=1e-06 within 1024 samples: adjoint=True suits few lights" in str(
        found
    )


@pytest.mark.parametrize("error", [1e-300, 5e-324, 1e-30])
def test_no_error_is_too_small_to_count_with(error):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = ltcl.solve(lambertian(9, 0.3).S, np.ones(9), "monte_carlo", error=error, samples=600)
    assert found.status is Status.SAMPLED


def test_the_samples_of_all_stages_are_told(monkeypatch):
    drawn = []
    rows = Walker.rows

    def spy(self: Walker, b: Any, pixels: np.ndarray, first: int, samples: int, stream: int = 0) -> Any:
        drawn.append((len(pixels) * samples, stream))
        return rows(self, b, pixels, first, samples, stream)

    monkeypatch.setattr(Walker, "rows", spy)
    S, b, _ = corner(4)
    found = ltcl.solve(S, b, "monte_carlo", error=5e-3)
    total = sum(count for count, _ in drawn)
    assert f"{total / 108:.3g} samples a pixel, {total:.3g} in all" in found.reason
    assert len({stream for _, stream in drawn}) > 2


@pytest.mark.parametrize(
    ("options", "advice"), [({"rtol": 0.05}, "lower rtol="), ({"degree": 3}, "raise degree=")]
)
def test_an_error_that_the_series_exceeds_is_met_by_the_noise_alone(options, advice):
    S = ltcl.scenes.box(5, sides=6, albedo=0.6).transport().systems[0]
    b = 1e3 * np.random.default_rng(0).random(150)
    exact = np.linalg.solve(S.to_dense().astype(float), b)
    found = ltcl.solve(S, b, "monte_carlo", series="chebyshev", error=10.0, **options)
    said = re.search(
        r"met by the noise alone, with .*; the series may be off by up to (\S+) in", found.reason
    )
    assert said is not None
    assert found.reason.endswith(f"over pixels: {advice}")
    assert float(said[1]) > 10.0
    assert np.sqrt(np.mean((found.x - exact) ** 2)) <= float(said[1]) + 10.0
    assert found.status is Status.SAMPLED
    enough = ltcl.solve(S, b, "monte_carlo", series="chebyshev", error=300.0, **options)
    assert "alone" not in enough.reason
