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


def jacobi(S: np.ndarray, b: np.ndarray, steps: int) -> np.ndarray:
    l = b
    for _ in range(steps):
        l = b - S @ l + l
    return l


@pytest.mark.parametrize("sampler", ["alias", "uniform"])
@pytest.mark.parametrize("dual", ["inverse", "forward"])
@pytest.mark.parametrize("form", ["csr", "dense"])
def test_the_mean_of_many_runs_is_the_iterate_of_jacobi(device, form, dual, sampler):
    M, sign = (SCENE.R, 1.0) if dual == "inverse" else (SCENE.A, -1.0)
    A = CSR(device, scipy.sparse.csr_array(M)) if form == "csr" else Dense(device, M)
    b = gallery.vectors(43, 2)
    options: dict[str, Any] = {"samples": 16, "iterations": 3, "sampler": sampler}
    runs = [ltcl.solve(IdentityPlus(A, sign), b, "hybrid", seed=s, **options).x for s in range(100)]
    x = np.stack(runs).astype(float)
    wanted = jacobi(np.eye(43) + sign * M, b, 3)
    assert np.all(np.abs(x.mean(axis=0) - wanted) <= 4.2 * x.std(axis=0, ddof=1) / 10)
    assert x.std(axis=0).max() > 0.01


def test_signs_and_empty_rows(device):
    R = gallery.sparse(41, 41, 0.3, seed=5).toarray() / 10
    R[[0, 9, 40]] = 0
    b = gallery.vectors(41, None)
    S = IdentityPlus(CSR(device, scipy.sparse.csr_array(R)))
    x = np.stack([ltcl.solve(S, b, "hybrid", seed=s, samples=64).x for s in range(30)]).astype(float)
    exact = np.linalg.solve(np.eye(41) + R.astype(float), b)
    assert np.all(
        np.abs(x.mean(axis=0) - exact) <= 4 * x.std(axis=0, ddof=1) / 30**0.5 + 1e-2 * np.abs(exact)
    )
    np.testing.assert_array_equal(x[:, [0, 9, 40]], np.broadcast_to(b[[0, 9, 40]], (30, 3)))


def test_noise_falls_with_samples_and_with_final_gather(device):
    b = np.random.default_rng(1).random((43, 3))
    exact = np.linalg.solve(SCENE.S, b)

    def error(**options: Any) -> float:
        runs = [ltcl.solve(SCENE.S, b, "hybrid", rtol=1e-3, seed=s, **options).x for s in range(12)]
        return float(np.sqrt(np.mean((np.stack(runs) - exact) ** 2)))

    few, many, gathered = error(samples=16), error(samples=1024), error(samples=16, gather=True)
    assert many == pytest.approx(few / 8, rel=0.3)  # 64 times the samples
    assert gathered < 0.4 * few


def test_the_true_residual_decides(device):
    b = np.random.default_rng(2).random(43)
    found = ltcl.solve(SCENE.S, b, "hybrid", samples=4)
    assert found.status is Status.SAMPLED
    assert found.residual == pytest.approx(residual(SCENE.S, found.x, b), rel=1e-4)
    assert ltcl.solve(SCENE.S, b, "hybrid", samples=2000, gather=True).converged
    assert ltcl.solve(SCENE.S, np.zeros(43), "hybrid").converged


def test_it_repeats_to_the_bit_and_takes_a_start(device):
    b = np.random.default_rng(3).random((43, 2))
    first, second = (ltcl.solve(SCENE.S, b, "hybrid", seed=9) for _ in range(2))
    np.testing.assert_array_equal(first.x, second.x)
    assert np.any(first.x != ltcl.solve(SCENE.S, b, "hybrid", seed=10).x)
    exact = np.linalg.solve(SCENE.S, b)
    np.testing.assert_allclose(ltcl.solve(SCENE.S, b, "hybrid", x0=exact).x, exact, rtol=0, atol=1e-5)


def test_iterations_are_those_of_jacobi_and_never_above_maxiter(device):
    b = np.ones(43)
    assert ltcl.solve(SCENE.S, b, "hybrid", rtol=1e-2).iterations == int(np.ceil(np.log(1e-2) / np.log(0.6)))
    assert ltcl.solve(SCENE.S, b, "hybrid", maxiter=3).iterations == 3
    assert ltcl.solve(SCENE.S, b, "hybrid", iterations=5).iterations == 5


def test_too_few_iterations_are_told_and_are_no_noise(device):
    rho = 0.999
    wanted = int(np.ceil(np.log(1e-2) / np.log(rho)))
    S = np.eye(4) - rho * np.ones((4, 4)) / 4
    for options, what in [({}, "maxiter"), ({"maxiter": 20}, "maxiter"), ({"iterations": 30}, "iterations")]:
        found = ltcl.solve(S, np.ones(4), "hybrid", **options)
        count = found.iterations
        says = rf"stopped at {count} of the (\d+) iterations that rtol asks for: raise {what}=$"
        told = re.search(says, str(found))
        assert told is not None
        assert int(told[1]) == pytest.approx(wanted, rel=1e-2)  # the spectral radius is that of float32
        assert "noise" not in str(found)
        assert "try more samples" not in str(found)
    assert "stopped at" not in ltcl.solve(SCENE.S, np.ones(43), "hybrid", samples=2).reason


def test_the_noise_that_the_least_samples_leave_is_told(device):
    """Within a factor of three of what runs of many iterations end with."""
    R = np.random.default_rng(0).standard_normal((43, 43))
    R *= 0.75 / np.abs(np.linalg.eigvals(R)).max()
    S, b = np.eye(43) + R, np.random.default_rng(1).random(43)
    with pytest.raises(InputError, match="or use method='auto'") as caught:
        ltcl.solve(S, b, "hybrid", samples=1)
    told = re.search(r"must be (\d+) at least, which leave noise of about ([\d.]+) times", str(caught.value))
    assert told is not None
    exact, least = np.linalg.solve(S, b), int(told[1])
    runs = [ltcl.solve(S, b, "hybrid", samples=least, iterations=300, seed=s).x for s in range(6)]
    noise = np.sqrt(np.mean((np.stack(runs) - exact) ** 2) / np.mean(exact**2))
    assert noise / 3 < float(told[2]) < 3 * noise


def test_iterations_tell_the_callback(device):
    seen: list[tuple[int, float]] = []
    found = ltcl.solve(SCENE.S, np.ones(43), "hybrid", iterations=2, callback=lambda *step: seen.append(step))
    np.testing.assert_array_equal(seen, [(0, 1.0), (1, np.nan), (2, np.nan), (3, found.residual)])


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"samples": 0}, "samples is 0"),
        ({"seed": -1}, "seed is -1"),
        ({"seed": 1 << 64}, "it must be below 2"),
        ({"iterations": 0}, "iterations is 0"),
        ({"iterations": 10**6}, "iterations is 1000000; it must be at most 10000"),
        ({"sampler": "none"}, "sampler is 'none'"),
        ({"gather": 1}, "gather is 1; it must be True or False"),
    ],
)
def test_bad_options_are_refused_in_one_line(device, options, says):
    with pytest.raises((InputError, InputTypeError), match=says) as caught:
        ltcl.solve(SCENE.S, np.ones(43), "hybrid", **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [3e38, 1e38])
def test_rows_that_overflow_are_refused(device, value):
    R = np.zeros((4, 4))
    R[2] = value
    with pytest.raises(InputError, match=r"1 row\(s\) of R, first of row 2, sum to more than float32 holds"):
        ltcl.solve(IdentityPlus(Dense(device, R)), np.ones(4), "hybrid")


def test_where_jacobi_diverges_it_is_refused(device):
    S = IdentityPlus(Dense(device, lambertian(30, 1.2).R))
    with pytest.raises(InputError, match=r"spectral radius of R is 1.2; method='hybrid' .*use method='auto'"):
        ltcl.solve(S, np.ones(30), "hybrid")
