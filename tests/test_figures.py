# SPDX-License-Identifier: BSD-3-Clause
"""A claim that fails ends a bench of the paper's figures with exit status 1, and is written as it is."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ltcl.device import Device

BENCH = Path(__file__).resolve().parents[1] / "bench"


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(BENCH))
    return importlib.import_module("_figures")


@pytest.fixture
def given(figures: Any, device: Device, tmp_path: Path) -> Any:
    return importlib.import_module("_harness").Options(True, tmp_path / "new" / "found.json", None, device)


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
    from ltcl.scenes import box

    scene = box(2, sides=2)
    middle = figures.signed(scene, np.zeros((*scene.grid, 3)), size=32)[16, 16]
    np.testing.assert_allclose(middle, 0.5, atol=1e-3)
    taken = np.zeros((*scene.grid, 3))
    taken[..., 0] = -1.0
    red, green, blue = figures.signed(scene, taken, size=32)[16, 16]
    assert red < 0.01 < 0.4 < green == pytest.approx(blue)
