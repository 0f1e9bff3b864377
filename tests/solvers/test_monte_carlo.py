# SPDX-License-Identifier: BSD-3-Clause
"""Monte Carlo: unbiased, its errors as large as it says, and refused where they would be infinite."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import InputError, InputTypeError, LtclError
from ltcl.operators import CSR, Dense, Host, IdentityPlus
from ltcl.operators.walks import Walker
from ltcl.solvers import Solution, Status
from tests import gallery
from tests.problems import enclosure, lambertian, residual

SCENE = lambertian(43, rho=0.6, density=0.7)


def _with_empty_rows() -> np.ndarray:
    R = gallery.sparse(41, 41, 0.3, seed=5).toarray() / 10
    R[[0, 9, 40]] = 0
    return R


def _strong_rows() -> np.ndarray:
    R = np.diag(gallery.signed(1, 37)[0]) / 3
    R[[7, 36]] = gallery.signed(2, 37, 1) / 25
    return R


# R of S = I + R, and of the forward dual with its sign.
MATRICES: dict[str, tuple[np.ndarray, float]] = {
    "a scene": (SCENE.R, 1.0),
    "forward": (SCENE.A, -1.0),
    "signs, empty rows": (_with_empty_rows(), 1.0),
    "strong rows": (_strong_rows(), 1.0),
    "1x1": (np.array([[0.4]]), 1.0),
    "nothing": (np.zeros((5, 5)), 1.0),
    "below the diagonal": (np.tril(gallery.signed(19, 19, 2), -1) / 6, 1.0),
}
SKEWED = ("strong rows", "below the diagonal")  # walks as short as they can be, and rows of one large entry
VARIANTS: dict[str, dict[str, Any]] = {
    "collision": {},
    "endpoint": {"estimator": "endpoint"},
    "uniform": {"sampler": "uniform", "series": "chebyshev", "degree": 8},
    "cdf": {"sampler": "cdf"},
    "long": {"albedo": 0.47},
    "adjoint": {"adjoint": True},
}


def error_of(solution: Solution) -> np.ndarray:
    assert solution.standard_error is not None
    return solution.standard_error.astype(np.float64)


def system(device, name: str) -> tuple[IdentityPlus, np.ndarray]:
    R, sign = MATRICES[name]
    R = R.astype(np.float32)
    return IdentityPlus(CSR(device, scipy.sparse.csr_array(R)), sign), np.eye(len(R)) + sign * R.astype(float)


@pytest.mark.parametrize("variant", [name for name in VARIANTS if name != "uniform"])
@pytest.mark.parametrize("name", MATRICES)
def test_the_mean_of_many_runs_is_the_solution(device, name, variant):
    """Within 4 standard errors at every pixel, and these are as large as the runs' own spread says.

    Where few walks carry most of the variance they are larger, by what the runs have not met.
    """
    S, dense = system(device, name)
    b = gallery.vectors(len(dense), 2)
    exact = np.linalg.solve(dense, b.astype(float))
    runs = [ltcl.solve(S, b, "monte_carlo", samples=2048, seed=s, **VARIANTS[variant]) for s in range(24)]
    x = np.stack([run.x for run in runs]).astype(float)
    error = np.sqrt(np.mean([error_of(run) ** 2 for run in runs], axis=0))
    slack = 1e-5 * np.abs(exact).max()  # float32
    assert np.all(np.abs(x.mean(axis=0) - exact) <= 4 * error / 24**0.5 + slack)
    noisy = error > slack
    spread = x.std(axis=0, ddof=1)[noisy] / error[noisy]
    assert spread.size == 0 or (0.2 if name in SKEWED else 0.8) < np.sqrt(np.mean(spread**2)) < 1.25


@pytest.mark.parametrize("sampler", ["alias", "uniform"])
def test_a_polynomial_is_estimated_where_the_series_diverges(device, sampler):
    """Its mean is the polynomial itself: the iterate of Chebyshev on the free bounds."""
    scene = enclosure(40, albedo=0.6)  # rho(R) = 1.5
    S, b = IdentityPlus(Dense(device, scene.R)), np.random.default_rng(0).random(40)
    found = ltcl.solve(
        S, b, "monte_carlo", series="chebyshev", degree=4, samples=20_000, sampler=sampler, seed=3
    )
    centre, half = (0.5 + 2.5) / 2, (2.5 - 0.5) / 2
    values, vectors = np.linalg.eigh(scene.S)
    n = 5
    T = np.polynomial.chebyshev.Chebyshev.basis(n)
    p = (1 - T((centre - values) / half) / T(centre / half)) / values
    wanted = vectors @ (p * (vectors.T @ b))
    assert np.all(np.abs(found.x - wanted) <= 4 * error_of(found))
    assert found.reason.startswith("Chebyshev series of degree 4, which leaves 0.")


def test_importance_sampling_has_less_variance_than_uniform(device):
    """At equal samples, and by the ratio of their second moments in a row of known entries."""
    R = gallery.sparse(53, 53, 0.5, seed=2).toarray() ** 3
    R *= 0.5 / np.abs(R).sum(axis=1).max()
    S, b = IdentityPlus(Dense(device, R)), np.ones(53)
    drawn, uniform = (
        error_of(ltcl.solve(S, b, "monte_carlo", samples=2048, albedo=0.4, sampler=sampler))
        for sampler in ("alias", "uniform")
    )
    assert np.linalg.norm(drawn) < 0.7 * np.linalg.norm(uniform)


def test_variance_falls_as_one_over_the_samples(device):
    """Slope -1 of Fig. 8 within its 99 % confidence interval."""
    S, dense = system(device, "a scene")
    b = np.random.default_rng(2).random(43)
    exact, counts = np.linalg.solve(dense, b), np.array([16, 64, 256, 1024, 4096])
    errors = [
        np.mean([(ltcl.solve(S, b, "monte_carlo", samples=int(n), seed=s).x - exact) ** 2 for s in range(12)])
        for n in counts
    ]
    fit: Any = scipy.stats.linregress(np.log(counts), np.log(errors))
    assert abs(fit.slope + 1.0) <= scipy.stats.t.ppf(0.995, len(counts) - 2) * fit.stderr
    assert fit.stderr < 0.1


def test_final_gather_lowers_the_error_as_theory_says(device):
    """x = b - R x_mc: errors of pixels pass through R, their variances through its squares."""
    S, dense = system(device, "a scene")
    b = np.random.default_rng(3).random((43, 2))
    exact = np.linalg.solve(dense, b)
    ratios, factors = [], []
    for seed in range(60):
        plain, gathered = (
            ltcl.solve(S, b, "monte_carlo", samples=30, seed=seed, gather=gather) for gather in (False, True)
        )
        np.testing.assert_allclose(gathered.x, b - (dense - np.eye(43)) @ plain.x, rtol=0, atol=1e-5)
        passed = np.sqrt((dense - np.eye(43)) ** 2 @ error_of(plain) ** 2)
        np.testing.assert_allclose(error_of(gathered), passed, rtol=1e-4)
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
    assert "unknown of some pixels alone" in str(some)


def test_one_pixel_takes_no_walks_of_the_others(device, monkeypatch):
    """A launch has the chunks of 64 samples of the pixels that are asked for, and no more."""
    S, _ = system(device, "a scene")
    launched: list[int] = []
    launch = Walker._launch

    def spy(self: Walker, name: str, estimator: str, width: int, units: int, *rest: object) -> None:
        launched.append(units)
        launch(self, name, estimator, width, units, *rest)

    monkeypatch.setattr(Walker, "_launch", spy)
    ltcl.solve(S, np.ones(43), "monte_carlo", samples=128)
    ltcl.solve(S, np.ones(43), "monte_carlo", samples=128, pixels=[17])
    assert launched == [43 * 2, 2]


def test_right_hand_sides_share_their_walks(device):
    """Three colours of one S: the samples of each are those that it gets alone."""
    S, _ = system(device, "a scene")
    b = gallery.vectors(43, 3)
    together = ltcl.solve(S, b, "monte_carlo", samples=100, seed=3)
    for column, x in zip(b.T, together.x.T, strict=True):
        np.testing.assert_array_equal(x, ltcl.solve(S, column, "monte_carlo", samples=100, seed=3).x)


@pytest.mark.parametrize("options", [{}, {"gather": True}, {"adjoint": True}, {"error": 0.01}])
def test_it_repeats_to_the_bit_and_seeds_differ(device, options):
    S, _ = system(device, "signs, empty rows")
    b = gallery.vectors(41, None)
    first, second, other = (ltcl.solve(S, b, "monte_carlo", seed=s, **options) for s in (5, 5, 2**64 - 1))
    np.testing.assert_array_equal(first.x, second.x)
    np.testing.assert_array_equal(error_of(first), error_of(second))
    assert np.any(first.x != other.x)


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e25])
def test_a_target_error_is_reached(device, scale):
    """In the units of x, by as many samples as each pixel needs; columns differ."""
    S, dense = system(device, "a scene")
    b = np.random.default_rng(4).random((43, 2)) * (1.0, 0.1) * scale
    found = ltcl.solve(S, b, "monte_carlo", error=0.004 * scale)
    exact = np.linalg.solve(dense, b / scale)
    error = error_of(found) / scale
    assert np.max(error) <= 0.004
    assert np.median(error[:, 0]) > 0.002  # not by drowning it in samples
    z = (found.x.astype(float) / scale - exact) / error
    assert np.abs(z).max() < 4.5


def test_a_target_error_stops_at_the_samples_given(device):
    S, _ = system(device, "a scene")
    capped = ltcl.solve(S, np.ones(43), "monte_carlo", error=1e-9, samples=512)
    plain = ltcl.solve(S, np.ones(43), "monte_carlo", samples=512)
    np.testing.assert_array_equal(capped.x, plain.x)


def test_the_true_residual_decides(device):
    S, dense = system(device, "a scene")
    b = np.random.default_rng(5).random(43)
    noisy = ltcl.solve(S, b, "monte_carlo", samples=16, rtol=1e-3)
    assert noisy.status is Status.SAMPLED
    assert noisy.residual == pytest.approx(residual(dense, noisy.x, b), rel=1e-4)
    assert "try more samples=" in str(noisy)
    close = ltcl.solve(S, b, "monte_carlo", samples=4096, gather=True)
    assert close.converged
    assert residual(dense, close.x, b) <= 1e-2


def test_a_start_is_corrected(device):
    """Noise is that of what the start leaves: of the solution itself nothing but rounding."""
    S, dense = system(device, "a scene")
    b = np.random.default_rng(6).random((43, 2))
    exact = np.linalg.solve(dense, b)
    found = ltcl.solve(S, b, "monte_carlo", x0=exact, samples=16)
    np.testing.assert_allclose(found.x, exact, rtol=0, atol=1e-5)
    assert found.converged


@pytest.mark.parametrize("form", ["dense", "csr"])
def test_stored_S_is_taken_as_it_is(device, form):
    S, b = SCENE.S, np.ones(43)
    matrix = S if form == "dense" else scipy.sparse.csr_array(S)
    found = ltcl.solve(matrix, b, "monte_carlo", samples=4000)
    assert np.all(np.abs(found.x - np.linalg.solve(S, b)) <= 4.5 * error_of(found))


def test_no_light_gives_none(device):
    tried: list[dict[str, Any]] = [{}, {"adjoint": True}, {"gather": True}]
    for options in tried:
        found = ltcl.solve(SCENE.S, np.zeros((43, 2)), "monte_carlo", **options)
        assert found.converged
        assert not found.x.any()


def test_launches_tell_the_callback(device, monkeypatch):
    """While it draws there is no residual to tell: NaN, between that of the start and the one found."""
    monkeypatch.setattr("ltcl.operators.walks._UNITS", 43)  # 14 pixels of 3 chunks a launch
    S, _ = system(device, "a scene")
    seen: list[tuple[int, float]] = []
    found = ltcl.solve(S, np.ones(43), "monte_carlo", samples=192, callback=lambda *step: seen.append(step))
    assert [step for step, _ in seen] == [0, 1, 2, 3, 4, 5]
    np.testing.assert_array_equal([value for _, value in seen], [1.0, *[np.nan] * 4, found.residual])


BAD: dict[str, tuple[dict[str, Any], type[LtclError], str]] = {
    "no samples": ({"samples": 0}, InputError, "samples is 0; it must be a whole number of at least 1"),
    "half a sample": ({"samples": 0.5}, InputError, "samples is 0.5"),
    "too many samples": ({"samples": 1 << 32}, InputError, r"samples is 4294967296; it must be below 2\^32"),
    "negative seed": ({"seed": -1}, InputError, "seed is -1; it must be a whole number of at least 0"),
    "large seed": ({"seed": 1 << 64}, InputError, r"seed is 18446744073709551616; it must be below 2\^64"),
    "text seed": ({"seed": "7"}, InputError, "seed is '7'"),
    "negative m": ({"albedo": -0.2}, InputError, "albedo is -0.2; it must be a finite number above 0"),
    "m of 1/2": ({"albedo": 0.5}, InputError, r"albedo is 0.5; .* need m below 1/2"),
    "m of 1": ({"albedo": 1.0}, InputError, "albedo is 1; "),
    "m too small for R": (
        {"albedo": 0.2},
        InputError,
        r"albedo is 0.2; .*infinite below 0.2\d.*leave",
    ),
    "no error": ({"error": 0.0}, InputError, "error is 0.0; it must be a finite number above 0"),
    "pixel beyond": ({"pixels": [0, 43]}, InputError, r"pixels holds 43; they must be in 0\.\.42"),
    "pixel below": ({"pixels": [-1, 5]}, InputError, "pixels holds -1"),
    "no pixels": ({"pixels": []}, InputError, "pixels is empty; it must hold at least one"),
    "ragged pixels": ({"pixels": [[1], [2, 3]]}, InputError, "pixels is ragged"),
    "pixel names": ({"pixels": ["a"]}, InputTypeError, "pixels holds <U1; it must hold real numbers"),
    "gather in words": ({"gather": "no"}, InputTypeError, "gather is 'no'; it must be True or False"),
    "three gathers": ({"gather": 3}, InputTypeError, "gather is 3; it must be True or False"),
    "adjoint in words": ({"adjoint": "yes"}, InputTypeError, "adjoint is 'yes'; it must be True or False"),
    "almost 1/2": ({"albedo": 0.4999999}, InputError, "albedo is 0.4999999; .* at most 0.499975"),
    "a million": (
        {"series": "chebyshev", "degree": 10**6},
        InputError,
        "degree is 1000000; .* at most 10000",
    ),
    "pixel fractions": ({"pixels": [0.5]}, InputError, "pixels has shape .* whole numbers"),
    "estimator": (
        {"estimator": "track"},
        InputError,
        "estimator is 'track'; it must be one of",
    ),
    "sampler": ({"sampler": "walker"}, InputError, "sampler is 'walker'"),
    "series": ({"series": "taylor"}, InputError, "series is 'taylor'"),
    "degree": ({"series": "chebyshev", "degree": 0}, InputError, "degree is 0"),
    "degree alone": ({"degree": 3}, InputTypeError, "degree= is for series='chebyshev'"),
    "gather of pixels": (
        {"gather": True, "pixels": [1]},
        InputTypeError,
        "gather=True needs x at every",
    ),
    "adjoint of pixels": ({"adjoint": True, "pixels": [1]}, InputTypeError, "adjoint=True estimates whole"),
    "adjoint collisions": ({"adjoint": True, "estimator": "collision"}, InputTypeError, "adjoint=True has"),
    "adjoint beyond": ({"adjoint": True, "samples": 1 << 28}, InputError, "of 43 pixels adjoint=True takes"),
    "polynomial ends": ({"series": "chebyshev", "estimator": "endpoint"}, InputTypeError, "scores at every"),
    "polynomial by m": ({"series": "chebyshev", "albedo": 0.3}, InputTypeError, "walks of one length"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_options_are_refused_in_one_line(device, case):
    options, error, says = BAD[case]
    S = IdentityPlus(Dense(device, SCENE.R))
    with pytest.raises(error, match=says) as caught:
        ltcl.solve(S, np.ones(43), "monte_carlo", **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("rho", [1.0, 4.0])
def test_an_infinite_variance_is_refused_with_the_reason(device, rho):
    S = IdentityPlus(Dense(device, lambertian(30, rho).R))
    tried: list[dict[str, Any]] = [{}, {"estimator": "endpoint"}, {"sampler": "uniform"}, {"adjoint": True}]
    tried.append({"albedo": 0.45})
    for options in tried:
        with pytest.raises(InputError, match=r"second moments of (their )?weights grow by .*chebyshev"):
            ltcl.solve(S, np.ones(30), "monte_carlo", **options)


def test_walks_from_b_have_a_variance_of_their_own(device):
    """A strong row makes rows heavy and columns light: each kind of walk is judged by its own moments."""
    R = np.full((30, 30), 0.01)
    R[0] = 0.5
    S = IdentityPlus(Dense(device, R))
    rows, columns = (np.abs(np.linalg.eigvals(M.sum(axis=1)[:, None] * M)).max() for M in (R, R.T))
    assert columns < 1.0 < rows
    with pytest.raises(InputError, match="no finite variance"):
        ltcl.solve(S, np.ones(30), "monte_carlo")
    exact = np.linalg.solve(np.eye(30) + R, np.ones(30))
    found = ltcl.solve(S, np.ones(30), "monte_carlo", adjoint=True, samples=2000)
    assert np.all(np.abs(found.x - exact) <= 4 * error_of(found))


@pytest.mark.parametrize("degree", [60, 500])
def test_a_degree_that_float32_cannot_hold_is_refused(device, degree):
    S = IdentityPlus(Dense(device, lambertian(20, 9.0).R))
    with pytest.raises(InputError, match=r"beyond float32.*: lower degree=, or use method='chebyshev'"):
        ltcl.solve(S, np.ones(20), "monte_carlo", series="chebyshev", degree=degree)


def test_rows_that_overflow_are_refused(device):
    R = np.zeros((4, 4))
    R[2] = 3e38
    with pytest.raises(InputError, match=r"1 row\(s\) of R, first of row 2, sum to more than float32 holds"):
        ltcl.solve(IdentityPlus(Dense(device, R)), np.ones(4), "monte_carlo")


def test_operators_without_rows_are_refused(device):
    S = IdentityPlus(Host(device, scipy.sparse.linalg.aslinearoperator(SCENE.R)))
    with pytest.raises(InputError, match="method='monte_carlo' reads S row by row, which Host does"):
        ltcl.solve(S, np.ones(43), "monte_carlo")


def test_the_residual_is_that_of_x_even_where_noise_exceeds_b(device):
    S = np.eye(4) - 0.999 * np.ones((4, 4)) / 4
    found = ltcl.solve(S, np.ones(4), "monte_carlo")
    assert found.residual == pytest.approx(residual(S, found.x, np.ones(4)), rel=1e-3)
    assert found.residual == found.residuals[-1] > 1.0
    assert "at best" not in str(found)


@pytest.mark.parametrize(
    ("options", "advice"),
    [
        ({}, "try more samples=, or gather=True"),
        ({"gather": True}, "try more samples="),
        ({"pixels": [1]}, "try more samples="),
        ({"error": 0.05}, "try a smaller error=, or gather=True"),
        ({"error": 0.05, "pixels": [1]}, "in all"),
    ],
)
def test_advice_fits_the_options(device, options, advice):
    S, _ = system(device, "a scene")
    found = ltcl.solve(S, np.ones(43), "monte_carlo", rtol=1e-5, **({"samples": 9} | options))
    if "error" in options:
        found = ltcl.solve(S, np.ones(43), "monte_carlo", rtol=1e-5, **options)
    assert found.status is Status.SAMPLED
    assert str(found).endswith(advice)


def test_what_a_polynomial_leaves_is_said_with_what_it_rests_on(device):
    """Of an S that is not symmetric it may leave more."""
    S = IdentityPlus(Dense(device, SCENE.R))
    reason = ltcl.solve(S, np.ones(43), "monte_carlo", series="chebyshev", degree=3).reason
    assert re.search(r"of a residual, if the spectrum of S is real and within \[0.5, [\d.]+\]", reason)


def test_noise_that_drowns_a_polynomial_is_refused_and_told(device):
    """As large as it is: the root mean square of many runs, within a factor of three."""
    S, b = IdentityPlus(Dense(device, lambertian(43, 4.0).R)), np.random.default_rng(0).random(43)
    with pytest.raises(
        InputError, match=r"samples is 256; .* noise of about \d+ times b: give a lower degree="
    ):
        ltcl.solve(S, b, "monte_carlo", series="chebyshev")
    found = ltcl.solve(S, b, "monte_carlo", series="chebyshev", degree=9)
    told = re.search(r"noise of about ([\d.]+) times b with 256 samples", found.reason)
    assert told is not None
    noise = np.sqrt(np.mean(error_of(found) ** 2)) / np.sqrt(np.mean(b**2))
    assert noise / 3 < float(told[1]) < 3 * noise
    assert ltcl.solve(S, b, "monte_carlo", series="chebyshev", rtol=0.3).converged


def test_where_the_series_would_do_better_than_a_polynomial_it_is_said(device):
    """Forward, with row sums of A above 1: the free bounds begin at 0.001."""
    A = np.abs(np.random.default_rng(2).standard_normal((60, 60)) ** 5)
    A *= 0.6 / np.abs(np.linalg.eigvals(A)).max()
    assert A.sum(axis=1).max() > 1
    with pytest.raises(InputError, match="or use series='neumann'"):
        ltcl.solve(np.eye(60) - A, np.ones(60), "monte_carlo", series="chebyshev", rtol=0.3)


def test_uniform_walks_that_are_refused_are_told_of_those_that_are_not(device):
    R = np.abs(np.random.default_rng(2).standard_normal((60, 60)) ** 5)
    R *= 0.4 / np.abs(np.linalg.eigvals(R)).max()
    S = IdentityPlus(Dense(device, R))
    with pytest.raises(InputError, match=r"sampler='uniform' have no finite variance .* use sampler='alias'"):
        ltcl.solve(S, np.ones(60), "monte_carlo", sampler="uniform")
    assert ltcl.solve(S, np.ones(60), "monte_carlo", samples=4000, rtol=0.1).converged


@pytest.mark.parametrize("options", [{"series": "chebyshev"}, {"adjoint": True}, {}])
def test_stored_rows_that_overflow_are_refused_in_one_line(device, options):
    S = np.eye(8)
    S[0, 1:] = 3e38
    with pytest.raises(InputError, match="float32") as caught:
        ltcl.solve(scipy.sparse.csr_array(S), np.ones(8), "monte_carlo", **options)
    assert "\n" not in str(caught.value)
    assert "nan" not in str(caught.value)


@pytest.mark.parametrize(("options", "advice"), [
    ({}, "use series='chebyshev' or method='auto'"),
    ({"albedo": 0.4}, "use series='chebyshev' without albedo= or method='auto'"),
    ({"adjoint": True}, "use series='chebyshev' without adjoint= or method='auto'"),
    ({"estimator": "endpoint"}, "use series='chebyshev' without estimator= or method='auto'"),
    ({"estimator": "endpoint", "albedo": 0.4}, "without estimator= and albedo= or method='auto'"),
    ({"estimator": "endpoint", "albedo": 0.5}, "without estimator= and albedo= or method='auto'"),
])  # fmt: skip
def test_no_refusal_advises_what_is_refused_too(options, advice):
    S, b = np.eye(4) + 1.5 * np.eye(4)[[1, 0, 3, 2]], np.ones(4)
    with pytest.raises(InputError) as caught:
        ltcl.solve(S, b, "monte_carlo", **options)
    assert str(caught.value).endswith(advice)
    kept = {k: v for k, v in options.items() if f"{k}=" not in advice}
    assert ltcl.solve(S, b, "monte_carlo", series="chebyshev", **kept).converged
    assert ltcl.solve(S, b, "auto").converged


def test_a_degree_that_nobody_gave_is_lowered_by_rtol():
    G = np.random.default_rng(1).standard_normal((30, 30))
    G *= 0.5 / np.abs(np.linalg.eigvals(G)).max()
    with pytest.raises(InputError, match=r"degree is \d+; .*: raise rtol=, or use method='chebyshev'"):
        ltcl.solve(np.eye(30) + G, np.ones(30), "monte_carlo", series="chebyshev")
    with pytest.raises(InputError, match=r"degree is 124; .*: lower degree=, or use method='chebyshev'"):
        ltcl.solve(np.eye(30) + G, np.ones(30), "monte_carlo", series="chebyshev", degree=124)
