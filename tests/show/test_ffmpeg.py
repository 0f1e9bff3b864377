# SPDX-License-Identifier: BSD-3-Clause
"""`ffmpeg ... | ltcl play --pipe ... | ffmpeg ...`, as a shell runs it."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition.radiometry import Response
from ltcl.images import from_srgb
from ltcl.show.export import write_cubes
from ltcl.show.pipes import RawVideo
from ltcl.show.projection import Projection
from ltcl.viewer.answers import ViewerScene
from tests.transport import projectors
from tests.transport.projectors import CAMERA, LEFT, RIGHT

PATIENCE = 100.0
# An expression of FFmpeg whose frames differ and lie within reach.
PICTURES = "testsrc2=size=16x8:rate=25:duration=0.4"


@pytest.fixture(scope="module")
def ffmpeg() -> list[str]:
    """Return the words that start FFmpeg."""
    found = shutil.which("ffmpeg")
    if found is None:
        pytest.skip("FFmpeg is not installed (Debian: apt install ffmpeg)")
    return [found, "-hide_banner", "-loglevel", "error"]


@pytest.fixture(scope="module")
def transport(device, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("pipes") / "T.npz"
    scene = ltcl.scenes.dihedral(8, albedo=(0.6, 0.5, 0.3))
    ltcl.save(path, scene.transport(device=device))
    return path


def start(words: list[Any], **pipes: Any) -> Any:
    return subprocess.Popen([str(word) for word in words], **pipes)


def play_between(
    ffmpeg: list[str], play: list[Any], pixel_format: str, options: str
) -> tuple[bytes, bytes, str]:
    """Bytes of the frames of FFmpeg, of what another FFmpeg receives, and what `play` has told.

    The other one reads the codes by `options`.
    """
    source = [*ffmpeg, "-f", "lavfi", "-i", PICTURES, "-f", "rawvideo", "-pix_fmt", pixel_format]
    sink = [*ffmpeg, *options.split(), "-i", "-", "-f", "rawvideo", "-"]
    pipe = subprocess.PIPE
    frames = subprocess.run([*source, "-"], capture_output=True, check=True).stdout
    with (
        start([*source, "-"], stdout=pipe) as first,
        start(play, stdin=first.stdout, stdout=pipe, stderr=pipe) as middle,
        start(sink, stdin=middle.stdout, stdout=pipe) as last,
    ):
        received, _ = last.communicate(timeout=PATIENCE)
        assert middle.stderr is not None
        told = middle.stderr.read().decode()
        codes = [first.wait(PATIENCE), middle.wait(PATIENCE), last.wait(PATIENCE)]
    assert codes == [0, 0, 0], told
    return frames, received, told


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pixel_format", "bounces_every"), [("rgb24", 1), ("rgb48le", 1), ("gbrpf32le", 3)]
)
def test_video_goes_through(ffmpeg, transport, pixel_format, bounces_every):
    video = RawVideo(width=16, height=8, pixel_format=pixel_format)
    play = [sys.executable, "-m", "ltcl", "play", "--pipe", "--pixel-format", pixel_format]
    play += ["--video-size", "16x8", "--gain", "0.2", "--bounces-every", str(bounces_every)]
    play += ["-", transport]
    frames, received, told = play_between(ffmpeg, play, pixel_format, video.options)
    assert "video_size 16x8" in told
    assert "10 frames written" in told
    assert len(received) == len(frames) == 10 * video.frame_bytes
    encoding = "linear" if video.dtype.kind == "f" else "srgb"
    projection = Projection(
        ViewerScene(ltcl.load(transport), "T", {}, None),
        0.2,
        fps=25.0,
        decode=encoding,
        encode=encoding,
        dtype=video.dtype.name,
        bounces_every=bounces_every,
    )
    size = video.frame_bytes
    for begin in range(0, len(frames), size):
        picture = video.from_bytes(frames[begin : begin + size])
        shown = video.from_bytes(received[begin : begin + size])
        np.testing.assert_allclose(shown, projection.codes(picture), rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_patterns_of_a_combination_go_through_side_by_side(ffmpeg, device, tmp_path):
    """Frames of the camera's size in, patterns of two sizes out, whose sum is the picture."""
    members = projectors.transports(device, projectors.corner())
    T = ltcl.combine(members)
    path = tmp_path / "two.npz"
    ltcl.save(path, T)
    height = max(LEFT.grid[0], RIGHT.grid[0])
    width = LEFT.grid[1] + RIGHT.grid[1]
    target = RawVideo(width=width, height=height, pixel_format="gbrpf32le")
    play = [sys.executable, "-m", "ltcl", "play", "--pipe", "--pixel-format", "gbrpf32le"]
    play += ["--gain", "0.1", "--rtol", "1e-3", "-", path]
    frames, received, told = play_between(ffmpeg, play, "gbrpf32le", target.options)
    assert f"video_size {width}x{height}" in told
    assert len(received) == 10 * target.frame_bytes
    video = RawVideo(width=CAMERA[1], height=CAMERA[0], pixel_format="gbrpf32le")
    assert len(frames) == 10 * video.frame_bytes
    for number in range(10):
        size = video.frame_bytes
        desired = 0.1 * video.from_bytes(frames[number * size : (number + 1) * size])
        size = target.frame_bytes
        shown = target.from_bytes(received[number * size : (number + 1) * size])
        left = shown[: LEFT.grid[0], : LEFT.grid[1]]
        right = shown[: RIGHT.grid[0], LEFT.grid[1] :]
        assert shown[LEFT.grid[0] :, : LEFT.grid[1]].max() == 0.0
        picture = members[0].to_numpy() @ left.reshape(-1, 3)
        picture += members[1].to_numpy() @ right.reshape(-1, 3)
        error = np.linalg.norm(picture - desired.reshape(-1, 3)) / np.linalg.norm(desired)
        # The edges are sharper than what the projectors can make.
        least = ltcl.compensate(T, desired, rtol=1e-3).error
        assert error < 1.02 * least


class Calibrated:
    """A projector of which only colours and response are known."""

    name = "projector"
    projector = Response(np.linspace(0.0, 1.0, 257)[None] ** 1.8)
    mixing = np.array([[1.0, 0.1, 0.0], [0.05, 1.0, 0.1], [0.0, 0.2, 1.0]])

    @property
    def calibration(self) -> Calibrated:
        return self


@pytest.mark.parametrize("kind", ["lut1d", "lut3d"])
def test_ffmpeg_reads_cubes(ffmpeg, tmp_path, kind):
    projector: Any = Calibrated()
    files = write_cubes(tmp_path, projector, "a remark")
    file = tmp_path / files[kind == "lut3d"]
    # Colours on the places of both tables.
    steps = np.linspace(0.0, 1.0, 33)[::4].astype(np.float32)
    colours = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(1, -1, 3)
    video = RawVideo(width=colours.shape[1], height=1, pixel_format="gbrpf32le")
    words = [*ffmpeg, *video.options.split(), "-i", "-", "-vf", f"{kind}=file={file}"]
    words += ["-f", "rawvideo", "-pix_fmt", "gbrpf32le", "-"]
    data = video.to_bytes(colours)
    shown = subprocess.run(words, input=data, capture_output=True, check=True).stdout
    codes = video.from_bytes(shown)
    light = from_srgb(colours.astype(np.float64))[0]
    if kind == "lut3d":
        white = projector.mixing.sum(axis=1)
        light = np.linalg.solve(projector.mixing, (light * white).T).T
    expected = projector.projector.codes(np.clip(light, 0.0, 1.0))
    np.testing.assert_allclose(codes[0], expected, atol=2e-3)


@pytest.mark.slow
def test_reader_that_ends_first(ffmpeg, transport):
    endless = "testsrc2=size=16x8:rate=1000"
    source = [*ffmpeg, "-f", "lavfi", "-i", endless, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    play = [sys.executable, "-m", "ltcl", "play", "--pipe", "--gain", "0.2", "-", transport]
    size = RawVideo(width=16, height=8).frame_bytes
    pipe = subprocess.PIPE
    with (
        start(source, stdout=pipe, stderr=subprocess.DEVNULL) as first,
        start(play, stdin=first.stdout, stdout=pipe, stderr=pipe) as middle,
    ):
        assert first.stdout is not None
        assert middle.stdout is not None
        assert middle.stderr is not None
        # Only the program holds the other end now.
        first.stdout.close()
        assert len(middle.stdout.read(size)) == size
        middle.stdout.close()
        told = middle.stderr.read().decode()
        assert middle.wait(PATIENCE) == 0, told
        assert "nobody reads stdout" in told
        first.wait(PATIENCE)
