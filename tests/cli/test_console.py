# SPDX-License-Identifier: BSD-3-Clause
"""Help, exit codes, errors, notes and progress; `ltcl devices`."""

from __future__ import annotations

import io
import json
import logging
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import typer

import ltcl
from ltcl.cli import doctor, failure
from ltcl.cli.main import PANELS, build_program, main
from ltcl.cli.progress import Progress
from ltcl.device import discovery
from tests import json_schema

# Writing there fails as on a full disk; Linux and FreeBSD have it.
FULL_DEVICE = Path("/dev/full")
needs_full_device = pytest.mark.skipif(not FULL_DEVICE.exists(), reason="there is no /dev/full")
COMMANDS = [
    "devices",
    "doctor",
    "demo",
    "simulate",
    "info",
    "analyze",
    "convert",
    "align",
    "compress",
    "denoise",
    "invert",
    "compensate",
    "film",
    "separate",
    "relight",
    "view",
    "play",
    "show",
    "export",
    "acquire plan",
    "acquire run",
    "acquire aim",
    "acquire fit",
    "acquire import",
    "acquire report",
]
CODES = [
    failure.FAILED,
    failure.USAGE,
    failure.WAITING,
    failure.INTERNAL,
    failure.INTERRUPTED,
]
EXIT_CODES = (json_schema.PAGES / "exit-codes.md").read_text(encoding="utf-8")


def test_version(program):
    assert program("--version").out == f"ltcl {ltcl.__version__}\n"


def test_help_has_all_commands_and_exit_codes(program):
    text = program("--help").out
    for name in COMMANDS:
        assert name.partition(" ")[0] in text
    for code in CODES:
        assert f" {code} " in text
        assert f"| {code} |" in EXIT_CODES


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(program, name):
    text = program(*name.split(), "--help").out
    for option in ("--json", "--quiet", "-q", "--verbose"):
        assert option in text
    assert name.replace(" ", "-") in json_schema.SCHEMA["$defs"]


def commands_below(command: Any, name: str = "ltcl") -> Iterator[tuple[str, Any]]:
    """The program and all its commands, by what is typed for them."""
    yield name, command
    for word, inner in getattr(command, "commands", {}).items():
        yield from commands_below(inner, f"{name} {word}")


WHOLE_PROGRAM: Any = typer.main.get_command(build_program())
ALL_COMMANDS = dict(commands_below(WHOLE_PROGRAM))
# Words by which no sentence of a help begins: what begins so is torn from another sentence.
TORN = r"(?:^|[.!] +)(?:Of|What|Those|That|Which|Whose|Where|And|Or|But|Than)\b"


@pytest.mark.parametrize("name", ALL_COMMANDS)
def test_help_is_in_sentences_and_plain_names_of_values(name):
    command = ALL_COMMANDS[name]
    context = command.context_class(command, info_name=name)
    texts = [" ".join(command.help.split())]
    for parameter in command.params:
        shown_names, text = parameter.get_help_record(context)
        if parameter.param_type_name == "option":
            assert not re.search(r"[<\[](int|float|str|bool|list)\b", shown_names)
        assert not re.search("x[<>]=", text)
        texts.append(re.sub(r"  \[.*\]$", "", text))
    for text in texts:
        assert text[0].isupper(), text
        assert text.endswith((".", "demo")), text
        assert re.search(TORN, text) is None, text


@pytest.mark.parametrize("name", ALL_COMMANDS)
def test_drawn_help_shows_no_types_of_python(program, name):
    text = program(*name.split()[1:], "--help").out
    assert "--help" in text
    # Values to choose from are <one|other>.
    assert re.search(r"<\w+>|\b(bool|int|float|str|list|Path|BOOLEAN|PATH)\b", text) is None


def test_the_help_of_the_program_has_the_first_lines_of_its_commands():
    """They stand in a table, so that the help needs no module of a command."""
    table = {name: line for commands in PANELS.values() for name, (_, line) in commands.items()}
    assert list(table) == list(WHOLE_PROGRAM.commands)
    for name, command in WHOLE_PROGRAM.commands.items():
        assert table[name] == " ".join(command.help.split("\n\n")[0].split())


@pytest.mark.parametrize("words", [["--help"], ["--version"], ["nothing"]])
def test_help_of_the_program_imports_little(words):
    """Typer, rich and what they need. Seconds differ between machines, modules do not."""
    run = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "ltcl", *words], capture_output=True, text=True
    )
    lines = [line for line in run.stderr.splitlines() if line.startswith("import time:")]
    modules = {line.split("|")[-1].strip() for line in lines}
    assert "typer" in modules
    packages = {module.partition(".")[0] for module in modules}
    assert not packages & {"numpy", "scipy", "pyopencl", "matplotlib", "cv2"}
    ours = {module for module in modules if module.startswith("ltcl")}
    assert len(ours) <= 12
    assert len(modules) <= 600


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_get_a_script_that_completes(program, monkeypatch, shell):
    monkeypatch.setenv("_LTCL_COMPLETE", f"source_{shell}")
    script = program().out
    assert f"complete_{shell}" in script
    assert re.search(r"\bltcl\b", script)

    def candidates(line: str) -> str:
        monkeypatch.setenv("_LTCL_COMPLETE", f"complete_{shell}")
        monkeypatch.setenv("_TYPER_COMPLETE_FISH_ACTION", "get-args")
        variable = "COMP_WORDS" if shell == "bash" else "_TYPER_COMPLETE_ARGS"
        monkeypatch.setenv(variable, line)
        monkeypatch.setenv("COMP_CWORD", str(len(line.split()) - 1))
        return program().out

    assert {"compensate", "compress"} <= set(re.findall(r"\w+", candidates("ltcl comp")))
    assert "--camera-grid" in candidates("ltcl compensate --cam")
    assert {"run", "report"} <= set(re.findall(r"\w+", candidates("ltcl acquire r")))


@pytest.mark.parametrize(
    ("error", "code", "parts"),
    [
        (KeyboardInterrupt(), 130, ["interrupted"]),
        (MemoryError(), 1, ["memory"]),
        (ltcl.errors.DeviceError("of two\n  lines"), 1, ["of two lines"]),
        (ZeroDivisionError("by nothing"), 70, ["ZeroDivisionError", "by nothing", "--verbose"]),
    ],
)
def test_an_error_is_a_line_a_code_and_json(program, monkeypatch, error, code, parts):
    monkeypatch.setattr(doctor.discovery, "list_devices", Mock(side_effect=error))
    program("devices").assert_refused(*parts, code=code)
    failed = program("devices", "--json").document
    assert failed["type"] == type(error).__name__
    assert failed["exit_code"] == code
    has_traceback = "Traceback" in program("devices", "--verbose").err
    assert has_traceback == (code == failure.INTERNAL)


@needs_full_device
@pytest.mark.parametrize(
    ("line", "code", "text"),
    [
        ("--help", 1, "stdout: "),
        ("--version", 1, "stdout: "),
        ("info --help", 1, "stdout: "),
        ("devices", 1, "stdout: "),
        ("devices --json", 1, "stdout: "),
        ("info {transport}", 1, "stdout: "),
        ("relight missing.npz p.png --json --out x", 1, "missing.npz: "),
        ("nothing --json", 2, "'nothing'"),
    ],
)
def test_stdout_on_a_full_disk_is_one_error(transport, monkeypatch, capsys, line, code, text):
    words = line.format(transport=transport).split()
    with FULL_DEVICE.open("w") as stdout:
        monkeypatch.setattr(sys, "stdout", stdout)
        assert main(words) == code
    (error,) = capsys.readouterr().err.splitlines()
    assert error.startswith("ltcl: error: ")
    assert text in error


@needs_full_device
def test_stderr_on_a_full_disk_loses_lines_only(transport, tmp_path, monkeypatch):
    """The note on the lost grid cannot be printed, and the file is written."""
    with FULL_DEVICE.open("w") as stderr:
        monkeypatch.setattr(sys, "stderr", stderr)
        assert main(["convert", str(transport), str(tmp_path / "T.npy")]) == 0
        assert main(["info", "missing.npz"]) == 1
    assert (tmp_path / "T.npy").exists()


def test_a_closed_stdout_is_an_error(transport, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdout", None)
    assert main(["info", str(transport)]) == 1
    assert "stdout: " in capsys.readouterr().err


@pytest.mark.parametrize("encoding", ["utf-8", "cp1252", "latin-1"])
@pytest.mark.parametrize("name", ["H\udcf6he", "Höhe", "漢字", "\U0001d11e"])
def test_names_are_printed_on_every_stdout(transport, tmp_path, monkeypatch, name, encoding):
    """Single surrogates stand for bytes that are not UTF-8."""
    path = tmp_path / f"{name}.npz"
    path.write_bytes(Path(transport).read_bytes())
    printed = {}
    for options in ([], ["--json"]):
        stdout = io.TextIOWrapper(io.BytesIO(), encoding, errors="strict")
        monkeypatch.setattr(sys, "stdout", stdout)
        assert main(["info", str(path), *options]) == 0
        stdout.seek(0)
        printed[len(options)] = stdout.read()
    assert ".npz" in printed[0]
    assert json.loads(printed[1])[0]["file"] == str(path)


@pytest.mark.slow
@pytest.mark.parametrize("module", ["numpy", "scipy", "typer"])
@pytest.mark.parametrize("options", [[], ["--json"]])
def test_ctrl_c_while_importing_is_one_line(tmp_path, module, options):
    """A module that interrupts its own import stands in the place of one that takes long."""
    text = "import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(60)"
    (tmp_path / f"{module}.py").write_text(text)
    root = Path(ltcl.__file__).parents[1]
    paths = os.pathsep.join([str(tmp_path), str(root)])
    run = subprocess.run(
        [sys.executable, "-m", "ltcl", "devices", *options],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 130
    assert run.stderr == "ltcl: error: interrupted\n"
    if options:
        assert json.loads(run.stdout)["exit_code"] == 130


@pytest.mark.slow
def test_ctrl_c_waits_until_native_code_is_imported(tmp_path):
    """That of pyopencl ends the process at an interrupt; a module in its place tells its end."""
    lines = (
        "import os, signal, time",
        "os.kill(os.getpid(), signal.SIGINT)",
        "time.sleep(0.1)",
        "os.write(2, b'imported\\n')",
    )
    (tmp_path / "pyopencl.py").write_text("\n".join(lines))
    paths = os.pathsep.join([str(tmp_path), str(Path(ltcl.__file__).parents[1])])
    run = subprocess.run(
        [sys.executable, "-m", "ltcl", "devices"],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.stderr == "imported\nltcl: error: interrupted\n"
    assert run.returncode == 130


@pytest.mark.rare
def test_ctrl_c_at_any_moment_is_one_line():
    """From the moment at which Python imports ltcl, to the end; after that all is printed."""
    words = [sys.executable, "-m", "ltcl", "devices"]
    start = time.monotonic()
    subprocess.run(words, capture_output=True, check=True)
    duration = time.monotonic() - start
    codes = set()
    for share in np.linspace(0.3, 1.0, 9):
        process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        time.sleep(share * duration)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
        codes.add(process.returncode)
        expected = {130: "ltcl: error: interrupted\n", 0: ""}
        assert errors == expected.get(process.returncode), process.returncode
    assert 130 in codes


@pytest.mark.slow
def test_who_imports_ltcl_keeps_the_handlers_of_signals():
    code = "import signal, ltcl; print(signal.getsignal(signal.SIGINT).__name__)"
    words = [sys.executable, "-c", code]
    run = subprocess.run(words, capture_output=True, text=True, check=True)
    assert run.stdout == "default_int_handler\n"


def test_quiet_and_verbose(program, transport, tmp_path):
    arguments = ["convert", transport, tmp_path / "T.npy"]
    assert "--grid 5x10" in program(*arguments).err
    assert program(*arguments, "--quiet").err == ""
    printed = program(*arguments, "--verbose").err
    assert re.search(r"^ltcl: reading .*corner\.npz$", printed, re.MULTILINE)


def test_a_warning_of_the_library_is_one_line(program, monkeypatch):
    warn = partial(logging.getLogger("ltcl.store").warning, "grid 16 x 64:\n is it right?")
    monkeypatch.setattr(doctor.discovery, "list_devices", lambda: warn() or [])
    printed = program("devices").err
    assert printed.splitlines()[0] == "ltcl: warning: grid 16 x 64: is it right?"
    assert logging.getLogger("ltcl").level == logging.NOTSET


@pytest.mark.parametrize("is_terminal", [False, True])
@pytest.mark.parametrize("quiet", [False, True])
def test_progress_is_a_bar_with_elapsed_time_and_time_left(capsys, monkeypatch, is_terminal, quiet):
    monkeypatch.setenv("FORCE_COLOR", "1" if is_terminal else "")
    with Progress(quiet) as progress:
        progress("reading")
        progress("frames", 8, 32)
        progress("frames", 16, 32)
        progress.refresh()
    assert progress.completed == 16
    out, err = capsys.readouterr()
    assert out == ""
    is_shown = is_terminal and not quiet
    for part in ("frames", "0:00:0", "left"):
        assert (part in err) == is_shown


def test_devices_mark_the_one_that_would_be_chosen(program, device):
    entries = program("devices", "--json").json
    (chosen,) = [entry for entry in entries if entry["chosen"]]
    assert chosen["name"] == device.name
    assert chosen["index"] == device.description.index
    marked = [line for line in program("devices").out.splitlines() if line.startswith("->")]
    assert [line.split()[1] for line in marked] == [chosen["index"]]


def test_devices_without_the_one_that_is_named(program, monkeypatch):
    monkeypatch.setenv("LTCL_DEVICE", "nonsense")
    outcome = program("devices")
    assert outcome.code == 0
    assert "LTCL_DEVICE=nonsense" in outcome.err
    assert "->" not in outcome.out
    monkeypatch.setattr(discovery, "list_devices", list)
    program("devices").assert_refused("no OpenCL device", "install")


@pytest.mark.slow
def test_ltcl_is_imported_whatever_the_words_of_the_process_are() -> None:
    """Processes of multiprocessing have the words of the program that started them."""
    code = "import sys; sys.argv = ['program'] * 50; import ltcl"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
