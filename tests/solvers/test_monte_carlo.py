# SPDX-License-Identifier: BSD-3-Clause
"""Monte Carlo: unbiased, its errors as large as it says, and refused where they would be infinite.

Hybrid: Jacobi in the mean, with noise that falls with the samples and with final gather.
"""

from __future__ import annotations

import re
import warnings
from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import InputError, InputTypeError
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
    "usual": {},
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
    runs = [ltcl.solve(S, b, "monte_carlo", samples=1024, seed=s, **VARIANTS[variant]) for s in range(48)]
    x = np.stack([run.x for run in runs]).astype(float)
    error = np.sqrt(np.mean([error_of(run) ** 2 for run in runs], axis=0))
    slack = 1e-5 * np.abs(exact).max()  # float32
    assert np.all(np.abs(x.mean(axis=0) - exact) <= 4 * error / 48**0.5 + slack)
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
@pytest.mark.parametrize("variant", ["usual", "adjoint"])
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


@pytest.mark.parametrize("options", [{}, {"samples": 50}, {"adjoint": True}, {"gather": True}])
@pytest.mark.parametrize("lit", [slice(None), slice(-1, None)])
def test_errors_hold_where_light_goes_one_way(device, lit, options):
    """rho(R) = 0 of rows that sum to 0.8: walks have to be as long as rows are heavy."""
    R, b = 0.8 * np.eye(5, k=1), np.zeros(5)
    b[lit] = 1.0
    S, exact = IdentityPlus(Dense(device, R)), np.linalg.solve(np.eye(5) + R, b)
    far = np.zeros((100, 5))
    for seed, row in enumerate(far):
        found = ltcl.solve(S, b, "monte_carlo", seed=seed, **{"samples": 20} | options)
        row[:] = np.abs(found.x - exact) > 5 * error_of(found) + 1e-6
    assert far.mean(axis=0).max() <= 0.01


@pytest.mark.parametrize("light", LIGHT)
def test_a_target_error_is_met_at_every_pixel_however_few_the_lights(light):
    exact, error = np.linalg.solve(ROOM, LIGHT[light]), 1e-2 if light == "dense" else 2e-3
    found = ltcl.solve(CORNER, LIGHT[light], "monte_carlo", error=error)
    assert np.all((error_of(found) > 0) & (error_of(found) <= error))
    assert np.median(error_of(found)) > error / 8  # not by drowning it in samples
    assert np.abs(found.x - exact).max() <= 5 * error
    assert covered(found, exact) >= 0.93
    assert f"error={error:g} was reached" in found.reason


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
    assert "512 in all" in ltcl.solve(S, b, "monte_carlo", error=0.01, pixels=[9]).reason


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
    assert ("was reached" in found.reason) == (error > 1)


def test_final_gather_lowers_the_error_as_theory_says(device):
    """x = b - R x_mc: errors of pixels pass through R, their variances through its squares."""
    S, dense = system(device, "a scene")
    b, R = np.random.default_rng(3).random((43, 2)), dense - np.eye(43)
    exact, ratios, factors = np.linalg.solve(dense, b), [], []
    for seed in range(60):
        plain, gathered = (
            ltcl.solve(S, b, "monte_carlo", samples=100, seed=seed, gather=gather) for gather in (False, True)
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


@pytest.mark.parametrize(
    "options", [{}, {"gather": True}, {"adjoint": True}, {"error": 0.01}, {"method": "hybrid"}]
)
def test_it_repeats_to_the_bit_and_seeds_differ(device, options):
    S, _ = system(device, "signs, empty rows")
    options, b = {"method": "monte_carlo"} | options, gallery.vectors(41, None)
    first, second, other = (ltcl.solve(S, b, seed=s, **options) for s in (5, 5, 2**64 - 1))
    np.testing.assert_array_equal(first.x, second.x)
    np.testing.assert_array_equal(first.standard_error, second.standard_error)
    assert np.any(first.x != other.x)


@pytest.mark.parametrize("method", ["monte_carlo", "hybrid"])
def test_the_true_residual_decides(method):
    b = np.random.default_rng(5).random(43)
    noisy = ltcl.solve(SCENE.S, b, method, samples=4, rtol=1e-3)
    assert noisy.status is Status.SAMPLED
    assert (noisy.standard_error is None) == (method == "hybrid")
    assert noisy.residual == pytest.approx(residual(SCENE.S, noisy.x, b), rel=1e-4)
    assert "samples=" in str(noisy)
    close = ltcl.solve(SCENE.S, b, method, samples=4096, gather=True)
    assert close.converged
    assert residual(SCENE.S, close.x, b) <= 1e-2


def test_a_picture_worse_than_none_tells_its_residual():
    loud = ltcl.solve(np.eye(4) - 0.999 / 4, np.ones(4), "monte_carlo")
    assert loud.residual == loud.residuals[-1] > 1.0


@pytest.mark.parametrize("options", [{}, {"adjoint": True}, {"gather": True}, {"method": "hybrid"}])
def test_noise_is_that_of_what_the_start_leaves(options):
    """Of the solution itself nothing but rounding, and of no light nothing."""
    options, b = {"method": "monte_carlo", "samples": 16} | options, np.random.default_rng(6).random((43, 2))
    exact = np.linalg.solve(SCENE.S, b)
    found = ltcl.solve(SCENE.S, b, x0=exact, **options)
    np.testing.assert_allclose(found.x, exact, rtol=0, atol=1e-5)
    assert found.converged
    dark = ltcl.solve(SCENE.S, np.zeros((43, 2)), **options)
    assert dark.converged
    assert not dark.x.any()


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


BAD: dict[str, tuple[str, dict[str, Any], str]] = {
    "no samples": ("monte_carlo", {"samples": 0}, "samples.*0.*1"),
    "half a sample": ("monte_carlo", {"samples": 0.5}, "samples.*0.5"),
    "too many samples": ("monte_carlo", {"samples": 1 << 32}, "samples.*4294967296.*4294967295"),
    "negative seed": ("monte_carlo", {"seed": -1}, "seed.*-1"),
    "large seed": ("monte_carlo", {"seed": 1 << 64}, "seed.*18446744073709551616.*18446744073709551615"),
    "negative m": ("monte_carlo", {"albedo": -0.2}, "albedo.*-0.2"),
    "m of 1/2": ("monte_carlo", {"albedo": 0.5}, "albedo.*0.5"),
    "m too small for R": ("monte_carlo", {"albedo": 0.2}, "albedo.*0.25"),
    "no error": ("monte_carlo", {"error": 0.0}, "error.*0.0"),
    "pixel beyond": ("monte_carlo", {"pixels": [0, 43]}, r"pixels.*43.*0\.\.42"),
    "pixel below": ("monte_carlo", {"pixels": [-1, 5]}, "pixels.*-1"),
    "no pixels": ("monte_carlo", {"pixels": []}, r"pixels.*\(0,\)"),
    "ragged pixels": ("monte_carlo", {"pixels": [[1], [2, 3]]}, "pixels"),
    "pixel fractions": ("monte_carlo", {"pixels": [0.5]}, "pixels.*float64"),
    "gather": ("monte_carlo", {"gather": 3}, "gather.*3"),
    "series": ("monte_carlo", {"series": "chebyshev"}, "series.*monte_carlo.*albedo"),
    "gather of pixels": ("monte_carlo", {"gather": True, "pixels": [1]}, "gather.*pixels"),
    "adjoint of pixels": ("monte_carlo", {"adjoint": True, "pixels": [1]}, "adjoint.*pixels"),
    "adjoint beyond": ("monte_carlo", {"adjoint": True, "samples": 1 << 28}, "samples.*268435456"),
    "hybrid samples": ("hybrid", {"samples": 0}, "samples.*0"),
    "hybrid adjoint": ("hybrid", {"adjoint": True}, "adjoint.*hybrid"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_options_are_refused_in_one_line(device, case):
    method, options, says = BAD[case]
    with pytest.raises((InputError, InputTypeError), match=says) as caught:
        ltcl.solve(IdentityPlus(Dense(device, SCENE.R)), np.ones(43), method, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("rho", [1.0, 4.0])
@pytest.mark.parametrize("variant", VARIANTS)
def test_an_infinite_variance_is_refused_with_what_remains(device, rho, variant):
    S = IdentityPlus(Dense(device, lambertian(30, rho).R))
    with pytest.raises(InputError, match=r"variance.*method='auto'"):
        ltcl.solve(S, np.ones(30), "monte_carlo", **VARIANTS[variant])


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


def signed(n: int, norm: float) -> np.ndarray:
    """R of both signs and ||R||_2 = norm, whose walks have no finite variance."""
    R = np.random.default_rng(n).standard_normal((n, n))
    return R * (norm / np.linalg.norm(R, 2))


@pytest.mark.parametrize("dual", ["inverse", "forward"])
@pytest.mark.parametrize("form", ["csr", "dense"])
def test_the_mean_of_many_hybrid_runs_is_the_iterate_of_jacobi(device, form, dual):
    M, sign = (SCENE.R, 1.0) if dual == "inverse" else (SCENE.A, -1.0)
    A = CSR(device, scipy.sparse.csr_array(M)) if form == "csr" else Dense(device, M)
    b = gallery.vectors(43, 2)
    options: dict[str, Any] = {"samples": 16, "maxiter": 3, "rtol": 1e-6}
    runs = [ltcl.solve(IdentityPlus(A, sign), b, "hybrid", seed=s, **options).x for s in range(100)]
    x, wanted = np.stack(runs).astype(float), b
    for _ in range(3):
        wanted = b - sign * M @ wanted
    assert np.all(np.abs(x.mean(axis=0) - wanted) <= 4.2 * x.std(axis=0, ddof=1) / 10)
    assert x.std(axis=0).max() > 0.01


def test_noise_falls_with_samples_and_with_final_gather():
    b = np.random.default_rng(1).random((43, 3))
    exact = np.linalg.solve(SCENE.S, b)

    def error(**options: Any) -> float:
        runs = [ltcl.solve(SCENE.S, b, "hybrid", rtol=1e-3, seed=s, **options).x for s in range(12)]
        return float(np.sqrt(np.mean((np.stack(runs) - exact) ** 2)))

    few, many, gathered = error(samples=16), error(samples=1024), error(samples=16, gather=True)
    assert many == pytest.approx(few / 8, rel=0.3)  # 64 times the samples
    assert gathered < 0.4 * few


def test_iterations_are_those_of_jacobi_and_too_few_are_told():
    wanted = int(np.ceil(np.log(1e-2) / np.log(0.6)))
    assert ltcl.solve(SCENE.S, np.ones(43), "hybrid", samples=2).iterations == wanted
    found = ltcl.solve(SCENE.S, np.ones(43), "hybrid", samples=2, maxiter=3)
    assert found.iterations == 3
    assert re.search(rf"3 of the {wanted} iterations.*maxiter=$", str(found))


@pytest.mark.parametrize("form", ["csr", "dense"])
def test_it_refuses_samples_with_which_noise_may_grow_and_names_what_does_not(device, form):
    R = signed(31, 0.75)
    S = IdentityPlus(CSR(device, scipy.sparse.csr_array(R)) if form == "csr" else Dense(device, R))
    b = np.random.default_rng(0).standard_normal(31)
    with pytest.raises(InputError, match=r"samples.*3\b.*method='auto'") as caught:
        ltcl.solve(S, b, "hybrid", samples=3, rtol=1e-6)
    enough = int(re.findall(r"samples=(\d+)", str(caught.value))[0])
    with pytest.raises(InputError, match=f"samples.*{enough - 1}"):
        ltcl.solve(S, b, "hybrid", samples=enough - 1)
    runs = [ltcl.solve(S, b, "hybrid", samples=enough, rtol=1e-6, seed=s).x for s in range(5)]
    assert np.abs(np.stack(runs) - np.linalg.solve(np.eye(31) + R, b)).max() < 20 * np.abs(b).max()


def test_light_of_one_sign_needs_one_sample():
    """R >= 0 of a scene: rho(Q) is about rho(R)^2, and nothing is to be refused."""
    scene = lambertian(43, rho=0.9)
    b = np.random.default_rng(1).random(43)
    found = ltcl.solve(scene.S, b, "hybrid", samples=1, rtol=1e-6)
    assert np.sqrt(np.mean((found.x - np.linalg.solve(scene.S, b)) ** 2)) < 10 * np.abs(b).max()


def test_where_jacobi_diverges_it_is_refused(device):
    S = IdentityPlus(Dense(device, lambertian(30, 1.2).R))
    with pytest.raises(InputError, match=r"1\.2.*hybrid.*method='auto'"):
        ltcl.solve(S, np.ones(30), "hybrid")
