# SPDX-License-Identifier: BSD-3-Clause
"""Folders of pictures as frames."""

from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from ltcl import images
from ltcl.errors import FileError, InputError
from ltcl.images.frames import is_frames, open_frames

random = np.random.default_rng(17)


def save(path: Path, codes: np.ndarray) -> None:
    assert cv2.imwrite(str(path), codes)


def names(folder: Path) -> list[str]:
    return [frame.name for frame in open_frames(folder)]


def test_numbers_in_names_compare_as_numbers(tmp_path):
    wanted = ["f1.png", "f2.png", "f009.png", "f10.png", "f10b.png", "f100.png", "g².png"]
    for name in random.permutation(wanted):
        save(tmp_path / name, np.zeros((2, 3), np.uint8))
    assert names(tmp_path) == wanted
    assert [frame.number for frame in open_frames(tmp_path)] == list(range(1, 8))
    assert open_frames(tmp_path).count == 7


def test_hidden_and_other_files_and_folders_are_no_frames(tmp_path):
    save(tmp_path / "a.png", np.zeros((2, 3), np.uint8))
    save(tmp_path / ".b.png", np.zeros((9, 9), np.uint8))
    (tmp_path / "frames.json").write_text("{}")
    (tmp_path / "c.png").mkdir()
    assert names(tmp_path) == ["a.png"]


@pytest.mark.parametrize(("suffix", "kind"), [("png", np.uint8), ("png", np.uint16), ("tif", np.uint16)])
@pytest.mark.parametrize("shape", [(1, 1), (5, 7), (5, 7, 3)])
def test_frames_are_what_pictures_are(tmp_path, suffix, kind, shape):
    most = np.iinfo(kind).max
    codes = [random.integers(0, most, shape, endpoint=True).astype(kind) for _ in range(3)]
    for number, code in enumerate(codes):
        save(tmp_path / f"{number}.{suffix}", code[..., ::-1] if code.ndim == 3 else code)
    for frame, code in zip(open_frames(tmp_path), codes, strict=True):
        picture = frame.picture()
        assert picture.dtype == np.float32
        np.testing.assert_allclose(picture, images.from_srgb(code / most), rtol=1e-6)
        assert frame.digest() == hashlib.sha256((tmp_path / frame.name).read_bytes()).hexdigest()
    for frame, code in zip(open_frames(tmp_path, encoding="linear"), codes, strict=True):
        np.testing.assert_allclose(frame.picture(), code / most, rtol=1e-6)


def test_floats_are_linear_and_may_stand_beside_integers(tmp_path):
    light = random.uniform(0, 9, (4, 5)).astype(np.float32)
    images.write(tmp_path / "1.exr", light)
    images.write(tmp_path / "2.tiff", light)
    save(tmp_path / "3.png", np.full((4, 5, 3), 255, np.uint8))
    first, second, third = (frame.picture() for frame in open_frames(tmp_path))
    np.testing.assert_array_equal(first, light)
    np.testing.assert_array_equal(second, light)
    assert third.shape == (4, 5, 3)


def test_another_size_is_told_by_the_frame(tmp_path):
    for number, shape in enumerate([(4, 5), (4, 5, 3), (5, 4), (4, 5)], start=1):
        save(tmp_path / f"{number}.png", np.zeros(shape, np.uint8))
    frames = list(open_frames(tmp_path))
    assert frames[1].picture().shape == (*frames[0].picture().shape, 3)
    with pytest.raises(FileError, match=r"frame 3 of 4 is 5 x 4 pixels; it must be 4 x 5 as frame 2$"):
        frames[2].picture()
    assert frames[3].picture().shape == (4, 5)


@pytest.mark.parametrize("damage", ["empty", "cut", "text", "gone"])
def test_a_frame_that_cannot_be_read_is_told_in_one_line(tmp_path, damage, capfd):
    for number in range(3):
        save(tmp_path / f"sky{number}.png", random.integers(0, 256, (20, 30)).astype(np.uint8))
    frames = list(open_frames(tmp_path))
    bad = tmp_path / "sky1.png"
    content = {"empty": b"", "cut": bad.read_bytes()[:200], "text": b"no picture at all"}
    bad.unlink() if damage == "gone" else bad.write_bytes(content[damage])
    frames[0].picture()
    with pytest.raises(FileError) as error:
        frames[1].picture()
    assert str(error.value).startswith(f"{tmp_path}: frame 2 of 3 cannot be read: sky1.png: ")
    assert "\n" not in str(error.value)
    assert str(error.value).count(str(tmp_path)) == 1
    assert frames[2].picture().shape == (20, 30)
    assert capfd.readouterr() == ("", "")


def test_a_lost_file_has_no_digest(tmp_path):
    save(tmp_path / "a.png", np.zeros((2, 3), np.uint8))
    (frame,) = open_frames(tmp_path)
    (tmp_path / "a.png").unlink()
    with pytest.raises(FileError, match=r"frame 1 of 1 cannot be read: a\.png: No such file"):
        frame.digest()


def test_a_folder_without_pictures_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("none")
    with pytest.raises(FileError, match=r"holds no pictures; frames are \.png"):
        open_frames(tmp_path)


def test_two_files_of_one_frame_are_refused(tmp_path):
    for name in ("a1.png", "a2.png", "a2.tif"):
        save(tmp_path / name, np.zeros((2, 3), np.uint8))
    with pytest.raises(FileError, match=r"holds a2\.png and a2\.tif; each frame must be one file"):
        open_frames(tmp_path)


def test_other_things_are_refused(tmp_path):
    save(tmp_path / "a.png", np.zeros((2, 3), np.uint8))
    with pytest.raises(
        FileError, match=r"a\.png: extension \.png is unknown; frames are a folder, or a video"
    ):
        open_frames(tmp_path / "a.png")
    with pytest.raises(FileError, match=r"nowhere: no such file"):
        open_frames(tmp_path / "nowhere")
    with pytest.raises(InputError, match="encoding is 'log'"):
        open_frames(tmp_path, encoding="log")  # pyright: ignore[reportArgumentType]


def test_what_is_taken_for_frames(tmp_path):
    assert is_frames(tmp_path)
    assert is_frames("film.MP4")
    assert not is_frames("sky.png")
    assert not is_frames(tmp_path / "nowhere")
