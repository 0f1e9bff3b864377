# SPDX-License-Identifier: BSD-3-Clause
"""Lines of Python in the README run as printed, and its shell commands on their files."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Project
from ltcl.cli.main import main

ROOT = Path(__file__).resolve().parents[1]
GUIDE = ROOT / "docs" / "guide"
README, ACQUISITION, SAMPLING, COMPRESSION = (
    path.read_text(encoding="utf-8")
    for path in (
        ROOT / "README.md",
        *(GUIDE / f"{name}.md" for name in ("acquisition", "sampling", "compression")),
    )
)


def block(pattern: str, page: str = README) -> str:
    found = re.search(pattern, page, re.DOTALL)
    assert found is not None
    return found[1]


def test_the_readme_is_short_and_its_links_lead_somewhere():
    assert README.count("\n") <= 120
    links = re.findall(r"\]\(([^)#]+)", README)
    assert [link for link in links if not (ROOT / link).is_file()] == []


def record(name: str) -> dict[str, Any]:
    path = ROOT / "bench" / "results" / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8"))


def rounded(value: float) -> str:
    """A number with two digits, or with all before its point."""
    return f"{float(f'{value:.2g}'):g}" if value < 10 else f"{value:.0f}"


def sketch_row(name: str) -> list[str]:
    """Cells of the table of costs that a record of bench/sketch_large.py gives."""
    facts = record(name)["facts"]
    (photographs,) = (c for c in record(name)["claims"] if c["text"] == "photographs")
    return [
        facts["grid"].replace("x", " x "),
        photographs["measured"],
        f"{rounded(facts['seconds until T is there'])} s",
        f"{rounded(facts['memory while T is estimated, MB'])} MB",
        f"{rounded(facts['T on disk, MB'])} MB",
        f"{rounded(facts['compensate, s'])} s",
    ]


def test_the_table_of_costs_has_the_figures_of_the_records():
    table = README.partition("## What it costs")[2].partition("\n**")[0]
    rows = [line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("| ")]
    assert sketch_row("sketch_large") in rows
    assert sketch_row("sketch_large_1080") in rows
    films = {row["question"]: row["ours"] for row in record("video-epyc-pocl3.0")["rows"]}
    late = films["colour, kept inverse: 99 % of frames within"]
    pace = films["colour, kept inverse: one by one"]
    assert f"99 % within {late:.1f} ms, {pace:.0f} a second" in table


@pytest.mark.slow
def test_what_the_readme_shows_runs(device, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(block(r"```python\n(.*?)```"), names)  # noqa: S102 - our own README
    assert Path("corner.png").is_file()
    assert "0.0% of the pattern clipped" in capsys.readouterr().out
    from_photographs = block(r"```py\n(.*?)```", ACQUISITION)
    exec(block(r"```py\n(.*?)```", SAMPLING), names)  # noqa: S102
    few = names["few"]
    assert (few.standard_error <= 1e-3).all()
    commands = block(r"on the files these lines have made:\s+```\n(.*?)```").splitlines()
    assert len(commands) > 5
    for command in commands:
        _run(command, capsys)
    first, _, others = block(r"```py\n(.*?)```", COMPRESSION).partition("\n")
    assert first.startswith("C = ltcl.compress(T, rtol=1e-2)")  # which the shell has done
    exec(others, names | {"C": ltcl.load("small.npz")})  # noqa: S102
    for command in block(
        r"tells what else could stand there:\s+```sh\n(.*?)```", ACQUISITION
    ).splitlines():
        _run(command, capsys)
    exec(from_photographs, names)  # noqa: S102
    rig = names["rig"]
    seen = rig.radiance(names["setup"].codes(names["c"].pattern))
    target = names["target"]
    scale = np.vdot(seen, target) / np.vdot(seen, seen)
    assert np.linalg.norm(scale * seen - target) < 0.02 * np.linalg.norm(target)


@pytest.mark.slow
def test_the_page_on_noise_runs(device, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    page = (GUIDE / "noise.md").read_text(encoding="utf-8")
    names: dict[str, Any] = {}
    for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(code, names)  # noqa: S102
    for T in (names["T"], names["twice"]):
        np.testing.assert_allclose(T.noise.floor, names["sigma"], rtol=0.15)
    np.testing.assert_array_equal(names["holes"].masked, names["unlit"])
    assert "3 of 288 pixels" in names["holes"].dark_note
    assert names["errors"]["denoised"] < 0.5 * names["errors"]["raw"]
    assert names["within"] == pytest.approx(0.68, abs=0.06)
    assert (names["verdict"].compensation, names["verdict"].bounces) == (True, False)
    for command in re.findall(r"^ltcl .*", page, re.MULTILINE):
        _run(command, capsys)


def _run(command, capsys):
    program, *arguments = shlex.split(command, comments=True)
    assert program == "ltcl"
    assert main(arguments) == 0, capsys.readouterr().err


def test_the_rigs_of_the_guide_are_ones(tmp_path):
    kinds = []
    for text in re.findall(r"```toml\n(.*?)```", ACQUISITION, re.DOTALL):
        (tmp_path / "acquisition.toml").write_text(text)
        project = Project.open(tmp_path)
        assert project.outlook()[1]["grid"] == (48, 64)
        kinds.append(project.kind)
    assert kinds == ["folder", "live"]
