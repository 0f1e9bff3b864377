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
from ltcl.cli import console
from ltcl.images.frames import open_frames

COUNT = 10


@pytest.fixture(scope="module")
def film(folder: Path) -> Path:
    """Ten 16-bit PNG of 5 x 10, within reach of `transport`."""
    frames, values = folder / "film", np.random.default_rng(5)
    frames.mkdir()
    for number in range(1, COUNT + 1):
        codes = values.integers(40000, 44000, (5, 10)).astype(np.uint16)
        assert cv2.imwrite(str(frames / f"f{number}.png"), codes)
    return frames


@pytest.fixture(scope="module")
def video(folder: Path) -> Path:
    """Ten grey frames of 4 x 12 in a lossless video."""
    path, values = folder / "film.avi", np.random.default_rng(6)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"FFV1"), 12.0, (12, 4))
    for _ in range(COUNT):
        writer.write(np.stack([values.integers(60, 80, (4, 12)).astype(np.uint8)] * 3, axis=-1))
    writer.release()
    return path


def test_patterns_of_a_folder_make_the_frames(program, transport, film, tmp_path):
    out = tmp_path / "out"
    told = program("compensate", transport, film, "--out", out, "--rtol", "1e-4", "--json").json
    assert (told["source"], told["solved"], told["options"]["rtol"]) == (str(film), COUNT, 1e-4)
    assert told["frames_per_second"] > 0
    assert [frame["name"] for frame in told["frames"]] == [f"f{number}.png" for number in range(1, COUNT + 1)]
    assert told["worst"]["error"] == max(frame["error"] for frame in told["frames"])
    T = ltcl.load(transport)
    for frame in open_frames(film):
        pattern, desired = images.read(out / f"pattern_{frame.number:06}.png"), frame.picture()
        assert np.linalg.norm(T @ pattern - desired) < 5e-4 * np.linalg.norm(desired)
    assert json.loads((out / "frames.json").read_text())["frames"] == told["frames"]


def test_a_video_comes_back_as_one(program, colour_transport, video, tmp_path):
    out, made = tmp_path / "out", tmp_path / "made.mkv"
    common = ["compensate", colour_transport, video, "--out", out, "--batch", "4", "--video", made]
    outcome = program(*common, "--high", "9", "--gain", "auto", "--appearance", "--format", "exr")
    assert outcome.code == 0, outcome.err
    assert f"as a video in {made}" in outcome.out
    source = open_frames(made)
    assert (source.count, source.fps) == (COUNT, pytest.approx(12.0))
    for frame in source:
        codes = images.to_srgb(images.read(out / f"pattern_{frame.number:06}.exr") / 9.0)
        np.testing.assert_allclose(images.to_srgb(frame.picture()), codes, atol=0.6 / 255)
        assert images.read(out / f"appearance/appearance_{frame.number:06}.exr").shape == (4, 12, 3)


def test_resume_goes_on_and_says_what_there_is(program, transport, film, tmp_path):
    common = ["compensate", transport, film, "--out", tmp_path, "--batch", "3"]
    assert program(*common, "--frames", "6").code == 0
    program(*common).refused(f"{tmp_path}: holds 6 frame(s)", "(--resume)")
    program(*common, "--resume", "--rtol", "1e-3").refused("rtol=0.01", "0.001", "(--rtol)")
    program(*common, "--resume", "--batch", "2").refused("batch=3", "2", "(--batch)")
    told = program(*common, "--resume", "--json").json
    assert (told["solved"], len(told["frames"])) == (COUNT - 6, COUNT)
    assert program(*common, "--resume").out.splitlines()[1].split()[:3] == [str(COUNT), "0", "-"]


def test_ctrl_c_says_how_to_go_on(program, transport, film, tmp_path, monkeypatch):
    common = ["compensate", transport, film, "--out", tmp_path, "--batch", "2"]
    note = console.Progress.__call__

    def interrupted(self: console.Progress, step: str, done: float = 0, total: float | None = None) -> None:
        note(self, step, done, total)
        if (step, done) == ("frames", 4):
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(console.Progress, "__call__", interrupted)
        program(*common).refused("interrupted", "4 frame(s) are done", str(tmp_path), "--resume", code=130)
    assert len(list(tmp_path.iterdir())) == 5
    assert program(*common, "--resume", "--json").json["solved"] == COUNT - 4


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for one process there")
def test_a_real_ctrl_c_is_taken_between_files(transport, tmp_path):
    frames, out = tmp_path / "in", tmp_path / "out"
    for number in range(400):
        images.write(frames / f"{number}.exr", np.full((5, 10), 0.3 + 1e-4 * number))
    command = [sys.executable, "-m", "ltcl", "compensate", transport, frames, "--out", out, "--batch", "2"]
    pipes = {"stderr": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([*command, "--json"], **pipes) as child:
        while not (out / "frames.json").exists():
            assert child.poll() is None
        child.send_signal(signal.SIGINT)
        stdout, stderr = child.communicate()
    done = json.loads((out / "frames.json").read_text())["frames"]
    assert child.returncode == json.loads(stdout)["exit_code"] == 130
    assert "--resume goes on from there" in stderr
    assert "Traceback" not in stderr
    assert 2 <= len(done) < 400
    assert all((out / f"pattern_{record['number']:06}.png").is_file() for record in done)
    assert not [name for name in os.listdir(out) if name.startswith(".")]


def test_a_bad_frame_is_one_line_with_what_is_done(program, transport, film, tmp_path):
    frames, out = tmp_path / "in", tmp_path / "out"
    frames.mkdir()
    for number in range(1, 6):
        data = (film / f"f{number}.png").read_bytes()
        (frames / f"{number}.png").write_bytes(data[:60] if number == 4 else data)
    outcome = program("compensate", transport, frames, "--out", out, "--batch", "2")
    outcome.refused(f"{frames / '4.png'}: ", f"2 frame(s) are done and stay in {out}", "(--resume)")


def test_clipped_frames_come_with_advice(program, transport, film, tmp_path):
    outcome = program("compensate", transport, film, "--out", tmp_path / "out", "--gain", "2")
    assert outcome.code == 0
    assert f"ltcl: {COUNT} frame(s) ask for light beyond the projector's, frame " in outcome.err
    assert "try a --gain below 2" in outcome.err


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["{film}", "{picture}"], ["film: holds frames", "1 more"]),
        (["{picture}", "--resume"], ["--resume is given", "sky.exr is a picture"]),
        (["{picture}", "--batch", "4"], ["--batch is given"]),
        (["{film}", "--video", "{out}.mp4"], ["5 x 10"]),
        (["{film}", "--video", "{out}.webm"], [".webm"]),
        (["{film}", "--fps", "0"], ["fps is 0.0", "(--fps)"]),
        (["{film}", "--gain", "0"], ["gain is 0.0", "(--gain)"]),
        (["{film}", "--low", "2"], ["bounds is (2.0, 1.0)", "(--low, --high)"]),
        (["{video}"], ["film.avi: frame 1 ", "4 x 12", "5 x 10", "(--resize)"]),
        (["nowhere.mp4"], ["nowhere.mp4: no such file"]),
        (["{empty}"], ["holds no pictures"]),
    ],
)
def test_refusals_leave_no_folder(program, transport, film, video, picture, tmp_path, arguments, parts):
    out, empty = tmp_path / "out", tmp_path / "empty"
    empty.mkdir()
    names = {"film": film, "video": video, "picture": picture, "empty": empty, "out": out}
    filled = [argument.format(**names) for argument in arguments]
    program("compensate", transport, *filled, "--out", out).refused(*parts)
    assert list(tmp_path.iterdir()) == [empty]
