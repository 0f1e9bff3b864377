# SPDX-License-Identifier: BSD-3-Clause
"""The program as a whole: help, exit codes, errors as one line and as JSON, output places."""

from __future__ import annotations

import logging
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import ltcl
from ltcl.cli import command, devices

COMMANDS = [
    *("devices", "doctor", "demo", "simulate", "info", "analyze", "convert", "compress", "invert"),
    *("compensate", "separate", "relight", "show", "acquire plan", "acquire run", "acquire report"),
]
DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "cli.md"


def test_version_and_help(program):
    assert program("--version").out == f"ltcl {ltcl.__version__}\n"
    outcome = program("--help")
    assert outcome.code == 0
    assert all(name.partition(" ")[0] in outcome.out for name in COMMANDS)
    for code in (command.FAILED, command.USAGE, command.WAITING, command.INTERNAL, command.INTERRUPTED):
        assert f" {code} " in outcome.out
        assert f"| {code} |" in DOCUMENT.read_text()


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(program, name):
    outcome = program(*name.split(), "--help")
    assert outcome.code == 0
    assert all(option in outcome.out for option in ("--json", "--quiet", "-q", "--verbose"))
    assert f"ltcl {name}" in DOCUMENT.read_text()


def test_names_of_earlier_versions_are_hidden_and_work(program):
    listed = program("acquire", "--help").out
    assert "resume" not in listed
    for name in ("resume", "finalize"):
        program("acquire", name, "nowhere").refused("nowhere", "acquisition.toml")


def test_python_m_is_the_same_program_and_its_help_imports_nothing_heavy():
    code = (
        "import sys, runpy\nsys.argv = ['ltcl', '--help']\n"
        "try:\n    runpy.run_module('ltcl', run_name='__main__')\n"
        "finally:\n    print(*{'pyopencl', 'matplotlib', 'cv2'} & set(sys.modules), file=sys.stderr)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (run.returncode, run.stderr.split()) == (0, [])
    assert "compensate" in run.stdout


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["nonsense"], ["nonsense", "ltcl --help"]),
        (["--nonsense"], ["--nonsense"]),
        (["info"], ["FILE"]),
        (["info", "a.npz", "--nonsense"], ["--nonsense", "ltcl info --help"]),
        (["convert", "a.npz", "b.npz", "--grid", "4y5"], ["--grid", "4y5"]),
        (["convert", "a.npz", "b.npz", "--grid", "0x5"], ["--grid", "0x5"]),
        (["compensate", "a.npz", "b.png"], ["--out"]),
        (["compensate", "a.npz", "b.png", "--out", "c", "--method", "nonsense"], ["--method", "nonsense"]),
        (["compensate", "a.npz", "b.png", "--out", "c", "--first-bounce", "nonsense"], ["--first-bounce"]),
        (["compensate", "a.npz", "b.png", "--out", "c", "--gain", "much"], ["--gain", "much"]),
        (["compensate", "a.npz", "b.png", "--out", "c", "--samples", "0"], ["--samples"]),
        (["compensate", "a.npz", "b.png", "--out", "c", "--seed", str(2**64)], ["--seed"]),
        (["separate", "a.npz", "b.png", "--out", "c", "--bounces", "-1"], ["--bounces", "-1"]),
        (["demo", "--size", "2"], ["--size", "2", "4"]),
        (["compress", "a.npz", "--out", "b.npz", "--budget", "5 parsecs"], ["--budget", "parsecs"]),
        (["compress", "a.npz", "--out", "b.npz", "--budget", "0"], ["--budget", "0"]),
        (["analyze", "a.npz", "--plot", "a.xyz"], ["--plot", "a.xyz"]),
        (["simulate", "dihedral", "--out", "a", "--albedo", "0.1,0.2"], ["--albedo", "0.1,0.2"]),
        (["simulate", "dihedral", "--out", "a", "--bits", "7"], ["--bits", "7"]),
        (["info", ""], ["path is empty"]),
        (["demo", "--out", " "], ["--out", "path is empty"]),
        (["compensate", "a.npz", "b.png", "--out", ""], ["--out", "path is empty"]),
        (["compensate", "a.npz", "b.png", "--out", "c", "--exact", ""], ["--exact", "path is empty"]),
    ],
)
def test_wrong_usage_names_the_option_and_exits_with_2(program, arguments, parts):
    program(*arguments).refused(*parts, code=2)
    failed = program(*arguments, "--json")
    assert failed.code == 2
    assert (failed.document["type"], failed.document["exit_code"]) == ("UsageError", 2)
    assert all(part in failed.document["error"] for part in parts)


@pytest.mark.parametrize(
    ("error", "code", "parts"),
    [
        (KeyboardInterrupt(), 130, ["interrupted"]),
        (MemoryError(), 1, ["memory"]),
        (ltcl.errors.DeviceError("of two\n  lines"), 1, ["of two lines"]),
        (ltcl.errors.FileError("no file"), 1, ["no file"]),
        (ZeroDivisionError("by nothing"), 70, ["ZeroDivisionError", "by nothing", "--verbose"]),
    ],
)
def test_what_a_command_raises_is_a_line_a_code_and_json(program, monkeypatch, error, code, parts):
    def raise_it(*_: Any) -> None:
        raise error

    monkeypatch.setattr(devices.discovery, "list_devices", raise_it)
    program("devices").refused(*parts, code=code)
    failed = program("devices", "--json")
    assert (failed.document["type"], failed.document["exit_code"]) == (type(error).__name__, code)
    assert ("Traceback" in program("devices", "--verbose").err) == (code == 70)


def test_a_message_is_followed_by_the_options_of_its_arguments(program, transport, picture, tmp_path):
    arguments = ["compensate", transport, picture, "--out", tmp_path / "out"]
    program(*arguments, "--rtol", "nan").refused("rtol is nan", "(--rtol)")
    program(*arguments, "--low", "1", "--high", "0").refused("bounds is (1.0, 0.0)", "(--low, --high)")


@pytest.mark.parametrize(
    ("arguments", "place"),
    [
        (["compensate", "nowhere.npz", "a.png", "--out"], "file/out"),
        (["compensate", "nowhere.npz", "a.png", "--out"], "file"),
        (["compensate", "nowhere.npz", "a.mp4", "--out", "{}/out", "--video"], "file/a.mp4"),
        (["separate", "nowhere.npz", "a.png", "--out"], "file/out"),
        (["relight", "nowhere.npz", "a.png", "--out"], "file/out"),
        (["simulate", "dihedral", "--out"], "file"),
        (["demo", "--out"], "file/out"),
        (["compress", "nowhere.npz", "--out"], "file/a.npz"),
        (["invert", "nowhere.npz", "--out"], "file/a.npz"),
        (["convert", "nowhere.npz"], "file/a.npz"),
        (["analyze", "nowhere.npz", "--plot"], "file/a.png"),
        (["acquire", "report", "nowhere", "--out"], "file/out"),
    ],
)
def test_output_places_are_tested_before_anything_is_read(program, tmp_path, arguments, place):
    (tmp_path / "file").write_text("mine")
    filled = [argument.format(tmp_path) for argument in arguments]
    outcome = program(*filled, tmp_path / place)
    assert outcome.code == 1
    assert f"{tmp_path / place}: " in outcome.err
    assert "nowhere" not in outcome.err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.skipif(sys.platform != "linux", reason="/proc is a folder that nobody can write to")
def test_a_folder_that_cannot_be_written_is_refused_before_the_work(program, transport):
    program("compress", transport, "--out", "/proc/C.npz").refused("/proc/C.npz: cannot be written")


def test_quiet_and_verbose(program, transport, tmp_path):
    told = program("convert", transport, tmp_path / "T.npy")
    assert "--grid 5x10" in told.err
    assert program("convert", transport, tmp_path / "T.npy", "--quiet").err == ""
    verbose = program("convert", transport, tmp_path / "T.npy", "--verbose").err
    assert re.search(r"^ltcl: reading .*corner\.npz$", verbose, re.MULTILINE)
    assert logging.getLogger("ltcl").level == logging.NOTSET


def test_a_warning_of_the_library_is_one_line(program, monkeypatch, transport):
    def warn() -> list[Any]:
        logging.getLogger("ltcl.store").warning("grid 16 x 64:\n is it another one?")
        return []

    monkeypatch.setattr(devices.discovery, "list_devices", warn)
    assert program("devices").err.splitlines()[0] == "ltcl: warning: grid 16 x 64: is it another one?"


def test_the_fields_of_reports_are_on_the_page(program, transport, picture, tmp_path):
    for name in ("compensate", "separate", "relight", "analyze", "info"):
        out = [] if name in ("analyze", "info") else [picture, "--out", tmp_path]
        told = program(name, transport, *out, "--json").json
        entries = [told, *told["pictures"], *told["pictures"][0].get("parts", [])] if out else told
        for entry in entries:
            missing = [field for field in entry if f"`{field}`" not in DOCUMENT.read_text()]
            assert missing == []
