# SPDX-License-Identifier: BSD-3-Clause
"""Bad input to all commands: a line that names it, exit code and JSON; nothing is written."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.images.frames import write_video

FIXTURES = (
    "transport",
    "compressed",
    "inverse",
    "picture",
    "large_picture",
    "simulated",
    "acquired",
)
USAGE = [
    ("combine a b --out c.npz --blend wrong", ["'--blend': 'wrong' is not one of 'auto'"]),
    ("nonsense", ["nonsense", "ltcl --help"]),
    ("info", ["FILE"]),
    ("convert a.npz b.npz --grid 4y5", ["--grid", "4y5"]),
    ("compensate a.npz b.png", ["--out"]),
    ("compensate a.npz b.png --out c --method nonsense", ["--method", "nonsense"]),
    ("demo --size 2", ["--size", "2", "4"]),
    ("compress a.npz --out b.npz --budget 5-parsecs", ["--budget", "parsecs"]),
    ("analyze a.npz --plot a.xyz", ["--plot", "a.xyz"]),
    ("simulate dihedral --out a --albedo 0.1,0.2", ["--albedo", "0.1,0.2"]),
    ("simulate dihedral --out a --bits 7", ["--bits", "7"]),
    ("info {nothing}", ["path is empty"]),
    ("demo --out {nothing}", ["--out", "path is empty"]),
    ("compensate a.npz b.png --out c --exact {nothing}", ["--exact", "path is empty"]),
    ("compensate a.npz b.png --out c --resume", ["--resume"]),
    ("film a.npz b.mp4 --out c --mpi", ["--mpi"]),
]
COMPENSATE = [
    ("compensate {transport} {large} --out {out}", ["20 x 30", "5 x 10", "--resize"]),
    ("compensate {inverse} {picture} --out {out}", ["inverse.npz: "]),
    (
        "compensate {dark} {picture} --resize stretch --on-dark raise --out {out}",
        ["dark.npz", "2 of 6", "on_dark"],
    ),
    (
        "compensate {transport} {picture} --weights {large} --out {out}",
        ["large.png", "20 x 30", "--resize"],
    ),
    ("compensate {transport} {picture} --inverse {transport} --out {out}", ["corner.npz: "]),
    ("compensate {compressed} {picture} --exact {other} --out {out}", ["other.npz: ", "TRANSPORT"]),
    ("compensate {transport} {film} {picture} --out {out}", ["film.avi: ", "ltcl film"]),
    ("compensate {transport} {picture} --cluster local --out {out}", ["--cluster", "--transports"]),
]
OTHERS = [
    ("separate {tall} {picture} --grid 2x5 --camera-grid 5x10 --out {out}", ["relight"]),
    ("convert {transport} {out}.xyz", ["xyz"]),
    ("convert {compressed} {out}.mtx", [".mtx", "compressed"]),
    ("compress {transport} --out {transport}", ["corner.npz", "TRANSPORT"]),
    ("compress {transport} --out {out}.npy", [".npy", ".npz"]),
    ("compress {compressed} --out {out}.npz", ["compressed.npz: "]),
    ("denoise {transport} --out {out}.npy", [".npy", ".npz"]),
    ("denoise {compressed} --out {out}.npz", ["T is made of", "compress"]),
    ("invert {transport} --out {out}.npy", [".npy", ".npz"]),
    ("simulate dihedral --size 3 --projectors 4 --out {out}", ["--size is 3", "4 or more"]),
    ("simulate sphere --out {out}", ["SCENE is 'sphere'", "dihedral"]),
    ("simulate dihedral --grid 4x8 --out {out}", ["--grid", "(4, 8)"]),
    ("simulate mitsuba:dihedral --ambient 0.1 --out {out}", ["--ambient", "mitsuba"]),
    ("simulate {nan} --grid 3x3 --out {out}", ["--grid is 3 x 3"]),
    ("film {transport} {picture} --out {out}", ["FILM is ", "sky.exr", "ltcl compensate"]),
    ("film {transport} no-film --out {out}", ["no-film: no such file"]),
    ("film {transport} {film} --workers 2 --out {out}", ["--workers is 2", "--cluster"]),
    ("play {film} {transport} --pipe", ["FILM is ", "--pipe is given"]),
    ("play - {transport}", ["FILM is -", "--pipe is not given"]),
    ("play {film} {transport} --video-size 4x4", ["--video-size is 4x4", "--pipe is not given"]),
    ("combine {transport} {transport} --out {out}.npz", ["SCAN ", "corner.npz is given twice"]),
    ("combine {transport} {out}.zarr --out {out}.npz", ["out.zarr: no such file"]),
    ("combine {out}.zarr --out {out}.npz", ["out.zarr: no such file"]),
    ("play --pipe - {transport} --gain auto", ["--gain is auto", "follow"]),
    (
        "play --pipe - {tall} --grid 2x5 --camera-grid 5x10 --bounces-every 2",
        ["bounces_every is 2", "no S"],
    ),
    ("play --pipe - {transport} --video-size 4", ["video_size is '4'", "1280x720"]),
    ("acquire run {empty}", ["acquisition.toml: ", "ltcl simulate"]),
    (
        "compensate {store} {picture} --resize stretch --high 2 --out {out}",
        ["--high is 2", "0 to 1"],
    ),
    ("compensate --transports {nan} {film} --out {out}", ["film.avi: holds frames"]),
    ("compensate --transports {nan} {empty} --out {out}", ["empty: holds frames"]),
    (
        "compensate --transports {store} {picture} --out {store}",
        ["--out is", "where transports are"],
    ),
    (
        "compensate --transports {nan} {store} {picture} --out {out}",
        ["zarr: is a transport", "--transports"],
    ),
    (
        "compensate --transports {nan} {transport} {picture} --out {out}",
        ["corner.npz: is a transport"],
    ),
    (
        "compensate --transports {nan}.x {picture} --out {out}",
        ["--transports is", "nan.npy.x"],
    ),
    ("compensate {store} {picture} --out {store}", ["--out is", "zarr, which is TRANSPORT itself"]),
    ("film {store} {film} --out {store}", ["--out is", "zarr, which is TRANSPORT itself"]),
    (
        "separate {store} {picture} --out {store}/new",
        ["--out is", "/new, which is TRANSPORT"],
    ),
    ("acquire run {simulated} --take {empty}", ["--take", "virtual"]),
    ("show {empty} --every 2 --arrival", ["--every is 2", "--arrival"]),
    ("show {empty} --every 0", ["is 0"]),
]


@pytest.fixture(scope="session")
def names(request: pytest.FixtureRequest, folder: Path) -> dict[str, Any]:
    """Files by the names that stand in the tables."""
    files = {}
    for name in FIXTURES:
        files[name] = request.getfixturevalue(name)
    T = ltcl.load(files["transport"]).matrices[0]
    ltcl.save(folder / "other.npz", ltcl.Transport(1.5 * T - 0.5 * np.diag(np.diag(T)), (5, 10)))
    dark = np.diag([1.0, 1, 0, 1, 0, 1]) + 0.01 * (1 - np.eye(6))
    np.savez(folder / "dark.npz", T=dark, grid=(2, 3))
    np.save(folder / "tall.npy", np.ones((50, 10)))
    np.save(folder / "nan.npy", np.full((4, 4), np.nan))
    film = np.random.default_rng(6).uniform(0.2, 0.3, (3, 4, 12))
    write_video(folder / "film.avi", film, fps=12.0)
    (folder / "empty").mkdir()
    files["store"] = files["acquired"] / "transport.zarr"
    return {path.stem: path for path in folder.iterdir()} | files


def times(folder: Path) -> dict[Path, int]:
    """When the files of a folder were written."""
    return {path: path.stat().st_mtime_ns for path in folder.iterdir()}


@pytest.mark.parametrize(("line", "parts"), USAGE)
def test_wrong_usage_is_code_2(program, line, parts):
    words = [word.format(nothing=" ") for word in line.split()]
    program(*words).assert_refused(*parts, code=2)
    failed = program(*words, "--json")
    assert failed.code == 2
    assert failed.document["type"] == "UsageError"
    assert failed.document["exit_code"] == 2
    for part in parts:
        assert part in failed.document["error"]


@pytest.mark.parametrize(("line", "parts"), COMPENSATE + OTHERS)
def test_bad_input_is_one_line_and_nothing_is_written(
    program, names, folder, tmp_path, line, parts
):
    before = times(folder)
    words = [word.format(**names, out=tmp_path / "out") for word in line.split()]
    program(*words).assert_refused(*parts)
    assert list(tmp_path.iterdir()) == []
    assert times(folder) == before


PLACES = [
    ("compensate nowhere.npz a.png --out", "file"),
    ("film nowhere.npz a.mp4 --out {}/out --video", "file/a.mp4"),
    ("separate nowhere.npz a.png --out", "file/out"),
    ("simulate dihedral --out", "file"),
    ("demo --out", "file/out"),
    ("compress nowhere.npz --out", "file/a.npz"),
    ("denoise nowhere.npz --out", "file/a.npz"),
    ("invert nowhere.npz --out", "file/a.npz"),
    ("convert nowhere.npz", "file/a.npz"),
    ("analyze nowhere.npz --plot", "file/a.png"),
]
if sys.platform == "linux":
    # Nobody can write there.
    PLACES.append(("compress nowhere.npz --out", "/proc/a.npz"))


@pytest.mark.parametrize(("line", "place"), PLACES)
def test_output_places_are_tested_before_anything_is_read(program, tmp_path, line, place):
    (tmp_path / "file").write_text("mine")
    outcome = program(*line.format(tmp_path).split(), tmp_path / place)
    assert outcome.code == 1
    assert f"{tmp_path / place}: " in outcome.err
    assert "nowhere" not in outcome.err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
