# SPDX-License-Identifier: BSD-3-Clause
"""What goes wrong in front of a camera, and on the disk behind it, through `acquire` as a whole.

It is named in one line, or masked; nothing that was committed is lost; and once it is put right,
the acquisition goes on to what it would have been.
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

from .stopping import LINE, Unplugged, scene, set_up

random = np.random.default_rng()
GRID = (8, 8)
FULL: dict[str, Any] = {"geometry": "aligned", "strategy": "pixel", "frames": 2}
SHORT: dict[str, Any] = {**FULL, "response": LINE, "exposures": [0.5]}
TWICE = np.repeat(np.repeat(np.eye(64).reshape(8, 8, 64), 2, axis=0), 2, axis=1).reshape(256, 64)


def in_one_line(text: str) -> str:
    return rf"\A.*{text}.*\Z"


def camera(T: np.ndarray | None = None, grid: tuple[int, int] = GRID, **options: Any) -> Unplugged:
    return Unplugged(scene(grid) if T is None else T, grid, response="linear", **options)


UNLIT, BRIGHT = camera(0 * scene(GRID)), camera(ambient=1e5)
DARK, SATURATED = "is the lens cap on, the projector off", "every pixel is saturated.* 0.0001 s"
MEASURED: dict[str, Any] = {"response": None, "exposures": None}
CONSTANT = camera(fault=lambda _, image: np.full_like(image, 7))
FINE = camera(camera_grid=(16, 16), camera_map=TWICE)
ALIGNED = {"geometry": Correspondence.aligned(GRID)}


@pytest.mark.parametrize(
    ("rig", "change", "error", "text"),
    [
        *(
            (rig, change, AcquisitionError, DARK)
            for rig in (UNLIT, CONSTANT)
            for change in ({}, MEASURED)
        ),
        *((BRIGHT, change, AcquisitionError, SATURATED) for change in ({}, MEASURED)),
        (CONSTANT, {"geometry": "graycode"}, AcquisitionError, "the geometry: photographs"),
        (camera(), {"exposures": [1e-4]}, InputError, "exposures is .*lost in noise at 0.0001 s"),
        (camera(), {"exposures": [30.0]}, InputError, "exposures is .*saturates at 30 s"),
        (FINE, {}, InputError, r"geometry is 'aligned'.*\(16, 16\)"),
        (FINE, ALIGNED, InputError, r"geometry.*\(8, 8\).*\(16, 16\)"),
        (camera(exposures=[0.5]), {"response": None}, InputError, "one exposure.*response="),
        (camera(grid=(8, 16)), ALIGNED, InputError, r"geometry.*\(8, 8\).*\(8, 16\)"),
        (None, {"strategy": "spiral"}, InputError, "strategy is 'spiral'"),
        (None, {"geometry": "stripes"}, InputError, "geometry is 'stripes'"),
        (None, {"geometry": np.eye(2)}, InputError, "geometry is an array of shape"),
        (None, {"order": 64}, InputError, "order is 64"),
        (None, {"block": 1}, InputError, "block is 1"),
        (None, {"threshold": 0.0}, InputError, "threshold is 0"),
        (None, {"frames": 0}, InputError, "frames is 0"),
        (None, {"resume": "no"}, InputTypeError, "resume is 'no'"),
        (None, {"exposures": 0.5}, InputError, "exposures is 0.5"),
        (None, {"exposures": "long"}, InputTypeError, "exposures"),
        (None, {"exposures": []}, InputError, r"exposures is \[\]"),
        (None, {"exposures": [1.0, -1.0]}, InputError, "exposures is"),
        (None, {"exposures": [np.nan]}, InputError, "exposures has 1 NaN"),
        (None, {"exposures": [0.5, 40.0]}, InputError, "exposures is 40.*30"),
        (None, {"response": "srgb"}, InputTypeError, "response is a str"),
        (None, {"progress": 3}, InputTypeError, "progress is 3"),
        (None, {"store": 3}, InputTypeError, "store is 3"),
        (None, {"device": "abacus"}, DeviceError, "abacus"),
        (None, {"device": 3}, InputTypeError, "device is 3"),
    ],
)
def test_bad_arguments(rig: Any, change: dict[str, Any], error: type[LtclError], text: str) -> None:
    """Those for None, which need no photograph, are refused before the first one."""
    with pytest.raises(error, match=in_one_line(text)):
        acquire(rig or camera(left=0), **{**SHORT, **change})


def test_a_photograph_of_another_kind_is_not_kept(tmp_path: Path) -> None:
    path, rig = (
        tmp_path / "T.zarr",
        camera(fault=lambda _, image: image[:4] if rig.count == 30 else image),
    )
    with pytest.raises(AcquisitionError, match=r"photograph 30 is uint16 \(4, 8\).*\(8, 8\)"):
        acquire(rig, **FULL, store=path)
    assert calibration_photographs(path) == 29


@pytest.mark.parametrize("strategy", ["pixel", "hadamard", "adaptive"])
def test_some_black_pixels_are_masked(strategy: str) -> None:
    """Their noise is no first bounce: what is compensated is as if they were not there."""
    black, T = [3, 17], scene(GRID)
    T[black] = T[:, black] = 0.0
    measured = acquire(camera(T), **{**SHORT, "strategy": strategy})
    assert np.flatnonzero(measured.masked).tolist() == black
    pattern = ltcl.compensate(measured, np.full(GRID, 0.1, np.float32), rtol=1e-3).pattern
    picture = np.delete(T @ np.asarray(pattern, np.float64).ravel(), black)
    assert np.std(picture) < 10 ** (-30 / 20) * np.mean(picture)


def test_hot_pixels_decide_nothing(tmp_path: Path) -> None:
    """They are masked; exposures, response and so T are what they are without them."""
    hot = np.isin(np.arange(64).reshape(GRID), [9, 10, 40])
    rig = camera(fault=lambda _, image: np.where(hot, np.uint16(4095), image))
    measured = acquire(rig, **FULL, store=tmp_path / "T.zarr")
    acquire(camera(), **FULL, store=tmp_path / "good.zarr")
    np.testing.assert_array_equal(measured.masked.reshape(GRID), hot)
    exposures, good = (Report.of(tmp_path / name).exposures for name in ("T.zarr", "good.zarr"))
    np.testing.assert_allclose(exposures, good, rtol=0.1)
    p = random.random(GRID).astype(np.float32)
    ours = np.asarray(measured @ p, np.float64)[~hot]
    theirs = (scene(GRID) @ p.ravel()).reshape(GRID)[~hot]
    assert np.linalg.norm((ours @ theirs) / (ours @ ours) * ours - theirs) < 0.02 * np.linalg.norm(
        theirs
    )


def test_whatever_ends_a_calibration_its_photographs_stay(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Also photographs that contradict each other: they are not taken again, and are refused again."""
    path, numbers = tmp_path / "T.zarr", iter(range(10**6))

    def lamp(codes: Any, image: np.ndarray) -> np.ndarray:
        on = codes.all() and next(numbers) == 6
        return np.minimum(image + np.uint16(300), 4095).astype(np.uint16) if on else image

    for rig in (camera(fault=lamp), camera(left=0)):
        with pytest.raises(AcquisitionError, match=in_one_line(r"photographs? \d+.* bright")):
            acquire(rig, **{**SHORT, "frames": 4}, store=path)
        assert calibration_photographs(path) > 20
        assert str(calibration_folder(path)) in caplog.text
    assert not path.exists()


def test_a_place_where_no_store_can_be(tmp_path: Path) -> None:
    """Refused before the first photograph; what is there stays."""
    (tmp_path / "file.zarr").write_text("x")
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.txt").write_text("x")
    (tmp_path / "link.zarr").symlink_to(tmp_path / "file.zarr")
    before = sorted(tmp_path.rglob("*"))
    for name in ("file.zarr", "link.zarr", "thesis", "file.zarr/T.zarr", "T" * 300):
        with pytest.raises(FileError, match=in_one_line(f"{tmp_path}.*: ")):
            acquire(camera(left=0), **FULL, store=tmp_path / name)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("strategy", ["pixel", "adaptive"])
def test_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, strategy: str) -> None:
    """From one call of the system on, at random places of all stages; each time there is room again later."""
    rig, settings = set_up(strategy)
    acquire(rig, store=tmp_path / "whole.zarr", **settings)
    path, failures, left = tmp_path / "T.zarr", [], [10**9]

    def full(real: Any, *arguments: Any, **options: Any) -> Any:
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(*arguments, **options)

    for name in ("write", "mkdir", "fsync"):  # all that takes room fails after so many calls
        monkeypatch.setattr(os, name, partial(full, getattr(os, name)))
    for calls in (*random.integers(10, 200, 3), *random.integers(20, 400, 9), 10**9):
        left[0] = calls
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
