# SPDX-License-Identifier: BSD-3-Clause
"""The README's lines of Python run as printed, and its shell commands run on the files these make."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

from ltcl.cli.main import main

README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")


def block(pattern: str) -> str:
    found = re.search(pattern, README, re.DOTALL)
    assert found is not None
    return found[1]


def test_what_the_readme_shows_runs(device, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(block(r"```python\n(.*?)```"), names)  # noqa: S102 - our own README
    assert Path("corner.png").is_file()
    assert "0.0% of the pattern clipped" in capsys.readouterr().out
    exec(block(r"```py\n(.*?)```"), names)  # noqa: S102
    few: Any = names["few"]
    assert (few.standard_error <= 1e-3).all()
    commands = block(r"on the files these lines have made:\s+```\n(.*?)```").splitlines()
    assert len(commands) > 5
    for command in commands:
        program, *arguments = shlex.split(command, comments=True)
        assert program == "ltcl"
        assert main(arguments) == 0, capsys.readouterr().err
