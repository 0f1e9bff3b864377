# SPDX-License-Identifier: BSD-3-Clause
"""Hybrid: Jacobi in the mean, with noise that falls with the samples and with final gather."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import CSR, Dense, IdentityPlus
from ltcl.solvers import Status
from tests import gallery
from tests.problems import lambertian, residual

SCENE = lambertian(43, rho=0.6, density=0.7)


def signed(n: int, norm: float) -> np.ndarray:
    """R of both signs and ||R||_2 = norm, whose walks have no finite variance."""
    R = np.random.default_rng(n).standard_normal((n, n))
    return R * (norm / np.linalg.norm(R, 2))


@pytest.mark.parametrize("sampler", ["alias", "uniform"])
@pytest.mark.parametrize("dual", ["inverse", "forward"])
@pytest.mark.parametrize("form", ["csr", "dense"])
def test_the_mean_of_many_runs_is_the_iterate_of_jacobi(device, form, dual, sampler):
    M, sign = (SCENE.R, 1.0) if dual == "inverse" else (SCENE.A, -1.0)
    A = CSR(device, scipy.sparse.csr_array(M)) if form == "csr" else Dense(device, M)
    b = gallery.vectors(43, 2)
    options: dict[str, Any] = {"samples": 16, "iterations": 3, "sampler": sampler}
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


def test_the_true_residual_decides():
    b = np.random.default_rng(2).random(43)
    found = ltcl.solve(SCENE.S, b, "hybrid", samples=4)
    assert found.status is Status.SAMPLED
    assert found.standard_error is None
    assert found.residual == pytest.approx(residual(SCENE.S, found.x, b), rel=1e-4)
    assert ltcl.solve(SCENE.S, b, "hybrid", samples=2000, gather=True).converged
    assert ltcl.solve(SCENE.S, np.zeros(43), "hybrid").converged


def test_it_repeats_to_the_bit_and_takes_a_start():
    b = np.random.default_rng(3).random((43, 2))
    first, second = (ltcl.solve(SCENE.S, b, "hybrid", seed=9) for _ in range(2))
    np.testing.assert_array_equal(first.x, second.x)
    assert np.any(first.x != ltcl.solve(SCENE.S, b, "hybrid", seed=10).x)
    exact = np.linalg.solve(SCENE.S, b)
    np.testing.assert_allclose(ltcl.solve(SCENE.S, b, "hybrid", x0=exact).x, exact, rtol=0, atol=1e-5)


def test_iterations_are_those_of_jacobi_and_too_few_are_told():
    wanted = int(np.ceil(np.log(1e-2) / np.log(0.6)))
    assert ltcl.solve(SCENE.S, np.ones(43), "hybrid", samples=2).iterations == wanted
    tried: list[tuple[dict[str, Any], str]] = [({"maxiter": 3}, "maxiter"), ({"iterations": 5}, "iterations")]
    for options, what in tried:
        found = ltcl.solve(SCENE.S, np.ones(43), "hybrid", samples=2, **options)
        assert found.iterations == options[what]
        assert re.search(rf"{found.iterations} of the {wanted} iterations.*{what}=$", str(found))


@pytest.mark.parametrize("form", ["csr", "dense"])
def test_it_refuses_samples_with_which_noise_may_grow_and_names_what_does_not(device, form):
    R = signed(31, 0.75)
    S = IdentityPlus(CSR(device, scipy.sparse.csr_array(R)) if form == "csr" else Dense(device, R))
    b = np.random.default_rng(0).standard_normal(31)
    with pytest.raises(InputError, match=r"samples.*3\b.*method='auto'") as caught:
        ltcl.solve(S, b, "hybrid", samples=3, iterations=200)
    enough = int(re.findall(r"samples=(\d+)", str(caught.value))[0])
    with pytest.raises(InputError, match=f"samples.*{enough - 1}"):
        ltcl.solve(S, b, "hybrid", samples=enough - 1)
    runs = [ltcl.solve(S, b, "hybrid", samples=enough, iterations=200, seed=s).x for s in range(5)]
    assert np.abs(np.stack(runs) - np.linalg.solve(np.eye(31) + R, b)).max() < 20 * np.abs(b).max()


def test_light_of_one_sign_needs_one_sample():
    """R >= 0 of a scene: rho(Q) is about rho(R)^2, and nothing is to be refused."""
    scene = lambertian(43, rho=0.9)
    b = np.random.default_rng(1).random(43)
    found = ltcl.solve(scene.S, b, "hybrid", samples=1, iterations=100)
    assert np.sqrt(np.mean((found.x - np.linalg.solve(scene.S, b)) ** 2)) < 10 * np.abs(b).max()


def test_where_jacobi_diverges_it_is_refused(device):
    S = IdentityPlus(Dense(device, lambertian(30, 1.2).R))
    with pytest.raises(InputError, match=r"1\.2.*hybrid.*method='auto'"):
        ltcl.solve(S, np.ones(30), "hybrid")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"samples": 0}, "samples.*0"),
        ({"seed": -1}, "seed.*-1"),
        ({"iterations": 0}, "iterations.*0"),
        ({"iterations": 10**6}, "iterations.*1000000.*10000"),
        ({"sampler": "cdf"}, "sampler.*cdf.*alias, uniform"),
        ({"gather": 1}, "gather.*1"),
    ],
)
def test_bad_options_are_refused_in_one_line(options, says):
    with pytest.raises((InputError, InputTypeError), match=says) as caught:
        ltcl.solve(SCENE.S, np.ones(43), "hybrid", **options)
    assert "\n" not in str(caught.value)
