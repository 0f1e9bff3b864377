# SPDX-License-Identifier: BSD-3-Clause
"""Benches of the paper's figures: claims that fail end them, and what they compute with is right."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ltcl.device import Device
from ltcl.operators import Wavelet
from ltcl.scenes import box, dihedral

BENCH = Path(__file__).resolve().parents[1] / "bench"


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Any]:
    monkeypatch.syspath_prepend(str(BENCH))
    return importlib.import_module


@pytest.fixture
def figures(load: Callable[[str], Any]) -> Any:
    return load("_figures")


@pytest.fixture
def given(load: Callable[[str], Any], device: Device, tmp_path: Path) -> Any:
    return load("_harness").Options(True, tmp_path / "new" / "found.json", None, device)


def conclude(figures: Any, given: Any, *claims: Any) -> list[dict[str, Any]]:
    """The claims as they were written."""
    figures.conclude(given, "title", claims, {"fact": 1.0}, lambda: None)
    return json.loads(given.json.read_text())["claims"]


@pytest.mark.parametrize(
    ("holds", "differs", "passed", "verdict"),
    [
        (True, "", True, "holds"),
        (False, "", False, "FAILS"),
        (False, "rho is 1.04", True, "DIFFERS: rho is 1.04"),
        (True, "rho is 1.04", False, "FAILS: holds, though it is said to differ"),
        (np.bool_(False), "", False, "FAILS"),
    ],
)
def test_a_claim_passes_only_when_it_is_as_expected(
    figures: Any, holds: bool, differs: str, passed: bool, verdict: str
) -> None:
    claim = figures.Claim("it converges", "3", "below 2", holds, differs)
    assert (claim.passed, claim.verdict) == (passed, verdict)


def test_a_failed_claim_ends_the_bench_and_is_written(figures: Any, given: Any) -> None:
    good, bad = figures.Claim("a", "1", "1", np.bool_(True)), figures.Claim("b", "3", "below 2", False)
    with pytest.raises(SystemExit) as end:
        conclude(figures, given, good, bad)
    assert end.value.code == 1
    assert [one["verdict"] for one in json.loads(given.json.read_text())["claims"]] == ["holds", "FAILS"]


def test_claims_that_pass_end_quietly(figures: Any, given: Any) -> None:
    (written,) = conclude(figures, given, figures.Claim("a", "1", "1", True))
    assert written == {
        "text": "a",
        "measured": "1",
        "wanted": "1",
        "holds": True,
        "differs": "",
        "verdict": "holds",
    }


def test_signed_light_is_grey_where_it_is_zero_and_cyan_where_red_is_taken(figures: Any) -> None:
    scene = dihedral(2)
    middle = figures.signed(scene, np.zeros((*scene.grid, 3)), size=32)[16, 16]
    np.testing.assert_allclose(middle, 0.5, atol=1e-3)
    taken = np.zeros((*scene.grid, 3))
    taken[..., 0] = -1.0
    red, green, blue = figures.signed(scene, taken, size=32)[16, 16]
    assert red < 0.01 < 0.4 < green == pytest.approx(blue)


def test_terms_are_powers_of_minus_R(load: Callable[[str], Any]) -> None:
    R = np.array([[0.1, 0.4], [0.2, 0.3]])
    found = load("_boxes").terms(np.eye(2) + R, np.array([1.0, 2.0]), 3)
    expected = [np.linalg.matrix_power(-R, k) @ [1.0, 2.0] for k in range(4)]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_all_bounces_are_the_sum_of_single_ones(load: Callable[[str], Any]) -> None:
    boxes, scene = load("_boxes"), box(2, sides=3, albedo=[(0.5, 0.4, 0.3)])
    l_d = np.random.default_rng(0).random(scene.albedo.shape)
    total, term = l_d, l_d
    for _ in range(100):
        term = boxes.bounce(scene, term)
        total = total + term
    np.testing.assert_allclose(boxes.all_bounces(scene, l_d), total, rtol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 5])
def test_n_terms_hold_later_bounces_only(load: Callable[[str], Any], n: int) -> None:
    # (I - R + ... + (-R)^n) (I - A)^-1 = I - (-R)^(n+1), and R^(n+1) holds A^j binom(j-1, n) times.
    expected = [1, *((-1) ** n * math.comb(j - 1, n) for j in range(1, 10))]
    assert load("fig4").contents(n, 9).tolist() == expected


def test_light_field_sums_every_bounce(load: Callable[[str], Any]) -> None:
    A = np.array([[0.1, 0.4], [0.2, 0.3]])
    found = load("fig6").LightField(A) @ np.array([1.0, 2.0])
    np.testing.assert_allclose(found, np.linalg.solve(np.eye(2) - A, [1.0, 2.0]), rtol=1e-7)


def test_a_slope_is_that_above_the_launch_floor(load: Callable[[str], Any]) -> None:
    pixels = np.array([2, 20, 200, 2000, 20000, 200000])
    found = load("fig7").law(pixels, 1e-3 + 1e-9 * pixels**1.5)
    # Only the largest takes five times the floor, which is the least time; three count at least.
    assert (found.start, found.count) == (2000, 3)
    assert found.slope == pytest.approx(1.5, abs=1e-4)
    np.testing.assert_allclose(found(pixels), 1e-3 + 1e-9 * pixels**1.5, rtol=1e-4)


def test_a_slope_begins_behind_the_last_time_near_the_floor(load: Callable[[str], Any]) -> None:
    pixels = np.array([1, 10, 100, 1000, 10000, 100000])
    spent = 1e-3 + 1e-3 * pixels**2.0
    spent[0] = 1e-3
    assert load("fig7").law(pixels, spent).count == 5
    spent[2] = 2e-3  # a slow moment before it must not begin the slope
    found = load("fig7").law(pixels, spent)
    assert (found.start, found.count) == (1000, 3)
    assert found.slope == pytest.approx(2.0)


def test_a_slow_moment_at_the_smallest_is_no_floor(load: Callable[[str], Any]) -> None:
    pixels = np.array([1, 10, 100, 1000, 10000, 100000])
    spent = 1e-3 + 1e-6 * pixels**1.0
    spent[0] = 3e-3
    assert load("fig7").law(pixels, spent).slope == pytest.approx(1.0, abs=0.02)


def test_what_does_not_rise_above_the_launch_floor_has_no_slope(load: Callable[[str], Any]) -> None:
    found = load("fig7").law(np.array([2, 20, 200, 2000]), np.array([1e-3, 1.1e-3, 0.9e-3, 1e-3]))
    assert (found.slope, found(np.array([5.0]))) == (0.0, 0.9e-3)


def test_every_way_finds_the_direct_light(load: Callable[[str], Any], given: Any) -> None:
    at = load("_ways").problem(4)
    truth = at.l_out - dihedral(4, albedo=0.8).A @ at.l_out
    np.testing.assert_allclose(at.l_d, truth, rtol=1e-6)
    found = load("fig7").ways(given, at)
    assert sorted(found) == ["both", "iteration", "peer", "rows", "series"]
    for way in found.values():
        l_d = way.run()
        assert np.linalg.norm(l_d - truth) <= 1e-2 * np.linalg.norm(truth)
        assert way.error == pytest.approx(np.linalg.norm(l_d - truth) / np.linalg.norm(truth), rel=1e-3)


def test_rows_in_wavelets_are_those_of_R(load: Callable[[str], Any], given: Any) -> None:
    ways = load("_ways")
    at = ways.problem(4)
    R = ways.dense(given, at).R.to_dense()
    W = Wavelet(given.device, at.rows.grid, "db2").to_dense()
    both = ways.of_both(given, at)
    size = float(np.linalg.norm(R))
    np.testing.assert_allclose(both.toarray(), W @ R @ W.T, atol=1e-3 * size)
    np.testing.assert_allclose(ways.of_rows(given, at, both).toarray(), R @ W.T, atol=2e-3 * size)
