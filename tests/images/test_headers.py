# SPDX-License-Identifier: BSD-3-Clause
"""Broken, lying and foreign picture files give one clear line: no crash, no print, no huge allocation."""

from __future__ import annotations

import os
import struct
import sys
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ltcl import images
from ltcl.errors import FileError, LtclError
from ltcl.images.decoder import overheard
from ltcl.images.headers import declared_size

SUFFIXES = [".png", ".jpg", ".tif", ".bmp", ".exr"]


def good(folder: Path, suffix: str, shape: tuple[int, ...] = (20, 30, 3)) -> bytes:
    images.write(folder / f"good{suffix}", np.random.default_rng(5).random(shape))
    return (folder / f"good{suffix}").read_bytes()


def refusal(path: Path, data: bytes) -> str:
    """Message of the FileError that reading `data` gives."""
    path.write_bytes(data)
    with pytest.raises(FileError) as error:
        images.read(path)
    text = str(error.value)
    assert text.startswith(str(path))
    assert "\n" not in text
    return text


def resized(suffix: str, data: bytes, h: int, w: int) -> bytes:
    """`data` with a header that declares (h, w), all checksums correct."""
    changed = bytearray(data)
    if suffix == ".png":
        changed[16:24] = struct.pack(">II", w, h)
        changed[29:33] = struct.pack(">I", zlib.crc32(changed[12:29]))
    elif suffix == ".jpg":
        place = data.index(b"\xff\xc0")
        changed[place + 5 : place + 9] = struct.pack(">HH", min(h, 65535), min(w, 65535))
    elif suffix == ".bmp":
        changed[18:26] = struct.pack("<ii", w, h)
    elif suffix == ".tif":
        for tag, value in ((256, w), (257, h)):
            for kind in (3, 4):  # stored as SHORT or LONG; becomes LONG
                place = data.find(struct.pack("<HHI", tag, kind, 1))
                if place >= 0:
                    changed[place : place + 12] = struct.pack("<HHII", tag, 4, 1, value)
    else:
        for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
            place = data.index(name) + len(name) + 4
            changed[place : place + 16] = struct.pack("<4i", 0, 0, w - 1, h - 1)
    return bytes(changed)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".bmp"])
@pytest.mark.parametrize("shape", [(20, 30, 3), (7, 300)])
def test_the_declared_size_is_found(tmp_path, suffix, shape):
    assert declared_size(good(tmp_path, suffix, shape)) == shape[:2]


def test_the_declared_size_of_big_endian_and_big_tiff():
    entries = struct.pack(">HHIHH", 256, 3, 1, 640, 0) + struct.pack(">HHII", 257, 4, 1, 480)
    assert declared_size(b"MM\0*" + struct.pack(">IH", 8, 2) + entries) == (480, 640)
    entries = struct.pack("<HHQQ", 256, 4, 1, 640) + struct.pack("<HHQQ", 257, 16, 1, 480)
    assert declared_size(b"II+\0\x08\0\0\0" + struct.pack("<QQ", 16, 2) + entries) == (480, 640)


ABSURD = [(2**31 - 1, 2**31 - 1), (60000, 60000), (30000, 30000), (0, 5)]


@pytest.mark.parametrize(
    ("suffix", "size"),
    # An EXR window is given by its corners, both inside: it cannot be empty.
    [(suffix, size) for suffix in SUFFIXES for size in ABSURD if (suffix, size) != (".exr", (0, 5))],
)
def test_absurd_sizes_are_refused_before_decoding(tmp_path, capfd, suffix, size):
    data = resized(suffix, good(tmp_path, suffix), *size)
    refusal(tmp_path / f"bad{suffix}", data)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("part", [0.02, 0.3, 0.5, 0.9, 0.999])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_truncated_files_are_refused_quietly(tmp_path, capfd, suffix, part):
    data = good(tmp_path, suffix)
    refusal(tmp_path / f"bad{suffix}", data[: int(len(data) * part)])
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_no_picture_is_refused(tmp_path, capfd, suffix):
    path = tmp_path / f"bad{suffix}"
    refusal(path, b"this is a letter, not a picture; " * 30)
    refusal(path, b"\x89PNG\r\n\x1a\n")
    refusal(path, b"\x76\x2f\x31\x01\x02\0\0\0")
    assert "empty" in refusal(path, b"")
    path.unlink()
    with pytest.raises(FileError, match="no such file"):
        images.read(path)
    path.mkdir()
    with pytest.raises(FileError, match="folder"):
        images.read(path)
    assert capfd.readouterr() == ("", "")


def test_unknown_extensions_list_the_known_ones(tmp_path):
    with pytest.raises(FileError, match=r"\.webp is unknown; pictures are .*\.png.*\.exr"):
        images.read(tmp_path / "a.webp")


def test_threads_leave_stdout_and_the_log_level_as_they_were(tmp_path):
    paths = [tmp_path / f"bad{number}{suffix}" for suffix in SUFFIXES for number in range(8)]
    for path in paths:
        data = good(tmp_path, path.suffix, (50, 60))
        path.write_bytes(data[: len(data) // 2] if path.stem.endswith("1") else data)

    def outcome(path: Path) -> bool:
        try:
            return images.read(path).shape == (50, 60)
        except FileError:
            return False

    before = sys.stdout, cv2.utils.logging.getLogLevel()
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(outcome, paths)) == [not path.stem.endswith("1") for path in paths]
    assert (sys.stdout, cv2.utils.logging.getLogLevel()) == before


def test_other_pixel_types_are_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "a.tif"), np.zeros((2, 2), np.int16))
    with pytest.raises(FileError, match="int16"):
        images.read(tmp_path / "a.tif")


def test_damaged_png_names_the_place(tmp_path):
    data = bytearray(good(tmp_path, ".png"))
    data[len(data) // 2] ^= 1
    assert "checksum" in refusal(tmp_path / "bad.png", bytes(data))


@pytest.mark.parametrize("suffix", SUFFIXES)
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(place=st.floats(0, 1, exclude_max=True), byte=st.integers(0, 255), keep=st.sampled_from([1.0, 0.7]))
def test_any_damage_gives_a_picture_or_an_error_of_ours(tmp_path, suffix, place, byte, keep):
    data = bytearray(good(tmp_path, suffix, (6, 5, 3)))
    data[int(place * len(data))] = byte
    path = tmp_path / f"bad{suffix}"
    path.write_bytes(data[: int(keep * len(data))])
    try:
        picture = images.read(path)
    except LtclError as error:
        message = str(error)
    else:
        message = ""
        assert picture.dtype == np.float32
        assert np.isfinite(picture).all()
    assert not message or message.startswith(str(path))
    assert "\n" not in message


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(data: bytes, depth: int = 8, more: bytes = b"") -> bytes:
    """A grey one of 4 x 3 pixels whose checksums are right, whatever is in it."""
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", 4, 3, depth, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + more + chunk(b"IDAT", data) + chunk(b"IEND", b"")


ROWS = b"\0abcd" * 3


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (png(b"nothing that zlib wrote"), "IDAT"),
        (png(zlib.compress(b"\x09" + ROWS[1:])), "bad adaptive filter value"),
        (png(zlib.compress(ROWS[:7])), "Not enough image data"),
        (png(zlib.compress(ROWS), depth=7), "Invalid IHDR data"),
        (png(zlib.compress(ROWS)[:-4] + b"abcd"), "incorrect data check"),
    ],
)
def test_what_libpng_says_is_part_of_the_one_line(tmp_path, capfd, data, said):
    text = refusal(tmp_path / "a.png", data)
    assert "is damaged; its decoder says: libpng error: " in text
    assert said in text
    assert capfd.readouterr().err == ""


def test_what_libpng_warns_of_is_no_damage(tmp_path, capfd):
    profile = chunk(b"iCCP", b"x\0\0" + zlib.compress(b"no profile"))
    (tmp_path / "a.png").write_bytes(png(zlib.compress(ROWS), more=profile))
    np.testing.assert_array_equal(images.read_codes(tmp_path / "a.png"), [list(b"abcd")] * 3)
    assert capfd.readouterr().err == ""


def test_a_jpeg_that_ends_early_is_refused(tmp_path, capfd):
    data = good(tmp_path, ".jpg", (64, 64))
    text = refusal(tmp_path / "a.jpg", data[: len(data) // 2] + b"\xff\xd9")
    assert "is damaged; its decoder says: Corrupt JPEG data: premature end" in text
    assert capfd.readouterr().err == ""


def test_a_jpeg_with_bytes_too_many_is_warned_of_by_its_name(tmp_path, capfd, caplog):
    data = good(tmp_path, ".jpg", (64, 64))
    (tmp_path / "a.jpg").write_bytes(data[:-2] + bytes(20) + data[-2:])
    images.read(tmp_path / "a.jpg")
    (line,) = caplog.messages
    assert line.startswith(f"{tmp_path / 'a.jpg'}: may be damaged; its decoder says: Corrupt JPEG data: ")
    assert capfd.readouterr().err in ("", f"ltcl: warning: {line}\n")  # the latter behind the program's tests


def test_others_still_write_to_stderr_while_a_picture_is_decoded(capfd):
    with overheard() as said:
        os.write(2, b"libpng error: one\nof another library\n")
        sys.stderr.flush()
    assert said == ["libpng error: one"]
    assert capfd.readouterr().err == "of another library\n"
