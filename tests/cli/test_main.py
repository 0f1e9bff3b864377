# SPDX-License-Identifier: BSD-3-Clause
"""The program as a whole: version, help, exit codes, errors as one line."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest

import ltcl
from ltcl.cli import devices
from ltcl.cli.main import as_options

from .conftest import Program

COMMANDS = [
    *("devices", "doctor", "demo", "simulate", "info", "analyze"),
    *("convert", "compress", "invert", "compensate", "separate", "relight"),
]


def test_version(program: Program) -> None:
    assert program("--version").out == f"ltcl {ltcl.__version__}\n"


def test_help_names_every_command(program: Program) -> None:
    outcome = program("--help")
    assert outcome.code == 0
    assert all(name in outcome.out for name in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(program: Program, command: str) -> None:
    outcome = program(command, "--help")
    assert outcome.code == 0
    assert "--json" in outcome.out


def test_python_m_is_the_same_program() -> None:
    run = subprocess.run([sys.executable, "-m", "ltcl", "--version"], capture_output=True, text=True)
    assert (run.returncode, run.stdout) == (0, f"ltcl {ltcl.__version__}\n")


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from ltcl.cli.main import main; main(['--help'])\n"
        "print(*{'pyopencl', 'matplotlib', 'cv2'}.intersection(sys.modules), file=sys.stderr)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.stderr.split() == []


@pytest.mark.parametrize(
    "arguments",
    [
        ["nonsense"],
        ["info"],
        ["info", "a.npz", "--nonsense"],
        ["convert", "a.npz", "b.npz", "--grid", "4y5"],
        ["convert", "a.npz", "b.npz", "--grid", "0x5"],
        ["compensate", "a.npz", "b.png"],
        ["compensate", "a.npz", "b.png", "--out", "c", "--method", "nonsense"],
        ["compensate", "a.npz", "b.png", "--out", "c", "--first-bounce", "nonsense"],
        ["separate", "a.npz", "b.png", "--out", "c", "--bounces", "-1"],
        ["demo", "--size", "2"],
    ],
)
def test_wrong_usage_exits_with_2(program: Program, arguments: list[str]) -> None:
    outcome = program(*arguments)
    assert outcome.code == 2
    assert outcome.out == ""
    assert len(outcome.err.splitlines()) == 1
    assert outcome.err.startswith("ltcl: error: ")


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (
            ["demo", "--size", "2"],
            "--size is '2'; it must be greater than or equal to 4; see 'ltcl demo --help'",
        ),
        (["compress", "a", "--out=b", "--rtol=x"], "--rtol is 'x'; it must be a valid number"),
        (["info", "a", "--xyz"], "No such option: --xyz"),
        (["--xyz"], "No such option: --xyz; see 'ltcl --help'"),
        (["convert", "a", "b", "--grid", "0x5"], "--grid is '0x5'; it is no grid; write height x width"),
    ],
)
def test_wrong_usage_names_the_option_and_what_it_was(
    program: Program, arguments: list[str], line: str
) -> None:
    assert f"ltcl: error: {line}" in program(*arguments).err


def _raising(error: BaseException) -> Any:
    def raise_it(*_: object) -> None:
        raise error

    return raise_it


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (KeyboardInterrupt(), 130, "ltcl: error: interrupted\n"),
        (MemoryError(), 1, "ltcl: error: the host has no memory left\n"),
        (ltcl.errors.DeviceError("of two\n  lines"), 1, "ltcl: error: of two lines\n"),
        (ltcl.errors.FileError("no file"), 1, "ltcl: error: no file\n"),
    ],
)
def test_what_a_command_raises_becomes_a_line(
    program: Program, monkeypatch: pytest.MonkeyPatch, error: BaseException, code: int, line: str
) -> None:
    monkeypatch.setattr(devices.discovery, "list_devices", _raising(error))
    outcome = program("devices")
    assert (outcome.code, outcome.out, outcome.err) == (code, "", line)


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        ("give grid=(h, w), perhaps grid=(64, 32)", "give --grid HxW, perhaps --grid 64x32"),
        ("needs camera_grid=(h, w)", "needs --camera-grid HxW"),
        ("give on_dark='mask' to", "give --on-dark mask to"),
        ("try method='chebyshev' or 'direct'", "try --method chebyshev or 'direct'"),
        ("rtol=1e-07 is below", "--rtol 1e-07 is below"),
        ("the grid is (4, 5)", "the grid is (4, 5)"),
        ("bounds[0] is nan", "--low is nan"),
        ("bounds is (1.0, 0.0)", "(--low, --high) is (1.0, 0.0)"),
        ("rtol is 0.001; S is compressed", "--rtol is 0.001; S is compressed"),
        ("frames 1 to 8: rtol is 0.001", "frames 1 to 8: --rtol is 0.001"),
        ("T.npz: grid is 4 x 9 = 36 pixels", "T.npz: grid is 4 x 9 = 36 pixels"),  # the file's own
        ("or give exact=T, the uncompressed transport", "or give --exact FILE, the uncompressed transport"),
        ("make it with ltcl.invert(T)", "make it with 'ltcl invert'"),
        ("make a better one with ltcl.invert(T, rtol=...)", "make a better one with 'ltcl invert --rtol'"),
        ("such as ltcl.compress(T, basis='db2') has it", "such as 'ltcl compress --basis db2' has it"),
        ("that run had batch=1, this one has 4", "that run had --batch 1, this one has 4"),
        ("that run had encoding='auto', this one", "that run had --encoding auto, this one"),
        (
            "rtol is 0; it must be above 0 and below 1, or atol above 0",
            "--rtol is 0; it must be above 0 and below 1",
        ),
    ],
)
def test_arguments_are_named_as_options(message: str, shown: str) -> None:
    assert as_options(message) == shown
