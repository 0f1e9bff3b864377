# SPDX-License-Identifier: BSD-3-Clause
"""An acquisition that ends at any line of ltcl loses nothing committed; a flipped bit is noticed.

It ends by SIGKILL and by Ctrl-C. LTCL_KILLS=N in the environment takes N ends of each strategy.
"""

from __future__ import annotations

import os
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Calibration, Report
from ltcl.acquisition.session import calibration_photographs
from ltcl.errors import AcquisitionError, FileError, LtclError
from ltcl.store import BlockStore
from tests.store.stores import contents

from .stopping import acquire_and_end, set_up

pytestmark = pytest.mark.slow

random = np.random.default_rng()
KILLS = int(os.environ.get("LTCL_KILLS", "3"))
STATUS = {"SIGKILL": -signal.SIGKILL, "Ctrl-C": 2}
FINAL = ("pixel", "adaptive")
HALF = ("pixel, half done", "adaptive, half done")


def committed(path: Path) -> tuple[bool, bool, int]:
    """State of an acquisition: later states are larger.

    Whether the calibration and the transport are committed; the number of photographs of the one,
    or of batches of the other.
    """
    if path.exists():
        store = BlockStore.open(path)
        store.verify()
        if "strategy" in store.attributes:
            return True, store.final, 0 if store.final else len(store.written)
    return False, False, calibration_photographs(path)


@pytest.mark.rare
@pytest.mark.parametrize(
    "strategy",
    [
        "pixel",
        "adaptive",
        "sketch",
        "direct",
        pytest.param("hadamard", marks=pytest.mark.slow),
        pytest.param("block", marks=pytest.mark.slow),
    ],
)
def test_ended_and_resumed(tmp_path: Path, strategy: str) -> None:
    """Three ends each, so that all stages are met; then to the end."""
    whole = tmp_path / "whole" / "T.zarr"
    whole.parent.mkdir()
    _, photographs, lines = acquire_and_end(whole, strategy)
    batch = max(16, BlockStore.open(whole).layout.block_rows + 2)
    for number in range(-(-KILLS // 3)):
        path = tmp_path / str(number) / "T.zarr"
        path.parent.mkdir()
        total = 0
        before = (False, False, 0)
        for line in random.integers(1, lines, 3).tolist():
            end = str(random.choice(list(STATUS)))
            status, taken, _ = acquire_and_end(path, strategy, line, end)
            # A run that is resumed has fewer lines, and may come to its end.
            assert status in (STATUS[end], 0), (line, end)
            total += taken
            assert committed(path) >= before
            before = committed(path)
        status, taken, _ = acquire_and_end(path, strategy)
        assert status == 0
        assert photographs <= total + taken <= photographs + 3 * (batch + 1)
        assert contents(path) == contents(whole)
        assert os.listdir(path.parent) == ["T.zarr"]


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Stores of finished acquisitions, and of others that were stopped in the scan."""
    paths = {kind: tmp_path_factory.mktemp("stores") / "T.zarr" for kind in FINAL + HALF}
    for kind in FINAL:
        rig, settings = set_up(kind)
        ltcl.acquire(rig, store=paths[kind], **settings)
        half_done = paths[f"{kind}, half done"]
        rig, settings = set_up(kind, left=70)
        with pytest.raises(AcquisitionError, match="photograph 71: "):
            ltcl.acquire(rig, store=half_done, **settings)
        assert BlockStore.open(half_done).written
    return paths


def flip(file: Path) -> bytes:
    """Flip one bit; return the bytes before."""
    good = file.read_bytes()
    bad = bytearray(good)
    bad[int(random.integers(len(good)))] ^= 1 << int(random.integers(8))
    file.write_bytes(bad)
    return good


@pytest.mark.slow
@pytest.mark.parametrize("kind", FINAL + HALF)
def test_any_flipped_bit_is_detected(stores: dict[str, Path], tmp_path: Path, kind: str) -> None:
    """`verify` notices one bit of each file, so does a report, or a run that goes on."""
    path = Path(shutil.copytree(stores[kind], tmp_path / "T.zarr"))
    files = sorted(file for file in path.rglob("*") if file.is_file())
    for file in files:
        good = flip(file)
        with pytest.raises(FileError, match=rf"^{path}[^\n]*$"):
            BlockStore.open(path).verify()
        if kind in FINAL:
            with pytest.raises(FileError, match=r"T\.zarr"):
                Report.of(path)
        elif random.random() < 0.2 or file == files[-1]:
            rig, settings = set_up(kind.partition(",")[0])
            with pytest.raises(FileError, match=r"T\.zarr"):
                ltcl.acquire(rig, store=path, **settings)
        file.write_bytes(good)
    BlockStore.open(path).verify()
    flip(next(file for file in files if "calibration.white.value" in str(file)))
    with pytest.raises(FileError, match=r"T\.zarr"):
        Calibration.of(path)


@pytest.mark.parametrize(
    "state", [{"strategy": "spiral"}, {"strategy": ["pixel"]}, {"settings": 3}]
)
def test_a_state_that_makes_no_sense(
    stores: dict[str, Path], tmp_path: Path, state: dict[str, Any]
) -> None:
    path = Path(shutil.copytree(stores["pixel, half done"], tmp_path / "T.zarr"))
    BlockStore.open(path).update(**state)
    rig, settings = set_up("pixel")
    with pytest.raises(LtclError, match=r"T\.zarr"):
        ltcl.acquire(rig, store=path, **settings)
    with pytest.raises(FileError, match=r"T\.zarr"):
        ltcl.acquisition.finalize(path)
