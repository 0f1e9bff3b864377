# SPDX-License-Identifier: BSD-3-Clause
"""Ctrl-C in the middle of the imports, from a module that stands in for one of the dependencies."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for one process there")
KILLS = "import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(60)\n"
ROOT = Path(__file__).resolve().parents[1]


def started(folder: Path, name: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    (folder / f"{name}.py").write_text(KILLS)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])}
    command = [sys.executable, *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=50)


@pytest.mark.parametrize("name", ["scipy", "typer"])
def test_the_program_ends_in_one_line(tmp_path: Path, name: str) -> None:
    run = started(tmp_path, name, "-m", "ltcl", "info")
    assert (run.returncode, run.stdout, run.stderr) == (130, "", "ltcl: error: interrupted\n")


@pytest.mark.parametrize("name", ["scipy", "typer"])
def test_its_script_ends_in_one_line(tmp_path: Path, name: str) -> None:
    script = tmp_path / "ltcl"
    script.write_text("import sys\nfrom ltcl.cli.main import main\nsys.exit(main())\n")
    sys_path = tmp_path / "modules"
    sys_path.mkdir()
    run = started(sys_path, name, script, "info")
    assert (run.returncode, run.stdout, run.stderr) == (130, "", "ltcl: error: interrupted\n")


def test_other_programs_end_as_they_like(tmp_path: Path) -> None:
    run = started(tmp_path, "scipy", "-c", "import ltcl")
    assert run.returncode != 130
    assert run.stderr.endswith("KeyboardInterrupt\n")
    assert run.stderr.startswith("Traceback")
