# SPDX-License-Identifier: BSD-3-Clause
"""Three S at once: one walk a sample, no colour biased, and walks of their own where sharing is of no use."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import InputError, InputTypeError, LtclError
from ltcl.operators import CSR, Dense, IdentityPlus
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
    "both": lambda device, R, c: Dense(device, R) if c == 1 else CSR(device, scipy.sparse.csr_array(R)),
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


def launched(device, call: Any) -> dict[str, int]:
    """Launches of walks, by kernel."""
    before = device.launches.copy()
    call()
    return {name: count for name, count in (device.launches - before).items() if name.startswith("walk")}


@pytest.mark.parametrize("options", [{}, {"adjoint": True}])
@pytest.mark.parametrize("name", COLOURS)
def test_the_mean_of_many_runs_is_the_solution_of_every_channel(device, name, options):
    """Within 4 standard errors at every pixel, and these are as large as the runs' own spread says."""
    S, dense = systems(device, name, "both" if name == "apart" else "csr")
    b = pictures(2)
    exact = solved(dense, b)
    runs = [ltcl.solve(S, b, "monte_carlo", samples=256, seed=s, **options) for s in range(24)]
    x = np.stack([run.x for run in runs]).astype(float)
    error = np.sqrt(np.mean([error_of(run) ** 2 for run in runs], axis=0))
    slack = 1e-4 * np.abs(exact).max()
    assert x.shape == (24, 3, N, 2)
    assert np.all(np.abs(x.mean(axis=0) - exact) <= 4 * error / 24**0.5 + slack)
    for c in range(3):
        noisy = error[c] > slack
        spread = x[:, c].std(axis=0, ddof=1)[noisy] / error[c][noisy]
        assert spread.size == 0 or 0.8 < np.sqrt(np.mean(spread**2)) < 1.25


@pytest.mark.parametrize("method", ["monte_carlo", "hybrid"])
def test_a_sample_is_one_walk_and_not_three(device, method):
    S, _ = systems(device, "scenes")
    steps = 1 if method == "monte_carlo" else int(np.ceil(np.log(1e-2) / np.log(0.6)))
    for call in (
        lambda: ltcl.solve(S, pictures(), method, samples=128),
        lambda: solve_each(S, list(pictures(4)), method, samples=128),
    ):
        assert launched(device, call) == {"walk_rows": steps}


@pytest.mark.parametrize("scale", [(1.0, 1.0, 1.0), (1e-20, 1.0, 1e15)])
def test_a_target_error_is_reached_in_every_channel(device, scale):
    """In the units of x: the brightest channel needs the most walks, and the others get as many."""
    S, dense = systems(device, "scenes")
    b = np.stack([np.random.default_rng(c).random(N) * factor for c, factor in enumerate(scale)])
    found = ltcl.solve(S, b, "monte_carlo", error=0.005 * max(scale))
    assert error_of(found).max() <= 0.005 * max(scale) * (1 + 1e-6)
    assert found.reason.count(f"error={0.005 * max(scale):g} was reached") == 1
    for c in range(3):
        z = (found.x[c] - np.linalg.solve(dense[c], b[c])) / error_of(found)[c]
        assert np.abs(z).max() < 4.5
    some = ltcl.solve(S, b, "monte_carlo", error=0.005 * max(scale), pixels=[40, 3])
    np.testing.assert_array_equal(some.x, found.x[:, [40, 3]])


@pytest.mark.parametrize(
    ("method", "options"), [("monte_carlo", {}), ("monte_carlo", {"adjoint": True}), ("hybrid", {})]
)
def test_the_largest_residual_is_told_and_all_products_are_counted(device, method, options):
    S, dense = systems(device, "scenes")
    b, seen = pictures(), []
    found = ltcl.solve(S, b, method, samples=16, callback=lambda *step: seen.append(step), **options)
    assert found.status is Status.SAMPLED
    largest = max(residual(*one) for one in zip(dense, found.x, b, strict=True))
    assert found.residual == pytest.approx(largest, rel=1e-4)
    assert found.products == 3
    assert [step for step, _ in seen] == list(range(len(seen)))
    assert [value for _, value in seen if np.isfinite(value)] == [1.0, found.residual]
    each = solve_each(S, list(b), method, samples=16, **options)
    np.testing.assert_array_equal(np.stack([one.x for one in each]), found.x)
    assert max(one.residual for one in each) == found.residual


def test_where_shared_walks_have_no_variance_channels_have_their_own(device):
    """Row sums of 0.8, moments of up to three times their square; and of signed light, samples too few."""
    Rs, b = _lit_apart(0.8), pictures()
    S = tuple(IdentityPlus(Dense(device, R)) for R in Rs)
    found = ltcl.solve(S, b, "monte_carlo", samples=4000)
    assert "channels share no walks" in found.reason
    exact = solved(np.stack([np.eye(N) + R for R in Rs]), b)
    assert np.all(np.abs(found.x - exact) <= 4.2 * error_of(found))
    np.testing.assert_array_equal(found.x[1], ltcl.solve(S[1], b[1], "monte_carlo", samples=4000).x)
    for signs in np.random.default_rng(0).choice((-1, 1), (3, N, N)), np.ones((3, N, N)):
        Rs = [0.6 * sign * R / np.linalg.norm(sign * R, 2) for sign, R in zip(signs, Rs, strict=True)]
        S = tuple(IdentityPlus(Dense(device, R)) for R in Rs)
        found = ltcl.solve(S, b, "hybrid", samples=1 if signs.min() > 0 else 64)
        assert ("share no walks" in found.reason) == (signs.min() > 0)


def test_what_no_channel_can_do_alone_is_refused(device):
    S = tuple(IdentityPlus(Dense(device, lambertian(30, rho).R)) for rho in (0.5, 1.2, 0.5))
    with pytest.raises(InputError, match=r"^in channel 1: .*variance"):
        ltcl.solve(S, np.ones((3, 30)), "monte_carlo")
    with pytest.raises(InputError, match=r"^in channel 1: .*1\.2"):
        ltcl.solve(S, np.ones((3, 30)), "hybrid")


BAD: dict[str, tuple[dict[str, Any], type[LtclError], str]] = {
    "b of one channel": ({"b": np.ones(N)}, InputError, r"b.*\(43,\).*\(3, 43\)"),
    "b the other way": ({"b": np.ones((N, 3))}, InputError, r"b.*\(43, 3\)"),
    "NaN in blue": ({"b": np.pad(np.full((1, N), np.nan), ((2, 0), (0, 0)))}, InputError, "channel 2.*b.*43"),
    "another method": ({"method": "cg"}, InputTypeError, "S is 3 operators"),
    "two S": ({"S": 2}, InputTypeError, "S is 2 operators"),
    "an option": ({"light": 1}, InputTypeError, "'light'"),
    "a pixel": ({"pixels": [N]}, InputError, "pixels.*43"),
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
