# SPDX-License-Identifier: BSD-3-Clause
"""A flipped bit in the store of an acquisition, done or not, is noticed by whoever reads it."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Calibration, Report
from ltcl.errors import AcquisitionError, FileError, LtclError
from ltcl.store import BlockStore

from .stopping import made

KINDS = ("pixel", "adaptive", "pixel, half done", "adaptive, half done")


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Stores of acquisitions that are done, and of such that were stopped in the middle of the scan."""
    paths = {}
    for kind in KINDS:
        strategy, _, half = kind.partition(", ")
        rig, given = made(strategy)
        paths[kind] = path = tmp_path_factory.mktemp("stores") / "T.zarr"
        if half:
            real, numbers = rig.photograph, iter(range(70))

            def photograph(
                codes: Any, seconds: float, real: Any = real, numbers: Any = numbers
            ) -> np.ndarray:
                next(numbers)  # at last StopIteration: what the rig's own library might raise
                return real(codes, seconds)

            rig.photograph = photograph
            with pytest.raises(AcquisitionError, match=r"photograph 71: .*StopIteration"):
                ltcl.acquire(rig, store=path, **given)
            assert BlockStore.open(path).written
        else:
            ltcl.acquire(rig, store=path, **given)
        assert BlockStore.open(path).final == (not half)
    return paths


def files(path: Path) -> list[Path]:
    """All of a store, in order."""
    return sorted(file for file in path.rglob("*") if file.is_file())


def flip(file: Path, random: np.random.Generator) -> bytes:
    """Flip one bit; returns what was there."""
    good = file.read_bytes()
    bad = bytearray(good)
    bad[int(random.integers(len(good)))] ^= 1 << int(random.integers(8))
    file.write_bytes(bad)
    return good


@pytest.mark.parametrize("kind", KINDS)
def test_any_flipped_bit_is_detected(stores: dict[str, Path], tmp_path: Path, kind: str) -> None:
    """Of each file once, by `verify`; of the transport by whoever loads it; of half a scan by who goes on."""
    path, random = Path(shutil.copytree(stores[kind], tmp_path / "T.zarr")), np.random.default_rng()
    for file in files(path):
        good = flip(file, random)
        with pytest.raises(FileError) as error:
            BlockStore.open(path).verify()
        assert str(error.value).startswith(str(path))
        assert "\n" not in str(error.value)
        file.write_bytes(good)
    BlockStore.open(path).verify()


@pytest.mark.parametrize("kind", ["pixel", "adaptive"])
def test_reports_and_calibrations_notice_damage(stores: dict[str, Path], tmp_path: Path, kind: str) -> None:
    path, random = Path(shutil.copytree(stores[kind], tmp_path / "T.zarr")), np.random.default_rng()
    for file in files(path):
        good = flip(file, random)
        with pytest.raises(FileError, match=r"T\.zarr"):
            Report.of(path)
        file.write_bytes(good)
    (name,) = [file for file in files(path) if "calibration.white.value" in str(file)][:1]
    flip(name, random)
    with pytest.raises(FileError, match=r"T\.zarr"):
        Calibration.of(path)


@pytest.mark.parametrize("kind", ["pixel, half done", "adaptive, half done"])
def test_half_a_scan_that_is_damaged_does_not_go_on(
    stores: dict[str, Path], tmp_path: Path, kind: str
) -> None:
    """No photograph stands for one that is damaged, and none is lost quietly."""
    random = np.random.default_rng()
    for number in range(6):
        path = Path(shutil.copytree(stores[kind], tmp_path / f"{number}.zarr"))
        flip(files(path)[int(random.integers(len(files(path))))], random)
        rig, given = made(kind.partition(",")[0])
        with pytest.raises(FileError, match=rf"{number}\.zarr"):
            ltcl.acquire(rig, store=path, **given)


@pytest.mark.parametrize(
    "state",
    [{"strategy": "spiral"}, {"strategy": ["pixel"]}, {"settings": 3}, {"settings": {}}, {"plan": 3}],
)
def test_a_state_that_makes_no_sense(stores: dict[str, Path], tmp_path: Path, state: dict[str, Any]) -> None:
    path = Path(shutil.copytree(stores["pixel, half done"], tmp_path / "T.zarr"))
    BlockStore.open(path, "a").update(**state)
    rig, given = made("pixel")
    with pytest.raises(LtclError, match=r"T\.zarr"):
        ltcl.acquire(rig, store=path, **given)
