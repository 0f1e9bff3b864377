# SPDX-License-Identifier: BSD-3-Clause
"""Benches of the paper's figures: failed claims end them, and their computations are right."""

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
from ltcl.scenes import dihedral

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
    return load("_harness").Options(
        smoke=True, json=tmp_path / "new" / "found.json", plot=None, device=device
    )


def conclude(figures: Any, given: Any, *claims: Any) -> list[dict[str, Any]]:
    """The claims as they were written."""
    figures.conclude(given, "title", claims, {"fact": 1.0}, lambda: None)
    return json.loads(given.json.read_text())["claims"]


@pytest.mark.slow
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
    good = figures.Claim("a", "1", "1", np.bool_(True))
    bad = figures.Claim("b", "3", "below 2", False)
    with pytest.raises(SystemExit) as end:
        conclude(figures, given, good, bad)
    assert end.value.code == 1
    assert [one["verdict"] for one in json.loads(given.json.read_text())["claims"]] == [
        "holds",
        "FAILS",
    ]


@pytest.mark.parametrize("n", [1, 2, 5])
def test_n_terms_hold_later_bounces_only(load: Callable[[str], Any], n: int) -> None:
    # (I - R + ... + (-R)^n) (I - A)^-1 = I - (-R)^(n+1), and R^(n+1) holds A^j binom(j-1, n) times.
    expected = [1, *((-1) ** n * math.comb(j - 1, n) for j in range(1, 10))]
    assert load("fig4").contents(n, 9).tolist() == expected


def test_a_slope_is_that_above_the_launch_floor(load: Callable[[str], Any]) -> None:
    pixels = np.array([2, 20, 200, 2000, 20000, 200000])
    found = load("fig7").law(pixels, 1e-3 + 1e-9 * pixels**1.5)
    # Only the largest takes five times the floor, which is the least time; three count at least.
    assert (found.start, found.count) == (2000, 3)
    assert found.slope == pytest.approx(1.5, abs=1e-4)
    np.testing.assert_allclose(found(pixels), 1e-3 + 1e-9 * pixels**1.5, rtol=1e-4)


@pytest.mark.slow
def test_every_way_finds_the_direct_light(load: Callable[[str], Any], given: Any) -> None:
    at = load("fig7").problem(4)
    truth = at.l_out - dihedral(4, albedo=0.8).A @ at.l_out
    np.testing.assert_allclose(at.l_d, truth, rtol=1e-6)
    found = load("fig7").ways(given, at)
    assert sorted(found) == ["both", "iteration", "peer", "rows", "series"]
    for way in found.values():
        l_d = way.run()
        assert np.linalg.norm(l_d - truth) <= 1e-2 * np.linalg.norm(truth)
        assert way.error == pytest.approx(
            np.linalg.norm(l_d - truth) / np.linalg.norm(truth), rel=1e-3
        )


@pytest.mark.parametrize("n", [1, 2, 5])
def test_a_bounce_of_the_corner_is_that_of_the_dihedral(load: Callable[[str], Any], n: int) -> None:
    A = load("_corner").Bounce(n, 0.5)
    exact = dihedral(n, albedo=0.5).A
    for start, stop in ((0, 2 * n * n), (n, n + 1), (1, 2 * n), (0, 0)):
        np.testing.assert_allclose(A.rows(start, stop), exact[start:stop], rtol=1e-6, atol=1e-9)
    for shape in ((2 * n * n,), (2 * n * n, 3)):
        x = np.random.default_rng(n).random(shape, dtype=np.float32)
        np.testing.assert_allclose(A.matmat(x), exact @ x, rtol=1e-6, atol=1e-6)
