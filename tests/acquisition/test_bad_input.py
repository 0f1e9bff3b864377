# SPDX-License-Identifier: BSD-3-Clause
"""Faults in front of a camera, and on the disk behind it, through `acquire` as a whole.

Each is named in one line, or masked; nothing that was committed is lost; and once it is put right,
the acquisition goes on to the same result.
"""

from __future__ import annotations

import errno
import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Correspondence, Report, acquire
from ltcl.acquisition.session import calibration_folder, calibration_photographs
from ltcl.errors import (
    AcquisitionError,
    DeviceError,
    FileError,
    InputError,
    InputTypeError,
    LtclError,
)
from ltcl.store import BlockStore
from tests.store.stores import contents

from .stopping import LINEAR_RESPONSE, Unplugged, scene, set_up

random = np.random.default_rng()
GRID = (8, 8)
FULL: dict[str, Any] = {"geometry": "aligned", "strategy": "pixel", "frames": 2}
SHORT: dict[str, Any] = {**FULL, "response": LINEAR_RESPONSE, "exposures": [0.5]}


def in_one_line(text: str) -> str:
    return rf"\A.*{text}.*\Z"


def camera(T: np.ndarray | None = None, grid: tuple[int, int] = GRID, **options: Any) -> Unplugged:
    return Unplugged(scene(grid) if T is None else T, grid, response="linear", **options)


def fine_camera() -> Unplugged:
    """A camera with 2 x 2 pixels to each of the projector's."""
    pixels = np.eye(64).reshape(8, 8, 64)
    view = np.repeat(np.repeat(pixels, 2, axis=0), 2, axis=1)
    return camera(camera_grid=(16, 16), camera_map=view.reshape(256, 64))


def constant_camera() -> Unplugged:
    return camera(fault=lambda codes, image: np.full_like(image, 7))


NO_LIGHT = "lens cap"
SATURATED = "every pixel is saturated.* 0.0001 s"
MEASURED: dict[str, Any] = {"response": None, "exposures": None}
ALIGNED = {"geometry": Correspondence.aligned(GRID)}


@pytest.mark.parametrize(
    ("rig", "change", "error", "text"),
    [
        (camera(0 * scene(GRID)), {}, AcquisitionError, NO_LIGHT),
        (camera(0 * scene(GRID)), MEASURED, AcquisitionError, NO_LIGHT),
        (constant_camera(), {}, AcquisitionError, NO_LIGHT),
        (constant_camera(), MEASURED, AcquisitionError, NO_LIGHT),
        (camera(ambient=1e5), {}, AcquisitionError, SATURATED),
        (camera(ambient=1e5), MEASURED, AcquisitionError, SATURATED),
        (
            constant_camera(),
            {"geometry": "graycode"},
            AcquisitionError,
            "the geometry: photographs",
        ),
        (camera(), {"exposures": [1e-4]}, InputError, "exposures is .*noise at 0.0001 s"),
        (camera(), {"exposures": [30.0]}, InputError, "exposures is .*saturates at 30 s"),
        (fine_camera(), {}, InputError, r"geometry is 'aligned'.*\(16, 16\)"),
        (fine_camera(), ALIGNED, InputError, r"geometry.*\(8, 8\).*\(16, 16\)"),
        (camera(exposures=[0.5]), {"response": None}, InputError, "one exposure.*response="),
        (camera(grid=(8, 16)), ALIGNED, InputError, r"geometry.*\(8, 8\).*\(8, 16\)"),
    ],
)
def test_rigs_that_cannot_be_used(
    rig: Unplugged, change: dict[str, Any], error: type[LtclError], text: str
) -> None:
    with pytest.raises(error, match=in_one_line(text)):
        acquire(rig, **{**SHORT, **change})


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        ({"strategy": "spiral"}, InputError, "strategy is 'spiral'"),
        ({"geometry": "stripes"}, InputError, "geometry is 'stripes'"),
        ({"geometry": np.eye(2)}, InputError, "geometry is an array of shape"),
        ({"order": 64}, InputError, "order is 64"),
        ({"block": 1}, InputError, "block is 1"),
        ({"threshold": 0.0}, InputError, "threshold is 0"),
        ({"frames": 0}, InputError, "frames is 0"),
        ({"resume": "no"}, InputTypeError, "resume is 'no'"),
        ({"exposures": 0.5}, InputError, "exposures is 0.5"),
        ({"exposures": "long"}, InputTypeError, "exposures"),
        ({"exposures": []}, InputError, r"exposures is \[\]"),
        ({"exposures": [1.0, -1.0]}, InputError, "exposures is"),
        ({"exposures": [np.nan]}, InputError, "exposures has 1 NaN"),
        ({"exposures": [0.5, 40.0]}, InputError, "exposures is 40.*30"),
        ({"response": "srgb"}, InputTypeError, "response is a str"),
        ({"progress": 3}, InputTypeError, "progress is 3"),
        ({"store": 3}, InputTypeError, "store is 3"),
        ({"device": "abacus"}, DeviceError, "abacus"),
        ({"device": 3}, InputTypeError, "device is 3"),
    ],
)
def test_bad_arguments_are_refused_before_the_first_photograph(
    change: dict[str, Any], error: type[LtclError], text: str
) -> None:
    with pytest.raises(error, match=in_one_line(text)):
        acquire(camera(left=0), **{**SHORT, **change})


def test_a_photograph_of_another_kind_is_not_kept(tmp_path: Path) -> None:
    path = tmp_path / "T.zarr"
    rig = camera()
    rig.fault = lambda codes, image: image[:4] if rig.count == 30 else image
    with pytest.raises(AcquisitionError, match=r"photograph 30 is uint16 \(4, 8\).*\(8, 8\)"):
        acquire(rig, **FULL, store=path)
    assert calibration_photographs(path) == 29


@pytest.mark.parametrize("strategy", ["pixel", "hadamard", "adaptive", "sketch", "direct"])
def test_some_black_pixels_are_masked(strategy: str) -> None:
    """Their noise is no first bounce: compensation goes on as if they were not there."""
    black = [3, 17]
    T = scene(GRID)
    T[black] = 0.0
    T[:, black] = 0.0
    measured = acquire(camera(T), **{**SHORT, "strategy": strategy})
    assert np.flatnonzero(measured.masked).tolist() == black
    compensation = ltcl.compensate(measured, np.full(GRID, 0.1, np.float32), rtol=1e-3)
    pattern = np.asarray(compensation.pattern, np.float64).ravel()
    picture = np.delete(T @ pattern, black)
    assert np.std(picture) < 10 ** (-30 / 20) * np.mean(picture)


@pytest.mark.rare
def test_hot_pixels_decide_nothing(tmp_path: Path) -> None:
    """They are masked; exposures, response and so T are the same without them."""
    hot = np.isin(np.arange(64).reshape(GRID), [9, 10, 40])
    rig = camera(fault=lambda codes, image: np.where(hot, np.uint16(4095), image))
    measured = acquire(rig, **FULL, store=tmp_path / "hot.zarr")
    acquire(camera(), **FULL, store=tmp_path / "good.zarr")
    np.testing.assert_array_equal(measured.masked.reshape(GRID), hot)
    exposures = Report.of(tmp_path / "hot.zarr").exposures
    expected_exposures = Report.of(tmp_path / "good.zarr").exposures
    np.testing.assert_allclose(exposures, expected_exposures, rtol=0.1)
    p = random.random(GRID).astype(np.float32)
    picture = np.asarray(measured @ p, np.float64)[~hot]
    expected = (scene(GRID) @ p.ravel()).reshape(GRID)[~hot]
    scale = (picture @ expected) / (picture @ picture)
    assert np.linalg.norm(scale * picture - expected) < 0.02 * np.linalg.norm(expected)


class Lamp:
    """A fault: a lamp is on during the seventh photograph of white."""

    def __init__(self) -> None:
        self.white_photographs = 0

    def __call__(self, codes: np.ndarray, image: np.ndarray) -> np.ndarray:
        if codes.all():
            self.white_photographs += 1
            if self.white_photographs == 7:
                return np.minimum(image + np.uint16(300), 4095).astype(np.uint16)
        return image


def test_photographs_of_a_refused_calibration_stay(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Photographs that contradict each other are not taken again, and are refused again."""
    path = tmp_path / "T.zarr"
    for rig in (camera(fault=Lamp()), camera(left=0)):
        with pytest.raises(AcquisitionError, match=in_one_line(r"photographs? \d+.* bright")):
            acquire(rig, **{**SHORT, "frames": 4}, store=path)
        assert calibration_photographs(path) > 20
        assert str(calibration_folder(path)) in caplog.text
    assert not path.exists()


def test_a_place_where_no_store_can_be(tmp_path: Path) -> None:
    """It is refused before the first photograph, and stays as it is."""
    (tmp_path / "file.zarr").write_text("x")
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.txt").write_text("x")
    (tmp_path / "link.zarr").symlink_to(tmp_path / "file.zarr")
    before = sorted(tmp_path.rglob("*"))
    for name in ("file.zarr", "link.zarr", "thesis", "file.zarr/T.zarr", "T" * 300):
        with pytest.raises(FileError, match=in_one_line(f"{tmp_path}.*: ")):
            acquire(camera(left=0), **FULL, store=tmp_path / name)
    assert sorted(tmp_path.rglob("*")) == before


class Disk:
    """A disk that is full after so many calls of the system that take room."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.calls_left = 10**9
        for name in ("write", "mkdir", "fsync"):
            monkeypatch.setattr(os, name, partial(self._call, getattr(os, name)))

    def _call(self, real: Any, *arguments: Any, **options: Any) -> Any:
        self.calls_left -= 1
        if self.calls_left < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(*arguments, **options)


@pytest.mark.rare
@pytest.mark.parametrize("strategy", ["pixel", "adaptive", "sketch", "direct"])
def test_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, strategy: str) -> None:
    """It is full at random places of all stages; each time there is room again later."""
    path = tmp_path / "T.zarr"
    rig, settings = set_up(strategy)
    acquire(rig, store=tmp_path / "whole.zarr", **settings)
    disk = Disk(monkeypatch)
    failures = []
    calls = [*random.integers(10, 200, 3), *random.integers(20, 400, 9), 10**9]
    for left in calls:
        disk.calls_left = left
        try:
            acquire(set_up(strategy)[0], store=path, **settings)
            break
        except FileError as error:
            failures.append(str(error))
        if path.exists():
            BlockStore.open(path).verify()
    assert contents(path) == contents(tmp_path / "whole.zarr")
    assert len(failures) >= 3, failures
    for text in failures:
        assert text.startswith((f"{path}", f"{calibration_folder(path)}")), text
        assert "No space left on device" in text
    assert {path.name for path in tmp_path.iterdir()} == {"whole.zarr", "T.zarr"}
