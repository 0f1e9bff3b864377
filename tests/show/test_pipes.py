# SPDX-License-Identifier: BSD-3-Clause
"""Raw video through pipes: formats, order, back-pressure, late frames, and both ends."""

from __future__ import annotations

import io
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl import errors
from ltcl.cli.main import main
from ltcl.cli.pipe import describe_pipe
from ltcl.show import pipes
from ltcl.show.pipes import RawVideo
from ltcl.show.projection import Projection
from ltcl.viewer.answers import ViewerScene

random = np.random.default_rng(0)
PATIENCE = 20.0


def quiet(*_: Any, **__: Any) -> None:
    """Take progress that nobody sees."""


@pytest.fixture(scope="module")
def T(device) -> ltcl.Transport:
    return ltcl.scenes.dihedral(4, albedo=(0.6, 0.5, 0.3)).transport(device=device)


def project(T: ltcl.Transport, video: RawVideo, **settings: Any) -> Projection:
    encoding = "linear" if video.dtype.kind == "f" else "srgb"
    return Projection(
        ViewerScene(T, "T", {}, None),
        0.3,
        fps=video.fps,
        decode=encoding,
        encode=encoding,
        dtype=video.dtype.name,
        **settings,
    )


def raw_video(T: ltcl.Transport, pixel_format: str = "rgb24") -> RawVideo:
    height, width = T.camera_grid
    return RawVideo(width=width, height=height, pixel_format=pixel_format)


def frames_of(video: RawVideo, count: int) -> list[np.ndarray]:
    shape = (count, video.height, video.width, 3)
    light = random.random(shape, np.float32)
    if video.dtype.kind == "f":
        return [*light]
    return [*np.rint(light * np.iinfo(video.dtype).max).astype(video.dtype)]


def run_through(projection: Projection, video: RawVideo, data: bytes) -> bytes:
    out = io.BytesIO()
    pipes.pipe(projection, video, io.BytesIO(data), out, progress=quiet)
    return out.getvalue()


@pytest.mark.parametrize("pixel_format", [*pipes.PIXEL_FORMATS])
def test_codes_are_those_of_compensator(T, pixel_format):
    video = raw_video(T, pixel_format)
    frames = frames_of(video, 5)
    sent = b"".join(video.to_bytes(frame) for frame in frames)
    received = run_through(project(T, video), video, sent)
    size = video.frame_bytes
    assert len(received) == 5 * size
    expected = project(T, video)
    for number, frame in enumerate(frames):
        codes = video.from_bytes(received[number * size : (number + 1) * size])
        np.testing.assert_allclose(codes, expected.codes(frame), rtol=1e-5)


def test_planes_come_green_blue_red():
    video = RawVideo(width=1, height=1, pixel_format="gbrpf32le")
    data = np.array([2.0, 3.0, 1.0], "<f4").tobytes()
    assert video.from_bytes(data).tolist() == [[[1.0, 2.0, 3.0]]]


def test_larger_frames_are_resized(T):
    height, width = T.camera_grid
    video = RawVideo(width=2 * width, height=2 * height)
    frame = np.full((2 * height, 2 * width, 3), 100, np.uint8)
    received = run_through(project(T, video), video, video.to_bytes(frame))
    small = raw_video(T)
    expected = project(T, small).codes(frame[::2, ::2])
    difference = small.from_bytes(received).astype(int) - expected
    assert abs(difference).max() <= 1


class SlowOutput(io.RawIOBase):
    """A stream that takes a frame when it is told to, or after so many seconds."""

    def __init__(self, seconds: float = 0.0) -> None:
        self.data = b""
        self.may_write = threading.Event()
        self.seconds = seconds
        if seconds:
            self.may_write.set()

    def write(self, data: Any, /) -> int:
        assert self.may_write.wait(PATIENCE)
        time.sleep(self.seconds)
        self.data += bytes(data)
        return len(data)


class CountedInput(io.BytesIO):
    """A stream that counts the frames that were asked for."""

    asked = 0

    def readinto(self, buffer: Any, /) -> int:
        self.asked += 1
        return super().readinto(buffer)


def in_thread(run: Callable[[], Any]) -> tuple[threading.Thread, list[Any]]:
    results: list[Any] = []
    thread = threading.Thread(target=lambda: results.append(run()))
    thread.start()
    return thread, results


def test_slow_reader_stops_reading(T):
    video = raw_video(T)
    frames = frames_of(video, 40)
    stdin = CountedInput(b"".join(video.to_bytes(frame) for frame in frames))
    stdout = SlowOutput()
    projection = project(T, video)
    thread, results = in_thread(
        lambda: pipes.pipe(projection, video, stdin, stdout, progress=quiet)
    )
    asked = -1
    while asked != stdin.asked:
        asked = stdin.asked
        time.sleep(0.2)
    # One frame is in the hands of each thread, beside those of the queues.
    assert asked <= 2 * pipes.QUEUED_FRAMES + 4
    stdout.may_write.set()
    thread.join(PATIENCE)
    assert results[0].written == 40
    assert results[0].dropped == 0
    assert len(stdout.data) == 40 * video.frame_bytes


def test_dropped_frames_are_repeated(T):
    video = raw_video(T)
    frames = frames_of(video, 30)
    data = b"".join(video.to_bytes(frame) for frame in frames)
    stdout = SlowOutput(seconds=0.005)
    result = pipes.pipe(
        project(T, video), video, io.BytesIO(data), stdout, late="drop", progress=quiet
    )
    assert result.written == 30
    assert len(stdout.data) == 30 * video.frame_bytes
    assert result.dropped > 0
    # The last frame is never dropped.
    expected = project(T, video).codes(frames[-1])
    assert stdout.data[-video.frame_bytes :] == video.to_bytes(expected)


def test_closed_output_ends_it(T):
    video = raw_video(T)
    read_end, write_end = os.pipe()
    os.close(read_end)
    frames = b"".join(video.to_bytes(frame) for frame in frames_of(video, 20))
    with open(write_end, "wb", buffering=0) as stdout:
        result = pipes.pipe(project(T, video), video, io.BytesIO(frames), stdout, progress=quiet)
    assert result.is_cut_off
    assert result.written == 0


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full")
def test_full_disk_is_an_error(T):
    video = raw_video(T)
    data = video.to_bytes(frames_of(video, 1)[0])
    with (
        open("/dev/full", "wb", buffering=0) as stdout,
        pytest.raises(errors.FileError, match=r"stdout: .* No space left"),
    ):
        pipes.pipe(project(T, video), video, io.BytesIO(data), stdout, progress=quiet)


def test_last_piece_is_left_out(T, caplog):
    video = raw_video(T)
    data = video.to_bytes(frames_of(video, 1)[0])
    assert len(run_through(project(T, video), video, data + b"12345")) == len(data)
    assert f"5 bytes into a frame of {video.frame_bytes}" in caplog.text
    with pytest.raises(errors.FileError, match="--video-size"):
        run_through(project(T, video), video, b"12345")
    assert run_through(project(T, video), video, b"") == b""


def test_no_frame_took_no_time():
    nothing = pipes.PipeStatistics(written=0, dropped=0, frames_per_second=0.0, is_cut_off=False)
    assert "nan" not in describe_pipe(nothing, math.nan)
    assert "within 2.0 ms" in describe_pipe(nothing, 0.002)


def test_bad_light_is_an_error(T):
    video = raw_video(T, "gbrpf32le")
    data = np.full((video.height, video.width, 3), np.nan, np.float32).tobytes()
    with pytest.raises(errors.InputError, match="frame"):
        run_through(project(T, video), video, data)


@pytest.mark.parametrize(
    ("given", "names"),
    [
        ({"width": 0}, "width is 0"),
        ({"pixel_format": "yuv420p"}, "pixel_format is 'yuv420p'"),
        ({"fps": 0.0}, "fps is 0"),
        ({"width": 10**7, "height": 10**7}, "frames of 10000000 x 10000000"),
    ],
)
def test_bad_videos_are_refused(given, names):
    with pytest.raises((errors.InputError, errors.MemoryLimitError), match=names):
        RawVideo(**{"width": 4, "height": 2, **given})


@pytest.mark.parametrize("text", ["12", "4x", "0x4", "4:3", "-1x2"])
def test_bad_sizes_are_refused(text):
    with pytest.raises(errors.InputError, match="video_size is"):
        pipes.parse_video_size(text)


@pytest.fixture(scope="module")
def measured(room_of_two: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The transport of two projectors that were scanned."""
    file = tmp_path_factory.mktemp("measured") / "both.npz"
    assert main(["combine", str(room_of_two), "--out", str(file), "--quiet"]) == 0
    return file


def play(transport: Path, *words: str, **streams: Any) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-m", "ltcl", "play", "--pipe", *words, "-", str(transport)]
    return subprocess.run(command, capture_output=True, check=False, **streams)


def test_the_gain_of_measured_projectors_follows(measured: Path) -> None:
    frame = np.full((6, 12, 3), 150, np.uint8).tobytes()
    by_default = play(measured, input=frame)
    assert by_default.returncode == 0, by_default.stderr
    assert by_default.stdout == play(measured, "--gain", "follow", input=frame).stdout
    assert by_default.stdout != play(measured, "--gain", "1", input=frame).stdout


def test_closed_stdin_is_told(measured: Path) -> None:
    played = play(measured, preexec_fn=lambda: os.close(0))
    assert played.returncode == 1
    assert b"stdin is closed" in played.stderr
