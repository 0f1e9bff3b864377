# SPDX-License-Identifier: BSD-3-Clause
"""Monte Carlo: unbiased, its errors as large as it says, and refused where they would be infinite."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import InputError, InputTypeError, LtclError
from ltcl.operators import CSR, Dense, Host, IdentityPlus
from ltcl.solvers import Solution, Status
from tests import gallery
from tests.problems import lambertian, residual

SCENE = lambertian(43, rho=0.6, density=0.7)
CORNER = ltcl.scenes.box(10, sides=3, albedo=0.4).transport().systems[0]
ROOM = CORNER.to_dense().astype(float)


def _with_empty_rows() -> np.ndarray:
    R = gallery.sparse(41, 41, 0.3, seed=5).toarray() / 10
    R[[0, 9, 40]] = 0
    return R


# R of S = I + R, and of the forward dual with its sign.
MATRICES: dict[str, tuple[np.ndarray, float]] = {
    "a scene": (SCENE.R, 1.0),
    "forward": (SCENE.A, -1.0),
    "signs, empty rows": (_with_empty_rows(), 1.0),
    "1x1": (np.array([[0.4]]), 1.0),
    "nothing": (np.zeros((5, 5)), 1.0),
}
VARIANTS: dict[str, dict[str, Any]] = {
    "collision": {},
    "endpoint": {"estimator": "endpoint"},
    "uniform": {"sampler": "uniform"},
    "long": {"albedo": 0.47},
    "adjoint": {"adjoint": True},
}


def error_of(solution: Solution) -> np.ndarray:
    assert solution.standard_error is not None
    return solution.standard_error.astype(np.float64)


def covered(found: Solution, exact: np.ndarray) -> float:
    return float(np.mean(np.abs(found.x - exact) <= 2 * error_of(found)))


def system(device, name: str) -> tuple[IdentityPlus, np.ndarray]:
    R, sign = MATRICES[name]
    R = R.astype(np.float32)
    return IdentityPlus(CSR(device, scipy.sparse.csr_array(R)), sign), np.eye(len(R)) + sign * R.astype(float)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", MATRICES)
def test_the_mean_of_many_runs_is_the_solution(device, name, variant):
    """Within 4 standard errors at every pixel, and these are as large as the runs' own spread says."""
    S, dense = system(device, name)
    b = gallery.vectors(len(dense), 2)
    exact = np.linalg.solve(dense, b.astype(float))
    runs = [ltcl.solve(S, b, "monte_carlo", samples=2048, seed=s, **VARIANTS[variant]) for s in range(24)]
    x = np.stack([run.x for run in runs]).astype(float)
    error = np.sqrt(np.mean([error_of(run) ** 2 for run in runs], axis=0))
    slack = 1e-5 * np.abs(exact).max()  # float32
    assert np.all(np.abs(x.mean(axis=0) - exact) <= 4 * error / 24**0.5 + slack)
    noisy = x.std(axis=0) > slack
    spread = x.std(axis=0, ddof=1)[noisy] / error[noisy]
    assert spread.size == 0 or 0.8 < np.sqrt(np.mean(spread**2)) < 1.25


def _light(lights: int, ambient: float = 0.0) -> np.ndarray:
    b = np.full(300, ambient)
    b[np.random.default_rng(lights).choice(300, lights, replace=False)] = 1.0
    return b


LIGHT = {
    "dense": np.random.default_rng(0).random(300),
    "one": _light(1),
    "one in 1e-3": _light(1, 1e-3),
    "24": _light(24),
}


@pytest.mark.parametrize("samples", [64, 256])
@pytest.mark.parametrize("variant", ["collision", "endpoint", "adjoint"])
@pytest.mark.parametrize("light", LIGHT)
def test_two_standard_errors_hold_at_the_share_they_promise(light, variant, samples):
    """Also where no walk has met most of the light."""
    exact = np.linalg.solve(ROOM, LIGHT[light])
    runs = [
        ltcl.solve(CORNER, LIGHT[light], "monte_carlo", samples=samples, seed=s, **VARIANTS[variant])
        for s in range(6)
    ]
    assert np.mean([covered(run, exact) for run in runs]) >= 0.93
    assert all(np.all(error_of(run) > 0) for run in runs)


@pytest.mark.parametrize("light", LIGHT)
def test_a_target_error_is_met_at_every_pixel_however_few_the_lights(light):
    exact, error = np.linalg.solve(ROOM, LIGHT[light]), 1e-2 if light == "dense" else 2e-3
    found = ltcl.solve(CORNER, LIGHT[light], "monte_carlo", error=error)
    assert np.all((error_of(found) > 0) & (error_of(found) <= error))
    assert np.median(error_of(found)) > error / 8  # not by drowning it in samples
    assert np.abs(found.x - exact).max() <= 5 * error
    assert covered(found, exact) >= 0.93
    assert f"error={error:g} met" in found.reason


def test_stopping_by_the_spread_leaves_no_bias(device):
    """Skewed scores: where few have met light, those with the smallest spread have the smallest mean."""
    scene = lambertian(20, rho=0.5)
    S, b = IdentityPlus(Dense(device, scene.R)), np.eye(20)[7]
    exact, z = np.linalg.solve(scene.S, b), []
    for seed in range(60):
        found = ltcl.solve(S, b, "monte_carlo", error=5e-3, seed=seed)
        z.append((found.x - exact) / error_of(found))
    assert abs(np.mean(z)) < 4 / np.size(z) ** 0.5
    assert 0.85 < np.std(z) < 1.05  # errors have room for what was not met


def test_a_single_sample_tells_nothing_and_an_empty_row_has_no_error(device):
    S, _ = system(device, "signs, empty rows")
    b = np.random.default_rng(0).random(41)
    assert np.all(np.isinf(error_of(ltcl.solve(S, b, "monte_carlo", samples=1))))
    assert np.all(np.isinf(error_of(ltcl.solve(S, b, "monte_carlo", samples=1, gather=True))))
    found = ltcl.solve(S, b, "monte_carlo", error=0.01)
    np.testing.assert_array_equal(error_of(found) == 0.0, np.isin(np.arange(41), [0, 9, 40]))
    assert ltcl.solve(S, b, "monte_carlo", error=0.01, pixels=[9]).reason.endswith("512 in all)")


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e25])
def test_a_target_error_is_in_the_units_of_x(device, scale):
    S, dense = system(device, "a scene")
    b = np.random.default_rng(4).random((43, 2)) * (1.0, 0.1) * scale
    found = ltcl.solve(S, b, "monte_carlo", error=0.004 * scale)
    error = error_of(found) / scale
    assert np.max(error) <= 0.004
    assert np.median(error[:, 0]) > 0.002
    assert np.abs((found.x.astype(float) / scale - np.linalg.solve(dense, b / scale)) / error).max() < 4.5


@pytest.mark.parametrize("pixels", [None, [3, 4]])
def test_a_missed_error_is_told_and_never_converged(pixels):
    count = 43 if pixels is None else 2
    found = ltcl.solve(SCENE.S, np.ones(43), "monte_carlo", rtol=0.9, error=1e-9, samples=600, pixels=pixels)
    assert found.status is Status.SAMPLED
    assert not np.any(error_of(found) <= 1e-9)
    for text in (found.reason, str(found)):
        assert f"{count} of {count} pixels missed error=1e-09 within 600" in text
    assert ltcl.solve(SCENE.S, np.ones(43), "monte_carlo", rtol=0.9, error=0.1).converged


@pytest.mark.parametrize("error", [5e-324, 1e-30, 1e308])
def test_no_error_is_too_small_or_large_to_count_with(error):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = ltcl.solve(lambertian(9, 0.3).S, np.ones(9), "monte_carlo", error=error, samples=600)
    assert ("met (" in found.reason) == (error > 1)


def test_importance_sampling_has_less_variance_than_uniform(device):
    R = gallery.sparse(53, 53, 0.5, seed=2).toarray() ** 3
    R *= 0.5 / np.abs(R).sum(axis=1).max()
    S, b = IdentityPlus(Dense(device, R)), np.ones(53)
    options: dict[str, Any] = {"samples": 2048, "albedo": 0.4}
    drawn, uniform = (
        error_of(ltcl.solve(S, b, "monte_carlo", sampler=sampler, **options))
        for sampler in ("alias", "uniform")
    )
    assert np.linalg.norm(drawn) < 0.7 * np.linalg.norm(uniform)


def test_final_gather_lowers_the_error_as_theory_says(device):
    """x = b - R x_mc: errors of pixels pass through R, their variances through its squares."""
    S, dense = system(device, "a scene")
    b, R = np.random.default_rng(3).random((43, 2)), dense - np.eye(43)
    exact, ratios, factors = np.linalg.solve(dense, b), [], []
    for seed in range(60):
        plain, gathered = (
            ltcl.solve(S, b, "monte_carlo", samples=30, seed=seed, gather=gather) for gather in (False, True)
        )
        np.testing.assert_allclose(gathered.x, b - R @ plain.x, rtol=0, atol=1e-5)
        np.testing.assert_allclose(error_of(gathered), np.sqrt(R**2 @ error_of(plain) ** 2), rtol=1e-4)
        ratios.append(np.mean(((gathered.x - exact) / error_of(gathered)) ** 2))
        factors.append(np.linalg.norm(gathered.x - exact) / np.linalg.norm(plain.x - exact))
    assert 0.7 < np.mean(ratios) < 1.4
    assert np.mean(factors) < 0.4


def test_pixels_cost_and_get_the_same_alone(device):
    S, _ = system(device, "a scene")
    b = gallery.vectors(43, 3)
    whole = ltcl.solve(S, b, "monte_carlo", samples=100, seed=7)
    some = ltcl.solve(S, b, "monte_carlo", samples=100, seed=7, pixels=[40, 3, 3])
    np.testing.assert_array_equal(some.x, whole.x[[40, 3, 3]])
    np.testing.assert_array_equal(error_of(some), error_of(whole)[[40, 3, 3]])
    assert some.status is Status.SAMPLED
    assert some.products == 0
    column = ltcl.solve(S, b[:, 1], "monte_carlo", samples=100, seed=7)  # right-hand sides share their walks
    np.testing.assert_array_equal(column.x, whole.x[:, 1])


@pytest.mark.parametrize("options", [{}, {"gather": True}, {"adjoint": True}, {"error": 0.01}])
def test_it_repeats_to_the_bit_and_seeds_differ(device, options):
    S, _ = system(device, "signs, empty rows")
    b = gallery.vectors(41, None)
    first, second, other = (ltcl.solve(S, b, "monte_carlo", seed=s, **options) for s in (5, 5, 2**64 - 1))
    np.testing.assert_array_equal(first.x, second.x)
    np.testing.assert_array_equal(error_of(first), error_of(second))
    assert np.any(first.x != other.x)


def test_the_true_residual_decides(device):
    S, dense = system(device, "a scene")
    b = np.random.default_rng(5).random(43)
    noisy = ltcl.solve(S, b, "monte_carlo", samples=16, rtol=1e-3)
    assert noisy.status is Status.SAMPLED
    assert noisy.residual == pytest.approx(residual(dense, noisy.x, b), rel=1e-4)
    assert "samples=" in str(noisy)
    close = ltcl.solve(S, b, "monte_carlo", samples=4096, gather=True)
    assert close.converged
    assert residual(dense, close.x, b) <= 1e-2
    loud = ltcl.solve(np.eye(4) - 0.999 / 4, np.ones(4), "monte_carlo")
    assert loud.residual == loud.residuals[-1] > 1.0
    tried: list[dict[str, Any]] = [{}, {"adjoint": True}, {"gather": True}]
    for options in tried:
        dark = ltcl.solve(SCENE.S, np.zeros((43, 2)), "monte_carlo", **options)
        assert dark.converged
        assert not dark.x.any()


def test_a_start_is_corrected(device):
    """Noise is that of what the start leaves: of the solution itself nothing but rounding."""
    S, dense = system(device, "a scene")
    b = np.random.default_rng(6).random((43, 2))
    exact = np.linalg.solve(dense, b)
    found = ltcl.solve(S, b, "monte_carlo", x0=exact, samples=16)
    np.testing.assert_allclose(found.x, exact, rtol=0, atol=1e-5)
    assert found.converged


def test_launches_tell_the_callback(device, monkeypatch):
    """While it draws there is no residual to tell: NaN, between that of the start and the one found."""
    monkeypatch.setattr("ltcl.operators.walks._UNITS", 43)  # 14 pixels of 3 chunks a launch
    S, _ = system(device, "a scene")
    seen: list[tuple[int, float]] = []
    found = ltcl.solve(S, np.ones(43), "monte_carlo", samples=192, callback=lambda *step: seen.append(step))
    assert [step for step, _ in seen] == [0, 1, 2, 3, 4, 5]
    np.testing.assert_array_equal([value for _, value in seen], [1.0, *[np.nan] * 4, found.residual])
    seen.clear()
    ltcl.solve(S, np.ones(43), "monte_carlo", pixels=[1], callback=lambda *step: seen.append(step))
    np.testing.assert_array_equal(seen, [(0, 1.0), (1, np.nan)])


BAD: dict[str, tuple[dict[str, Any], type[LtclError], str]] = {
    "no samples": ({"samples": 0}, InputError, "samples.*0.*1"),
    "half a sample": ({"samples": 0.5}, InputError, "samples.*0.5"),
    "too many samples": ({"samples": 1 << 32}, InputError, "samples.*4294967296.*4294967295"),
    "negative seed": ({"seed": -1}, InputError, "seed.*-1"),
    "large seed": ({"seed": 1 << 64}, InputError, "seed.*18446744073709551616.*18446744073709551615"),
    "negative m": ({"albedo": -0.2}, InputError, "albedo.*-0.2"),
    "m of 1/2": ({"albedo": 0.5}, InputError, "albedo.*0.5"),
    "m too small for R": ({"albedo": 0.2}, InputError, "albedo.*0.25"),
    "no error": ({"error": 0.0}, InputError, "error.*0.0"),
    "pixel beyond": ({"pixels": [0, 43]}, InputError, r"pixels.*43.*0\.\.42"),
    "pixel below": ({"pixels": [-1, 5]}, InputError, "pixels.*-1"),
    "no pixels": ({"pixels": []}, InputError, r"pixels.*\(0,\)"),
    "ragged pixels": ({"pixels": [[1], [2, 3]]}, InputError, "pixels"),
    "pixel fractions": ({"pixels": [0.5]}, InputError, "pixels.*float64"),
    "gather": ({"gather": 3}, InputTypeError, "gather.*3"),
    "estimator": ({"estimator": "track"}, InputError, "estimator.*track.*endpoint, collision"),
    "sampler": ({"sampler": "cdf"}, InputError, "sampler.*cdf.*alias, uniform"),
    "series": ({"series": "chebyshev"}, InputTypeError, "series.*monte_carlo.*albedo"),
    "gather of pixels": ({"gather": True, "pixels": [1]}, InputTypeError, "gather.*pixels"),
    "adjoint of pixels": ({"adjoint": True, "pixels": [1]}, InputTypeError, "adjoint.*pixels"),
    "adjoint collisions": ({"adjoint": True, "estimator": "collision"}, InputTypeError, "adjoint.*endpoint"),
    "adjoint beyond": ({"adjoint": True, "samples": 1 << 28}, InputError, "samples.*268435456"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_options_are_refused_in_one_line(device, case):
    options, error, says = BAD[case]
    with pytest.raises(error, match=says) as caught:
        ltcl.solve(IdentityPlus(Dense(device, SCENE.R)), np.ones(43), "monte_carlo", **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("rho", [1.0, 4.0])
@pytest.mark.parametrize("variant", VARIANTS)
def test_an_infinite_variance_is_refused_with_what_remains(device, rho, variant):
    S = IdentityPlus(Dense(device, lambertian(30, rho).R))
    with pytest.raises(InputError, match=r"variance.*method='auto'") as caught:
        ltcl.solve(S, np.ones(30), "monte_carlo", **VARIANTS[variant])
    assert ("alias" in str(caught.value)) == (variant == "uniform")


def test_walks_from_b_have_a_variance_of_their_own(device):
    """A strong row makes rows heavy and columns light: each kind of walk is judged by its own moments."""
    R = np.full((30, 30), 0.01)
    R[0] = 0.5
    S = IdentityPlus(Dense(device, R))
    with pytest.raises(InputError, match="variance"):
        ltcl.solve(S, np.ones(30), "monte_carlo")
    exact = np.linalg.solve(np.eye(30) + R, np.ones(30))
    found = ltcl.solve(S, np.ones(30), "monte_carlo", adjoint=True, samples=2000)
    assert np.all(np.abs(found.x - exact) <= 4 * error_of(found))


def test_rows_that_overflow_and_operators_without_rows_are_refused(device):
    R = np.zeros((4, 4))
    R[2] = 3e38
    for method in ("monte_carlo", "hybrid"):
        with pytest.raises(InputError, match=r"R.*row 2.*float32"):
            ltcl.solve(IdentityPlus(Dense(device, R)), np.ones(4), method)
        S = IdentityPlus(Host(device, scipy.sparse.linalg.aslinearoperator(SCENE.R)))
        with pytest.raises(InputError, match=f"{method}.*Host"):
            ltcl.solve(S, np.ones(43), method)
