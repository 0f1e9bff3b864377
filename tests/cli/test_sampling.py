# SPDX-License-Identifier: BSD-3-Clause
"""Methods that sample, on the command line: their options, what is reported, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl import images

from .conftest import Program


def report(out: Path, command: str) -> dict[str, Any]:
    return json.loads((out / f"{command}.json").read_text())


@pytest.mark.parametrize("method", ["monte_carlo", "hybrid"])
def test_samples_and_seed_reach_the_solver(
    program: Program, transport: Path, picture: Path, tmp_path: Path, method: str
) -> None:
    out = tmp_path / "out"
    arguments = ("--out", out, "--method", method, "--samples", 300, "--seed", 2**64 - 1, "--high", 9)
    outcome = program("compensate", transport, picture, *arguments)
    assert outcome.code == 0, outcome.err
    said = report(out, "compensate")
    assert (said["options"]["samples"], said["options"]["seed"]) == (300, 2**64 - 1)
    (entry,) = said["pictures"]
    T, desired = ltcl.load(transport), images.read(picture)
    wanted = ltcl.compensate(T, desired, bounds=(0, 9), method=method, samples=300, seed=2**64 - 1, rtol=1e-2)
    np.testing.assert_array_equal(images.read(out / entry["pattern"]["exr"]), wanted.pattern)
    off = np.linalg.norm(T @ wanted.pattern - desired) / np.linalg.norm(desired)
    assert entry["error"] == pytest.approx(off, rel=1e-3)
    assert entry["gap"] >= entry["error"] * (1 - 1e-3)  # noise is no limit of the projector


def test_the_standard_error_is_reported(
    program: Program, transport: Path, picture: Path, tmp_path: Path
) -> None:
    arguments = ("--method", "monte_carlo", "--bounces", 1)
    assert program("separate", transport, picture, "--out", tmp_path / "out", *arguments).code == 0
    said = report(tmp_path / "out", "separate")
    assert (said["options"]["samples"], said["options"]["seed"]) == (256, 0)
    direct = next(part for part in said["pictures"][0]["parts"] if part["part"] == "direct")
    T = ltcl.load(transport)
    found = ltcl.separate(T, images.read(picture), 1, method="monte_carlo").solutions[0]
    for channel, one in zip(direct["channels"], found if isinstance(found, tuple) else (found,), strict=True):
        assert one.standard_error is not None
        spread = {"largest": one.standard_error.max(), "median": np.median(one.standard_error)}
        spread["unknown"] = 0
        assert channel["standard_error"] == pytest.approx(spread)


def test_methods_without_noise_report_no_error(
    program: Program, transport: Path, picture: Path, tmp_path: Path
) -> None:
    assert program("compensate", transport, picture, "--out", tmp_path / "out").code == 0
    said = report(tmp_path / "out", "compensate")
    assert "samples" not in said["options"]
    assert [channel["standard_error"] for channel in said["pictures"][0]["channels"]] == [None]


@pytest.mark.parametrize("command", ["compensate", "separate"])
@pytest.mark.parametrize("option", ["samples", "seed"])
def test_other_methods_refuse_samples_before_a_file_is_read(
    program: Program, tmp_path: Path, command: str, option: str
) -> None:
    arguments = (command, "none.npz", "none.png", "--out", tmp_path / "out", f"--{option}", 30)
    program(*arguments).refused(f"--{option} is 30, but --method is auto; only monte_carlo and hybrid sample")
    program(*arguments, "--method", "cg").refused("--method is cg")


@pytest.mark.parametrize(
    "option", [("--samples", 0), ("--samples", 2**32), ("--seed", -1), ("--seed", 2**64)]
)
def test_samples_and_seeds_out_of_range_are_wrong_usage(
    program: Program, tmp_path: Path, option: tuple[str, int]
) -> None:
    outcome = program(
        "compensate", "a.npz", "b.png", "--out", tmp_path / "out", "--method", "hybrid", *option
    )
    assert outcome.code == 2
    assert option[0] in outcome.err
