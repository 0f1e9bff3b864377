# SPDX-License-Identifier: BSD-3-Clause
"""A calibration that ended early goes on with its photographs, and begins anew where these are of no use."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import FolderRig, VirtualRig, acquire, kept
from ltcl.errors import AcquisitionError, FileError, InputError, PhotographMissing
from ltcl.store.array_log import ArrayLog
from tests.store.stores import contents

GRID = (8, 8)
TRUTH = np.eye(64) * 0.5 + 0.002


class Unplugged(VirtualRig):
    """Gives so many photographs, then fails."""

    def __init__(self, left: int = 1 << 30, **given: Any) -> None:
        super().__init__(TRUTH, GRID, **{"bits": 12, "ambient": 0.01, **given})
        self.left, self.taken = left, 0

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        if self.taken == self.left:
            raise OSError("unplugged")
        self.taken += 1
        return super().photograph(codes, seconds)


def run(rig: Any, store: Path, **given: Any) -> None:
    acquire(rig, geometry="aligned", strategy="pixel", store=store, **given)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[int, dict[str, str]]:
    """Photographs in all, and the files of an acquisition that nothing ended."""
    rig, store = Unplugged(), tmp_path_factory.mktemp("whole") / "T.zarr"
    run(rig, store)
    assert not kept.place(store).exists()
    return rig.taken, contents(store)


def test_a_camera_that_is_unplugged_again_and_again(
    tmp_path: Path, whole: tuple[int, dict[str, str]], caplog: pytest.LogCaptureFixture
) -> None:
    store, taken = tmp_path / "T.zarr", 0
    for more in (1, 20, 30):
        with pytest.raises(
            AcquisitionError, match=f"photograph {taken + more + 1}: the rig failed with OSErr"
        ):
            run(Unplugged(more), store)
        taken += more
        assert kept.count(store) == taken
        assert not store.exists()
    rig = Unplugged()
    with caplog.at_level(logging.INFO, "ltcl.acquisition"):
        run(rig, store)
    assert "51 photographs of an earlier run are used again" in caplog.text
    assert taken + rig.taken == whole[0]
    assert contents(store) == whole[1]
    assert not kept.place(store).exists()


def test_a_damaged_photograph_is_taken_again(tmp_path: Path, whole: tuple[int, dict[str, str]]) -> None:
    store = tmp_path / "T.zarr"
    with pytest.raises(AcquisitionError):
        run(Unplugged(20), store)
    file = next(kept.place(store).glob("shot_*.npz"))
    file.write_bytes(file.read_bytes()[:-1] + b"\xff")
    rig = Unplugged()
    run(rig, store)
    assert 20 + rig.taken == whole[0] + 1


def test_photographs_that_cannot_be_used_stay_and_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Whatever ends a calibration; who has mended the set-up removes them."""
    store = tmp_path / "T.zarr"
    with pytest.raises(AcquisitionError) as error:
        run(VirtualRig(0 * TRUTH, GRID, bits=12, read=0, gain=None), store)
    assert "the rig failed" not in str(error.value)
    assert kept.count(store) > 0
    assert str(kept.place(store)) in caplog.text
    shutil.rmtree(kept.place(store))
    run(Unplugged(), store)


def test_one_of_another_kind_is_not_kept(tmp_path: Path) -> None:
    class Turned(Unplugged):
        def photograph(self, codes: Any, seconds: float) -> np.ndarray:
            image = super().photograph(codes, seconds)
            return image if self.taken < 10 else image[:-1]

    store = tmp_path / "T.zarr"
    with pytest.raises(AcquisitionError, match=r"photograph 10 is uint16 \(7, 8\)"):
        run(Turned(), store)
    assert kept.count(store) == 9
    run(Unplugged(), store)


def test_another_rig_is_refused(tmp_path: Path) -> None:
    store = tmp_path / "T.zarr"
    with pytest.raises(AcquisitionError):
        run(Unplugged(20), store)
    with pytest.raises(InputError, match=r"rig.bits is 8, but .*T.zarr.calibration was begun with 12"):
        run(Unplugged(bits=8), store)
    with pytest.raises(InputError, match=r"resume is False, but .*calibration holds 20 photographs"):
        run(Unplugged(), store, resume=False)
    assert kept.count(store) == 20


def test_other_settings_use_what_they_can(tmp_path: Path) -> None:
    store = tmp_path / "T.zarr"
    with pytest.raises(AcquisitionError):
        run(Unplugged(40), store, frames=3)
    rig, fresh = Unplugged(), Unplugged()
    run(rig, store, frames=4)
    run(fresh, tmp_path / "fresh.zarr", frames=4)
    assert contents(store) == contents(tmp_path / "fresh.zarr")
    assert rig.taken < fresh.taken - 25


def test_a_full_disk_loses_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, put, left = tmp_path / "T.zarr", ArrayLog.put, [16]  # the first file tells the rig

    def full(*given: Any, **arrays: Any) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise FileError("T.zarr.calibration/shot.npz: cannot be written: No space left on device")
        put(*given, **arrays)

    with monkeypatch.context() as patch:
        patch.setattr(ArrayLog, "put", full)
        with pytest.raises(FileError, match="No space left"):
            run(Unplugged(), store)
    assert kept.count(store) == 15
    run(Unplugged(), store)


def test_a_folder_keeps_its_own(tmp_path: Path) -> None:
    with pytest.raises(PhotographMissing):
        run(FolderRig(tmp_path / "rig", GRID), tmp_path / "T.zarr")
    assert not kept.place(tmp_path / "T.zarr").exists()


def test_without_a_store_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ArrayLog, "put", lambda *_, **__: pytest.fail("a photograph was kept"))
    with pytest.raises(AcquisitionError, match="photograph 21"):
        acquire(Unplugged(20), geometry="aligned", strategy="pixel")


def test_what_a_kill_behind_the_calibration_left_goes(
    tmp_path: Path, whole: tuple[int, dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    store = tmp_path / "T.zarr"
    with monkeypatch.context() as patch:
        patch.setattr(kept, "forget", lambda _: None)
        with pytest.raises(AcquisitionError):
            run(Unplugged(whole[0] - 10), store)
    assert kept.count(store) > 0
    run(Unplugged(), store)
    assert not kept.place(store).exists()
    assert contents(store) == whole[1]
