# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of every kind reach a `FolderRig` as the camera stored them; damage and exposures are named."""

from __future__ import annotations

import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ltcl import images
from ltcl.acquisition import FolderRig
from ltcl.errors import AcquisitionError, LtclError
from tests.acquisition.rigs import camera_files

RNG = np.random.default_rng(8)
GREY = RNG.integers(0, 256, (5, 7), dtype=np.uint8)
COLOUR = RNG.integers(0, 256, (5, 7, 3), dtype=np.uint8)
DEEP = RNG.integers(0, 65536, (5, 7, 3), dtype=np.uint16)
RAW = np.tile([[1000, 2000], [2000, 3000]], (16, 24))


def rig(folder: Path, channels: int = 3) -> FolderRig:
    rig = FolderRig(folder, (1, 1), channels)
    rig.prepare([([[1.0]], 1 / 30)])
    return rig


def photograph(folder: Path, channels: int = 3) -> np.ndarray:
    return rig(folder, channels).photograph([[1.0]], 1 / 30)


def place(folder: Path, suffix: str) -> Path:
    rig(folder)
    return folder / f"photographs/photo_000001{suffix}"


@pytest.mark.parametrize(
    ("suffix", "bits", "codes"),
    [(suffix, 8, codes) for suffix in (".png", ".tif", ".bmp") for codes in (GREY, COLOUR)]
    + [(suffix, 16, DEEP) for suffix in (".png", ".tif")],
)
def test_codes_are_not_changed(tmp_path: Path, suffix: str, bits: int, codes: np.ndarray) -> None:
    images.write(place(tmp_path, suffix), codes / (2**bits - 1), encoding="linear", bits=bits)
    if codes.ndim == 2:
        with pytest.raises(AcquisitionError, match=rf"photograph 1 \(photo_000001\{suffix}\) is grey"):
            photograph(tmp_path)
    else:
        np.testing.assert_array_equal(photograph(tmp_path), codes)
    (tmp_path / "shots.json").unlink()
    np.testing.assert_array_equal(photograph(tmp_path, 1), codes if codes.ndim == 2 else codes[..., 1])


@pytest.mark.parametrize("suffix", [".tif", ".exr"])
def test_floats_are_not_changed(tmp_path: Path, suffix: str) -> None:
    values = RNG.normal(0.5, 1.0, (5, 7, 3)).astype(np.float32)
    images.write(place(tmp_path, suffix), values)
    np.testing.assert_array_equal(photograph(tmp_path), values)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
@pytest.mark.parametrize(
    ("seconds", "good"), [(1 / 30, True), (1 / 31, True), (0.0, True), (1 / 34, False), (1 / 24, False)]
)
def test_exposures_of_exif_are_those_of_the_list(
    tmp_path: Path, suffix: str, seconds: float, good: bool
) -> None:
    camera_files.write(place(tmp_path, suffix), COLOUR, seconds)
    if good:
        assert photograph(tmp_path).shape == (5, 7, 3)
    else:
        with pytest.raises(AcquisitionError, match=rf"exposed for {seconds:.4g} s .* 0\.03333 s"):
            photograph(tmp_path)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), suffix=st.sampled_from([".jpg", ".tif", ".png"]))
def test_damage_gives_one_line_or_a_photograph(tmp_path: Path, data: st.DataObject, suffix: str) -> None:
    for old in (tmp_path / "photographs").glob("*"):
        old.unlink()
    path = place(tmp_path, suffix)
    camera_files.write(path, COLOUR, 1 / 30)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(1, len(content)))])
    message = f"photograph 1 (photo_000001{suffix}) "
    try:
        assert photograph(tmp_path).size
    except LtclError as error:
        message = str(error)
    assert message.startswith(f"photograph 1 (photo_000001{suffix}) ")
    assert "\n" not in message


@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_raw_is_linear_and_keeps_its_black(tmp_path: Path, scale: float) -> None:
    raw = np.rint(RAW * scale).astype(np.uint16)
    camera_files.write_dng(place(tmp_path, ".dng"), raw, 1 / 30, black=256, white=4095)
    codes = photograph(tmp_path)
    assert (codes.shape, codes.dtype) == ((32, 48, 3), np.uint16)
    expected = np.array([1000, 2000, 3000]) * scale * 65535 / 4095  # no gain but that of full scale
    np.testing.assert_allclose(codes, np.broadcast_to(expected, codes.shape), atol=1.5)
    camera_files.write_dng(place(tmp_path, ".dng"), raw, 1 / 60, black=256, white=4095)
    with pytest.raises(AcquisitionError, match=r"exposed for 0\.01667 s"):
        photograph(tmp_path)


def test_raw_does_not_depend_on_the_rest_of_the_picture(tmp_path: Path) -> None:
    bright, codes = RAW.astype(np.uint16), []
    for _ in range(2):
        camera_files.write_dng(place(tmp_path, ".dng"), bright, 1 / 30, black=256, white=4095)
        codes.append(photograph(tmp_path))
        bright[10:14, 10:14] = 4000
    np.testing.assert_array_equal(codes[0][20:], codes[1][20:])


@pytest.mark.parametrize("part", [slice(100), slice(0), slice(2000)])
def test_a_broken_raw_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: slice) -> None:
    path = place(tmp_path, ".dng")
    camera_files.write_dng(path, RAW, 1 / 30, black=0, white=4095)
    path.write_bytes(path.read_bytes()[part])
    with pytest.raises(AcquisitionError, match=r"^photograph 1 \(photo_000001\.dng\) cannot be used: "):
        photograph(tmp_path)
    path.write_bytes(b"raw")
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(AcquisitionError, match=r"ltcl\[camera\]"):
        photograph(tmp_path)


def test_a_raw_that_declares_too_much_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Raw:
        sizes = types.SimpleNamespace(raw_height=1 << 24, raw_width=1 << 24)

        def __enter__(self) -> Raw:
            return self

        def __exit__(self, *_: object) -> None: ...

    place(tmp_path, ".nef").write_bytes(b"raw")
    fake: Any = types.ModuleType("rawpy")
    fake.imread, fake.LibRawError, fake.NotSupportedError = lambda _: Raw(), OSError, OSError
    monkeypatch.setitem(sys.modules, "rawpy", fake)
    with pytest.raises(LtclError, match=r"photo_000001\.nef.*developing the RAW file needs 4096 TiB"):
        photograph(tmp_path)
