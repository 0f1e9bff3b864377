# SPDX-License-Identifier: BSD-3-Clause
"""One folder for several runs: whose files stay, whose go."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ltcl import images
from ltcl.cli import results

from .conftest import Program


def fill(out: Path, *files: str, command: str = "compensate") -> None:
    with results.fill(out, {"command": command}) as folder:
        for file in files:
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_text(command)


def found(out: Path) -> set[str]:
    return {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}


def test_a_later_run_takes_away_what_the_earlier_one_of_its_command_left(tmp_path: Path) -> None:
    fill(tmp_path, "a.exr", "sky/b.exr")
    fill(tmp_path, "c.exr", command="separate")
    (tmp_path / "mine.txt").write_text("mine")
    fill(tmp_path, "d.exr", "a.exr")
    assert found(tmp_path) == {
        "a.exr",
        "c.exr",
        "d.exr",
        "mine.txt",
        "compensate.json",
        "separate.json",
    }
    assert not (tmp_path / "sky").exists()
    assert json.loads((tmp_path / "compensate.json").read_text())["files"] == [
        "a.exr",
        "d.exr",
        "compensate.json",
    ]


def test_a_failed_run_changes_nothing(tmp_path: Path) -> None:
    fill(tmp_path, "a.exr")
    before = {name: (tmp_path / name).read_bytes() for name in found(tmp_path)}

    def fail() -> None:
        with results.fill(tmp_path, {"command": "compensate"}) as folder:
            (folder / "b.exr").write_text("new")
            raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        fail()
    assert {name: (tmp_path / name).read_bytes() for name in found(tmp_path)} == before


def test_a_report_cannot_point_outside_its_folder(tmp_path: Path) -> None:
    out, outside = tmp_path / "out", tmp_path / "outside"
    (out / "kept").mkdir(parents=True)
    outside.mkdir()
    for name in ("a", "b", "c"):
        (outside / name).write_text("mine")
    (out / "link").symlink_to(outside)
    (out / "arrow").symlink_to(outside / "c")
    files = ["../outside/a", str(outside / "b"), "link/c", "arrow", "kept", "kept/../../outside/a", "", "\0"]
    (out / "compensate.json").write_text(json.dumps({"files": [*files, 5, None]}))
    fill(out, "new.exr")
    assert {path.name for path in outside.iterdir()} == {"a", "b", "c"}
    assert (out / "arrow").is_symlink()
    assert (out / "kept").is_dir()


@pytest.mark.parametrize(
    "text", ["", "old", "[]", "5", '{"files": 5}', '{"files": {"a.exr": 1}}', "[" * 9999]
)
def test_a_broken_report_is_ignored(tmp_path: Path, text: str) -> None:
    (tmp_path / "compensate.json").write_text(text)
    (tmp_path / "a.exr").write_text("mine")
    fill(tmp_path, "b.exr")
    assert found(tmp_path) == {"a.exr", "b.exr", "compensate.json"}


def test_commands_share_a_folder(program: Program, transport: Path, picture: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert program("separate", transport, picture, "--bounces", "2", "--out", out).code == 0
    assert program("separate", transport, picture, "--bounces", "1", "--out", out).code == 0
    assert program("compensate", transport, picture, "--out", out).code == 0
    assert program("relight", transport, picture, "--out", out).code == 0
    assert {"separate.json", "compensate.json", "relight.json", "bounce_1.exr"} <= found(out)
    assert "bounce_2.exr" not in found(out)
    reports = [
        json.loads((out / f"{name}.json").read_text()) for name in ("separate", "compensate", "relight")
    ]
    assert set().union(*(report["files"] for report in reports)) == found(out)


def test_reports_tell_every_option(program: Program, transport: Path, picture: Path, tmp_path: Path) -> None:
    common = ["--on-dark", "mask", "--encoding", "linear", "--grid", "5x10", "--resize", "--out", tmp_path]
    solving = ["--first-bounce", "exact", "--rtol", "0.005", "--method", "chebyshev"]
    told = {}
    for command, options in (("compensate", solving), ("separate", solving), ("relight", [])):
        outcome = program(command, transport, picture, *common, *options, "--json")
        told[command] = outcome.json["options"]
        assert outcome.json["files"][-1] == f"{command}.json"
        for name, value in {"on_dark": "mask", "encoding": "linear", "grid": [5, 10], "resize": True}.items():
            assert told[command][name] == value
    for command in ("compensate", "separate"):
        assert told[command]["first_bounce"] == "exact"
        assert (told[command]["rtol"], told[command]["method"]) == (0.005, "chebyshev")
    assert (told["compensate"]["low"], told["compensate"]["high"], told["compensate"]["gain"]) == (0, 1, 1)
    assert told["separate"]["bounces"] == 4


@pytest.mark.parametrize("command", ["separate", "analyze"])
def test_rectangular_transport_is_refused_where_S_is_needed(
    program: Program, picture: Path, tmp_path: Path, command: str
) -> None:
    path = tmp_path / "T.npy"
    np.save(path, np.ones((40, 32), np.float32))
    arguments = [path] if command == "analyze" else [path, picture, "--out", tmp_path / "out"]
    for grid in ([], ["--grid", "4x8"]):
        outcome = program(command, *arguments, *grid)
        outcome.refused("T is 40 x 32; only compensate and relight can use it")
        assert "--camera-grid" not in outcome.err


def test_unlit_pixels_are_counted(program: Program, dark_transport: Path, tmp_path: Path) -> None:
    images.write(tmp_path / "grey.exr", np.full((2, 3), 0.5, np.float32))
    for command in ("compensate", "separate"):
        arguments = ["--on-dark", "mask", "--method", "chebyshev", "--out", tmp_path / "out", "--json"]
        outcome = program(command, dark_transport, tmp_path / "grey.exr", *arguments)
        assert "dark.npz: 2 of 6 projector pixels give no direct light; they stay unlit" in outcome.err
        assert outcome.json["transport"]["masked"] == 2
    arguments = ["--on-dark", "mask", "--out", tmp_path / "out"]
    assert "unlit" not in program("relight", dark_transport, tmp_path / "grey.exr", *arguments).err


def test_an_empty_name_is_no_folder(program: Program, transport: Path, picture: Path) -> None:
    for name in ("", " "):
        outcome = program("compensate", transport, picture, "--out", name)
        assert outcome.code == 2
        assert "empty" in outcome.err
