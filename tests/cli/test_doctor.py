# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl doctor` and `devices`: what works, what fails and what to do about it; `demo`: what it prints."""

from __future__ import annotations

import json
from typing import Any

import pytest

from ltcl import demo
from ltcl.cli import doctor
from ltcl.device import Device, discovery
from ltcl.solvers import METHODS

from .conftest import Program


def test_all_is_well_here_and_every_solver_and_product_is_tried(program, device, monkeypatch):
    kernel, files = Device.kernel, set()

    def record(self: Device, file: str, *arguments: Any, **defines: Any) -> Any:
        files.add(file)
        return kernel(self, file, *arguments, **defines)

    monkeypatch.setattr(Device, "kernel", record)
    told = program("doctor", "--json").json
    assert told["passed"] is True
    assert {f"solve, {method}" for method in METHODS} <= {check["check"] for check in told["checks"]}
    assert {"csr", "dense", "tile", "wavelet", "form_factor", "southwell", "walk", "vector"} <= files
    assert device.name in program("doctor").out


def failed(program: Program, *arguments: str) -> dict[str, Any]:
    """The only check that fails."""
    outcome = program("doctor", *arguments, "--json")
    assert outcome.code == 1
    (check,) = [check for check in outcome.document["checks"] if not check["passed"]]
    return check


def test_a_wrong_device_a_hidden_driver_and_a_bad_cache_have_a_fix(program, device, monkeypatch, tmp_path):
    check = failed(program, "--device", "nonsense")
    assert "nonsense" in check["found"]
    assert "ltcl devices" in check["fix"]
    (tmp_path / "file").write_text("no folder")
    with monkeypatch.context() as patch:
        patch.setenv("LTCL_CACHE", str(tmp_path / "file"))
        assert "LTCL_CACHE" in failed(program)["fix"]
        assert "FAILED  cache folder" in program("doctor").out
    monkeypatch.setattr(discovery, "list_devices", list)
    monkeypatch.setenv("OCL_ICD_VENDORS", "/nowhere")
    assert "OCL_ICD_VENDORS=/nowhere" in failed(program)["found"]


# What the loader would do, with a driver that does as its file says.
TRIAL = """
import os, time
action = open(os.environ["OCL_ICD_VENDORS"]).read()
if action == "crash":
    os.abort()
if action == "hang":
    time.sleep(60)
if action == "refuse":
    raise RuntimeError("a Python error harms nobody")
"""


@pytest.mark.parametrize("action", ["crash", "hang"])
def test_a_driver_that_crashes_or_hangs_is_named(program, device, monkeypatch, tmp_path, action):
    monkeypatch.setattr(doctor, "TRIAL", TRIAL)
    monkeypatch.setattr(doctor, "SECONDS", 2)
    monkeypatch.setenv("OCL_ICD_VENDORS", str(tmp_path))
    for name, does in (("bad", action), ("good", "work"), ("odd", "refuse")):
        (tmp_path / f"{name}.icd").write_text(does)
    check = failed(program)
    crashing, working = check["found"].split("working")
    assert "bad.icd" in crashing
    assert "odd.icd" in working
    assert "good.icd" in working
    assert "OCL_ICD_VENDORS" in check["fix"]


def test_wrong_results_are_findings(program, device, monkeypatch):
    monkeypatch.setitem(doctor.LIMITS, "product", 0.0)
    checks = program("doctor", "--json").document["checks"]
    wrong = [check for check in checks if "differs from NumPy" in check["found"]]
    assert {check["check"].partition(",")[0] for check in wrong} == {"product"}


def test_devices_mark_the_one_that_would_be_chosen(program, device, monkeypatch):
    entries = program("devices", "--json").json
    (chosen,) = [entry for entry in entries if entry["chosen"]]
    assert (chosen["name"], chosen["index"]) == (device.name, device.description.index)
    assert min(chosen["compute_units"], chosen["max_allocation"]) > 0
    (marked,) = [line for line in program("devices").out.splitlines() if line.startswith("->")]
    assert chosen["index"] in marked
    monkeypatch.setenv("LTCL_DEVICE", "nonsense")
    outcome = program("devices")
    assert (outcome.code, outcome.err) == (0, "ltcl: LTCL_DEVICE=nonsense matches none of these\n")
    assert device.name in outcome.out
    assert "->" not in outcome.out
    monkeypatch.setattr(discovery, "list_devices", list)
    program("devices").refused("no OpenCL device", "install")


def test_the_demo_says_what_was_reached_and_where_to_look(program, device, tmp_path):
    outcome = program("demo", "--out", tmp_path, "--size", "6", "--verbose")
    assert outcome.code == 0, outcome.err
    errors = json.loads((tmp_path / "report.json").read_text())["errors"]
    assert errors["compensated"] < 0.02 < errors["uncompensated"]
    for error in errors.values():
        assert f"{100 * error:.3g} %" in outcome.out
    assert "diverged" in outcome.out
    assert str(tmp_path / "contact_sheet.png") in outcome.out
    assert [line.removeprefix("ltcl: ") for line in outcome.err.splitlines()] == list(demo.STEPS)
