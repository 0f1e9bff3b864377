# SPDX-License-Identifier: BSD-3-Clause
"""Help, exit codes, errors, notes and progress; `ltcl doctor` and `devices`."""

from __future__ import annotations

import logging
import re
import subprocess
import sys
import time
from functools import partial
from typing import Any
from unittest.mock import Mock

import pytest

import ltcl
from ltcl.cli import command, doctor
from ltcl.cli.progress import Progress
from ltcl.device import Device, discovery
from ltcl.solvers import METHODS
from tests import json_schema

from .conftest import Program

COMMANDS = [
    *("devices", "doctor", "demo", "simulate", "info", "analyze", "convert", "compress", "denoise"),
    *(
        "invert",
        "compensate",
        "film",
        "separate",
        "relight",
        "view",
        "play",
        "show",
        "acquire plan",
        "acquire run",
        "acquire report",
    ),
]
EXIT_CODES = (json_schema.PAGES / "exit-codes.md").read_text(encoding="utf-8")


def test_version_and_help(program):
    assert program("--version").out == f"ltcl {ltcl.__version__}\n"
    outcome = program("--help")
    assert all(name.partition(" ")[0] in outcome.out for name in COMMANDS)
    for code in (
        command.FAILED,
        command.USAGE,
        command.WAITING,
        command.INTERNAL,
        command.INTERRUPTED,
    ):
        assert f" {code} " in outcome.out
        assert f"| {code} |" in EXIT_CODES


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(program, name):
    text = program(*name.split(), "--help").out
    assert all(option in text for option in ("--json", "--quiet", "-q", "--verbose"))
    assert name.replace(" ", "-") in json_schema.SCHEMA["$defs"]


def test_python_m_is_the_same_program_and_its_help_imports_nothing_heavy():
    words = [sys.executable, "-X", "importtime", "-m", "ltcl", "--help"]
    run = subprocess.run(words, capture_output=True, text=True)
    assert (run.returncode, "compensate" in run.stdout) == (0, True)
    imported = {line.split("|")[-1].strip().partition(".")[0] for line in run.stderr.splitlines()}
    assert {"pyopencl", "matplotlib", "cv2"} & imported == set() < {"typer"} & imported


@pytest.mark.parametrize(
    ("error", "code", "parts"),
    [
        (KeyboardInterrupt(), 130, ["interrupted"]),
        (MemoryError(), 1, ["memory"]),
        (ltcl.errors.DeviceError("of two\n  lines"), 1, ["of two lines"]),
        (ZeroDivisionError("by nothing"), 70, ["ZeroDivisionError", "by nothing", "--verbose"]),
    ],
)
def test_what_a_command_raises_is_a_line_a_code_and_json(program, monkeypatch, error, code, parts):
    monkeypatch.setattr(doctor.discovery, "list_devices", Mock(side_effect=error))
    program("devices").refused(*parts, code=code)
    failed = program("devices", "--json")
    assert (failed.document["type"], failed.document["exit_code"]) == (type(error).__name__, code)
    assert ("Traceback" in program("devices", "--verbose").err) == (code == 70)


def test_quiet_and_verbose_and_warnings_of_the_library(program, transport, tmp_path, monkeypatch):
    arguments = ["convert", transport, tmp_path / "T.npy"]
    assert "--grid 5x10" in program(*arguments).err
    assert program(*arguments, "--quiet").err == ""
    assert re.search(
        r"^ltcl: reading .*corner\.npz$", program(*arguments, "--verbose").err, re.MULTILINE
    )

    warn = partial(logging.getLogger("ltcl.store").warning, "grid 16 x 64:\n is it right?")
    monkeypatch.setattr(doctor.discovery, "list_devices", lambda: warn() or [])
    assert program("devices").err.splitlines()[0] == "ltcl: warning: grid 16 x 64: is it right?"
    assert logging.getLogger("ltcl").level == logging.NOTSET


def test_progress_is_a_bar_with_elapsed_time_and_time_left(capsys, monkeypatch):
    for terminal, quiet in ((False, False), (True, True), (True, False)):
        monkeypatch.setenv("FORCE_COLOR", "1" if terminal else "")
        with Progress(quiet) as progress:
            progress("reading")
            progress("frames", 8, 32)
            progress("frames", 16, 32)
            progress.refresh()
        out, err = capsys.readouterr()
        assert (out, progress.tasks[0].completed) == ("", 16)
        assert all(
            (part in err) == (terminal and not quiet) for part in ("frames", "0:00:0", "left")
        )


def failed(program: Program, *arguments: str) -> list[dict[str, Any]]:
    """The checks that fail."""
    outcome = program("doctor", *arguments, "--json")
    assert (outcome.code, outcome.document["passed"]) == (1, False)
    return [check for check in outcome.document["checks"] if not check["passed"]]


def test_all_is_well_here_and_every_solver_and_product_is_tried(program, device, monkeypatch):
    kernel, files = Device.kernel, set()

    def record(self: Device, file: str, *arguments: Any, **defines: Any) -> Any:
        files.add(file)
        return kernel(self, file, *arguments, **defines)

    monkeypatch.setattr(Device, "kernel", record)
    report = program("doctor", "--json").json
    assert report["passed"] is True
    assert {f"solve, {method}" for method in METHODS} <= {
        check["check"] for check in report["checks"]
    }
    assert {
        "csr",
        "dense",
        "tile",
        "wavelet",
        "form_factor",
        "southwell",
        "walk",
        "vector",
    } <= files


def test_a_compiler_prints_nothing(device, capfd):
    """Remarks on a kernel of constants; a define of its own keeps the driver's cache out."""
    device.kernel("form_factor", "form_factor_matvec", K=1, LANES=8, BLOCKS=0, FRESH=time.time_ns())
    assert capfd.readouterr() == ("", "")


def test_what_fails_has_a_fix(program, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("no folder")
    with monkeypatch.context() as patch:
        patch.setenv("LTCL_CACHE", str(tmp_path / "file"))
        patch.setitem(doctor.LIMITS, "product", 0.0)
        cache, *products = failed(program)
        assert (cache["check"], "LTCL_CACHE" in cache["fix"]) == ("cache folder", True)
        assert {(each["check"][:8], "NumPy" in each["found"]) for each in products} == {
            ("product,", True)
        }
    printed = program("doctor", "--device", "nonsense").out
    assert all(word in printed for word in ("FAILED", "nonsense", "fix: ", "ltcl devices", "1 of "))
    monkeypatch.setattr(discovery, "list_devices", list)
    monkeypatch.setenv("OCL_ICD_VENDORS", "/nowhere")
    (check,) = failed(program)
    assert "OCL_ICD_VENDORS=/nowhere" in check["found"]


def test_a_driver_that_crashes_or_hangs_is_named(program, monkeypatch, tmp_path):
    """As the loader would do, with drivers that do what is in their files."""
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
    (check,) = failed(program)
    crashing, working = check["found"].split("working")
    assert [name for name in actions if f"{name}.icd" in crashing] == ["crash", "hang"]
    assert [name for name in actions if f"{name}.icd" in working] == ["good", "odd"]
    assert "OCL_ICD_VENDORS" in check["fix"]


def test_devices_mark_the_one_that_would_be_chosen(program, device, monkeypatch):
    entries = program("devices", "--json").json
    (chosen,) = [entry for entry in entries if entry["chosen"]]
    assert (chosen["name"], chosen["index"]) == (device.name, device.description.index)
    assert ["->", chosen["index"]] in [
        line.split()[:2] for line in program("devices").out.splitlines()
    ]
    monkeypatch.setenv("LTCL_DEVICE", "nonsense")
    outcome = program("devices")
    assert (outcome.code, outcome.err) == (0, "ltcl: LTCL_DEVICE=nonsense matches none of these\n")
    assert "->" not in outcome.out
    monkeypatch.setattr(discovery, "list_devices", list)
    program("devices").refused("no OpenCL device", "install")
