# SPDX-License-Identifier: BSD-3-Clause
"""Videos in and out; damage is told by the frame at which it begins."""

from __future__ import annotations

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from ltcl import images
from ltcl.errors import FileError, InputError
from ltcl.images.frames import check_video, open_frames, write_video

LOSSLESS = [".mkv", ".avi"]
SIZE = (32, 48)


def film(count: int, size: tuple[int, int] = SIZE, seed: int = 0) -> np.ndarray:
    """RGB codes (count, h, w, 3) of coarse noise, so that lossy codecs keep most of it."""
    h, w = size
    coarse = np.random.default_rng(seed).integers(0, 256, (count, -(-h // 8), -(-w // 8), 3))
    return coarse.repeat(8, axis=1).repeat(8, axis=2)[:, :h, :w].astype(np.uint8)


def opencv_writes(path: Path, codes: np.ndarray, fourcc: str, fps: float = 25.0) -> None:
    size = codes.shape[2], codes.shape[1]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*fourcc), fps, size)
    assert writer.isOpened()
    for code in codes:
        writer.write(np.ascontiguousarray(code[..., ::-1]))
    writer.release()


def damaged(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("suffix", LOSSLESS)
@pytest.mark.parametrize("size", [(2, 2), (6, 4), (32, 48)])
def test_lossless_videos_give_every_code_back(tmp_path, suffix, size):
    codes = film(5, size)
    path = tmp_path / f"a{suffix}"
    assert write_video(path, images.from_srgb(codes / 255), fps=12.5) == 5
    source = open_frames(path)
    assert source.count == 5
    assert source.fps == pytest.approx(12.5)
    for frame, code in zip(source, codes, strict=True):
        shown = frame.picture()
        assert shown.dtype == np.float32
        shown = np.stack([shown] * 3, axis=-1) if shown.ndim == 2 else shown
        np.testing.assert_allclose(shown, images.from_srgb(code / 255), rtol=1e-6)
    for frame, code in zip(open_frames(path, encoding="linear"), codes, strict=True):
        np.testing.assert_allclose(frame.picture().max(), code.max() / 255, rtol=1e-6)


def test_mp4_looks_the_same(tmp_path):
    codes = np.full((6, *SIZE, 3), 128, np.uint8)
    codes += np.arange(0, 60, 10, dtype=np.uint8)[:, None, None, None]
    write_video(tmp_path / "a.mp4", images.from_srgb(codes / 255))
    for frame, code in zip(open_frames(tmp_path / "a.mp4"), codes, strict=True):
        np.testing.assert_allclose(images.to_srgb(frame.picture()) * 255, code[0, 0, 0], atol=8)


@pytest.mark.parametrize(("suffix", "fourcc"), [(".mp4", "mp4v"), (".avi", "MJPG"), (".mkv", "FFV1")])
def test_videos_of_others_are_read_in_order(tmp_path, suffix, fourcc):
    codes = film(9)
    opencv_writes(tmp_path / f"a{suffix}", codes, fourcc)
    found = [images.to_srgb(frame.picture()) for frame in open_frames(tmp_path / f"a{suffix}")]
    assert len(found) == 9
    for place, shown in enumerate(found):
        distances = [np.abs(shown * 255 - code).mean() for code in codes]
        assert np.argmin(distances) == place


def test_a_frame_of_equal_channels_is_grey(tmp_path):
    grey = np.random.default_rng(1).integers(0, 256, (3, 8, 10))
    grey[2] = 0
    opencv_writes(tmp_path / "a.mkv", np.stack([grey] * 3, axis=-1).astype(np.uint8), "FFV1")
    for frame, code in zip(open_frames(tmp_path / "a.mkv"), grey, strict=True):
        np.testing.assert_allclose(frame.picture(), images.from_srgb(code / 255), rtol=1e-6)


def test_digests_are_those_of_the_pixels(tmp_path):
    codes = film(4)
    codes[3] = codes[0]
    for name in ("a.mkv", "b.avi"):
        opencv_writes(tmp_path / name, codes, "FFV1")
    first, second = (
        [frame.digest() for frame in open_frames(tmp_path / name)] for name in ("a.mkv", "b.avi")
    )
    assert first == second
    assert first[0] == first[3]
    assert len(set(first)) == 3


@pytest.mark.parametrize("share", [0.5, 0.7, 0.97])
@pytest.mark.parametrize("suffix", LOSSLESS)
def test_a_truncated_video_gives_what_there_is_and_tells_the_rest(tmp_path, suffix, share):
    path = tmp_path / f"a{suffix}"
    opencv_writes(path, codes := film(20), "FFV1")
    whole = path.read_bytes()
    cut = damaged(tmp_path / f"cut{suffix}", whole[: int(share * len(whole))])
    found = []
    with pytest.raises(FileError) as error:
        found.extend(frame.picture() for frame in open_frames(cut))
    assert 0 < len(found) < 20
    text = f"{cut}: frame {len(found) + 1} of 20 cannot be read: the video is damaged or cut off there"
    assert str(error.value).startswith(text)
    assert "\n" not in str(error.value)
    for shown, code in zip(found, codes, strict=False):
        np.testing.assert_allclose(shown, images.from_srgb(code / 255), rtol=1e-6)


def test_frames_lost_in_the_middle_are_told_by_the_first(tmp_path):
    path = tmp_path / "a.mkv"
    noise = np.random.default_rng(2).integers(0, 256, (20, *SIZE, 3)).astype(np.uint8)
    opencv_writes(path, noise, "FFV1")
    whole = bytearray(path.read_bytes())
    middle = len(whole) // 2
    whole[middle - 2000 : middle + 2000] = bytes(4000)  # of about 4600 bytes a frame
    frames = open_frames(damaged(tmp_path / "hole.mkv", bytes(whole)))
    digests = []
    with pytest.raises(FileError, match="cannot be read: the video is damaged") as error:
        digests.extend(frame.digest() for frame in frames)
    right = [frame.digest() for frame in open_frames(path)]
    wrong = next(number for number, digest in enumerate(right, start=1) if digest not in digests)
    assert 5 < wrong < 15
    # The first one may be there, with pixels that the decoder has made up.
    assert any(f"frame {number} of 20 cannot" in str(error.value) for number in (wrong, wrong + 1))


@pytest.mark.parametrize("content", [b"", b"not a video", b"\0" * 5000, "mp4"])
def test_what_is_no_video_is_refused(tmp_path, content):
    path = tmp_path / "a.mp4"
    if content == "mp4":  # whose table of frames stands at the end
        opencv_writes(path, film(20), "mp4v")
        content = path.read_bytes()[:-400]
    path.write_bytes(content)
    with pytest.raises(FileError, match=r"a\.mp4: (is no video|the file is empty)"):
        open_frames(path)
    with pytest.raises(FileError, match="no such file"):
        open_frames(tmp_path / "b.mp4")


def test_nothing_but_our_line_is_on_stderr(tmp_path):
    opencv_writes(tmp_path / "a.mkv", film(20), "FFV1")
    whole = (tmp_path / "a.mkv").read_bytes()
    damaged(tmp_path / "cut.mkv", whole[: len(whole) // 2])
    damaged(tmp_path / "no.mp4", b"\0\0\0\x18ftypmp42" + bytes(2000))
    code = (
        "import sys\nfrom ltcl.images.frames import open_frames\nfrom ltcl.errors import FileError\n"
        "for name in sys.argv[1:]:\n"
        "    try:\n        [frame.picture() for frame in open_frames(name)]\n"
        "    except FileError as error:\n        sys.stdout.write(f'{error}\\n')\n"
    )
    files = [str(tmp_path / name) for name in ("cut.mkv", "no.mp4", "a.mkv")]
    run = subprocess.run([sys.executable, "-c", code, *files], capture_output=True, text=True)
    assert run.returncode == 0
    assert run.stderr == ""
    assert run.stdout.count("\n") == 2


@pytest.mark.parametrize("size", [(5, 8), (4, 9), (1, 1)])
def test_odd_sizes_are_refused_before_anything_is_written(tmp_path, size):
    with pytest.raises(InputError, match=f"frames are {size[0]} x {size[1]} pixels; those of a video"):
        write_video(tmp_path / "a.mkv", [np.zeros(size)])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "pictures", "text"),
    [
        ("a.webm", [np.zeros((2, 2))], r"extension \.webm is unknown; a video must be \.mkv, \.avi, \.mp4"),
        ("a", [np.zeros((2, 2))], "has no extension"),
        ("a.mkv", [], "there are no frames"),
        ("a.mkv", [np.zeros((4, 4)), np.zeros((4, 6))], r"frame 2 is \(4, 6\); it must be \(4, 4\)"),
        ("a.mkv", [np.full((4, 4), np.nan)], "NaN"),
        ("a.mkv", [np.zeros((4, 4)), np.full((4, 4), np.inf)], "infinite"),
    ],
)
def test_bad_frames_leave_the_earlier_video(tmp_path, name, pictures, text):
    (tmp_path / name).write_bytes(b"old")
    with pytest.raises(InputError, match=text):
        write_video(tmp_path / name, pictures)
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [(name, b"old")]


def test_a_bad_rate_is_refused(tmp_path):
    with pytest.raises(InputError, match="fps is 0"):
        write_video(tmp_path / "a.mkv", [np.zeros((2, 2))], fps=0)
    check_video(tmp_path / "a.mkv", (2, 4))


def test_grey_and_colour_may_follow_each_other_and_values_are_clipped(tmp_path):
    pictures = [np.full((4, 6), 2.0), np.zeros((4, 6, 3)), np.full((4, 6), -1.0)]
    write_video(tmp_path / "a.mkv", iter(pictures))
    assert [frame.picture().max() for frame in open_frames(tmp_path / "a.mkv")] == [1.0, 0.0, 0.0]


def test_a_video_is_read_from_the_start_each_time(tmp_path):
    opencv_writes(tmp_path / "a.mkv", film(6), "FFV1")
    source = open_frames(tmp_path / "a.mkv")
    one, other = iter(source), iter(source)
    next(one)
    digests = [frame.digest() for frame in other]
    assert next(one).digest() == digests[1]
    assert all(a != b for a, b in pairwise(digests))
