# SPDX-License-Identifier: BSD-3-Clause
"""What goes wrong in front of a camera, and on the disk behind it, through `acquire` as a whole.

It is named in one line, or masked; nothing that was committed is lost; and once it is put right, the
acquisition goes on to what it would have been.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Report, Shots, VirtualRig, acquire, kept
from ltcl.acquisition.geometry import Correspondence
from ltcl.acquisition.measuring import measure
from ltcl.errors import AcquisitionError, FileError, InputError, InputTypeError, LtclError, ScanRefused
from ltcl.store import BlockStore

from .stopping import LINE, made, scene
from .test_killed import contents

GRID = (8, 8)
FULL: dict[str, Any] = {"geometry": "aligned", "strategy": "pixel", "frames": 2}
SHORT: dict[str, Any] = {**FULL, "response": LINE, "exposures": [0.5]}
CAMERA: dict[str, Any] = {"bits": 12, "ambient": 0.01, "response": "linear"}
CAUSES = "is the lens cap on, the projector off or showing something else, or every exposure far too short"
SHINE = "pictures are no brighter under code 1 than under code 0; "
SATURATED = "every pixel is saturated under white at the shortest exposure, 0.0001 s"


def refused(error: type[LtclError], text: str, rig: Any, **given: Any) -> None:
    """Assert that `acquire` says so in one line."""
    with pytest.raises(error, match=text) as found:
        acquire(rig, **given)
    assert "\n" not in str(found.value)


class Constant(VirtualRig):
    """A camera that sees nothing of the scene."""

    def __init__(self, code: int) -> None:
        super().__init__(scene(GRID), GRID)
        self._code = code

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        return np.full(GRID, self._code, np.uint8)


@pytest.mark.parametrize("given", [FULL, SHORT, {**SHORT, "strategy": "adaptive"}])
def test_a_scene_without_light(given: dict[str, Any]) -> None:
    refused(AcquisitionError, f"{SHINE}.*{CAUSES}", VirtualRig(0 * scene(GRID), GRID, **CAMERA), **given)
    for code in (0, 7):
        refused(
            AcquisitionError, f"(the response of|the noise of|{SHINE}).*{CAUSES}", Constant(code), **given
        )


@pytest.mark.parametrize("given", [FULL, SHORT, {"strategy": "pixel"}])
def test_a_scene_that_is_all_saturated(given: dict[str, Any]) -> None:
    refused(AcquisitionError, SATURATED, VirtualRig(scene(GRID), GRID, **{**CAMERA, "ambient": 1e5}), **given)
    refused(AcquisitionError, SATURATED, Constant(255), **given)


@pytest.mark.parametrize("code", [0, 7])
def test_a_scene_that_gray_code_says_nothing_of(code: int) -> None:
    given: dict[str, Any] = {"strategy": "pixel", "response": LINE}
    refused(AcquisitionError, "the geometry: photographs", Constant(code), **given)


@pytest.mark.parametrize("strategy", ["pixel", "hadamard", "adaptive"])
def test_some_black_pixels_are_masked(tmp_path: Path, strategy: str) -> None:
    """Their noise is no first bounce: T loads, and what is compensated is as if they were not there."""
    black, T = [3, 17], scene(GRID)
    T[black] = T[:, black] = 0.0
    found = acquire(
        VirtualRig(T, GRID, **CAMERA), **{**SHORT, "strategy": strategy}, store=tmp_path / "T.zarr"
    )
    assert np.flatnonzero(found.masked).tolist() == black
    desired = np.full(GRID, 0.1, np.float32)
    pattern = np.asarray(ltcl.compensate(found, desired, rtol=1e-3).pattern, np.float64)
    seen = np.delete((T @ pattern.ravel()).ravel(), black)
    assert np.std(seen) < 10 ** (-30 / 20) * np.mean(seen)
    BlockStore.open(tmp_path / "T.zarr").verify()


class Hot(VirtualRig):
    """A camera with pixels that are at their last code whatever they see."""

    def __init__(self, pixels: list[int]) -> None:
        super().__init__(scene(GRID), GRID, **CAMERA)
        self._pixels = pixels

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        image = super().photograph(codes, seconds).copy()
        image.flat[self._pixels] = 4095
        return image


@pytest.mark.parametrize("pixels", [[5], [0, 63], [9, 10, 40]])
def test_hot_pixels_decide_nothing(tmp_path: Path, pixels: list[int]) -> None:
    """They are masked; exposures, response and so T are what they are without them."""
    found = acquire(Hot(pixels), **FULL, store=tmp_path / "T.zarr")
    acquire(VirtualRig(scene(GRID), GRID, **CAMERA), **FULL, store=tmp_path / "good.zarr")
    assert np.flatnonzero(found.masked).tolist() == pixels
    exposures, good = (Report.of(tmp_path / name).exposures for name in ("T.zarr", "good.zarr"))
    np.testing.assert_allclose(exposures, good, rtol=0.1)
    p = np.random.default_rng(0).random(GRID).astype(np.float32)
    ours, theirs = (
        np.delete(np.asarray(part).ravel(), pixels) for part in (found @ p, scene(GRID) @ p.ravel())
    )
    assert np.linalg.norm(ours - theirs) < 0.02 * np.linalg.norm(theirs)


def test_exposures_at_which_all_is_noise() -> None:
    rig = VirtualRig(scene(GRID), GRID, **CAMERA)
    text = r"exposures is \(0.0001,\), but half of what white shows is lost in noise at 0.0001 s; the longest"
    refused(InputError, text, rig, **{**SHORT, "exposures": [1e-4]})


def test_exposures_at_which_lit_pixels_saturate() -> None:
    rig = VirtualRig(scene(GRID), GRID, **CAMERA)
    text = r"exposures is \(30.0,\), but half of what white shows saturates at 30 s; the shortest must be at"
    refused(InputError, text, rig, **{**SHORT, "exposures": [30.0]})


class Late(VirtualRig):
    """Shows what was asked for a pattern ago, from some photograph on."""

    def __init__(self, start: int) -> None:
        super().__init__(scene(GRID), GRID, **CAMERA)
        self._left, self._before = start, np.zeros(GRID, np.float32)

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        self._left -= 1
        shown, self._before = (codes if self._left > 0 else self._before), np.array(codes)
        return super().photograph(shown, seconds)


def test_photographs_that_lag_behind_their_patterns(tmp_path: Path) -> None:
    """Named in the first batch: nothing of it is kept."""
    text = "photograph 109 shows the pattern of .*; photographs must be in the order of their patterns"
    refused(AcquisitionError, text, Late(_calibrating() + 1), **SHORT, store=tmp_path / "T.zarr")
    assert not BlockStore.open(tmp_path / "T.zarr").written


class Dimmed(VirtualRig):
    """Sends half of its light, from some photograph on."""

    def __init__(self, start: int) -> None:
        super().__init__(scene(GRID), GRID, **CAMERA)
        self._left = start

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        self._left -= 1
        return super().photograph(codes * np.float32(1.0 if self._left > 0 else 0.5), seconds)


def test_light_that_changes_behind_the_calibration(tmp_path: Path) -> None:
    """Columns then do not add up to white: no transport is made of them."""
    text = (
        "columns of T add up to light that is .* beside what white showed; photographs must be in the order"
    )
    refused(ScanRefused, text, Dimmed(_calibrating() + 1), **SHORT, store=tmp_path / "T.zarr")
    assert not BlockStore.open(tmp_path / "T.zarr").final


def _calibrating() -> int:
    """Photographs before the first of a scan."""
    shots = Shots(VirtualRig(scene(GRID), GRID, **CAMERA))
    measure(shots, geometry="aligned", frames=2, response=LINE, exposures=[0.5])
    return shots.count


def test_some_saturated_pixels_are_masked(tmp_path: Path) -> None:
    T = scene(GRID)
    T[5, 5] = 100.0
    found = acquire(VirtualRig(T, GRID, **CAMERA), **SHORT, store=tmp_path / "T.zarr")
    assert np.flatnonzero(found.masked).tolist() == [5]
    assert np.flatnonzero(ltcl.load(tmp_path / "T.zarr", on_dark="mask").masked).tolist() == [5]
    with pytest.raises(FileError, match="first_bounce is zero or negative at 1 of 64 pixels"):
        ltcl.load(tmp_path / "T.zarr")
    pattern = ltcl.compensate(found, np.full(GRID, 0.1, np.float32), rtol=1e-3).pattern
    seen = np.delete(T @ np.asarray(pattern, np.float64).ravel(), 5)
    assert np.std(seen) < 10 ** (-30 / 20) * np.mean(seen)


@pytest.mark.parametrize(
    ("spoilt", "text"),
    [
        (lambda image: image[:4], r"photograph 100 is uint16 \(4, 8\); it must be uint16 \(8, 8\)"),
        (lambda image: image.astype(np.uint8), r"photograph 100 is uint8 \(8, 8\); it must be uint16"),
        (lambda image: None, "photograph 100 is None; it must be an image"),
        (lambda image: np.stack([image] * 3, -1), r"photograph 100 has shape \(8, 8, 3\)"),
        (lambda image: image[:0], r"photograph 100 has shape \(0, 8\)"),
        (lambda image: image + np.uint16(60000), "photograph 100 reaches"),
    ],
)
def test_photographs_of_another_kind(spoilt: Callable[[np.ndarray], Any], text: str) -> None:
    made, number = VirtualRig(scene(GRID), GRID, **CAMERA), iter(range(1, 10000))
    real = made.photograph
    made.photograph = lambda codes, seconds: (
        spoilt(real(codes, seconds)) if next(number) == 100 else real(codes, seconds)
    )
    refused(AcquisitionError, text, made, **SHORT)


@pytest.mark.parametrize(
    ("given", "error", "text"),
    [
        ({"exposures": []}, InputError, r"exposures is \[\]"),
        ({"exposures": 0.5}, InputError, "exposures is 0.5"),
        ({"exposures": [1.0, -1.0]}, InputError, "exposures is"),
        ({"exposures": [np.nan]}, InputError, "exposures has 1 NaN"),
        ({"exposures": "fast"}, InputTypeError, "exposures is"),
        ({"response": "srgb"}, InputTypeError, "response is a str"),
        ({"progress": 3}, InputTypeError, "progress is 3"),
        ({"store": 3}, InputTypeError, "store is 3"),
    ],
)
def test_arguments_are_refused_before_the_first_photograph(
    given: dict[str, Any], error: type[LtclError], text: str
) -> None:
    refused(error, text, _dark_room(), **{**FULL, **given})


def _dark_room(made: VirtualRig | None = None) -> VirtualRig:
    """A rig that must not be asked for a photograph."""
    made = made or VirtualRig(scene(GRID), GRID)

    def photograph(codes: Any, seconds: float) -> np.ndarray:
        raise AssertionError("photographed before all was checked")

    made.photograph = photograph
    return made


def test_a_place_where_no_store_can_be(tmp_path: Path) -> None:
    """Told before the first photograph, not behind the calibration; what is there stays."""
    (tmp_path / "file.zarr").write_text("x")
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.txt").write_text("x")
    (tmp_path / "link.zarr").symlink_to(tmp_path / "file.zarr")
    (tmp_path / "loop.zarr").symlink_to(tmp_path / "loop.zarr")
    before = sorted(tmp_path.rglob("*"))
    for name, text in {
        "file.zarr": "is no folder, as a store is",
        "link.zarr": "is no folder, as a store is",
        "thesis": r"zarr\.json is missing",
        "loop.zarr": "is there, and is no store of ltcl",
        "file.zarr/T.zarr": "the store cannot be written: File exists",
        "T" * 300: "the store cannot be written: File name too long",
        "T\0.zarr": "the store cannot be written: embedded null byte",
    }.items():
        refused(FileError, f"{tmp_path}.*: {text}", _dark_room(), **FULL, store=tmp_path / name)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_store_through_a_link_or_in_an_empty_folder(tmp_path: Path) -> None:
    given = made("block")[1]
    (tmp_path / "disk").mkdir()
    (tmp_path / "T.zarr").symlink_to(tmp_path / "disk" / "scan.zarr")
    (tmp_path / "empty").mkdir()
    for name in ("T.zarr", "empty"):
        acquire(made("block")[0], store=tmp_path / name, **given)
        acquire(_dark_room(made("block")[0]), store=tmp_path / name, **given)  # it is done
        BlockStore.open(tmp_path / name).verify()
    assert (tmp_path / "T.zarr").is_symlink()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["T.zarr", "disk", "empty"]


def test_grids_that_do_not_match(tmp_path: Path) -> None:
    wide = VirtualRig(scene((8, 16)), (8, 16), **CAMERA)
    twice = np.repeat(np.repeat(np.eye(64).reshape(8, 8, 64), 2, axis=0), 2, axis=1).reshape(256, 64)
    fine = VirtualRig(scene(GRID), GRID, camera_grid=(16, 16), camera_map=twice, **CAMERA)
    refused(InputError, r"geometry is 'aligned', but photographs are \(16, 16\)", fine, **SHORT)
    given = {**SHORT, "geometry": Correspondence.aligned(GRID)}
    refused(InputError, r"geometry is from \(8, 8\) to \(8, 8\); the rig is from \(8, 16\)", wide, **given)
    refused(InputError, r"geometry is from .* the rig is from \(16, 16\) to \(8, 8\)", fine, **given)
    acquire(VirtualRig(scene(GRID), GRID, **CAMERA), **SHORT, store=tmp_path / "T.zarr")
    refused(InputError, r"rig has \(8, 16\) pixels and 1 channel", wide, **SHORT, store=tmp_path / "T.zarr")


@pytest.mark.parametrize("strategy", ["pixel", "adaptive"])
def test_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, strategy: str) -> None:
    """From one call of the system on, at random places of all stages; each time there is room again later."""
    rig, given = made(strategy)
    acquire(rig, store=tmp_path / "whole.zarr", **given)
    path, rng, told, T = tmp_path / "T.zarr", np.random.default_rng(1), [], None
    for left in (*rng.integers(10, 300, 3), *rng.integers(20, 500, 12), 10**9):
        with monkeypatch.context() as patch:
            _fill_after(patch, int(left))
            try:
                T = acquire(made(strategy)[0], store=path, **given)
                break
            except FileError as error:
                told.append(str(error))
        if path.exists():
            BlockStore.open(path).verify()
    assert T is not None
    assert contents(path) == contents(tmp_path / "whole.zarr")
    assert len(told) >= 4, told
    for text in told:
        assert text.startswith((f"{path}: ", f"{kept.place(path)}: ")), text
        assert text.endswith("cannot be written: No space left on device"), text
    assert {path.name for path in tmp_path.iterdir()} == {"whole.zarr", "T.zarr"}


def _fill_after(patch: pytest.MonkeyPatch, left: int) -> None:
    """Everything that takes room on the disk fails after so many calls."""
    count = iter(range(1, 10**9))

    def full(real: Callable[..., Any]) -> Callable[..., Any]:
        def act(*arguments: Any, **options: Any) -> Any:
            if next(count) > left:
                raise OSError(errno.ENOSPC, "No space left on device")
            return real(*arguments, **options)

        return act

    for name in ("write", "mkdir", "fsync"):
        patch.setattr(os, name, full(getattr(os, name)))
