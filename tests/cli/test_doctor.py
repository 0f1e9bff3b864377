# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

import errno
from pathlib import Path

import pytest

from ltcl.cli import device_checks, doctor
from ltcl.device import Device, discovery, kernels
from ltcl.errors import DeviceError, FileError

from .conftest import Program


def test_all_is_well_here(program: Program, device: Device) -> None:
    outcome = program("doctor")
    assert outcome.code == 0, outcome.out
    assert "FAILED" not in outcome.out
    assert device.name in outcome.out


def test_json_covers_every_kernel_file(program: Program, device: Device) -> None:
    outcome = program("doctor", "--json")
    assert outcome.code == 0
    assert outcome.json["passed"] is True
    checks = {check["check"] for check in outcome.json["checks"]}
    assert {f"kernels/{file.name}" for file in kernels.folder().glob("*.cl")} <= checks


def test_wrong_device_fails_with_a_fix(program: Program, device: Device) -> None:
    outcome = program("doctor", "--device", "nonsense", "--json")
    assert outcome.code == 1
    (failed,) = [check for check in outcome.json["checks"] if not check["passed"]]
    assert "nonsense" in failed["found"]
    assert "ltcl devices" in failed["fix"]


def test_unusable_cache_fails(
    program: Program, device: Device, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    taken = tmp_path / "file"
    taken.write_text("no folder")
    monkeypatch.setenv("LTCL_CACHE", str(taken))
    outcome = program("doctor")
    assert outcome.code == 1
    assert "FAILED  cache folder" in outcome.out
    assert "LTCL_CACHE" in outcome.out


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
def test_crashing_driver_is_named_and_not_loaded(
    program: Program, device: Device, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, action: str
) -> None:
    monkeypatch.setattr(device_checks, "TRIAL", TRIAL)
    monkeypatch.setattr(device_checks, "_SECONDS", 2)
    monkeypatch.setenv("OCL_ICD_VENDORS", str(tmp_path))
    for name, does in (("bad", action), ("good", "work"), ("odd", "refuse")):
        (tmp_path / f"{name}.icd").write_text(does)
    outcome = program("doctor", "--json")
    assert outcome.code == 1
    *_, drivers = outcome.json["checks"]
    crashing, working = drivers["found"].split("working")
    assert "bad.icd" in crashing
    assert "odd.icd" in working
    assert "good.icd" in working
    assert "OCL_ICD_VENDORS" in drivers["fix"]


def test_wrong_results_are_a_failure() -> None:
    with pytest.raises(DeviceError, match="differs from NumPy"):
        device_checks._agrees(1.0, 1e-5, "NumPy")
    with pytest.raises(DeviceError):
        device_checks._agrees(float("nan"), 1e-5, "NumPy")


def test_old_dependency_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_wanted", lambda: [("numpy", "999.0"), ("no-such-package", "1")])
    finding = doctor.attempt("dependencies", doctor._dependencies, "pip install")
    assert not finding.passed
    assert "it must be at least 999.0" in finding.found
    assert "no-such-package is missing" in finding.found


def test_whatever_is_raised_is_a_finding() -> None:
    finding = doctor.attempt("x", lambda: str(1 / 0), "no fix")
    assert not finding.passed
    assert finding.found.startswith("ZeroDivisionError")


def test_chmod_is_no_advice_for_a_read_only_disk() -> None:
    def fail() -> str:
        raise OSError(errno.EROFS, "Read-only file system")

    finding = doctor.attempt("cache folder", fail, doctor._cache_fix)
    assert finding.fix == "set LTCL_CACHE=DIR to a folder that can be written"
    assert doctor._cache_fix(FileError("mode 755")).startswith("chmod 700")


def test_a_variable_that_hides_the_drivers_is_named(
    program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(discovery, "list_devices", list)
    monkeypatch.setenv("OCL_ICD_VENDORS", "/nowhere")
    outcome = program("doctor", "--json")
    (failed,) = [check for check in outcome.json["checks"] if check["check"] == "device"]
    assert "OCL_ICD_VENDORS=/nowhere" in failed["found"]
