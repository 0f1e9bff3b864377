# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of every kind come as the camera stored them, with exposure and time; damage is named."""

from __future__ import annotations

import sys
import types
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from ltcl import images
from ltcl.acquisition.rigs import exif, photographs
from ltcl.acquisition.rigs.exif import Taken
from ltcl.errors import AcquisitionError, FileError, LtclError
from tests.acquisition.rigs import camera_files

RNG = np.random.default_rng(8)
GREY = RNG.integers(0, 256, (5, 7), dtype=np.uint8)
COLOUR = RNG.integers(0, 256, (5, 7, 3), dtype=np.uint8)


@pytest.mark.parametrize("codes", [GREY, COLOUR])
@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp"])
def test_codes_come_as_they_are(tmp_path: Path, suffix: str, codes: np.ndarray) -> None:
    images.write(tmp_path / f"a{suffix}", codes / 255, encoding="linear", bits=8)
    found = photographs.read(tmp_path / f"a{suffix}")
    assert found.codes.dtype == np.uint8
    np.testing.assert_array_equal(found.codes, codes)
    assert found.taken == Taken(None, None)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bits_come_as_they_are(tmp_path: Path, suffix: str) -> None:
    codes = RNG.integers(0, 65536, (5, 7, 3), dtype=np.uint16)
    images.write(tmp_path / f"a{suffix}", codes / 65535, encoding="linear", bits=16)
    np.testing.assert_array_equal(photographs.read(tmp_path / f"a{suffix}").codes, codes)


def test_floats_come_as_they_are(tmp_path: Path) -> None:
    values = RNG.normal(0.5, 1.0, (5, 7, 3)).astype(np.float32)
    for name in ("a.tif", "a.exr"):
        images.write(tmp_path / name, values)
        np.testing.assert_array_equal(photographs.read(tmp_path / name).codes, values)
    half = values.astype(np.float16)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": half}).write(str(tmp_path / "half.exr"))
    found = photographs.read(tmp_path / "half.exr").codes
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, half.astype(np.float32))


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
def test_exif_tells_exposure_and_time(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    camera_files.write(path, COLOUR, 1 / 60, "2026:03:01 12:00:05.25")
    found = photographs.read(path)
    assert found.taken.seconds == pytest.approx(1 / 60, rel=1e-4)
    assert found.taken.time == datetime(2026, 3, 1, 12, 0, 5, 250000)
    assert found.codes.shape == (5, 7, 3)
    if suffix != ".jpg":
        np.testing.assert_array_equal(found.codes, COLOUR)


@pytest.mark.parametrize("time", ["    :  :     :  :  ", "yesterday", "2026:13:01 12:00:00", ""])
def test_times_that_are_none_are_none(tmp_path: Path, time: str) -> None:
    camera_files.write(tmp_path / "a.jpg", COLOUR, None, time)
    assert photographs.read(tmp_path / "a.jpg").taken == Taken(None, None)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf"), None, "1/30", (1, 30), 10**400])
def test_exposures_that_are_none_are_none(value: Any) -> None:
    assert exif.positive(value) is None


def test_rotations_are_not_applied(tmp_path: Path) -> None:
    tags = Image.Exif()
    tags[0x0112] = 6
    Image.fromarray(COLOUR).save(tmp_path / "a.png", exif=tags)
    np.testing.assert_array_equal(photographs.read(tmp_path / "a.png").codes, COLOUR)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), suffix=st.sampled_from([".jpg", ".tif", ".png"]))
def test_damage_gives_one_line_or_a_photograph(tmp_path: Path, data: st.DataObject, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    camera_files.write(path, COLOUR, 1 / 60, camera_files.NOON)
    good = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        good[data.draw(st.integers(0, len(good) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(good[: data.draw(st.integers(1, len(good)))])
    message = f"{path}: "
    try:
        assert photographs.read(path).codes.size
        seconds = exif.read(path).seconds
        assert seconds is None or 0 < seconds < np.inf
    except LtclError as error:
        message = str(error)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message


def test_a_damaged_exif_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(b"\xff\xd8\xff\xe1\0\4ab")
    with pytest.raises(FileError, match="EXIF header that cannot be read"):
        exif.read(path)


RAW = np.tile([[1000, 2000], [2000, 3000]], (16, 24))


@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_raw_is_linear_and_keeps_its_black(tmp_path: Path, scale: float) -> None:
    raw = np.rint(RAW * scale).astype(np.uint16)
    camera_files.write_dng(tmp_path / "a.dng", raw, 1 / 30, black=256, white=4095)
    codes, taken = photographs.read(tmp_path / "a.dng")
    assert (codes.shape, codes.dtype) == ((32, 48, 3), np.uint16)
    wanted = np.array([1000, 2000, 3000]) * scale * 65535 / 4095  # no gain but that of full scale
    np.testing.assert_allclose(codes, np.broadcast_to(wanted, codes.shape), atol=1.5)
    assert taken.seconds == pytest.approx(1 / 30, rel=1e-3)
    assert taken.time == datetime(2026, 3, 1, 12, 0, 0)


def test_raw_of_a_sum_is_the_sum_of_raws(tmp_path: Path) -> None:
    a, b = np.random.default_rng(4).integers(0, 2000, (2, 32, 48), dtype=np.uint16)
    for name, raw in [("a", a), ("b", b), ("sum", a + b)]:
        camera_files.write_dng(tmp_path / f"{name}.dng", raw, 1.0, black=0, white=4095)
    x, y, z = (photographs.read(tmp_path / f"{name}.dng").codes.astype(int) for name in ("a", "b", "sum"))
    np.testing.assert_allclose(x + y, z, atol=4)  # a demosaicing that looks for edges bends this


def test_a_bright_spot_does_not_change_the_scale_of_raw(tmp_path: Path) -> None:
    bright = RAW.astype(np.uint16)
    bright[10:14, 10:14] = 4000
    camera_files.write_dng(tmp_path / "a.dng", RAW.astype(np.uint16), 1.0, black=256, white=4095)
    camera_files.write_dng(tmp_path / "b.dng", bright, 1.0, black=256, white=4095)
    a, b = (photographs.read(tmp_path / name).codes for name in ("a.dng", "b.dng"))
    np.testing.assert_array_equal(a[20:], b[20:])


def test_a_broken_raw_is_named(tmp_path: Path) -> None:
    camera_files.write_dng(tmp_path / "a.dng", RAW, 1.0, black=0, white=4095)
    good = (tmp_path / "a.dng").read_bytes()
    for bad in (good[:100], b"no camera wrote this", good[: len(good) // 2]):
        (tmp_path / "a.dng").write_bytes(bad)
        with pytest.raises(FileError, match=r"a\.dng: is no readable camera RAW") as error:
            photographs.read(tmp_path / "a.dng")
        assert "\n" not in str(error.value)


def test_raw_without_rawpy_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.nef").write_bytes(b"raw")
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(AcquisitionError, match=r"ltcl\[camera\]"):
        photographs.read(tmp_path / "a.nef")


def test_a_raw_that_declares_too_much_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Raw:
        sizes = types.SimpleNamespace(raw_height=1 << 24, raw_width=1 << 24)

        def __enter__(self) -> Raw:
            return self

        def __exit__(self, *_: object) -> None: ...

    (tmp_path / "a.nef").write_bytes(b"raw")
    fake: Any = types.ModuleType("rawpy")
    fake.imread, fake.LibRawError, fake.NotSupportedError = lambda _: Raw(), OSError, OSError
    monkeypatch.setitem(sys.modules, "rawpy", fake)
    with pytest.raises(LtclError, match="developing the RAW file needs 4096 TiB"):
        photographs.read(tmp_path / "a.nef")


@pytest.mark.parametrize(
    ("name", "content"), [("a.png", b""), ("a.dng", b""), ("a.gif", b"GIF"), ("a", b"x")]
)
def test_what_is_no_photograph_is_refused(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FileError):
        photographs.read(tmp_path / name)
