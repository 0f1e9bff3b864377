# SPDX-License-Identifier: BSD-3-Clause
"""What goes wrong in front of a camera, and on the disk behind it, through `acquire` as a whole.

It is named in one line, or masked; nothing that was committed is lost; and once it is put right, the
acquisition goes on to what it would have been.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Correspondence, Report, VirtualRig, acquire
from ltcl.acquisition.session import calibration_folder, calibration_photographs
from ltcl.errors import AcquisitionError, FileError, InputError, InputTypeError, LtclError
from ltcl.store import BlockStore
from tests.store.stores import contents

from .stopping import LINE, Unplugged, made, scene

random = np.random.default_rng()
GRID = (8, 8)
FULL: dict[str, Any] = {"geometry": "aligned", "strategy": "pixel", "frames": 2}
SHORT: dict[str, Any] = {**FULL, "response": LINE, "exposures": [0.5]}
CAMERA: dict[str, Any] = {"bits": 12, "ambient": 0.01, "response": "linear"}
TWICE = np.repeat(np.repeat(np.eye(64).reshape(8, 8, 64), 2, axis=0), 2, axis=1).reshape(256, 64)


def refused(error: type[LtclError], text: str, rig: Any, **settings: Any) -> None:
    """Assert that `acquire` says so in one line."""
    with pytest.raises(error, match=rf"\A.*{text}.*\Z"):
        acquire(rig, **settings)


class Faulty(VirtualRig):
    """A camera whose photographs are changed on the way, from some number on."""

    def __init__(self, fault: Callable[[Any, np.ndarray], Any], start: int = 1) -> None:
        super().__init__(scene(GRID), GRID, **CAMERA)
        self._fault, self._left = fault, start

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        self._left -= 1
        image = super().photograph(codes, seconds)
        return image if self._left > 0 else self._fault(codes, image)


def camera(T: np.ndarray | None = None, grid: tuple[int, int] = GRID, **options: Any) -> VirtualRig:
    return VirtualRig(scene(grid) if T is None else T, grid, **{**CAMERA, **options})


def unused() -> Unplugged:
    """A rig that must not be asked for a photograph."""
    return Unplugged(scene(GRID), GRID, left=0)


UNLIT, BRIGHT = camera(0 * scene(GRID)), camera(ambient=1e5)
DARK, SATURATED = "is the lens cap on, the projector off", "every pixel is saturated.* 0.0001 s"
MEASURED: dict[str, Any] = {"response": None, "exposures": None}
CONSTANT = Faulty(lambda _, image: np.full_like(image, 7))
FINE = camera(camera_grid=(16, 16), camera_map=TWICE)
GIVEN = {"geometry": Correspondence.aligned(GRID)}


@pytest.mark.parametrize(
    ("rig", "change", "error", "text"),
    [
        (UNLIT, {}, AcquisitionError, DARK),
        (UNLIT, MEASURED, AcquisitionError, DARK),
        (CONSTANT, {}, AcquisitionError, DARK),
        (CONSTANT, MEASURED, AcquisitionError, DARK),
        (BRIGHT, {}, AcquisitionError, SATURATED),
        (BRIGHT, MEASURED, AcquisitionError, SATURATED),
        (CONSTANT, {"geometry": "graycode"}, AcquisitionError, "the geometry: photographs"),
        (camera(), {"exposures": [1e-4]}, InputError, "exposures is .*lost in noise at 0.0001 s"),
        (camera(), {"exposures": [30.0]}, InputError, "exposures is .*saturates at 30 s"),
        (FINE, {}, InputError, r"geometry is 'aligned'.*\(16, 16\)"),
        (FINE, GIVEN, InputError, r"geometry.*\(8, 8\).*\(16, 16\)"),
        (camera(grid=(8, 16)), GIVEN, InputError, r"geometry.*\(8, 8\).*\(8, 16\)"),
        (None, {"strategy": "spiral"}, InputError, "strategy is 'spiral'"),
        (None, {"geometry": "stripes"}, InputError, "geometry is 'stripes'"),
        (None, {"geometry": np.eye(2)}, InputError, "geometry is a ndarray"),
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
    ],
)
def test_bad_arguments(rig: Any, change: dict[str, Any], error: type[LtclError], text: str) -> None:
    """Those for None, which need no photograph, are refused before the first one."""
    refused(error, text, rig or unused(), **{**SHORT, **change})


def test_a_photograph_of_another_kind_is_not_kept(tmp_path: Path) -> None:
    path, rig = tmp_path / "T.zarr", Faulty(lambda _, image: image[:4], start=30)
    refused(AcquisitionError, r"photograph 30 is uint16 \(4, 8\).*\(8, 8\)", rig, **FULL, store=path)
    assert calibration_photographs(path) == 29


@pytest.mark.parametrize("strategy", ["pixel", "hadamard", "adaptive"])
def test_some_black_pixels_are_masked(strategy: str) -> None:
    """Their noise is no first bounce: what is compensated is as if they were not there."""
    black, T = [3, 17], scene(GRID)
    T[black] = T[:, black] = 0.0
    measured = acquire(camera(T), **{**SHORT, "strategy": strategy})
    assert np.flatnonzero(measured.masked).tolist() == black
    pattern = ltcl.compensate(measured, np.full(GRID, 0.1, np.float32), rtol=1e-3).pattern
    seen = np.delete(T @ np.asarray(pattern, np.float64).ravel(), black)
    assert np.std(seen) < 10 ** (-30 / 20) * np.mean(seen)


def test_hot_pixels_decide_nothing(tmp_path: Path) -> None:
    """They are masked; exposures, response and so T are what they are without them."""
    pixels = [9, 10, 40]

    def hot(_: Any, image: np.ndarray) -> np.ndarray:
        image = image.copy()
        image.flat[pixels] = 4095
        return image

    measured = acquire(Faulty(hot), **FULL, store=tmp_path / "T.zarr")
    acquire(camera(), **FULL, store=tmp_path / "good.zarr")
    assert np.flatnonzero(measured.masked).tolist() == pixels
    exposures, good = (Report.of(tmp_path / name).exposures for name in ("T.zarr", "good.zarr"))
    np.testing.assert_allclose(exposures, good, rtol=0.1)
    p = random.random(GRID).astype(np.float32)
    ours = np.delete(np.asarray(measured @ p, np.float64).ravel(), pixels)
    theirs = np.delete(scene(GRID) @ p.ravel(), pixels)
    assert np.linalg.norm((ours @ theirs) / (ours @ ours) * ours - theirs) < 0.02 * np.linalg.norm(theirs)


def test_whatever_ends_a_calibration_its_photographs_stay(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Also photographs that contradict each other: they are not taken again, and are refused again."""
    path, numbers = tmp_path / "T.zarr", iter(range(10**6))

    def lamp(codes: Any, image: np.ndarray) -> np.ndarray:
        on = codes.all() and next(numbers) == 6
        return np.minimum(image + np.uint16(300), 4095).astype(np.uint16) if on else image

    for rig in (Faulty(lamp), Unplugged(scene(GRID), GRID, left=0, **CAMERA)):
        refused(AcquisitionError, r"photographs? \d+.* bright", rig, **{**SHORT, "frames": 4}, store=path)
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
        refused(FileError, f"{tmp_path}.*: ", unused(), **FULL, store=tmp_path / name)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("strategy", ["pixel", "adaptive"])
def test_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, strategy: str) -> None:
    """From one call of the system on, at random places of all stages; each time there is room again later."""
    rig, settings = made(strategy)
    acquire(rig, store=tmp_path / "whole.zarr", **settings)
    path, failures = tmp_path / "T.zarr", []
    for left in (*random.integers(10, 200, 3), *random.integers(20, 400, 9), 10**9):
        with monkeypatch.context() as patch:
            calls = iter(range(10**9))

            def full(*arguments: Any, real: Any, calls: Any = calls, left: int = left, **options: Any) -> Any:
                if next(calls) >= left:
                    raise OSError(errno.ENOSPC, "No space left on device")
                return real(*arguments, **options)

            for name in ("write", "mkdir", "fsync"):  # all that takes room fails after so many calls
                patch.setattr(os, name, partial(full, real=getattr(os, name)))
            try:
                acquire(made(strategy)[0], store=path, **settings)
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
