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
from ltcl.acquisition.calibrate import measure
from ltcl.acquisition.geometry import Correspondence
from ltcl.errors import AcquisitionError, FileError, InputError, InputTypeError, LtclError
from ltcl.store import BlockStore
from tests.store.stores import contents

from .stopping import LINE, made, scene

GRID = (8, 8)
FULL: dict[str, Any] = {"geometry": "aligned", "strategy": "pixel", "frames": 2}
SHORT: dict[str, Any] = {**FULL, "response": LINE, "exposures": [0.5]}
CAMERA: dict[str, Any] = {"bits": 12, "ambient": 0.01, "response": "linear"}


def refused(error: type[LtclError], text: str, rig: Any, **given: Any) -> None:
    """Assert that `acquire` says so in one line."""
    with pytest.raises(error, match=text) as found:
        acquire(rig, **given)
    assert "\n" not in str(found.value)


class Faulty(VirtualRig):
    """A camera whose photographs are changed on the way, from some number on."""

    def __init__(self, fault: Callable[[Any, np.ndarray], Any], start: int = 1, T: Any = None) -> None:
        super().__init__(scene(GRID) if T is None else T, GRID, **CAMERA)
        self._fault, self._left = fault, start

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        self._left -= 1
        image = super().photograph(codes, seconds)
        return image if self._left > 0 else self._fault(codes, image)


def constant(code: int) -> Faulty:
    """A camera that sees nothing of the scene."""
    return Faulty(lambda _, image: np.full(GRID, code, image.dtype))


@pytest.mark.parametrize("given", [FULL, SHORT])
def test_a_scene_without_light(given: dict[str, Any]) -> None:
    for dark in (VirtualRig(0 * scene(GRID), GRID, **CAMERA), constant(0), constant(7)):
        refused(AcquisitionError, "is the lens cap on, the projector off", dark, **given)


@pytest.mark.parametrize("given", [FULL, SHORT])
def test_a_scene_that_is_all_saturated(given: dict[str, Any]) -> None:
    for bright in (VirtualRig(scene(GRID), GRID, **{**CAMERA, "ambient": 1e5}), constant(4095)):
        refused(AcquisitionError, "every pixel is saturated.* 0.0001 s", bright, **given)


def test_a_scene_that_gray_code_cannot_decode() -> None:
    given: dict[str, Any] = {"strategy": "pixel", "response": LINE}
    refused(AcquisitionError, "the geometry: photographs", constant(7), **given)


@pytest.mark.parametrize("strategy", ["pixel", "hadamard", "adaptive"])
def test_some_black_pixels_are_masked(tmp_path: Path, strategy: str) -> None:
    """Their noise is no first bounce: T loads, and what is compensated is as if they were not there."""
    black, T = [3, 17], scene(GRID)
    T[black] = T[:, black] = 0.0
    path = tmp_path / "T.zarr"
    measured = acquire(VirtualRig(T, GRID, **CAMERA), **{**SHORT, "strategy": strategy}, store=path)
    assert np.flatnonzero(measured.masked).tolist() == black
    pattern = ltcl.compensate(measured, np.full(GRID, 0.1, np.float32), rtol=1e-3).pattern
    seen = np.delete(T @ np.asarray(pattern, np.float64).ravel(), black)
    assert np.std(seen) < 10 ** (-30 / 20) * np.mean(seen)


@pytest.mark.parametrize("pixels", [[5], [9, 10, 40]])
def test_hot_pixels_decide_nothing(tmp_path: Path, pixels: list[int]) -> None:
    """They are masked; exposures, response and so T are what they are without them."""

    def hot(_: Any, image: np.ndarray) -> np.ndarray:
        image = image.copy()
        image.flat[pixels] = 4095
        return image

    measured = acquire(Faulty(hot), **FULL, store=tmp_path / "T.zarr")
    acquire(VirtualRig(scene(GRID), GRID, **CAMERA), **FULL, store=tmp_path / "good.zarr")
    assert np.flatnonzero(measured.masked).tolist() == pixels
    exposures, good = (Report.of(tmp_path / name).exposures for name in ("T.zarr", "good.zarr"))
    np.testing.assert_allclose(exposures, good, rtol=0.1)
    p = np.random.default_rng(0).random(GRID).astype(np.float32)
    ours = np.delete(np.asarray(measured @ p, np.float64).ravel(), pixels)
    theirs = np.delete(scene(GRID) @ p.ravel(), pixels)
    assert np.linalg.norm((ours @ theirs) / (ours @ ours) * ours - theirs) < 0.02 * np.linalg.norm(theirs)


@pytest.mark.parametrize(("seconds", "part"), [(1e-4, "lost in noise"), (30.0, "saturates")])
def test_exposures_at_which_nothing_is_seen(seconds: float, part: str) -> None:
    rig = VirtualRig(scene(GRID), GRID, **CAMERA)
    refused(InputError, f"exposures is .*{part} at {seconds:g} s", rig, **{**SHORT, "exposures": [seconds]})


def test_a_change_behind_the_calibration_keeps_no_batch(tmp_path: Path) -> None:
    """Half of the light; a photograph too late: refused before the batch is kept, naming photographs."""
    shots = Shots(VirtualRig(scene(GRID), GRID, **CAMERA))
    measure(shots, geometry="aligned", frames=2, response=LINE, exposures=[0.5])
    last: list[np.ndarray] = [np.zeros(GRID, np.uint16)]

    def late(_: Any, image: np.ndarray) -> np.ndarray:
        last.append(image)
        return last[-2]

    for number, fault in enumerate((late, lambda _, image: image // 2)):
        path = tmp_path / f"{number}.zarr"
        refused(AcquisitionError, r"photographs? \d+", Faulty(fault, shots.count + 2), **SHORT, store=path)
        assert not BlockStore.open(path).written


def test_whatever_ends_a_calibration_its_photographs_stay(tmp_path: Path) -> None:
    """Also photographs that contradict each other: they are not taken again, and are refused again."""
    path, numbers = tmp_path / "T.zarr", iter(range(10**6))

    def lamp(codes: Any, image: np.ndarray) -> np.ndarray:
        on = codes.all() and next(numbers) == 6
        return np.minimum(image + np.uint16(300), 4095).astype(np.uint16) if on else image

    for rig in (Faulty(lamp), unused(VirtualRig(scene(GRID), GRID, **CAMERA))):
        refused(AcquisitionError, r"photographs? \d+.* bright", rig, **{**SHORT, "frames": 4}, store=path)
        assert kept.count(path) > 20
    assert not path.exists()


@pytest.mark.parametrize(
    ("spoilt", "text"),
    [
        (lambda image: image[:4], r"photograph 50 is uint16 \(4, 8\).*\(8, 8\)"),
        (lambda image: image.astype(np.uint8), r"photograph 50 is uint8 \(8, 8\)"),
        (lambda image: None, "photograph 50 is None"),
        (lambda image: np.stack([image] * 3, -1), r"photograph 50 has shape \(8, 8, 3\)"),
        (lambda image: image[:0], r"photograph 50 has shape \(0, 8\)"),
        (lambda image: image + np.uint16(60000), "photograph 50 reaches"),
    ],
)
def test_photographs_of_another_kind(spoilt: Callable[[np.ndarray], Any], text: str) -> None:
    refused(AcquisitionError, text, Faulty(lambda _, image: spoilt(image), start=50), **SHORT)


@pytest.mark.parametrize(
    ("given", "error", "text"),
    [
        ({"strategy": "spiral"}, InputError, "strategy is 'spiral'"),
        ({"geometry": "stripes"}, InputError, "geometry is 'stripes'"),
        ({"geometry": 3}, InputTypeError, "geometry is a int"),
        ({"order": 64}, InputError, "order is 64"),
        ({"block": 1}, InputError, "block is 1"),
        ({"threshold": 0.0}, InputError, "threshold is 0"),
        ({"frames": 0}, InputError, "frames is 0"),
        ({"resume": "no"}, InputTypeError, "resume is 'no'"),
        ({"exposures": []}, InputError, r"exposures is \[\]"),
        ({"exposures": 0.5}, InputError, "exposures is 0.5"),
        ({"exposures": [1.0, -1.0]}, InputError, "exposures is"),
        ({"exposures": [np.nan]}, InputError, "exposures has 1 NaN"),
        ({"exposures": "fast"}, InputTypeError, "exposures is"),
        ({"exposures": [0.5, 40.0]}, InputError, "exposures has 40 s"),
        ({"response": "srgb"}, InputTypeError, "response is a str"),
        ({"progress": 3}, InputTypeError, "progress is 3"),
        ({"store": 3}, InputTypeError, "store is 3"),
    ],
)
def test_arguments_are_refused_before_the_first_photograph(
    given: dict[str, Any], error: type[LtclError], text: str
) -> None:
    refused(error, text, unused(), **{**FULL, **given})


def unused(rig: VirtualRig | None = None) -> VirtualRig:
    """A rig that must not be asked for a photograph."""
    rig = rig or VirtualRig(scene(GRID), GRID)

    def photograph(codes: Any, seconds: float) -> np.ndarray:
        raise AssertionError("photographed before all was checked")

    rig.photograph = photograph
    return rig


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


def test_grids_that_do_not_match() -> None:
    wide = VirtualRig(scene((8, 16)), (8, 16), **CAMERA)
    twice = np.repeat(np.repeat(np.eye(64).reshape(8, 8, 64), 2, axis=0), 2, axis=1).reshape(256, 64)
    fine = VirtualRig(scene(GRID), GRID, camera_grid=(16, 16), camera_map=twice, **CAMERA)
    refused(InputError, r"geometry is 'aligned'.*\(16, 16\)", fine, **SHORT)
    given = {**SHORT, "geometry": Correspondence.aligned(GRID)}
    for rig, part in ((wide, r"\(8, 16\)"), (fine, r"\(16, 16\)")):
        refused(InputError, rf"geometry is from \(8, 8\) to \(8, 8\).*{part}", rig, **given)


@pytest.mark.parametrize("strategy", ["pixel", "adaptive"])
def test_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, strategy: str) -> None:
    """From one call of the system on, at random places of all stages; each time there is room again later."""
    rig, given = made(strategy)
    acquire(rig, store=tmp_path / "whole.zarr", **given)
    path, random, failures = tmp_path / "T.zarr", np.random.default_rng(1), []
    for left in (*random.integers(10, 200, 3), *random.integers(20, 400, 9), 10**9):
        with monkeypatch.context() as patch:
            fill_after(patch, int(left))
            try:
                acquire(made(strategy)[0], store=path, **given)
                break
            except FileError as error:
                failures.append(str(error))
        if path.exists():
            BlockStore.open(path).verify()
    assert contents(path) == contents(tmp_path / "whole.zarr")
    assert len(failures) >= 3, failures
    for text in failures:
        assert text.startswith((f"{path}", f"{kept.place(path)}")), text
        assert "No space left on device" in text
    assert {path.name for path in tmp_path.iterdir()} == {"whole.zarr", "T.zarr"}


def fill_after(patch: pytest.MonkeyPatch, left: int) -> None:
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
