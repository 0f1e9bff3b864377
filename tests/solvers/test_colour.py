# SPDX-License-Identifier: BSD-3-Clause
"""Three S at once: one walk a sample, no colour biased, and walks of their own where sharing is of no use."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import InputError, InputTypeError, LtclError
from ltcl.operators import CSR, Dense, IdentityPlus
from ltcl.operators.walks import Walker
from ltcl.solvers import Solution, Status, solve_each
from tests import gallery
from tests.problems import lambertian, residual

SCENES = [lambertian(43, rho, density=0.7) for rho in (0.6, 0.3, 0.5)]  # as the albedos of a wall differ
N = 43


def _apart() -> list[np.ndarray]:
    """Signs, places and empty rows of each channel's own."""
    found = [gallery.sparse(N, N, 0.3, seed).toarray() / 12 for seed in range(3)]
    for c, R in enumerate(found):
        R[[c, 9 + c, 42]] = 0
    return found


def _lit_apart(row: float) -> list[np.ndarray]:
    """Channels lit from places of their own: of shared steps the second moments are three times as large."""
    Rs = [np.zeros((N, N)) for _ in range(3)]
    for c, R in enumerate(Rs):
        R[:, 10 * c : 10 * c + 10] = row / 10
    return Rs


# R of S = I + sign R.
COLOURS: dict[str, tuple[list[np.ndarray], float]] = {
    "scenes": ([scene.R for scene in SCENES], 1.0),
    "forward": ([scene.A for scene in SCENES], -1.0),
    "apart": (_apart(), 1.0),
    "one is dark": ([SCENES[0].R, np.zeros((N, N)), SCENES[2].R], 1.0),
}
FORMS = {
    "csr": lambda device, R, c: CSR(device, scipy.sparse.csr_array(R)),
    "dense": lambda device, R, c: Dense(device, R),
    "both": lambda device, R, c: Dense(device, R) if c == 1 else CSR(device, scipy.sparse.csr_array(R)),
}
VARIANTS: dict[str, dict[str, Any]] = {
    "collision": {},
    "endpoint": {"estimator": "endpoint"},
    "cdf": {"sampler": "cdf"},
    "polynomial": {"series": "chebyshev", "degree": 12, "sampler": "uniform"},
    "adjoint": {"adjoint": True},
}


def systems(device, name: str, form: str = "csr") -> tuple[tuple[IdentityPlus, ...], np.ndarray]:
    """Three S, and the same dense."""
    Rs, sign = COLOURS[name]
    Rs = [R.astype(np.float32) for R in Rs]
    S = tuple(IdentityPlus(FORMS[form](device, R, c), sign) for c, R in enumerate(Rs))
    return S, np.stack([np.eye(N) + sign * R.astype(float) for R in Rs])


def pictures(k: int | None = None) -> np.ndarray:
    return np.stack([gallery.vectors(N, k, seed) for seed in range(3)])


def solved(dense: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.stack([np.linalg.solve(S, x) for S, x in zip(dense, b.astype(float), strict=True)])


def error_of(solution: Solution) -> np.ndarray:
    assert solution.standard_error is not None
    return solution.standard_error.astype(np.float64)


@pytest.fixture
def launched(monkeypatch) -> list[tuple[str, int, int]]:
    """Name, columns and chunks of 64 samples of the launches of walks."""
    found: list[tuple[str, int, int]] = []
    launch = Walker._launch

    def spy(self: Walker, name: str, estimator: str, width: int, units: int, *rest: object) -> None:
        found.append((name, width, units))
        launch(self, name, estimator, width, units, *rest)

    monkeypatch.setattr(Walker, "_launch", spy)
    return found


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", COLOURS)
def test_the_mean_of_many_runs_is_the_solution_of_every_channel(device, name, variant):
    """Within 4 standard errors at every pixel, and these are as large as the runs' own spread says."""
    S, dense = systems(device, name)
    b = pictures(2)
    exact = solved(dense, b)
    runs = [ltcl.solve(S, b, "monte_carlo", samples=256, seed=s, **VARIANTS[variant]) for s in range(24)]
    x = np.stack([run.x for run in runs]).astype(float)
    error = np.sqrt(np.mean([error_of(run) ** 2 for run in runs], axis=0))
    slack = 1e-4 * np.abs(exact).max()  # float32, and what a polynomial leaves
    assert x.shape == (24, 3, N, 2)
    assert np.all(np.abs(x.mean(axis=0) - exact) <= 4 * error / 24**0.5 + slack)
    for c in range(3):
        noisy = error[c] > slack
        spread = x[:, c].std(axis=0, ddof=1)[noisy] / error[c][noisy]
        assert spread.size == 0 or 0.8 < np.sqrt(np.mean(spread**2)) < 1.25


@pytest.mark.parametrize("form", ["dense", "both"])
def test_dense_rows_too(device, form):
    S, dense = systems(device, "apart", form)
    b = pictures()
    found = ltcl.solve(S, b, "monte_carlo", samples=20_000)
    assert found.x.shape == (3, N)
    assert np.all(np.abs(found.x - solved(dense, b)) <= 4.2 * error_of(found) + 1e-5)


@pytest.mark.parametrize("method", ["monte_carlo", "hybrid"])
def test_a_sample_is_one_walk_and_not_three(device, launched, method):
    S, _ = systems(device, "scenes")
    ltcl.solve(S, pictures(), method, samples=128, rtol=1e-2)
    steps = 1 if method == "monte_carlo" else int(np.ceil(np.log(1e-2) / np.log(0.6)))
    assert launched == [("walk_rows", 3, N * 2)] * steps
    launched.clear()
    solve_each(S, list(pictures(4)), method, samples=128, rtol=1e-2)
    assert launched == [("walk_rows", 12, N * 2)] * steps


@pytest.mark.parametrize("sampler", ["alias", "cdf", "uniform"])
@pytest.mark.parametrize("method", ["monte_carlo", "hybrid"])
def test_equal_channels_get_what_one_gets_alone_to_the_bit(device, method, sampler):
    options: dict[str, Any] = {"sampler": sampler, "samples": 100}
    if sampler == "uniform" and method == "monte_carlo":
        options |= {"series": "chebyshev", "degree": 5}
    R = SCENES[0].R
    S, b = tuple(IdentityPlus(Dense(device, R)) for _ in range(3)), gallery.vectors(N, 2)
    alone, together = (
        ltcl.solve(S[0], b, method, **options),
        ltcl.solve(S, np.stack([b] * 3), method, **options),
    )
    np.testing.assert_array_equal(together.x, np.stack([alone.x] * 3))
    if method == "monte_carlo":
        np.testing.assert_allclose(error_of(together), np.stack([error_of(alone)] * 3), rtol=1e-6)
    assert together.reason == alone.reason


def test_grey_light_on_nearly_grey_walls_has_hardly_any_colour_noise(device):
    """Errors of channels that share walks go together; those of their own walks do not, seeds apart."""
    S = tuple(IdentityPlus(Dense(device, SCENES[0].R * factor)) for factor in (1.0, 0.95, 0.9))
    b = np.stack([np.random.default_rng(0).random(N)] * 3)
    exact = solved(np.stack([np.eye(N) + SCENES[0].R * factor for factor in (1.0, 0.95, 0.9)]), b)
    off = ltcl.solve(S, b, "monte_carlo", samples=64).x - exact
    own = [ltcl.solve(S[c], b[c], "monte_carlo", samples=64, seed=c).x for c in range(3)]
    apart = np.stack(own) - exact
    assert np.abs(off[0] - off[2]).mean() < 0.3 * np.abs(apart[0] - apart[2]).mean()


@pytest.mark.parametrize("units", [1, 50])
def test_no_bit_depends_on_the_split_into_launches(device, monkeypatch, units):
    S, _ = systems(device, "apart")
    wanted = ltcl.solve(S, pictures(3), "monte_carlo", samples=200)
    monkeypatch.setattr("ltcl.operators.walks._UNITS", units)
    found = ltcl.solve(S, pictures(3), "monte_carlo", samples=200)
    np.testing.assert_array_equal(found.x, wanted.x)
    some = ltcl.solve(S, pictures(3), "monte_carlo", samples=200, pixels=[40, 3])
    np.testing.assert_array_equal(some.x, wanted.x[:, [40, 3]])
    np.testing.assert_array_equal(error_of(some), error_of(wanted)[:, [40, 3]])


@pytest.mark.parametrize("scale", [(1.0, 1.0, 1.0), (1e-20, 1.0, 1e15)])
def test_a_target_error_is_reached_in_every_channel(device, scale):
    """In the units of x: the brightest channel needs the most walks, and the others get as many."""
    S, dense = systems(device, "scenes")
    b = np.stack([np.random.default_rng(c).random(N) * factor for c, factor in enumerate(scale)])
    found = ltcl.solve(S, b, "monte_carlo", error=0.005 * max(scale))
    assert error_of(found).max() < 0.005 * 1.15 * max(scale)
    for c, factor in enumerate(scale):
        z = (found.x[c] - np.linalg.solve(dense[c], b[c])) / error_of(found)[c]
        assert np.abs(z).max() < 4.5
        assert error_of(found)[c].max() < 0.1 * factor


def test_final_gather_and_a_start_are_those_of_each_channel(device):
    S, dense = systems(device, "scenes")
    b = np.stack([np.random.default_rng(c).random(N) for c in range(3)])
    exact = solved(dense, b)
    plain, gathered = (ltcl.solve(S, b, "monte_carlo", samples=64, gather=gather) for gather in (False, True))
    for c in range(3):
        R = dense[c] - np.eye(N)
        np.testing.assert_allclose(gathered.x[c], b[c] - R @ plain.x[c], rtol=0, atol=1e-5)
        np.testing.assert_allclose(error_of(gathered)[c], np.sqrt(R**2 @ error_of(plain)[c] ** 2), rtol=1e-4)
    started = ltcl.solve(S, b, "monte_carlo", samples=8, x0=exact)
    np.testing.assert_allclose(started.x, exact, rtol=0, atol=1e-5)
    assert started.converged


@pytest.mark.parametrize("method", ["monte_carlo", "hybrid"])
def test_the_callback_hears_of_one_beginning_and_of_the_largest_residual(device, method):
    S, _ = systems(device, "scenes")
    seen: list[tuple[int, float]] = []
    found = ltcl.solve(S, pictures(), method, samples=16, callback=lambda *step: seen.append(step))
    assert seen[0] == (0, 1.0)
    assert [number for number, _ in seen] == list(range(len(seen)))
    assert all(np.isnan(value) for _, value in seen[1:-1])
    assert len(seen) == 2 + found.iterations
    assert seen[-1][1] == found.residuals[-1] == found.residual


def test_the_callback_hears_no_more_of_channels_with_walks_of_their_own(device):
    S, _ = systems(device, "scenes")
    seen: list[tuple[int, float]] = []
    found = ltcl.solve(S, pictures(), "monte_carlo", adjoint=True, callback=lambda *step: seen.append(step))
    assert [number for number, _ in seen] == list(range(len(seen)))
    assert [value for _, value in seen if np.isfinite(value)] == [1.0, found.residual]
    few: list[float] = []
    ltcl.solve(S, pictures(), "monte_carlo", pixels=[1], callback=lambda _, residual: few.append(residual))
    np.testing.assert_array_equal(few, [1.0, np.nan])


@pytest.mark.parametrize("method", ["monte_carlo", "hybrid"])
def test_the_largest_residual_is_told_and_all_products_are_counted(device, method):
    S, dense = systems(device, "scenes")
    b = pictures()
    found = ltcl.solve(S, b, method, samples=16)
    assert found.status is Status.SAMPLED
    largest = max(residual(*one) for one in zip(dense, found.x, b, strict=True))
    assert found.residual == pytest.approx(largest, rel=1e-4)
    assert found.products == 3
    assert ltcl.solve(S, np.zeros((3, N)), method).converged
    each = solve_each(S, list(b), method, samples=16)
    np.testing.assert_array_equal(np.stack([one.x for one in each]), found.x)
    assert max(one.residual for one in each) == found.residual


def test_hybrid_converges_to_every_channel(device):
    S, dense = systems(device, "apart")
    b = pictures(2)
    runs = [ltcl.solve(S, b, "hybrid", samples=64, rtol=1e-4, seed=s).x for s in range(30)]
    x, exact = np.stack(runs).astype(float), solved(dense, b)
    assert np.all(np.abs(x.mean(axis=0) - exact) <= 4 * x.std(axis=0, ddof=1) / 30**0.5 + 1e-3)


def test_where_shared_walks_have_no_variance_channels_have_their_own(device, launched):
    """Row sums of 0.8, moments of up to three times their square."""
    Rs = _lit_apart(0.8)
    S, b = tuple(IdentityPlus(Dense(device, R)) for R in Rs), pictures()
    found = ltcl.solve(S, b, "monte_carlo", samples=4000)
    assert [columns for _, columns, _ in launched] == [1, 1, 1]
    assert "channels share no walks: walks over R have no finite variance" in found.reason
    exact = solved(np.stack([np.eye(N) + R for R in Rs]), b)
    assert np.all(np.abs(found.x - exact) <= 4.2 * error_of(found))
    own = ltcl.solve(S[1], b[1], "monte_carlo", samples=4000)
    np.testing.assert_array_equal(found.x[1], own.x)


@pytest.mark.parametrize("method", ["monte_carlo", "hybrid"])
def test_where_links_do_not_fit_channels_have_walks_of_their_own(device, monkeypatch, method):
    S, _ = systems(device, "scenes", "dense")
    monkeypatch.setattr(device, "max_allocation", 12 * N * N)
    found = ltcl.solve(S, pictures(), method, samples=30)
    assert "channels share no walks: tables of the 1849 entries of R need" in found.reason
    np.testing.assert_array_equal(found.x[2], ltcl.solve(S[2], pictures()[2], method, samples=30).x)


def test_walks_from_b_are_of_one_channel(device, launched):
    S, _ = systems(device, "scenes")
    found = ltcl.solve(S, pictures(), "monte_carlo", samples=64, adjoint=True)
    assert [name for name, _, _ in launched] == ["walk_columns"] * 3
    assert "channels share no walks: those from b are of one channel" in found.reason


def test_certain_is_what_a_channel_has_no_noise_of(device):
    """Of two rooms one is lit, and green alone passes the wall: walks go through it, red and blue do not."""
    rooms = np.zeros((40, 40))
    rooms[:20, :20] = rooms[20:, 20:] = lambertian(20, 0.5).R
    S = tuple(np.eye(40) + R for R in (rooms, lambertian(40, 0.5).R, 0.5 * rooms))
    b = np.stack([np.where(np.arange(40) < 20, 1.0, 0.0)] * 3)
    S = tuple(IdentityPlus(Dense(device, one - np.eye(40))) for one in S)
    tried: list[dict[str, Any]] = [{}, {"error": 0.01}, {"estimator": "endpoint"}, {"gather": True}]
    for options in [*tried, {"series": "chebyshev", "degree": 4}]:
        found = ltcl.solve(S, b, "monte_carlo", **options)
        assert "share no walks" not in found.reason
        assert not error_of(found)[[0, 2], 20:].any()
        assert not found.x[[0, 2], 20:].any()
        assert np.all(error_of(found)[[0, 2], :20] > 0)
        assert np.all(error_of(found)[1] > 0)


def test_the_choices_of_shared_rows_are_noise_of_a_channel_that_has_none_alone(device):
    Rs = np.zeros((3, 3, 3))
    Rs[0, 0, 1] = Rs[1, 0, 2] = 0.5
    Rs[1, 1, 2] = 0.5
    S = tuple(IdentityPlus(CSR(device, scipy.sparse.csr_array(R))) for R in Rs)
    found = ltcl.solve(S, np.ones((3, 3)), "monte_carlo", samples=4000)
    noisy = np.array([[True, False, False], [True, False, False], [False, False, False]])
    np.testing.assert_array_equal(error_of(found) > 0, noisy)
    exact = np.array([[0.5, 1, 1], [0.5, 0.5, 1], [1, 1, 1]])
    assert np.all(np.abs(found.x - exact) <= 4 * error_of(found))
    alone = ltcl.solve(S[0], np.ones(3), "monte_carlo", samples=4000)
    assert not error_of(alone).any()


def test_an_error_is_met_where_each_channel_has_one_light(device):
    """By all of x of a pixel: the channel that finds its light last asks for the samples."""
    S, dense = systems(device, "scenes")
    b = np.zeros((3, N))
    b[[0, 1, 2], [4, 17, 30]] = 1.0
    found = ltcl.solve(S, b, "monte_carlo", error=2e-3)
    off = np.abs(found.x - solved(dense, b))
    assert np.all((error_of(found) > 0) & (error_of(found) <= 2e-3))
    assert off.max() <= 5 * 2e-3
    assert np.mean(off <= 1.96 * error_of(found)) > 0.88
    assert found.reason.count("error=0.002 met by ") == 1
    missed = ltcl.solve(S, b, "monte_carlo", error=1e-9, samples=600, rtol=0.9)
    assert missed.status is Status.SAMPLED
    assert missed.reason.count("43 of 43 pixels missed error=1e-09 within 600 samples") == 1
    few = ltcl.solve(S, b, "monte_carlo", samples=2)
    assert np.all(np.abs(few.x - solved(dense, b)) <= 2 * error_of(few))


def test_the_residual_is_the_largest_even_where_noise_exceeds_b(device):
    strengths = (0.5, -0.999, 0.3)
    S = tuple(IdentityPlus(Dense(device, np.full((4, 4), strength / 4))) for strength in strengths)
    found = ltcl.solve(S, np.ones((3, 4)), "monte_carlo")
    dense = [np.eye(4) + strength / 4 for strength in strengths]
    largest = max(residual(*one) for one in zip(dense, found.x, np.ones((3, 4)), strict=True))
    assert found.residual == pytest.approx(largest, rel=1e-3)
    assert found.residual == found.residuals[-1] > 1.0
    assert "at best" not in str(found)


def test_where_noise_of_shared_walks_drowns_a_polynomial_channels_have_their_own(device):
    S, b = tuple(IdentityPlus(Dense(device, R)) for R in _lit_apart(0.9)), pictures()
    options: dict[str, Any] = {"series": "chebyshev", "rtol": 0.05, "samples": 12}
    found = ltcl.solve(S, b, "monte_carlo", **options)
    assert "channels share no walks: samples is 12; of the polynomial of degree" in found.reason
    np.testing.assert_array_equal(found.x[1], ltcl.solve(S[1], b[1], "monte_carlo", **options).x)


def test_where_samples_are_too_few_for_shared_columns_channels_draw_their_own(device):
    """Signed light: noise of shared columns grows with a few samples more than that of a channel's own."""
    Rs = [np.random.default_rng(seed).standard_normal((N, N)) for seed in range(3)]
    Rs = [R * (0.75 / np.abs(np.linalg.eigvals(R)).max()) for R in Rs]
    S, b = tuple(IdentityPlus(Dense(device, R)) for R in Rs), pictures()
    alone = []
    for one, light in zip(S, b, strict=True):
        with pytest.raises(InputError, match="noise grows") as caught:
            ltcl.solve(one, light, "hybrid", samples=1)
        alone.append(int(re.findall(r"samples= must be (\d+) at least", str(caught.value))[0]))
    found = ltcl.solve(S, b, "hybrid", samples=max(alone))
    why = re.search(
        rf"channels share no walks: samples is {max(alone)}; .* samples= must be (\d+) at", found.reason
    )
    assert why is not None
    own = ltcl.solve(S[2], b[2], "hybrid", samples=max(alone))
    np.testing.assert_array_equal(found.x[2], own.x)
    shared = ltcl.solve(S, b, "hybrid", samples=int(why[1]), iterations=200)
    assert "share no walks" not in shared.reason
    assert np.isfinite(shared.x).all()


def test_what_no_channel_can_do_alone_is_refused(device):
    S = tuple(IdentityPlus(Dense(device, lambertian(30, rho).R)) for rho in (0.5, 1.2, 0.5))
    with pytest.raises(InputError, match=r"^in channel 1: walks over R have no finite variance"):
        ltcl.solve(S, np.ones((3, 30)), "monte_carlo")
    with pytest.raises(InputError, match=r"^in channel 1: the spectral radius of R is 1\.2"):
        ltcl.solve(S, np.ones((3, 30)), "hybrid")
    found = ltcl.solve(S, np.ones((3, 30)), "monte_carlo", series="chebyshev", degree=3)
    assert found.reason.startswith("Chebyshev series of degree 3")


BAD: dict[str, tuple[dict[str, Any], type[LtclError], str]] = {
    "b of one channel": (
        {"b": np.ones(N)},
        InputError,
        r"b has shape \(43,\); of three S it must be \(3, 43\)",
    ),
    "b of two channels": ({"b": np.ones((2, N))}, InputError, r"b has shape \(2, 43\); of three S it"),
    "b the other way": ({"b": np.ones((N, 3))}, InputError, r"b has shape \(43, 3\); of three S it"),
    "NaN": ({"b": np.full((3, N), np.nan)}, InputError, "b has 43 NaN or infinite"),
    "NaN in blue": (
        {"b": np.pad(np.full((1, N), np.nan), ((2, 0), (0, 0)))},
        InputError,
        "^in channel 2: b has 43 NaN",
    ),
    "rtol": ({"rtol": 2}, InputError, "^rtol is 2"),
    "x0": ({"x0": np.ones(N)}, InputError, r"x0 has shape \(43,\); of three S it must be"),
    "x0 of one frame": ({"x0": np.ones((3, N, 2))}, InputError, r"x0 has shape \(43, 2\)"),
    "another method": (
        {"method": "cg"},
        InputTypeError,
        "S is 3 operators, one per colour channel; it must be",
    ),
    "two S": ({"S": 2}, InputTypeError, "S is 2 operators, one per colour channel"),
    "an option": ({"light": 1}, InputTypeError, "unknown option 'light'"),
    "a pixel": ({"pixels": [N]}, InputError, "pixels holds 43"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_refused_in_one_line(device, case):
    given, error, says = BAD[case]
    S, _ = systems(device, "scenes")
    options = {"b": np.ones((3, N)), "method": "monte_carlo"} | given
    S = S[: options.pop("S", 3)]
    with pytest.raises(error, match=says) as caught:
        ltcl.solve(S, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("matrix", [np.eye(N), scipy.sparse.eye_array(N, format="csr")])
def test_three_matrices_are_told_of_operators(matrix):
    with pytest.raises(InputTypeError, match=r"^S is 3 matrices; .* three Operators, such as T\.interref"):
        ltcl.solve([matrix] * 3, np.ones((3, N)), "monte_carlo")


def test_systems_of_different_sizes_are_refused(device):
    S, _ = systems(device, "scenes")
    small = IdentityPlus(Dense(device, np.zeros((5, 5))))
    with pytest.raises(InputError, match=r"S is operators of shapes \[\(43, 43\), \(43, 43\), \(5, 5\)\]"):
        ltcl.solve((*S[:2], small), np.ones((3, N)), "monte_carlo")
