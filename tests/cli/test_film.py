# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl film`: patterns of folders and videos, listed, kept after Ctrl-C, resumed."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl import batch, images
from ltcl.cli.progress import Progress
from ltcl.files import locked
from ltcl.images.frames import open_frames, write_video
from tests.transport import projectors
from tests.transport.projectors import CAMERA, LEFT, RIGHT

COUNT = 10


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten 16-bit PNG of 5 x 10, within reach of `transport`."""
    folder = tmp_path_factory.mktemp("film")
    light = np.random.default_rng(5).uniform(0.33, 0.4, (COUNT, 5, 10))
    for number, picture in enumerate(light, 1):
        images.write(folder / f"f{number}.png", picture, bits=16)
    return folder


def interrupt_at(frames_done: int) -> Callable[..., None]:
    """Make a method for Progress that is interrupted by Ctrl-C when so many frames are done."""
    show = Progress.__call__

    def show_or_end(progress: Progress, step: str, *counts: Any, **options: Any) -> None:
        show(progress, step, *counts, **options)
        if step == "frames" and progress.completed == frames_done:
            signal.raise_signal(signal.SIGINT)

    return show_or_end


def test_patterns_of_a_folder_are_listed(program, transport, film, tmp_path):
    report = program("film", transport, film, "--out", tmp_path, "--json").json
    assert report["source"] == str(film)
    assert report["solved"] == COUNT
    names = [frame["name"] for frame in report["frames"]]
    assert names == [f"f{number}.png" for number in range(1, COUNT + 1)]
    assert report["worst"]["error"] == max(frame["error"] for frame in report["frames"])
    listed = json.loads((tmp_path / "frames.json").read_text())
    assert listed["frames"] == report["frames"]


def test_finished_frames_are_kept_after_ctrl_c(program, transport, film, tmp_path, monkeypatch):
    common = ["film", transport, film, "--out", tmp_path, "--batch", "3"]
    with monkeypatch.context() as patch:
        patch.setattr(Progress, "__call__", interrupt_at(6))
        # A third batch is solved while the second one is written, and is kept.
        program(*common).assert_refused("9 frame(s)", str(tmp_path), "--resume", code=130)
    listed = json.loads((tmp_path / "frames.json").read_text())
    assert len(listed["frames"]) == 9
    assert len([*tmp_path.glob("pattern_*.png")]) == 9
    program(*common).assert_refused(f"{tmp_path}: ", "9 frame(s)", "resume=True")
    program(*common, "--resume", "--rtol", "1e-3").assert_refused("rtol=0.01", "0.001")
    report = program(*common, "--resume", "--json").json
    assert report["solved"] == COUNT - 9
    assert len(report["frames"]) == COUNT
    assert report["options"]["rtol"] == 1e-2
    row = program(*common, "--resume").out.splitlines()[1]
    assert row.split()[:3] == [str(COUNT), "0", "-"]


def test_frames_beyond_the_projector_are_noted(program, transport, film, tmp_path):
    advice = program("film", transport, film, "--out", tmp_path, "--gain", "2").err
    assert f"{COUNT} frame(s)" in advice
    assert "--gain" in advice


def test_a_second_run_in_a_folder_is_refused_at_once(program, transport, film, tmp_path):
    arguments = ["film", transport, film, "--out", tmp_path / "out"]
    with locked(tmp_path / "out"):
        program(*arguments).assert_refused("out: another run")
    assert not (tmp_path / "out").exists()
    assert program(*arguments).code == 0


def test_a_video_becomes_a_video(program, colour_transport, tmp_path):
    film = tmp_path / "film.avi"
    video = tmp_path / "patterns.mkv"
    out = tmp_path / "out"
    write_video(film, np.random.default_rng(6).uniform(0.05, 0.08, (3, 4, 12)), fps=12.0)
    frame_options = ["--batch", "2", "--video", video, "--appearance", "--format", "exr"]
    light_options = ["--high", "9", "--gain", "auto"]
    outcome = program("film", colour_transport, film, "--out", out, *frame_options, *light_options)
    assert str(video) in outcome.out
    source = open_frames(video)
    assert source.count == 3
    assert source.fps == pytest.approx(12.0)
    for frame in source:
        pattern = images.read(out / f"pattern_{frame.number:06}.exr")
        codes = images.to_srgb(pattern / 9.0)
        np.testing.assert_allclose(images.to_srgb(frame.picture()), codes, atol=0.6 / 255)
        appearance = images.read(out / f"appearance/appearance_{frame.number:06}.exr")
        assert appearance.shape == (4, 12, 3)


def test_films_of_a_combination(program, device, tmp_path):
    """Patterns of two projectors side by side in a file for each frame."""
    members = projectors.transports(device, projectors.corner())
    path = tmp_path / "two.npz"
    ltcl.save(path, ltcl.combine(members))
    film = tmp_path / "film"
    film.mkdir()
    y, x = np.mgrid[: CAMERA[0], : CAMERA[1]]
    light = [0.2 + 0.05 * np.sin(0.6 * x + shift) * np.cos(0.5 * y) for shift in range(3)]
    for number, picture in enumerate(light, 1):
        images.write(film / f"{number}.exr", picture.astype(np.float32))
    out = tmp_path / "out"
    words = ["film", path, film, "--rtol", "1e-3", "--appearance", "--format", "exr"]
    report = program(*words, "--out", out, "--json").json
    assert [frame["name"] for frame in report["frames"]] == ["1.exr", "2.exr", "3.exr"]
    assert report["worst"]["error"] < 0.02
    T: Any = ltcl.load(path)
    for number, picture in enumerate(light, 1):
        pattern = images.read(out / f"pattern_{number:06}.exr")
        patterns = T.split(pattern)
        assert [part.shape for part in patterns] == [LEFT.grid, RIGHT.grid]
        shown = sum(
            member.to_numpy() @ part.ravel() for member, part in zip(members, patterns, strict=True)
        )
        assert np.linalg.norm(shown - picture.ravel()) < 0.02 * np.linalg.norm(picture)
        appearance = images.read(out / f"appearance/appearance_{number:06}.exr")
        np.testing.assert_allclose(appearance.ravel(), shown, rtol=1e-3)
    # The same call in Python, as codes, and resumed.
    codes = tmp_path / "codes"
    first = batch.compensate_frames(T, film, codes, rtol=1e-3, frames=2)
    assert first.solved == 2
    done = batch.compensate_frames(T, film, codes, rtol=1e-3, resume=True)
    assert done.solved == 1
    for number in (1, 2, 3):
        expected = images.read(out / f"pattern_{number:06}.exr")
        pattern = images.read(codes / f"pattern_{number:06}.png")
        np.testing.assert_allclose(pattern, expected, atol=2e-3)


def test_a_gain_of_a_show_that_is_none_is_told_all_of_them(program):
    outcome = program("play", "film.mp4", "T.npz", "--gain", "loud")
    outcome.assert_refused("'loud' is not a gain; write a number, auto or follow", code=2)
