# SPDX-License-Identifier: BSD-3-Clause
"""Folders of pictures and videos as frames, in and out; damage is one line."""

from __future__ import annotations

import hashlib
import resource
import struct

import cv2
import numpy as np
import pytest

from ltcl import images
from ltcl.errors import FileError, InputError
from ltcl.images.frames import is_frames, open_frames, write_video

random = np.random.default_rng(17)


def test_a_folder_in_natural_order_without_hidden_and_other_files(tmp_path):
    names = ["f1.png", "f2.png", "f009.png", "f10.png", "f10b.png", "f100.png", "g².png"]
    for name in [*random.permutation(names), ".b.png"]:
        images.write(tmp_path / name, np.zeros((2, 3)))
    (tmp_path / "frames.json").write_text("{}")
    source = open_frames(tmp_path)
    assert [(frame.number, frame.name) for frame in source] == list(enumerate(names, start=1))
    assert (source.count, source.fps) == (7, None)


def test_frames_of_a_folder_are_what_pictures_are(tmp_path):
    light = random.uniform(0, 9, (4, 5)).astype(np.float32)
    images.write(tmp_path / "1.exr", light)
    images.write(tmp_path / "2.png", np.full((4, 5, 3), 128 / 255), encoding="linear")
    first, second = open_frames(tmp_path)
    np.testing.assert_array_equal(first.picture(), light)
    np.testing.assert_allclose(
        second.picture(), images.from_srgb(np.full((4, 5, 3), 128 / 255)), rtol=1e-6
    )
    _, second = open_frames(tmp_path, encoding="linear")
    np.testing.assert_allclose(second.picture(), 128 / 255, rtol=1e-6)
    assert second.digest() == hashlib.sha256((tmp_path / "2.png").read_bytes()).hexdigest()
    (tmp_path / "2.png").unlink()
    for use in (second.picture, second.digest):
        with pytest.raises(FileError, match=r"2\.png: "):
            use()


def test_other_things_than_frames_are_refused(tmp_path):
    with pytest.raises(FileError, match=rf"{tmp_path}: .* \.png"):
        open_frames(tmp_path)
    for name in ("a1.png", "a2.png", "a2.tif"):
        images.write(tmp_path / name, np.zeros((2, 3)))
    (tmp_path / "text.mp4").write_bytes(b"not a video")
    (tmp_path / "zeros.mp4").write_bytes(b"\0" * 5000)
    files = {"a1.png": r"\.png .*\.mp4", "nowhere": "", "text.mp4": "", "zeros.mp4": ""}
    for name, text in {"": r"a2\.png and a2\.tif", **files}.items():
        with pytest.raises(FileError, match=rf"{tmp_path / name}: .*{text}"):
            open_frames(tmp_path / name)
    with pytest.raises(InputError, match="encoding is 'log'"):
        open_frames(tmp_path, encoding="log")  # pyright: ignore[reportArgumentType]
    assert [is_frames(path) for path in (tmp_path, "film.MP4", "sky.png")] == [True, True, False]


def film(count: int, size: tuple[int, int] = (32, 48)) -> np.ndarray:
    return random.integers(0, 256, (count, *size, 3)).astype(np.uint8)


@pytest.mark.parametrize("suffix", [".mkv", ".avi"])
@pytest.mark.parametrize("size", [(2, 2), (32, 48)])
def test_lossless_videos_give_every_code_back(tmp_path, suffix, size):
    path = tmp_path / f"a{suffix}"
    codes = film(5, size)
    codes[1] = codes[0]
    codes[2] = codes[2, ..., :1]  # grey, and read as grey
    clipped = 2 * images.from_srgb(codes[4] / 255) - 0.5
    pictures = [*images.from_srgb(codes[:4] / 255), clipped]
    codes[4] = np.rint(255 * images.to_srgb(np.clip(clipped, 0, 1)))
    assert write_video(path, iter(pictures), fps=12.5) == 5
    np.testing.assert_array_equal(cv2.VideoCapture(str(path)).read()[1][..., ::-1], codes[0])  # BGR
    source = open_frames(path)
    assert (source.count, source.fps) == (5, pytest.approx(12.5))
    for _ in range(2):  # from the start each time
        for frame, code in zip(source, codes, strict=True):
            shown = code[..., 0] if frame.number == 3 else code
            np.testing.assert_allclose(frame.picture(), images.from_srgb(shown / 255), rtol=1e-6)
    digests = [frame.digest() for frame in source]
    assert digests[0] == digests[1]
    assert len({*digests}) == 4


def test_a_video_is_upright_as_a_player_shows_it(tmp_path):
    write_video(tmp_path / "a.mp4", film(3) / 255)
    data = (tmp_path / "a.mp4").read_bytes()
    place = data.index(
        struct.pack(">9i", 65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30), data.index(b"tkhd")
    )
    turned = struct.pack(">9i", 0, 65536, 0, -65536, 0, 0, 0, 0, 1 << 30)
    (tmp_path / "b.mp4").write_bytes(data[:place] + turned + data[place + 36 :])
    original = open_frames(tmp_path / "a.mp4")
    rotated = open_frames(tmp_path / "b.mp4")
    for frame, turned_frame in zip(original, rotated, strict=True):
        expected = np.rot90(frame.picture(), -1)
        np.testing.assert_allclose(turned_frame.picture(), expected, atol=0.02)


def test_a_truncated_video_gives_the_frames_there_are_and_an_error(tmp_path):
    path = tmp_path / "cut.avi"
    codes = film(20)
    frames = []
    write_video(path, images.from_srgb(codes / 255))
    path.write_bytes(path.read_bytes()[: int(0.9 * path.stat().st_size)])
    with pytest.raises(FileError) as error:
        frames.extend(frame.picture() for frame in open_frames(path))
    assert 0 < len(frames) < 20
    assert str(error.value).startswith(f"{path}: {len(frames)} of 20 frames")
    for picture, code in zip(frames, codes, strict=False):
        np.testing.assert_allclose(picture, images.from_srgb(code / 255), rtol=1e-6)


BLACK = np.zeros((4, 4))


@pytest.mark.parametrize(
    ("name", "pictures", "fps", "text"),
    [
        ("a.webm", [BLACK], 25, r"\.webm .*\.mkv, \.avi, \.mp4"),
        ("a.mkv", [], 25, "no frames"),
        ("a.mkv", [np.zeros((5, 8))], 25, "5 x 8 .* even"),
        ("a.mkv", [BLACK, np.zeros((4, 6))], 25, r"frame 2 is \(4, 6\).* \(4, 4\)"),
        ("a.mkv", [BLACK, np.full((4, 4), np.inf)], 25, "infinite"),
    ],
)
def test_bad_frames_leave_the_earlier_video(tmp_path, name, pictures, fps, text):
    (tmp_path / name).write_bytes(b"old")
    with pytest.raises(InputError, match=text):
        write_video(tmp_path / name, pictures, fps)
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [(name, b"old")]


@pytest.mark.parametrize("name", ["a.mkv", "a.avi", "a.mp4", "a.png", "a.exr", "a.tif", "a.jpg"])
def test_a_full_disk_is_noticed_and_the_earlier_file_stays(tmp_path, name):
    """Files cannot become larger than a limit, in the place of a full disk."""
    path = tmp_path / name
    pictures = [np.random.default_rng(seed).random((40, 60, 3)) for seed in range(8)]

    def write() -> None:
        if path.suffix in (".mkv", ".avi", ".mp4"):
            write_video(path, pictures)
        else:
            images.write(path, pictures[0])

    write()
    before = path.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    for share in (0.01, 0.5, 0.999):
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(share * len(before)), limits[1]))
        try:
            with pytest.raises(FileError, match=str(path)):
                write()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert path.read_bytes() == before
        assert len(list(tmp_path.iterdir())) == 1
