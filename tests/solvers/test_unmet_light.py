# SPDX-License-Identifier: BSD-3-Clause
"""Standard errors hold however the light is spread, also where no walk has met most of it."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.operators import CSR, Dense, IdentityPlus, as_operator
from ltcl.operators.alias import tables, tables_of_columns
from ltcl.operators.links import links
from ltcl.solvers import Solution
from ltcl.theory.unmet import Weights, largest_square
from ltcl.theory.walks import growth_of_weights
from tests import gallery
from tests.problems import lambertian

S = ltcl.scenes.box(10, sides=3, albedo=0.4).transport().systems[0]
N = 300
DENSE = S.to_dense().astype(float)


def _light(lights: int, ambient: float) -> np.ndarray:
    b = np.full(N, ambient)
    b[np.random.default_rng(lights).choice(N, lights, replace=False)] = 1.0
    return b


LIGHT = {
    "dense": np.random.default_rng(0).random(N),
    "one": _light(1, 0.0),
    "one in 1e-3": _light(1, 1e-3),
    "one in 1e-6": _light(1, 1e-6),
    "24": _light(24, 0.0),
}
VARIANTS: dict[str, dict[str, Any]] = {
    "collision": {},
    "endpoint": {"estimator": "endpoint"},
    "polynomial": {"series": "chebyshev", "degree": 6},
    "adjoint": {"adjoint": True},
}


def error_of(solution: Solution) -> np.ndarray:
    assert solution.standard_error is not None
    return solution.standard_error.astype(np.float64)


def covered(found: Solution, exact: np.ndarray) -> float:
    return float(np.mean(np.abs(found.x - exact) <= 2 * error_of(found)))


@pytest.mark.parametrize("samples", [64, 256])
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("light", LIGHT)
def test_two_standard_errors_hold_at_the_share_they_promise(light, variant, samples):
    b = LIGHT[light]
    exact = np.linalg.solve(DENSE, b)
    runs = [ltcl.solve(S, b, "monte_carlo", samples=samples, seed=s, **VARIANTS[variant]) for s in range(6)]
    assert np.mean([covered(run, exact) for run in runs]) >= 0.93
    assert not any(np.isnan(error_of(run)).any() for run in runs)


@pytest.mark.parametrize("light", LIGHT)
def test_an_error_that_is_met_is_no_more_than_a_few_times_as_large(light):
    b = LIGHT[light]
    exact, error = np.linalg.solve(DENSE, b), 1e-2 if light == "dense" else 1e-3
    found = ltcl.solve(S, b, "monte_carlo", error=error)
    assert f"error={error:g} met by" in found.reason
    assert np.abs(found.x - exact).max() <= 5 * error
    assert covered(found, exact) >= 0.93


def test_ordinary_pictures_have_the_errors_that_their_runs_show():
    b = LIGHT["dense"]
    runs = [ltcl.solve(S, b, "monte_carlo", seed=s) for s in range(16)]
    x = np.stack([run.x for run in runs]).astype(float)
    said = np.sqrt(np.mean([error_of(run) ** 2 for run in runs], axis=0))
    assert 0.9 < np.sqrt(np.mean((x.std(axis=0, ddof=1) / said) ** 2)) < 1.1


@pytest.mark.parametrize("samples", [64, 256, 4096])
def test_a_weak_entry_of_a_bright_pixel_is_part_of_every_error(device, samples):
    R = np.random.default_rng(1).random((60, 60))
    R *= 0.4 / R.sum(axis=1, keepdims=True)
    R[:, 7] = 1e-5
    b = np.where(np.arange(60) == 7, 1000.0, np.random.default_rng(2).random(60))
    exact = np.linalg.solve(np.eye(60) + R, b)
    system = IdentityPlus(Dense(device, R))
    runs = [ltcl.solve(system, b, "monte_carlo", samples=samples, seed=s) for s in range(6)]
    assert np.mean([covered(run, exact) for run in runs]) >= 0.93


def test_a_single_hit_is_no_certainty(device):
    """One of 60 entries is lit: of 24 samples often one alone meets it, each pixel by itself."""
    R = np.full((60, 60), 0.3 / 60)
    b = np.where(np.arange(60) == 7, 1.0, 0.0)
    exact = np.linalg.solve(np.eye(60) + R, b)
    system = IdentityPlus(Dense(device, R))
    runs = [ltcl.solve(system, b, "monte_carlo", samples=24, seed=s) for s in range(6)]
    assert np.mean([covered(run, exact) for run in runs]) >= 0.93
    for run in runs:
        single = np.isclose(error_of(run), 2 * np.abs(run.x - b), rtol=0.2)  # 1 + 3 in place of 1
        assert np.mean(single) > 0.1


def test_channels_that_share_walks_have_bounds_of_their_own(device):
    Rs = [lambertian(43, rho, density=0.7).R for rho in (0.6, 0.05, 0.5)]
    systems = tuple(IdentityPlus(Dense(device, R)) for R in Rs)
    b = np.full((3, 43), 1e-4)
    b[[0, 1, 2], [4, 17, 30]] = (1.0, 1.0, 0.01)
    exact = np.stack([np.linalg.solve(np.eye(43) + R, light) for R, light in zip(Rs, b, strict=True)])
    runs = [ltcl.solve(systems, b, "monte_carlo", samples=64, seed=s) for s in range(8)]
    for c in range(3):
        within = [np.abs(run.x[c] - exact[c]) <= 2 * error_of(run)[c] for run in runs]
        assert np.mean(within) >= 0.93
    means = error_of(runs[0]).mean(axis=1)
    assert means[1] < 0.3 * means[0]  # darker walls
    assert means[2] < 0.1 * means[0]  # darker light


@pytest.mark.parametrize("form", ["csr", "dense"])
def test_weights_grow_by_the_powers_of_their_moments(device, form):
    R = gallery.sparse(31, 31, 0.4, seed=4).toarray() / 6
    M = CSR(device, scipy.sparse.csr_array(R)) if form == "csr" else Dense(device, R)
    R = np.abs(R.astype(float))
    entries = (R != 0).sum(axis=1) if form == "csr" else np.full(31, 31)
    alike = tuple(Dense(device, factor * R) for factor in (1.0, 1.0, 1.0))
    for found, Q in [
        (growth_of_weights(M, tables(M)), R.sum(axis=1)[:, None] * R),
        (growth_of_weights(M, tables(M, "uniform")), entries[:, None] * R**2),
        (growth_of_weights(M, tables_of_columns(M), True), R.sum(axis=0)[:, None] * R.T),
        (growth_of_weights(alike[0], links(alike, (1.0,) * 3))[2:], R.sum(axis=1)[:, None] * R),
    ]:
        wanted = np.stack([np.linalg.matrix_power(Q, k) @ np.ones(31) for k in range(1, 9)])
        np.testing.assert_allclose(found[0], wanted, rtol=1e-4)


def test_steps_beyond_those_kept_grow_as_the_last_did():
    """Equal rows: every power is known; the largest of c_k^2 Q^k is that of the last step."""
    growth = 2.0 ** np.arange(1, 9)[:, None] * np.ones((8, 3))
    alike = Weights(growth, growth**2, np.sqrt(growth), 2.0**0.5)
    worth = np.full(12, 0.5)
    np.testing.assert_allclose(largest_square(alike, np.ones(12), worth, 50), 3 * 0.25 * 2.0**12)
    rare = np.append(np.ones(11), 0.01)  # 50 samples are scored there half a time
    np.testing.assert_allclose(largest_square(alike, rare, worth, 50), 3 * 0.25 * 2.0**11)


@pytest.mark.parametrize("sampler", ["alias", "cdf"])
@pytest.mark.parametrize("form", ["csr", "dense", "colour"])
def test_walks_over_rows_of_one_entry_have_no_noise(form, sampler):
    R = 0.5 * np.roll(np.eye(6), 1, axis=0)
    dense = np.eye(6) + R
    given: Any = {"csr": scipy.sparse.csr_array(dense), "dense": dense}.get(form)
    b = np.arange(1.0, 7.0)
    if form == "colour":
        given, b = tuple(as_operator(np.eye(6) + f * R) for f in (1.0, 0.5, -0.3)), np.stack([b] * 3)
    found = ltcl.solve(given, b, "monte_carlo", series="chebyshev", degree=5, sampler=sampler)
    assert not error_of(found).any()


def test_a_reason_foretells_no_noise_of_samples_that_nobody_knows():
    options: dict[str, Any] = {"series": "chebyshev", "degree": 4, "pixels": [3]}
    assert "noise of about" not in ltcl.solve(S, LIGHT["dense"], "monte_carlo", error=0.02, **options).reason
    assert "noise of about" in ltcl.solve(S, LIGHT["dense"], "monte_carlo", **options).reason


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e30])
def test_no_error_is_too_large_to_count_with(scale):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = ltcl.solve(lambertian(9, 0.3).S, np.full(9, scale), "monte_carlo", error=1e308)
    assert "error=1e+308 met by " in found.reason
