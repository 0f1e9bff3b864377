# SPDX-License-Identifier: BSD-3-Clause
"""Folders of pictures and videos as frames, in and out; damage is one line."""

from __future__ import annotations

import hashlib
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from ltcl import images
from ltcl.errors import FileError, InputError
from ltcl.images.frames import is_frames, open_frames, write_video

random = np.random.default_rng(17)
SIZE = (32, 48)


def save(path: Path, codes: np.ndarray) -> None:
    assert cv2.imwrite(str(path), codes)


def test_a_folder_in_natural_order_without_hidden_and_other_files(tmp_path):
    wanted = ["f1.png", "f2.png", "f009.png", "f10.png", "f10b.png", "f100.png", "g².png"]
    for name in [*random.permutation(wanted), ".b.png"]:
        save(tmp_path / name, np.zeros((2, 3), np.uint8))
    (tmp_path / "frames.json").write_text("{}")
    (tmp_path / "c.png").mkdir()
    source = open_frames(tmp_path)
    assert [(frame.number, frame.name) for frame in source] == list(enumerate(wanted, start=1))
    assert (source.count, source.fps) == (7, None)


def test_frames_of_a_folder_are_what_pictures_are(tmp_path):
    light = random.uniform(0, 9, (4, 5)).astype(np.float32)
    images.write(tmp_path / "1.exr", light)
    save(tmp_path / "2.png", np.full((4, 5, 3), 128, np.uint8))
    first, second = open_frames(tmp_path)
    np.testing.assert_array_equal(first.picture(), light)
    np.testing.assert_allclose(second.picture(), images.from_srgb(np.full((4, 5, 3), 128 / 255)), rtol=1e-6)
    _, second = open_frames(tmp_path, encoding="linear")
    np.testing.assert_allclose(second.picture(), 128 / 255, rtol=1e-6)
    assert second.digest() == hashlib.sha256((tmp_path / "2.png").read_bytes()).hexdigest()
    for use in (second.picture, second.digest):
        (tmp_path / "2.png").unlink(missing_ok=True)
        with pytest.raises(FileError, match=r"2\.png: no such file"):
            use()


def test_other_things_than_frames_are_refused(tmp_path):
    with pytest.raises(FileError, match=r"holds no pictures; frames are \.png"):
        open_frames(tmp_path)
    for name in ("a1.png", "a2.png", "a2.tif"):
        save(tmp_path / name, np.zeros((2, 3), np.uint8))
    with pytest.raises(FileError, match=r"a2\.png and a2\.tif"):
        open_frames(tmp_path)
    with pytest.raises(FileError, match=r"a1\.png: extension \.png is unknown; .*\.mp4"):
        open_frames(tmp_path / "a1.png")
    with pytest.raises(FileError, match=r"nowhere: no such file"):
        open_frames(tmp_path / "nowhere")
    with pytest.raises(InputError, match="encoding is 'log'"):
        open_frames(tmp_path, encoding="log")  # pyright: ignore[reportArgumentType]
    assert is_frames(tmp_path)
    assert is_frames("film.MP4")
    assert not is_frames("sky.png")


def film(count: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """RGB codes (count, h, w, 3) of coarse noise, so that lossy codecs keep most of it."""
    h, w = size
    coarse = random.integers(0, 256, (count, -(-h // 8), -(-w // 8), 3))
    return coarse.repeat(8, axis=1).repeat(8, axis=2)[:, :h, :w].astype(np.uint8)


def opencv_writes(path: Path, codes: np.ndarray, fourcc: str = "FFV1") -> bytes:
    size = codes.shape[2], codes.shape[1]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*fourcc), 25.0, size)
    assert writer.isOpened()
    for code in codes:
        writer.write(np.ascontiguousarray(code[..., ::-1]))
    writer.release()
    return path.read_bytes()


@pytest.mark.parametrize("suffix", [".mkv", ".avi"])
@pytest.mark.parametrize("size", [(2, 2), (32, 48)])
def test_lossless_videos_give_every_code_back(tmp_path, suffix, size):
    codes, path = film(5, size), tmp_path / f"a{suffix}"
    codes[2] = codes[2, ..., :1]  # is grey, and comes back as that
    codes[1] = codes[0]
    pictures = [*images.from_srgb(codes[:4] / 255), 2 * images.from_srgb(codes[4] / 255) - 0.5]  # is clipped
    pictures[2] = pictures[2][..., 0]
    codes[4] = np.rint(255 * images.to_srgb(np.clip(pictures[4], 0, 1)))
    assert write_video(path, iter(pictures), fps=12.5) == 5
    source = open_frames(path)
    assert source.count == 5
    assert source.fps == pytest.approx(12.5)
    for _ in range(2):  # from the start each time
        for frame, code in zip(source, codes, strict=True):
            shown = code[..., 0] if frame.number == 3 else code
            np.testing.assert_allclose(frame.picture(), images.from_srgb(shown / 255), rtol=1e-6)
    digests = [frame.digest() for frame in source]
    assert digests[0] == digests[1]
    assert len({*digests}) == 4


@pytest.mark.parametrize(("suffix", "fourcc"), [(".mp4", "mp4v"), (".avi", "MJPG"), (".mkv", "FFV1")])
def test_videos_of_others_are_read_in_order(tmp_path, suffix, fourcc):
    codes = film(9)
    opencv_writes(tmp_path / f"a{suffix}", codes, fourcc)
    shown = [images.to_srgb(frame.picture()) for frame in open_frames(tmp_path / f"a{suffix}")]
    nearest = [np.argmin([np.abs(picture * 255 - code).mean() for code in codes]) for picture in shown]
    assert nearest == list(range(9))


def test_a_video_is_upright_as_a_player_shows_it(tmp_path):
    data = opencv_writes(tmp_path / "a.mp4", film(3), "mp4v")
    place = data.index(struct.pack(">9i", 65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30), data.index(b"tkhd"))
    turned = struct.pack(">9i", 0, 65536, 0, -65536, 0, 0, 0, 0, 1 << 30)
    (tmp_path / "b.mp4").write_bytes(data[:place] + turned + data[place + 36 :])
    first, second = (next(iter(open_frames(tmp_path / name))).picture() for name in ("a.mp4", "b.mp4"))
    np.testing.assert_allclose(second, np.rot90(first, -1), atol=0.02)


@pytest.mark.parametrize("share", [0.5, 0.7, 0.97])
def test_a_truncated_video_gives_the_frames_there_are_and_an_error(tmp_path, capfd, share):
    codes, frames, path = film(20), [], tmp_path / "cut.avi"
    data = opencv_writes(tmp_path / "a.avi", codes)
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(FileError) as error:
        frames.extend(frame.picture() for frame in open_frames(path))
    assert 0 < len(frames) < 20
    assert str(error.value).startswith(f"{path}: {len(frames)} of 20 frames can be read")
    for picture, code in zip(frames, codes, strict=False):
        np.testing.assert_allclose(picture, images.from_srgb(code / 255), rtol=1e-6)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("content", [b"", b"not a video", b"\0" * 5000, "mp4"])
def test_what_is_no_video_is_refused(tmp_path, capfd, content):
    path = tmp_path / "a.mp4"
    if content == "mp4":  # whose table of frames stands at the end
        content = opencv_writes(path, film(20), "mp4v")[:-400]
    path.write_bytes(content)
    with pytest.raises(FileError, match=r"a\.mp4: (is no video|the file is empty)"):
        open_frames(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("name", "pictures", "fps", "text"),
    [
        ("a.webm", [np.zeros((2, 2))], 25, r"\.webm is unknown; .*\.mkv, \.avi, \.mp4"),
        ("a", [np.zeros((2, 2))], 25, "has no extension"),
        ("a.mkv", [], 25, "no frames"),
        ("a.mkv", [np.zeros((5, 8))], 25, "5 x 8 pixels; .* even"),
        ("a.mkv", [np.zeros((4, 4)), np.zeros((4, 6))], 25, r"frame 2 is \(4, 6\); it must be \(4, 4\)"),
        ("a.mkv", [np.zeros((4, 4)), np.full((4, 4), np.inf)], 25, "infinite"),
        ("a.mkv", [np.zeros((4, 4))], 0, "fps is 0"),
    ],
)
def test_bad_frames_leave_the_earlier_video(tmp_path, name, pictures, fps, text):
    (tmp_path / name).write_bytes(b"old")
    with pytest.raises(InputError, match=text):
        write_video(tmp_path / name, pictures, fps)
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [(name, b"old")]
