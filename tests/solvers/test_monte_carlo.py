# SPDX-License-Identifier: BSD-3-Clause
"""Monte Carlo is unbiased with true standard errors; hybrid is Jacobi in the mean.

Systems without a finite variance are refused. Three S share one walk a sample, and have walks of
their own where sharing does not help.
"""

from __future__ import annotations

import re
import warnings
from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.operators import CSR, Dense, IdentityPlus
from ltcl.solvers import Solution, Status, solve_each
from tests import gallery
from tests.problems import lambertian, residual
from tests.solvers.helpers import SAMPLED, refused

N = 43
# As the albedos of a wall differ.
SCENES = [lambertian(N, rho, density=0.7) for rho in (0.6, 0.3, 0.5)]
SCENE = SCENES[0]


def with_empty_rows(n: int, seed: int, *rows: int) -> np.ndarray:
    R = gallery.sparse(n, n, 0.3, seed).toarray() / 12
    R[list(rows)] = 0
    return R


SYSTEMS: dict[str, tuple[list[np.ndarray], float]] = {  # R of S = I + sign R, of one or three
    "a scene": ([SCENE.R], 1.0),
    "forward": ([SCENE.A], -1.0),
    "signs, empty rows": ([with_empty_rows(41, 5, 0, 9, 40)], 1.0),
    "1x1": ([np.array([[0.4]])], 1.0),
    "nothing": ([np.zeros((5, 5))], 1.0),
    "colour": ([scene.R for scene in SCENES], 1.0),
    "colour, forward": ([scene.A for scene in SCENES], -1.0),
    "colour, apart": ([with_empty_rows(N, c, c, 9 + c, 42) for c in range(3)], 1.0),
    "colour, one is dark": ([SCENE.R, np.zeros((N, N)), SCENES[2].R], 1.0),
}
VARIANTS: dict[str, dict[str, Any]] = {
    "usual": {},
    "long": {"albedo": 0.47},
    "adjoint": {"adjoint": True},
}
WALK_KERNELS = {"walk_rows", "walk_columns"}
WAYS: list[dict[str, Any]] = [{}, {"adjoint": True}, {"gather": True}, {"method": "hybrid"}]


def sample(S: Any, b: np.ndarray, method: str = "monte_carlo", **options: Any) -> Solution:
    return ltcl.solve(S, b, method, **options)


def operator(device, R: np.ndarray, form: str, sign: float = 1.0) -> IdentityPlus:
    if form == "csr":
        return IdentityPlus(CSR(device, scipy.sparse.csr_array(R)), sign)
    return IdentityPlus(Dense(device, R), sign)


def system(device, name: str) -> tuple[Any, np.ndarray]:
    """S, or three of them, and the same dense, (N, N) or (3, N, N)."""
    Rs, sign = SYSTEMS[name]
    Rs = [R.astype(np.float32) for R in Rs]
    forms = ["csr", "dense" if name.endswith("apart") else "csr", "csr"]
    S = tuple(operator(device, R, form, sign) for R, form in zip(Rs, forms))  # noqa: B905
    dense = np.stack([np.eye(len(R)) + sign * R.astype(float) for R in Rs])
    return (S, dense) if len(S) == 3 else (S[0], dense[0])


def pictures(dense: np.ndarray, k: int | None = None) -> np.ndarray:
    """(N,) or (N, k), of each S."""
    each = [gallery.vectors(dense.shape[-1], k, seed) for seed in range(3)]
    return np.stack(each) if dense.ndim == 3 else each[0]


def solved(dense: np.ndarray, b: np.ndarray) -> np.ndarray:
    b = b.astype(float)
    if b.ndim == dense.ndim:
        return np.linalg.solve(dense, b)
    return np.linalg.solve(dense, b[..., None])[..., 0]


def error_of(solution: Solution) -> np.ndarray:
    assert solution.standard_error is not None
    return solution.standard_error.astype(np.float64)


def covered(s: Solution, exact: np.ndarray) -> float:
    return float(np.mean(np.abs(s.x - exact) <= 2 * error_of(s)))


# Three channels take longer, and differ from one in the tables alone.
NAMES = [
    pytest.param(name, marks=pytest.mark.slow) if name.startswith("colour,") else name
    for name in SYSTEMS
]


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", NAMES)
def test_the_mean_of_many_runs_is_the_solution_of_every_channel(device, name, variant):
    """It is within 4 standard errors at every pixel, which agree with the spread of the runs."""
    S, dense = system(device, name)
    is_colour = dense.ndim == 3
    count = 24 if is_colour else 48
    samples = 256 if is_colour else 1024
    rounding = 1e-4 if is_colour else 1e-5
    b = pictures(dense, 2)
    exact = solved(dense, b)
    runs = [sample(S, b, samples=samples, seed=s, **VARIANTS[variant]) for s in range(count)]
    x = np.stack([run.x for run in runs]).astype(float)
    error = np.sqrt(np.mean([error_of(run) ** 2 for run in runs], axis=0))
    slack = rounding * np.abs(exact).max()
    assert x.shape == (count, *b.shape)
    assert np.all(np.abs(x.mean(axis=0) - exact) <= 4 * error / count**0.5 + slack)
    spread = x.std(axis=0, ddof=1) / np.where(error > slack, error, np.nan)
    channels = spread if is_colour else [spread]
    for channel in channels:
        noisy = channel[np.isfinite(channel)]
        assert noisy.size == 0 or 0.8 < np.sqrt(np.mean(noisy**2)) < 1.25


@pytest.fixture(scope="module")
def corner(device):
    """S of a corner of three walls, 300 pixels."""
    return ltcl.scenes.box(10, sides=3, albedo=0.4).transport(device=device).systems[0]


def light(lights: int, ambient: float = 0.0) -> np.ndarray:
    b = np.full(300, ambient)
    b[np.random.default_rng(lights).choice(300, lights, replace=False)] = 1.0
    return b


LIGHT = {"one": light(1), "one in 1e-3": light(1, 1e-3), "24": light(24)}
LIGHT["dense"] = np.random.default_rng(0).random(300)


@pytest.mark.parametrize("samples", [64, 256])
@pytest.mark.parametrize("variant", ["usual", "adjoint"])
@pytest.mark.parametrize("lights", LIGHT)
def test_two_standard_errors_hold_at_the_share_they_promise(corner, lights, variant, samples):
    """Also where no walk has met most of the light."""
    b = LIGHT[lights]
    options = VARIANTS[variant]
    exact = np.linalg.solve(corner.to_dense().astype(float), b)
    runs = [sample(corner, b, samples=samples, seed=s, **options) for s in range(6)]
    assert np.mean([covered(run, exact) for run in runs]) >= 0.93
    assert all(np.all(error_of(run) > 0) for run in runs)


def test_errors_of_a_light_that_no_walk_has_met_go_by_the_weight_of_the_first_step(device):
    """sqrt(3) W_i max |b| / n with W_i a multiple of the row sum |R_i|, at least 1."""
    R = np.abs(gallery.sparse(30, 30, 0.5).toarray()) / 12
    R[:, 0] = 1e-12
    b = np.eye(30)[0]
    s = sample(IdentityPlus(Dense(device, R)), b, samples=64)
    weights = error_of(s)[1:] * 64 / (3**0.5 * R[1:].sum(axis=1))
    np.testing.assert_allclose(weights, weights[0], rtol=1e-4)
    assert weights[0] >= 1.0


@pytest.mark.parametrize("options", [{}, {"samples": 50}, {"adjoint": True}, {"gather": True}])
@pytest.mark.parametrize("lit", [slice(None), slice(-1, None)])
def test_errors_hold_where_light_goes_one_way(device, lit, options):
    """rho(R) = 0 of rows that sum to 0.8: walks have to be as long as rows are heavy."""
    R = 0.8 * np.eye(5, k=1)
    b = np.zeros(5)
    b[lit] = 1.0
    S = IdentityPlus(Dense(device, R))
    exact = np.linalg.solve(np.eye(5) + R, b)
    far = np.zeros((100, 5))
    for seed, row in enumerate(far):
        s = sample(S, b, seed=seed, **{"samples": 20} | options)
        row[:] = np.abs(s.x - exact) > 5 * error_of(s) + 1e-6
    assert far.mean(axis=0).max() <= 0.01


@pytest.mark.parametrize("lights", LIGHT)
def test_a_target_error_is_met_at_every_pixel_however_few_the_lights(corner, lights):
    b = LIGHT[lights]
    error = 1e-2 if lights == "dense" else 2e-3
    exact = np.linalg.solve(corner.to_dense().astype(float), b)
    s = sample(corner, b, error=error)
    assert np.all((error_of(s) > 0) & (error_of(s) <= error))
    assert np.median(error_of(s)) > error / 8  # not by drowning it in samples
    assert np.abs(s.x - exact).max() <= 5 * error
    assert covered(s, exact) >= 0.93


@pytest.mark.parametrize(
    ("name", "units"),
    [
        *(("a scene", unit) for unit in (1e-30, 1.0, 1e25)),
        ("colour", 1.0),
        ("colour", (1e-20, 1.0, 1e15)),
    ],
)
def test_a_target_error_is_in_the_units_of_x_and_reached_in_every_channel(device, name, units):
    """The brightest channel needs the most walks, and the others get as many."""
    S, dense = system(device, name)
    b = (np.random.default_rng(4).random(dense.shape[:-1]).T * units).T
    error = 0.004 * np.max(units)
    s = sample(S, b, error=error)
    assert error_of(s).max() <= error * (1 + 1e-6)
    assert np.median(error_of(s), axis=-1).max() > error / 2
    assert np.abs((s.x - solved(dense, b)) / error_of(s)).max() < 4.5
    assert s.reason.count(f"error={error:g} was reached") == 1
    np.testing.assert_array_equal(sample(S, b, error=error, pixels=[40, 3]).x, s.x[..., [40, 3]])


def test_stopping_by_the_spread_leaves_no_bias(device):
    """Scores are skewed: if few have met light, the smallest spread has the smallest mean."""
    scene = lambertian(20, rho=0.5)
    S = IdentityPlus(Dense(device, scene.R))
    b = np.eye(20)[7]
    runs = [sample(S, b, error=5e-3, seed=seed) for seed in range(60)]
    exact = np.linalg.solve(scene.S, b)
    z = [(s.x - exact) / error_of(s) for s in runs]
    assert abs(np.mean(z)) < 4 / np.size(z) ** 0.5
    assert 0.85 < np.std(z) < 1.05  # errors have room for what was not met


def test_a_single_sample_tells_nothing_and_an_empty_row_has_no_error(device):
    S, _ = system(device, "signs, empty rows")
    b = np.random.default_rng(0).random(41)
    assert np.all(np.isinf(error_of(sample(S, b, samples=1))))
    assert np.all(np.isinf(error_of(sample(S, b, samples=1, gather=True))))
    assert np.flatnonzero(error_of(sample(S, b, error=0.01)) == 0.0).tolist() == [0, 9, 40]
    assert "512 in all" in sample(S, b, error=0.01, pixels=[9]).reason


@pytest.mark.parametrize("pixels", [None, [3, 4]])
def test_a_missed_error_is_told_and_never_converged(pixels):
    count = N if pixels is None else 2
    s = sample(SCENE.S, np.ones(N), rtol=0.9, error=1e-9, samples=600, pixels=pixels)
    assert s.status is Status.SAMPLED
    assert not np.any(error_of(s) <= 1e-9)
    for text in (s.reason, str(s)):
        assert f"{count} of {count} pixels missed error=1e-09 within 600" in text
    assert sample(SCENE.S, np.ones(N), rtol=0.9, error=0.1).converged


@pytest.mark.parametrize("error", [5e-324, 1e-30, 1e308])
def test_no_error_is_too_small_or_large_to_count_with(error):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        s = sample(lambertian(9, 0.3).S, np.ones(9), error=error, samples=600)
    assert ("was reached" in s.reason) == (error > 1)


def test_final_gather_lowers_the_error_as_theory_says(device):
    """x = b - R x_mc: errors of pixels pass through R, their variances through its squares."""
    S, dense = system(device, "a scene")
    b = np.random.default_rng(3).random((N, 2))
    R = dense - np.eye(N)
    exact = np.linalg.solve(dense, b)
    ratios = []
    factors = []
    for seed in range(60):
        plain, gathered = (
            sample(S, b, samples=100, seed=seed, gather=gather) for gather in (False, True)
        )
        np.testing.assert_allclose(gathered.x, b - R @ plain.x, rtol=0, atol=1e-5)
        np.testing.assert_allclose(
            error_of(gathered), np.sqrt(R**2 @ error_of(plain) ** 2), rtol=1e-4
        )
        ratios.append(np.mean(((gathered.x - exact) / error_of(gathered)) ** 2))
        factors.append(np.linalg.norm(gathered.x - exact) / np.linalg.norm(plain.x - exact))
    assert 0.7 < np.mean(ratios) < 1.4
    assert np.mean(factors) < 0.4


@pytest.mark.slow
def test_pixels_cost_and_get_the_same_alone(device):
    S, _ = system(device, "a scene")
    b = gallery.vectors(N, 3)
    whole = sample(S, b, samples=100, seed=7)
    seen = []
    pixels = [40, 3, 3]
    some = sample(
        S, b, samples=100, seed=7, pixels=pixels, callback=lambda *step: seen.append(step)
    )
    np.testing.assert_array_equal(seen, [(0, 1.0), (1, np.nan)])
    np.testing.assert_array_equal(some.x, whole.x[[40, 3, 3]])
    np.testing.assert_array_equal(error_of(some), error_of(whole)[[40, 3, 3]])
    assert (some.status, some.products) == (Status.SAMPLED, 0)
    column = sample(S, b[:, 1], samples=100, seed=7)  # right-hand sides share their walks
    np.testing.assert_array_equal(column.x, whole.x[:, 1])


@pytest.mark.parametrize("options", [*WAYS, {"error": 0.01}])
def test_it_repeats_to_the_bit_and_seeds_differ(device, options):
    S = system(device, "signs, empty rows")[0]
    b = gallery.vectors(41, None)
    first, second, other = (sample(S, b, seed=s, **options) for s in (5, 5, 2**64 - 1))
    np.testing.assert_array_equal(first.x, second.x)
    np.testing.assert_array_equal(first.standard_error, second.standard_error)
    assert np.any(first.x != other.x)


@pytest.mark.parametrize("method", SAMPLED)
def test_the_true_residual_decides(method):
    b = np.random.default_rng(5).random(N)
    noisy = sample(SCENE.S, b, method, samples=4, rtol=1e-3)
    assert noisy.status is Status.SAMPLED
    assert (noisy.standard_error is None) == (method == "hybrid")
    assert noisy.residual == pytest.approx(residual(SCENE.S, noisy.x, b), rel=1e-4)
    assert "samples=" in str(noisy)
    close = sample(SCENE.S, b, method, samples=4096, gather=True)
    assert close.converged
    assert residual(SCENE.S, close.x, b) <= 1e-2
    loud = sample(np.eye(4) - 0.9 / 4, np.ones(4), samples=1)  # worse than none
    assert loud.residual == loud.residuals[-1] > 1.0


@pytest.mark.parametrize("options", WAYS)
def test_noise_is_that_of_what_the_start_leaves(options):
    """A start at the solution leaves only rounding, and no light leaves nothing."""
    b = np.random.default_rng(6).random((N, 2))
    exact = np.linalg.solve(SCENE.S, b)
    s = sample(SCENE.S, b, x0=exact, samples=16, **options)
    np.testing.assert_allclose(s.x, exact, rtol=0, atol=1e-5)
    assert s.converged
    dark = sample(SCENE.S, np.zeros((N, 2)), samples=16, **options)
    assert dark.converged
    assert not dark.x.any()


# What has no finite variance, or no mean.


def radius(Q: np.ndarray) -> float:
    return float(np.abs(np.linalg.eigvals(Q)).max())


def drawn(R: np.ndarray) -> np.ndarray:
    """Second moments of the weights of a step over rows: |R_i| |R_ij|."""
    return np.abs(R).sum(axis=1)[:, None] * np.abs(R)


# rho(Q), m, and whether walks have a variance.
VARIANCES = [(0.98, None, True), (1.02, None, False), (0.5, 0.34, True), (0.5, 0.33, False)]


@pytest.mark.parametrize("form", ["csr", "dense"])
@pytest.mark.parametrize("adjoint", [False, True])
def test_a_variance_is_finite_where_moments_grow_less_than_walks_end(device, adjoint, form):
    """rho(Q) must be below q, sqrt(rho(Q)) or m / (1 - m); walks over columns have own moments."""
    R = gallery.sparse(37, 37, 0.7).toarray().astype(float)
    R[3] *= 5.0
    R /= np.sqrt(radius(drawn(R.T if adjoint else R)))
    for growth, m, is_finite in VARIANCES:
        S = operator(device, R * growth**0.5, form)
        b = np.ones(37)
        options = {"samples": 2, "albedo": m, "adjoint": adjoint}
        if is_finite:
            sample(S, b, **options)
        else:
            refused(rf"variance.* {growth:g} a step.*method='auto'", S, b, "monte_carlo", **options)


REFUSED: list[tuple[tuple[float, ...], str, dict[str, Any], str]] = [  # rho(R) of one S or three
    *(
        ((rho,), "monte_carlo", one, r"variance.*method='auto'")
        for rho in (1.0, 4.0)
        for one in VARIANTS.values()
    ),
    ((0.6,), "monte_carlo", {"albedo": 0.2}, "albedo.*0.25"),
    ((1.2,), "hybrid", {}, r"1\.2.*hybrid.*method='auto'"),
    ((0.5, 1.2, 0.5), "monte_carlo", {}, r"^in channel 1: .*variance"),
    ((0.5, 1.2, 0.5), "hybrid", {}, r"^in channel 1: .*1\.2"),
]


@pytest.mark.parametrize(("rhos", "method", "options", "says"), REFUSED)
def test_what_has_no_mean_or_variance_is_refused(device, rhos, method, options, says):
    S = tuple(IdentityPlus(Dense(device, lambertian(30, rho).R)) for rho in rhos)
    b = np.ones((3, 30))
    if len(S) == 1:
        refused(says, S[0], b[0], method, **options)
    else:
        refused(says, S, b, method, **options)


# The hybrid.


@pytest.mark.slow
@pytest.mark.parametrize(("M", "sign"), [(SCENE.R, 1.0), (SCENE.A, -1.0)])
@pytest.mark.parametrize("form", ["csr", "dense"])
def test_the_mean_of_many_hybrid_runs_is_the_iterate_of_jacobi(device, form, M, sign):
    b = gallery.vectors(N, 2)
    S = operator(device, M, form, sign)
    runs = []
    for seed in range(100):
        run = sample(S, b, "hybrid", seed=seed, samples=16, maxiter=3, rtol=1e-6)
        runs.append(run.x)
    x = np.stack(runs).astype(float)
    jacobi = b
    for _ in range(3):
        jacobi = b - sign * M @ jacobi
    assert np.all(np.abs(x.mean(axis=0) - jacobi) <= 4.2 * x.std(axis=0, ddof=1) / 10)
    assert x.std(axis=0).max() > 0.01


@pytest.mark.slow
def test_noise_falls_with_samples_and_with_final_gather():
    b = np.random.default_rng(1).random((N, 3))
    exact = np.linalg.solve(SCENE.S, b)

    def error(**options: Any) -> float:
        runs = [sample(SCENE.S, b, "hybrid", rtol=1e-3, seed=s, **options).x for s in range(12)]
        return float(np.sqrt(np.mean((np.stack(runs) - exact) ** 2)))

    few = error(samples=16)
    many = error(samples=1024)
    gathered = error(samples=16, gather=True)
    assert many == pytest.approx(few / 8, rel=0.3)  # 64 times the samples
    assert gathered < 0.4 * few


def test_iterations_are_those_of_jacobi_and_too_few_are_told():
    """Light of one sign needs one sample: rho(Q) is about rho(R)^2, and nothing is refused."""
    S = lambertian(N, rho=0.9).S
    b = np.random.default_rng(1).random(N)
    count = int(np.ceil(np.log(1e-6) / np.log(0.9)))
    s = sample(S, b, "hybrid", samples=1, rtol=1e-6)
    assert s.iterations == count
    assert np.sqrt(np.mean((s.x - np.linalg.solve(S, b)) ** 2)) < 10 * np.abs(b).max()
    s = sample(S, b, "hybrid", samples=2, rtol=1e-6, maxiter=3)
    assert s.iterations == 3
    assert re.search(rf"3 of the {count} iterations.*maxiter=$", str(s))


def signed(n: int, norm: float) -> np.ndarray:
    """R of both signs and ||R||_2 = norm, with walks without a finite variance."""
    R = np.random.default_rng(n).standard_normal((n, n))
    return R * (norm / np.linalg.norm(R, 2))


@pytest.mark.parametrize(("form", "R"), [("csr", signed(13, 0.75)), ("dense", signed(11, 0.8))])
def test_it_refuses_samples_with_which_noise_may_grow_and_names_what_does_not(device, form, R):
    """The map of all covariances decides, C' = R C R^T + diag(Q diag C - diag(R C R^T)) / s."""
    n = len(R)
    S = operator(device, R, form)
    b = np.random.default_rng(0).standard_normal(n)
    said = refused(r"samples.*1\b.*method='auto'", S, b, "hybrid", samples=1, rtol=1e-6)
    enough = int(re.findall(r"samples=(\d+)", said)[0])
    refused(f"samples.*{enough - 1}", S, b, "hybrid", samples=enough - 1)
    both = np.kron(R, R)
    own = np.arange(n) * (n + 1)
    Q = drawn(R)
    covariances = both.copy()
    covariances[own] -= both[own] / enough
    covariances[np.ix_(own, own)] += Q / enough
    assert radius(covariances) < 1
    assert enough <= 3 * radius(Q) / (1 - np.linalg.norm(R, 2) ** 2) + 1
    runs = [sample(S, b, "hybrid", samples=enough, rtol=1e-6, seed=s).x for s in range(5)]
    assert np.abs(np.stack(runs) - np.linalg.solve(np.eye(n) + R, b)).max() < 20 * np.abs(b).max()
    refused("samples=inf", operator(device, 1.05 * R / np.linalg.norm(R, 2), form), b, "hybrid")


# Three S at once.


@pytest.mark.parametrize("method", SAMPLED)
def test_a_sample_in_colour_is_one_walk_and_not_three(device, method):
    S, dense = system(device, "colour")
    steps = 1 if method == "monte_carlo" else int(np.ceil(np.log(1e-2) / np.log(0.6)))
    for call in (
        lambda: sample(S, pictures(dense), method, samples=128),
        lambda: solve_each(S, list(pictures(dense, 4)), method, samples=128),
    ):
        before = device.launches.copy()
        call()
        launches = (device.launches - before).items()
        walks = {name: count for name, count in launches if name in WALK_KERNELS}
        assert walks == {"walk_rows": steps}


@pytest.mark.parametrize("options", [{}, {"adjoint": True}, {"method": "hybrid"}])
def test_the_largest_residual_is_told_and_all_products_are_counted(device, options):
    S, dense = system(device, "colour")
    b = pictures(dense)
    seen = []
    s = sample(S, b, samples=16, callback=lambda *step: seen.append(step), **options)
    assert (s.status, s.products) == (Status.SAMPLED, 3)
    largest = max(residual(*one) for one in zip(dense, s.x, b, strict=True))
    assert s.residual == pytest.approx(largest, rel=1e-4)
    steps, values = zip(*seen, strict=True)
    assert list(steps) == list(range(len(seen)))
    # NaN while it draws and knows no residual.
    assert values[0] == 1.0
    assert np.isnan(values[1:-1]).all()
    assert values[-1] == s.residual
    each = solve_each(S, list(b), samples=16, **{"method": "monte_carlo"} | options)
    np.testing.assert_array_equal(np.stack([one.x for one in each]), s.x)
    assert max(one.residual for one in each) == s.residual


def test_where_shared_walks_have_no_variance_channels_have_their_own(device):
    """Channels are lit from different places: moments are up to three times those of one."""
    Rs = np.zeros((3, N, N))
    b = pictures(np.zeros((3, N, N)))
    for c, R in enumerate(Rs):
        R[:, 10 * c : 10 * c + 10] = 0.08
    S = tuple(IdentityPlus(Dense(device, R)) for R in Rs)
    s = sample(S, b, samples=4000)
    assert "channels share no walks" in s.reason
    assert np.all(np.abs(s.x - solved(np.eye(N) + Rs, b)) <= 4.2 * error_of(s))
    np.testing.assert_array_equal(s.x[1], sample(S[1], b[1], samples=4000).x)
    Rs *= np.random.default_rng(0).choice((-1, 1), Rs.shape)
    S = tuple(IdentityPlus(Dense(device, 0.6 * R / np.linalg.norm(R, 2))) for R in Rs)
    for samples in (64, 1):  # too few where light is signed
        assert ("share no walks" in sample(S, b, "hybrid", samples=samples).reason) == (
            samples == 1
        )
