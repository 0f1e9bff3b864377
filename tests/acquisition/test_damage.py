# SPDX-License-Identifier: BSD-3-Clause
"""A flipped byte anywhere in the store of an acquisition, done or not, is noticed; no header is believed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Calibration, Report, VirtualRig
from ltcl.errors import AcquisitionError, FileError
from ltcl.store import BlockStore
from ltcl.store.blocks import sealed

from .stopping import made

KINDS = ("pixel", "adaptive", "pixel, half done", "adaptive, half done")


class Unplugged(Exception):
    """What the rig's own library might raise."""


def unplugged_at(rig: VirtualRig, number: int) -> VirtualRig:
    """The same rig, which fails at one photograph."""
    real, left = rig.photograph, iter(range(1, number + 1))

    def photograph(codes: Any, seconds: float) -> np.ndarray:
        if next(left) == number:
            raise Unplugged("no such device")
        return real(codes, seconds)

    rig.photograph = photograph
    return rig


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Stores of acquisitions that are done, and of such that were stopped in the middle of the scan."""
    found = {}
    for kind in KINDS:
        strategy, _, half = kind.partition(", ")
        rig, given = made(strategy)
        found[kind] = path = tmp_path_factory.mktemp("stores") / "T.zarr"
        if half:
            with pytest.raises(AcquisitionError, match=r"photograph 1\d\d: .*Unplugged: no such device"):
                ltcl.acquire(unplugged_at(rig, 188 if strategy == "pixel" else 148), store=path, **given)
            assert BlockStore.open(path).written
        else:
            ltcl.acquire(rig, store=path, **given)
        assert BlockStore.open(path).final == (not half)
    return found


def flipped(path: Path, more: int, rng: np.random.Generator) -> Iterator[Path]:
    """Each file once, then `more` bytes anywhere: flip one bit, yield its file, put it right again."""
    files = sorted(file for file in path.rglob("*") if file.is_file())
    sizes = np.array([file.stat().st_size for file in files], np.float64)
    assert sizes.min() > 0
    for number in [*range(len(files)), *rng.choice(len(files), more, p=sizes / sizes.sum())]:
        good = files[number].read_bytes()
        bad = bytearray(good)
        bad[int(rng.integers(len(good)))] ^= 1 << int(rng.integers(8))
        files[number].write_bytes(bad)
        yield files[number]
        files[number].write_bytes(good)


@pytest.mark.parametrize("kind", KINDS)
def test_any_flipped_byte_is_detected(stores: dict[str, Path], tmp_path: Path, kind: str) -> None:
    path = Path(shutil.copytree(stores[kind], tmp_path / "T.zarr"))
    for file in flipped(path, 60, np.random.default_rng(KINDS.index(kind))):
        with pytest.raises(FileError) as error:
            BlockStore.open(path).verify()
        assert str(error.value).startswith(f"{path}: ")
        assert "\n" not in str(error.value)
        assert str(file.relative_to(path).parts[0]) in str(error.value)
    BlockStore.open(path).verify()


@pytest.mark.parametrize("kind", ["pixel", "adaptive"])
def test_info_and_reports_notice_damage_anywhere(stores: dict[str, Path], kind: str) -> None:
    for _ in flipped(stores[kind], 0, np.random.default_rng(4)):
        with pytest.raises(FileError):
            Report.of(stores[kind])
    assert Report.of(stores[kind]).strategy == kind


@pytest.mark.parametrize("kind", ["pixel", "adaptive"])
def test_damage_to_the_transport_is_noticed_when_it_is_loaded(
    stores: dict[str, Path], tmp_path: Path, kind: str
) -> None:
    """Without being asked; of the calibration and of variances when these are."""
    path = Path(shutil.copytree(stores[kind], tmp_path / "T.zarr"))
    noticed = 0
    for file in flipped(path, 0, np.random.default_rng(5)):
        name = file.relative_to(path).as_posix()
        if name.startswith("extra/calibration."):
            with pytest.raises(FileError, match=r"T\.zarr: "):
                Calibration.of(path)
        elif name.startswith(("channel_", "extra/first", "extra/system", "extra/grid", "zarr.json")):
            noticed += "variance" not in name
            with pytest.raises(FileError, match=r"T\.zarr: "):
                ltcl.load(path, on_dark="mask")
    assert noticed > 10


@pytest.mark.parametrize("kind", ["pixel, half done", "adaptive, half done"])
def test_damage_to_half_a_scan_is_noticed_when_it_goes_on(
    stores: dict[str, Path], tmp_path: Path, kind: str
) -> None:
    """What was committed and is read again is checked; no photograph stands for one that is damaged."""
    files = sorted(str(file.relative_to(stores[kind])) for file in stores[kind].rglob("*") if file.is_file())
    rng = np.random.default_rng(3)
    blocks = [name for name in files if name.startswith("columns_0/block")]
    others = [name for name in files if "calibration" in name]
    chosen = [*rng.choice(blocks, 4, replace=False), *rng.choice(others, 3), "zarr.json"]
    for number, name in enumerate(chosen):
        path = Path(shutil.copytree(stores[kind], tmp_path / f"{number}.zarr"))
        raw = bytearray((path / name).read_bytes())
        raw[int(rng.integers(len(raw)))] ^= 4
        (path / name).write_bytes(raw)
        rig, given = made(kind.partition(",")[0])
        with pytest.raises(FileError, match=rf"{number}\.zarr: .*"):
            ltcl.acquire(rig, store=path, **given)


def test_loading_reads_the_transport_and_no_more(
    stores: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a compressed one neither the calibration, which may be large, nor the variances."""
    real, asked = BlockStore.extra, []
    monkeypatch.setattr(BlockStore, "extra", lambda store, name: asked.append(name) or real(store, name))
    ltcl.load(stores["adaptive"])
    assert {"grid", "first_bounce", "system_0.R.core.data"} <= set(asked)
    assert not [name for name in asked if name.startswith(("calibration.", "core_variance"))]
    assert {"core_variance_0", "calibration.white.value"} <= set(BlockStore.open(stores["adaptive"]).extras)


def test_a_compressed_store_that_names_no_arrays(stores: dict[str, Path], tmp_path: Path) -> None:
    path = Path(shutil.copytree(stores["adaptive"], tmp_path / "T.zarr"))
    good = (path / "zarr.json").read_bytes()
    for change, text in (
        ({"arrays": None}, "without its texts and the names of its arrays"),
        ({"arrays": ["grid", 3]}, "name is 3"),
        ({"arrays": ["../grid"]}, r"name is '\.\./grid'"),
        ({"arrays": ["grid"]}, "a compressed transport has the array 'first_bounce', which is missing"),
        ({"arrays": ["nothing"]}, "extra/nothing is missing"),
    ):
        forge(path / "zarr.json", lambda told, change=change: told["state"].update(change))
        with pytest.raises(FileError, match=text):
            ltcl.load(path)
        (path / "zarr.json").write_bytes(good)


def forge(file: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change a document and seal it again, as an enemy could."""
    document = json.loads(file.read_bytes())
    attributes = document.pop("attributes")
    del attributes["checksum"]
    change(attributes)
    file.write_bytes(sealed.seal(attributes, document))


def readers(path: Path, strategy: str) -> list[Callable[[], Any]]:
    rig, given = made(strategy)
    return [
        lambda: ltcl.acquire(rig, store=path, **given),
        lambda: Calibration.of(path),
        lambda: Report.of(path),
        lambda: BlockStore.open(path).verify(),
    ]


@pytest.mark.parametrize("shape", [[1 << 40], [1 << 62], [3, -1], "many", None])
def test_a_calibration_that_declares_terabytes(stores: dict[str, Path], tmp_path: Path, shape: Any) -> None:
    """Nothing is allocated for it: what is declared must be what is there."""
    path = Path(shutil.copytree(stores["pixel, half done"], tmp_path / "T.zarr"))
    for name in ("exposures", "resampling.data", "white.value"):
        file = path / "extra" / f"calibration.{name}.0" / "zarr.json"
        good = file.read_bytes()
        forge(file, lambda told: told["arrays"]["array"].update(shape=shape))
        acquire, calibration, _, verify = readers(path, "pixel")
        for read in (acquire, calibration, verify):
            with pytest.raises(FileError, match=rf"T\.zarr: .*calibration\.{name}\.0"):
                read()
        file.write_bytes(good)


def test_a_store_that_declares_terabytes(stores: dict[str, Path], tmp_path: Path) -> None:
    path = Path(shutil.copytree(stores["pixel, half done"], tmp_path / "T.zarr"))
    huge = (1 << 31) - 1
    for change in (
        {"shape": [huge, huge], "grid": [1, huge]},
        {"shape": [1 << 50, 1 << 50]},
        {"channels": 10**12},
    ):
        file = path / "zarr.json"
        good = file.read_bytes()
        forge(file, lambda told, change=change: told["ltcl"].update(change))
        rig, given = made("pixel")
        with pytest.raises(ltcl.errors.LtclError, match=r"T\.zarr"):
            ltcl.acquire(rig, store=path, **given)
        file.write_bytes(good)


@pytest.mark.parametrize("kind", KINDS)
def test_a_store_of_a_later_version(stores: dict[str, Path], tmp_path: Path, kind: str) -> None:
    path = Path(shutil.copytree(stores[kind], tmp_path / "T.zarr"))
    forge(path / "zarr.json", lambda told: told["ltcl"].update(schema=2))
    for read in [*readers(path, kind.partition(",")[0]), lambda: ltcl.load(path)]:
        with pytest.raises(FileError, match=r"T\.zarr: zarr\.json is of schema 2; this ltcl reads schema 1"):
            read()


@pytest.mark.parametrize(
    "state",
    [
        {},
        {"strategy": "spiral"},
        {"strategy": ["pixel"]},
        {"strategy": "adaptive"},
        {"settings": 3},
        {"settings": {}},
        {"plan": 3},
        {"settings": None},
    ],
)
def test_a_state_that_makes_no_sense(stores: dict[str, Path], tmp_path: Path, state: dict[str, Any]) -> None:
    """Sealed right, so that only its meaning is wrong."""
    path = Path(shutil.copytree(stores["pixel, half done"], tmp_path / "T.zarr"))
    forge(path / "zarr.json", lambda told: told["state"].update(state) if state else told.update(state=7))
    rig, given = made("pixel")
    with pytest.raises(ltcl.errors.LtclError, match=r"T\.zarr"):
        ltcl.acquire(rig, store=path, **given)
