# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl doctor`: trials of drivers and of every kernel, in child processes, and their remedies."""

from __future__ import annotations

import re
from typing import Any

import pytest

from ltcl.cli import device_trials, doctor
from ltcl.device import Device, discovery, pocl_cache
from ltcl.device.sources import folder
from ltcl.solvers import METHODS

from .conftest import Program

# Kernels that ltcl launches on devices of the other kind alone.
KERNELS_OF_OTHERS = {
    "cpu": {
        "csr_matvec_group",
        "dense_matvec_group",
        "tile_matvec_group",
        "relax_rows",
        "relax_correct",
        "wavelet_tail_split",
        "wavelet_tail_join",
    },
    "gpu": {"relax_strips"},
}


def failed_checks(program: Program, *arguments: str) -> list[dict[str, Any]]:
    """Run `ltcl doctor`, and return the checks that fail."""
    outcome = program("doctor", *arguments, "--json")
    assert outcome.code == 1
    assert outcome.document["passed"] is False
    return [check for check in outcome.document["checks"] if not check["passed"]]


@pytest.mark.rare
def test_doctor_tries_every_solver_and_product(program, device):
    report = program("doctor", "--json").json
    assert report["passed"] is True
    names = {check["check"] for check in report["checks"]}
    assert {f"solve, {method}" for method in METHODS} <= names
    assert {"solve, bounded", "product, sparse", "product, dense", "product, wavelet"} <= names


@pytest.mark.rare
def test_trials_launch_every_kernel(shaped: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    # Variants are launched to be timed.
    monkeypatch.delenv("LTCL_TUNE")
    kernels = set()
    for path in folder().glob("*.cl"):
        kernels |= set(re.findall(r"^kernel void (\w+)\(", path.read_text(), re.MULTILINE))
    before = shaped.launches.copy()
    for trial in device_trials.trials(shaped):
        check = trial.check("")
        assert check.passed, check
    launched = set(shaped.launches - before)
    assert launched == kernels - KERNELS_OF_OTHERS[shaped.kind]


@pytest.mark.parametrize("kind", ["product", "solve"])
def test_a_wrong_result_fails_a_trial(device, monkeypatch, kind):
    monkeypatch.setitem(device_trials.LIMITS, kind, 0.0)
    for trial in device_trials.trials(device):
        if trial.kind == kind:
            check = trial.check("the remedy")
            assert not check.passed
            assert "NumPy" in check.found
            assert check.fix == "the remedy"
            return


@pytest.mark.parametrize(
    ("ending", "parts"),
    [
        ("os.abort()", ["SIGABRT", "last words"]),
        ("os._exit(3)", ["exit code 3", "last words"]),
        ("raise RuntimeError('broken')", ["error", "broken"]),
        ("time.sleep(60)", ["hangs"]),
    ],
)
def test_a_kernel_that_ends_the_process_is_named(program, device, monkeypatch, ending, parts):
    """The child prints two trials, of which the second ends it, and a line of the driver."""
    script = f"""
import json, os, sys, time
print(json.dumps({{"started": "product, first"}}))
print(json.dumps({{"check": "product, first", "passed": True, "found": "", "fix": ""}}))
print("a driver prints")
print(json.dumps({{"started": "product, second"}}), flush=True)
print("last words", file=sys.stderr)
{ending}
"""
    run_child = doctor._run_child

    def run_script(arguments: list[str], **variables: str) -> Any:
        if arguments[0] == "-m":
            arguments = ["-c", script]
        return run_child(arguments, **variables)

    monkeypatch.setattr(doctor, "_run_child", run_script)
    monkeypatch.setattr(doctor, "TRIAL", "")
    monkeypatch.setattr(doctor, "SECONDS", 5)
    (check,) = failed_checks(program)
    assert check["check"] == "product, second"
    for part in parts:
        assert part in check["found"]
    assert device.driver in check["fix"]


def test_a_failed_check_has_a_fix(program, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("LTCL_CACHE", str(tmp_path / "file"))
    monkeypatch.setattr(doctor, "_try_kernels", lambda device: iter([]))
    monkeypatch.setattr(doctor, "TRIAL", "")
    (cache,) = failed_checks(program)
    assert cache["check"] == "cache folder"
    assert "LTCL_CACHE" in cache["fix"]


@pytest.mark.rare
def test_an_unknown_device_fails_a_check(program):
    printed = program("doctor", "--device", "nonsense").out
    for word in ("FAILED", "nonsense", "fix: ", "ltcl devices", "1 of "):
        assert word in printed


@pytest.mark.parametrize("name", discovery.HIDING_VARIABLES)
@pytest.mark.parametrize("value", ["/nowhere", ""])
def test_what_may_hide_all_devices_is_named(program, monkeypatch, name, value):
    monkeypatch.setattr(discovery, "list_devices", list)
    monkeypatch.setattr(doctor, "TRIAL", "")
    monkeypatch.setenv(name, value)
    (check,) = failed_checks(program)
    assert f"{name}={value}" in check["found"]
    assert f"{name}={value}" in check["fix"]
    program("devices").assert_refused(f"{name}={value}")


def test_a_folder_that_pocl_cannot_use_is_named(program, device, monkeypatch, tmp_path):
    if pocl_cache.DRIVER not in device.driver:
        pytest.skip("the device is not of PoCL")
    monkeypatch.setattr(doctor, "TRIAL", "")
    monkeypatch.setattr(pocl_cache, "MIN_FREE_BYTES", 1 << 62)
    (check,) = failed_checks(program)
    assert str(pocl_cache.folder()) in check["found"]
    assert "POCL_CACHE_DIR" in check["fix"]


@pytest.mark.slow
def test_a_driver_that_crashes_or_hangs_is_named(program, monkeypatch, tmp_path):
    """The trial runs the file of a driver, as the loader would load it."""
    trial = "import os, time; exec(open(os.environ['OCL_ICD_VENDORS']).read())"
    monkeypatch.setattr(doctor, "TRIAL", trial)
    monkeypatch.setattr(doctor, "SECONDS", 2)
    monkeypatch.setenv("OCL_ICD_VENDORS", str(tmp_path))
    actions = {
        "crash": "os.abort()",
        "hang": "time.sleep(60)",
        "good": "",
        "odd": "raise RuntimeError",
    }
    for name, action in actions.items():
        (tmp_path / f"{name}.icd").write_text(action)
    (check,) = failed_checks(program)
    crashing, working = check["found"].split("working")
    # The driver of the wheel is there, too.
    assert re.findall(r"(\w+)\.icd", crashing) == ["crash", "hang"]
    assert {"good", "odd"} <= {*re.findall(r"(\w+)\.icd", working)}
    assert "OCL_ICD_VENDORS" in check["fix"]
