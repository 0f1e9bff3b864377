# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl compensate` on a folder or a video of frames."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import ltcl
from ltcl import images
from ltcl.batch.manifest import locked
from ltcl.cli import console
from ltcl.images.frames import open_frames

from .conftest import Program

COUNT = 10


@pytest.fixture(scope="session")
def film(folder: Path) -> Path:
    """Ten 16-bit PNG of 5 x 10, within reach of `transport`."""
    frames = folder / "film"
    frames.mkdir()
    rng = np.random.default_rng(5)
    for number in range(1, COUNT + 1):
        assert cv2.imwrite(
            str(frames / f"f{number}.png"), rng.integers(40000, 44000, (5, 10)).astype(np.uint16)
        )
    return frames


@pytest.fixture(scope="session")
def video(folder: Path) -> Path:
    """Ten grey frames of 4 x 12 in a lossless video."""
    path = folder / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"FFV1"), 12.0, (12, 4))
    rng = np.random.default_rng(6)
    for _ in range(COUNT):
        writer.write(np.stack([rng.integers(60, 80, (4, 12)).astype(np.uint8)] * 3, axis=-1))
    writer.release()
    return path


def test_patterns_of_a_folder_make_the_frames(
    program: Program, transport: Path, film: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    outcome = program("compensate", transport, film, "--out", out, "--rtol", "1e-4", "--json")
    assert outcome.code == 0, outcome.err
    told = outcome.json
    assert told["source"] == str(film)
    assert told["solved"] == COUNT
    assert told["frames_per_second"] > 0
    assert told["options"]["rtol"] == 1e-4
    assert [frame["name"] for frame in told["frames"]] == [f"f{number}.png" for number in range(1, COUNT + 1)]
    assert told["worst"]["error"] == max(frame["error"] for frame in told["frames"])
    T = ltcl.load(transport)
    for frame in open_frames(film):
        pattern = images.read(out / f"pattern_{frame.number:06}.png")
        difference = np.linalg.norm(T @ pattern - frame.picture())
        assert difference < 5e-4 * np.linalg.norm(frame.picture())
    kept = json.loads((out / "frames.json").read_text())
    assert kept["settings"]["rtol"] == 1e-4
    assert kept["frames"] == told["frames"]


def test_a_video_comes_back_as_one(
    program: Program, colour_transport: Path, video: Path, tmp_path: Path
) -> None:
    out, made = tmp_path / "out", tmp_path / "made.mkv"
    common = ["compensate", colour_transport, video, "--out", out, "--batch", "4", "--video", made]
    outcome = program(*common, "--high", "9", "--gain", "auto", "--appearance", "--format", "exr")
    assert outcome.code == 0, outcome.err
    assert f"patterns and frames.json in {out}, as a video in {made}" in outcome.out
    source = open_frames(made)
    assert (source.count, source.fps) == (COUNT, pytest.approx(12.0))
    for frame in source:
        pattern = images.read(out / f"pattern_{frame.number:06}.exr")
        np.testing.assert_allclose(
            images.to_srgb(frame.picture()), images.to_srgb(pattern / 9.0), atol=0.6 / 255
        )
        assert images.read(out / f"appearance/appearance_{frame.number:06}.exr").shape == (4, 12, 3)


def test_resume_goes_on_and_says_what_there_is(
    program: Program, transport: Path, film: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    common = ["compensate", transport, film, "--out", out, "--batch", "3"]
    assert program(*common, "--frames", "6").code == 0
    program(*common).refused(f"{out}: holds 6 frame(s) of an earlier run; give --resume to go on")
    program(*common, "--resume", "--rtol", "1e-3").refused("that run had --rtol 0.01, this one has 0.001")
    program(*common, "--resume", "--batch", "2").refused("that run had --batch 3, this one has 2")
    outcome = program(*common, "--resume", "--json")
    assert outcome.code == 0, outcome.err
    assert outcome.json["solved"] == COUNT - 6
    assert len(outcome.json["frames"]) == COUNT
    again = program(*common, "--resume")
    assert again.out.splitlines()[1].split()[:3] == [str(COUNT), "0", "-"]


def test_ctrl_c_says_how_to_go_on(
    program: Program, transport: Path, film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    common = ["compensate", transport, film, "--out", out, "--batch", "2"]
    note = console.Frames.__call__

    def interrupted(self: console.Frames, done: int, total: int | None) -> None:
        note(self, done, total)
        if done == 4:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(console.Frames, "__call__", interrupted)
        outcome = program(*common)
    assert outcome.code == 130
    assert outcome.err.splitlines() == [
        f"ltcl: 4 frame(s) are done and stay in {out}; --resume goes on from there",
        "ltcl: error: interrupted",
    ]
    assert len(list(out.iterdir())) == 5
    assert program(*common, "--resume", "--json").json["solved"] == COUNT - 4


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for one process there")
def test_a_real_ctrl_c_is_taken_between_files(transport: Path, tmp_path: Path) -> None:
    frames, out = tmp_path / "in", tmp_path / "out"
    frames.mkdir()
    for number in range(400):
        images.write(frames / f"{number}.exr", np.full((5, 10), 0.3 + 1e-4 * number))
    command = [sys.executable, "-m", "ltcl", "compensate", transport, frames, "--out", out, "--batch", "2"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as child:
        while not (out / "frames.json").exists():
            assert child.poll() is None
        child.send_signal(signal.SIGINT)
        _, err = child.communicate()
    done = json.loads((out / "frames.json").read_text())["frames"]
    assert child.returncode == 130
    assert "--resume goes on from there" in err
    assert "Traceback" not in err
    assert 2 <= len(done) < 400
    assert all((out / f"pattern_{record['number']:06}.png").is_file() for record in done)
    assert not [name for name in os.listdir(out) if name.startswith(".")]


def test_a_bad_frame_is_one_line_with_what_is_done(
    program: Program, transport: Path, film: Path, tmp_path: Path
) -> None:
    frames, out = tmp_path / "in", tmp_path / "out"
    frames.mkdir()
    for number in range(1, 6):
        (frames / f"{number}.png").write_bytes((film / f"f{number}.png").read_bytes())
    (frames / "4.png").write_bytes((film / "f4.png").read_bytes()[:60])
    common = ["compensate", transport, frames, "--out", out, "--batch", "2"]
    program(*common).refused(
        f"{frames / '4.png'}: is truncated",
        f"2 frame(s) are done and stay in {out}, --resume goes on from there",
    )


def test_progress_without_a_terminal_is_a_line_now_and_then(
    program: Program, transport: Path, film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console, "_AGAIN", 0.0)
    monkeypatch.setattr(console, "_PATIENCE", 0.0)
    outcome = program("compensate", transport, film, "--out", tmp_path / "out", "--batch", "4", "--json")
    lines = outcome.err.splitlines()
    assert lines[0] == f"ltcl: 0 of {COUNT} frames"
    assert lines[1].startswith(f"ltcl: 4 of {COUNT} frames, ")
    assert lines[-1].endswith("0:00:00 left")
    assert outcome.json["solved"] == COUNT


def test_clipped_frames_come_with_advice(
    program: Program, transport: Path, film: Path, tmp_path: Path
) -> None:
    outcome = program("compensate", transport, film, "--out", tmp_path / "out", "--gain", "2")
    assert outcome.code == 0
    assert f"ltcl: {COUNT} frame(s) ask for light beyond the projector's, frame " in outcome.err
    assert "try a --gain below 2" in outcome.err


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (
            ["{film}", "{picture}"],
            ["film: holds frames, and there are 1 more inputs; it must be the only one"],
        ),
        (["{picture}", "--resume"], ["--resume is given, but", "sky.exr is a picture"]),
        (["{picture}", "--batch", "4"], ["--batch is given"]),
        (["{picture}", "--video", "a.mp4"], ["--video is given"]),
        (["{film}", "--video", "a.mp4"], ["frames are 5 x 10 pixels; those of a video must be even"]),
        (["{film}", "--video", "a.webm"], ["a.webm: extension .webm is unknown"]),
        (["{film}", "--fps", "0"], ["fps is 0.0"]),
        (["{film}", "--gain", "0"], ["--gain is 0.0"]),
        (["{film}", "--low", "2"], ["(--low, --high) is (2.0, 1.0)"]),
        (["{video}"], ["film.avi: frame 1 ", "is 4 x 12 pixels, but the camera has 5 x 10; give --resize"]),
        (["nowhere.mp4"], ["nowhere.mp4: no such file"]),
        (["{empty}"], ["holds no pictures"]),
    ],
)
def test_refusals_leave_no_folder(
    program: Program,
    transport: Path,
    film: Path,
    video: Path,
    picture: Path,
    tmp_path_factory: pytest.TempPathFactory,
    tmp_path: Path,
    arguments: list[str],
    parts: list[str],
) -> None:
    names = {"film": film, "video": video, "picture": picture, "empty": tmp_path_factory.mktemp("empty")}
    filled = [argument.format(**names) for argument in arguments]
    program("compensate", transport, *filled, "--out", tmp_path / "out").refused(*parts)
    assert list(tmp_path.iterdir()) == []


def test_a_compressed_transport_is_told_and_corrected(
    program: Program, transport: Path, compressed_transport: Path, film: Path, tmp_path: Path
) -> None:
    common = ["compensate", compressed_transport, film, "--frames", "3", "--format", "exr"]
    alone = program(*common, "--out", tmp_path / "alone")
    assert alone.code == 0, alone.err
    assert "errors are of the compressed transport, which itself is off by up to 0.41 %\n" in alone.out
    kept = json.loads((tmp_path / "alone" / "frames.json").read_text())
    assert (kept["transport"]["error"], kept["settings"]["exact"]) == (0.0041, None)
    again = program(*common, "--out", tmp_path / "alone", "--resume", "--json").json
    assert (again["solved"], again["transport_error"]) == (0, 0.0041)
    exact = [*common, "--out", tmp_path / "exact", "--exact", transport, "--rtol", "1e-5"]
    outcome = program(*exact)
    assert outcome.code == 0, outcome.err
    assert f"errors are of {transport}, by which solutions were corrected\n" in outcome.out
    told = program(*exact, "--resume", "--json").json
    assert (told["solved"], told["transport_error"]) == (0, 0.0)
    T = ltcl.load(transport)
    for frame in list(open_frames(film))[:3]:
        pattern = images.read(tmp_path / "exact" / f"pattern_{frame.number:06}.exr")
        assert np.linalg.norm(T @ pattern - frame.picture()) <= 2e-5 * np.linalg.norm(frame.picture())


@pytest.mark.skipif(sys.platform == "win32", reason="no flock there")
@pytest.mark.parametrize("name", ["film", "picture"])
def test_a_second_run_in_a_folder_is_refused_at_once(
    program: Program, transport: Path, film: Path, picture: Path, tmp_path: Path, name: str
) -> None:
    command = ["compensate", transport, {"film": film, "picture": picture}[name], "--out", tmp_path / "out"]
    with locked(tmp_path / "out"):  # as the first one does
        program(*command).refused("out: another run writes there")
    assert program(*command).code == 0
