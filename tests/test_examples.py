# SPDX-License-Identifier: BSD-3-Clause
"""Examples of what can be added to ltcl run as they are, from any folder."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

import ltcl
from ltcl.errors import InputTypeError

FOLDER = Path(__file__).resolve().parents[1] / "examples"
EXAMPLES = sorted(FOLDER.glob("*.py"))
# A scan from beginning to end.
RIG = pytest.param(FOLDER / "rig.py", marks=pytest.mark.slow)


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize(
    "path", [*(path for path in EXAMPLES if path.stem != "rig"), RIG], ids=lambda path: path.stem
)
def test_examples_run(path, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(path), run_name="__main__")
    assert len(capsys.readouterr().out.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_there_is_one_of_each_thing_and_the_page_lists_them() -> None:
    page = (FOLDER / "README.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| (.*?) \|", page, re.MULTILINE)
    files = set(re.findall(r"`([\w.]+)`", " ".join(listed)))
    assert files == {path.name for path in FOLDER.iterdir() if path.name != "README.md"}
    assert {"kernel", "solver", "rig", "strategy", "export"} <= {path.stem for path in EXAMPLES}


def test_a_method_of_ones_own_takes_no_options_of_solve(device) -> None:
    HeavyBall = runpy.run_path(str(FOLDER / "solver.py"))["HeavyBall"]
    S, b = np.eye(2), np.ones(2)
    assert ltcl.solve(S, b, HeavyBall()).method == "heavy_ball"
    with pytest.raises(InputTypeError, match="omega"):
        ltcl.solve(S, b, HeavyBall(), omega=0.5)
