# SPDX-License-Identifier: BSD-3-Clause
"""A calibration that ended early goes on with its photographs, if the rig is the same."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import FolderRig, Shots, acquire
from ltcl.acquisition.session import calibration_folder, calibration_photographs, check_same_rig
from ltcl.errors import AcquisitionError, FileError, InputError, PhotographMissing
from ltcl.files import locked
from tests.store.stores import contents

from .stopping import LINEAR_RESPONSE, Unplugged, scene

GRID = (8, 8)
T = scene(GRID)
DIM = T * np.linspace(0.5, 1.0, 64)[:, None]


def unplugged(left: int = 1 << 30, **options: Any) -> Unplugged:
    return Unplugged(T, GRID, left=left, **options)


def run(rig: Any, store: Path, **settings: Any) -> None:
    acquire(rig, geometry="aligned", strategy="pixel", store=store, **settings)


@pytest.mark.slow
def test_a_camera_that_is_unplugged_again_and_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Nothing is photographed twice, except one photograph that was damaged."""
    whole = unplugged()
    run(whole, tmp_path / "whole.zarr")
    store = tmp_path / "T.zarr"
    for left, count in ((1, 1), (20, 21), (30, 51)):
        text = f"photograph {count + 1}: the rig failed with OSErr"
        with pytest.raises(AcquisitionError, match=text):
            run(unplugged(left), store)
        assert calibration_photographs(store) == count
        assert not store.exists()
    file = next(calibration_folder(store).glob("shot_*.npz"))
    file.write_bytes(file.read_bytes()[:-1] + b"\xff")
    rig = unplugged()
    with caplog.at_level(logging.INFO, "ltcl.acquisition"):
        run(rig, store)
    assert "51 photographs" in caplog.text
    assert 51 + rig.count == whole.count + 1
    assert contents(store) == contents(tmp_path / "whole.zarr")
    assert {path.name for path in tmp_path.iterdir()} == {"whole.zarr", "T.zarr"}


def test_another_rig_and_a_second_process_are_refused(tmp_path: Path) -> None:
    store = tmp_path / "T.zarr"
    with pytest.raises(AcquisitionError):
        run(unplugged(20), store)
    text = r"rig.bits is 8, but .*T.zarr.calibration was begun with 12"
    with pytest.raises(InputError, match=text):
        run(unplugged(bits=8), store)
    with pytest.raises(InputError, match=r"resume is False.*calibration"):
        run(unplugged(), store, resume=False)
    with locked(calibration_folder(store)), pytest.raises(FileError, match="calibration: another"):
        run(unplugged(), store)
    assert calibration_photographs(store) == 20


def test_a_rig_that_keeps_its_photographs_needs_no_folder(tmp_path: Path) -> None:
    with pytest.raises(PhotographMissing):
        run(FolderRig(tmp_path / "rig", GRID), tmp_path / "T.zarr")
    assert not calibration_folder(tmp_path / "T.zarr").exists()


LIVE: dict[str, Any] = {
    "kind": "live",
    "camera": {"kind": "opencv", "source": 0, "locked": {"exposure": True}},
    "display": {"index": 1, "driver": "x11", "block": [2, 2]},
    "period": 1 / 60,
    "exposures": [1 / 60, 1 / 30],
    "survey": {"latency": 0.05},
}


def live_rig(change: dict[str, Any]) -> Shots:
    """A rig that describes itself as `LIVE` with a change."""
    rig: Any = unplugged()
    rig.describe = lambda: {**LIVE, **change}
    return Shots(rig)


@pytest.mark.parametrize(
    "change",
    [
        {"survey": {"latency": 0.08}, "seed": 3, "mitsuba": "3.9"},
        {"camera": LIVE["camera"] | {"source": 2}, "display": {"index": 0, "block": [2, 2]}},
        {"period": 1 / 60 + 1e-9, "exposures": [1 / 60 + 1e-9, 1 / 30]},
    ],
)
def test_a_rig_is_the_same_except_for_volatile_keys(change: dict[str, Any]) -> None:
    check_same_rig(LIVE, live_rig(change), Path("T.zarr"))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"kind": "virtual"}, r"rig\.kind is 'virtual'"),
        ({"camera": {"kind": "opencv", "locked": {}}}, r"rig\.camera\.locked\.exposure is"),
        ({"exposures": [1 / 60]}, r"rig\.exposures is \[0\.016"),
        ({"iso": "200"}, r"rig\.iso is '200'"),
    ],
)
def test_another_rig_is_refused(change: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError, match=text):
        check_same_rig(LIVE, live_rig(change), Path("T.zarr"))


class Plain:
    """A user's rig, without `describe()`."""

    projector_grid = GRID
    channels = 1

    def __init__(self, T: np.ndarray = T, bits: int = 12, left: int = 1 << 30) -> None:
        self.bits = bits
        self.photograph = Unplugged(T, GRID, left=left, bits=bits, response="linear").photograph


class Terse(Plain):
    """A rig that says nothing of its camera."""

    def describe(self) -> dict[str, Any]:
        return {"kind": "terse"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "others"),
    [
        (
            Plain,
            [(Terse(), "rig.kind is 'terse'"), (Plain(bits=10), "levels"), (Plain(DIM), "white")],
        ),
        (Terse, [(Terse(bits=10), r"1024 levels.*4096")]),
    ],
)
def test_a_rig_is_known_by_its_class_its_bits_and_its_pictures(
    tmp_path: Path, kind: Any, others: list[tuple[Any, str]]
) -> None:
    """Without `describe()` black and white are photographed again."""
    settings: dict[str, Any] = {
        "frames": 2,
        "response": LINEAR_RESPONSE,
        "exposures": [0.5],
        "store": tmp_path / "T.zarr",
    }
    with pytest.raises(AcquisitionError, match="unplugged"):
        run(kind(left=60), **settings)
    for other, text in others:
        with pytest.raises(InputError, match=text):
            run(other, **settings)
    run(kind(), **settings)
