# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from ltcl import report
from ltcl.device import Device
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


def test_solution_is_told_without_its_vector() -> None:
    one = Solution(np.ones(4), Status.MAXITER, 2, 3, (1.0, 0.5, float("inf")), 0.1, "jacobi", "because")
    (told,) = report.solution(one)
    assert (told["method"], told["status"], told["products"]) == ("jacobi", "maxiter", 3)
    assert told["residual"] == 0.5
    assert "x" not in told
    assert len(report.solution((one, one, one))) == 3


def test_write_replaces_whole_files_only(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    report.write(path, {"a": 1})
    circle: list = []
    circle.append(circle)
    with pytest.raises(RecursionError):
        report.write(path, circle)
    assert json.loads(path.read_text()) == {"a": 1}
    assert [file.name for file in tmp_path.iterdir()] == ["report.json"]


def test_device_and_versions(device: Device) -> None:
    assert report.device(device)["name"] == device.name
    assert {"ltcl", "python", "numpy", "scipy", "pyopencl"} <= set(report.versions())
