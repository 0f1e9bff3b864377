# SPDX-License-Identifier: BSD-3-Clause
"""Damaged, lying and foreign picture files: one clear line, no print, no huge allocation."""

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

from ltcl import images
from ltcl.errors import FileError, MemoryLimitError

random = np.random.default_rng(0)
KINDS = [
    (".png", 8),
    (".png", 16),
    (".jpg", 8),
    (".bmp", 8),
    (".tif", 8),
    (".tif", 16),
    (".tif", 32),
]
KINDS += [(".exr", 16), (".exr", 32)]
SUFFIXES = [".png", ".jpg", ".tif", ".bmp", ".exr"]
MUTANTS = 60


def good(
    folder: Path, suffix: str, bits: int | None = None, shape: tuple[int, ...] = (20, 30, 3)
) -> bytes:
    images.write(
        folder / f"good{suffix}", np.linspace(0, 1, int(np.prod(shape))).reshape(shape), bits=bits
    )
    return (folder / f"good{suffix}").read_bytes()


def refusal(path: Path, data: bytes) -> str | None:
    """Message of the FileError that reading `data` gives, or None where it is a picture."""
    path.write_bytes(data)
    try:
        picture = images.read(path)
    except (FileError, MemoryLimitError) as error:
        message = str(error)
    else:
        assert picture.dtype == np.float32
        assert np.isfinite(picture).all()
        return None
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    assert " object at 0x" not in message
    return message


def mutant(data: bytes) -> bytes:
    """`data` cut off, longer, or with up to three bytes changed, more often near its begin."""
    changed = bytearray(data)
    kind = random.random()
    if kind < 0.25:
        return data[: random.integers(1, len(data))]
    if kind < 0.35:
        return data + random.bytes(int(random.integers(1, 100)))
    for _ in range(random.integers(1, 4)):
        changed[random.integers(min(len(data), 400 if kind < 0.7 else len(data)))] = (
            random.integers(256)
        )
    return bytes(changed)


@pytest.mark.parametrize(("suffix", "bits"), KINDS)
@pytest.mark.parametrize("shape", [(20, 30, 3), (20, 30)])
def test_a_mutant_gives_a_picture_or_one_line_that_names_it(tmp_path, capfd, suffix, bits, shape):
    data = good(tmp_path, suffix, bits, shape)
    path = tmp_path / f"bad{suffix}"
    refused = 0
    for _ in range(MUTANTS):
        refused += refusal(path, mutant(data)) is not None
    assert refused > MUTANTS / 10
    out, err = capfd.readouterr()
    assert out == ""
    # OpenEXR itself writes of damaged pixels, and cannot be told not to.
    assert suffix == ".exr" or err == ""


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_truncated_files_and_any_flip_in_a_png_are_refused(tmp_path, suffix):
    data = good(tmp_path, suffix)
    path = tmp_path / f"bad{suffix}"
    for share in (0.02, 0.3, 0.5, 0.9, 0.99):
        assert refusal(path, data[: int(len(data) * share)])
    if suffix == ".png":
        for place in np.linspace(0, len(data) - 5, 60).astype(int):
            flipped = bytes([data[place] ^ 16])
            assert refusal(path, data[:place] + flipped + data[place + 1 :])


def png(
    data: bytes,
    depth: int = 8,
    size: tuple[int, int] = (3, 4),
    methods: tuple[int, int, int] = (0, 0, 0),
) -> bytes:
    """A PNG file whose checksums are right, whatever is in it.

    `methods` are those of compression, filter and interlace.
    """
    head = struct.pack(">IIBBBBB", *size[::-1], depth, 0, *methods)
    chunks = [b"IHDR" + head, b"IDAT" + data, b"IEND"]
    file = b"\x89PNG\r\n\x1a\n"
    for chunk in chunks:
        length = struct.pack(">I", len(chunk) - 4)
        file += length + chunk + struct.pack(">I", zlib.crc32(chunk))
    return file


@pytest.mark.parametrize("size", [(2**31 - 1, 2**31 - 1), (60000, 60000), (30000, 30000), (0, 5)])
@pytest.mark.parametrize("suffix", [".png", ".tif", ".exr"])
def test_absurd_sizes_are_refused_before_decoding(tmp_path, capfd, suffix, size):
    """Headers declare `size`: as LONG in place of SHORT in a TIFF, as two windows in an EXR."""
    h, w = size
    data = good(tmp_path, suffix)
    if suffix == ".png":
        data = png(b"", size=size)
    elif suffix == ".tif":
        for tag, before, now in ((256, 30, w), (257, 20, h)):
            short_entry = struct.pack("<HHII", tag, 3, 1, before)
            long_entry = struct.pack("<HHII", tag, 4, 1, now)
            data = data.replace(short_entry, long_entry)
    else:
        window = struct.pack("<4i", 0, 0, 29, 19)
        data = data.replace(window, struct.pack("<4i", 0, 0, w - 1, h - 1))
    assert refusal(tmp_path / f"bad{suffix}", data)
    out, err = capfd.readouterr()
    assert out == ""
    assert suffix == ".exr" or err == ""


ROWS = b"\0abcd" * 3
NO_PICTURES = [
    b"",
    b"a letter, no picture; " * 30,
    b"\x89PNG\r\n\x1a\n",
    b"\x76\x2f\x31\x01\x02\0\0\0",
    b"II*\0",
    png(b"nothing that zlib wrote"),
    png(zlib.compress(b"\x09" + ROWS[1:])),  # 9 is no filter
    png(zlib.compress(ROWS[:7])),
    png(zlib.compress(ROWS), depth=7),
    *(png(zlib.compress(ROWS), methods=methods) for methods in ((1, 0, 0), (0, 1, 0), (0, 0, 2))),
    png(zlib.compress(b"\0abcdabcd" * 3), depth=16, methods=(1, 0, 0)),
]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_no_picture_is_refused(tmp_path, capfd, suffix):
    path = tmp_path / f"bad{suffix}"
    for data in NO_PICTURES:
        assert refusal(path, data)
    for missing in (tmp_path / f"none{suffix}", tmp_path):
        with pytest.raises(FileError, match=f"{missing}: "):
            images.read(missing)
    assert capfd.readouterr() == ("", "")


def test_threads_leave_stdout_and_the_log_level_as_they_were(tmp_path):
    paths = [tmp_path / f"{number}{suffix}" for suffix in SUFFIXES for number in range(8)]
    for path in paths:
        data = good(tmp_path, path.suffix)
        path.write_bytes(data[: len(data) // (1 + (path.stem == "1"))])

    before = (sys.stdout, os.fstat(2).st_ino, cv2.utils.logging.getLogLevel())
    with ThreadPoolExecutor(4) as pool:
        refused = list(pool.map(lambda path: refusal(path, path.read_bytes()), paths))
    assert [message is None for message in refused] == [path.stem != "1" for path in paths]
    assert (sys.stdout, os.fstat(2).st_ino, cv2.utils.logging.getLogLevel()) == before
