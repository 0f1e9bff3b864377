# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from ltcl import report
from ltcl.solvers import Solution, Status


@dataclass(frozen=True)
class Facts:
    norms: tuple[float, ...]
    at: Path


def test_plain_leaves_nothing_that_json_does_not_know() -> None:
    value = {1: np.arange(2), "b": np.bool_(True), "c": Facts((np.nan, -np.inf, 1.5), Path("x")), "d": None}
    assert report.plain(value) == {
        "1": [0, 1],
        "b": True,
        "c": {"norms": [None, None, 1.5], "at": "x"},
        "d": None,
    }
    assert json.loads(report.dumps(value)) == report.plain(value)


def test_a_solution_is_reported_without_its_vector() -> None:
    one = Solution(np.ones(4), Status.MAXITER, 2, 3, (1.0, 0.5, float("inf")), 0.1, "jacobi", "because")
    (facts,) = report.solution(one)
    assert (facts["method"], facts["status"], facts["products"]) == ("jacobi", "maxiter", 3)
    assert facts["residual"] == 0.5
    assert "x" not in facts
    assert facts["standard_error"] is None
    sampled = dataclasses.replace(one, standard_error=np.array([np.nan, 0.1, 0.3]))
    assert report.solution((sampled,) * 3)[2]["standard_error"] == {
        "largest": 0.3,
        "median": pytest.approx(0.2),
        "unknown": 1,
    }
