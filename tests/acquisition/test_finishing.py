# SPDX-License-Identifier: BSD-3-Clause
"""Transports of stores whose photographs are all there, without the rig."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Report, VirtualRig, acquire, finalize
from ltcl.errors import AcquisitionError, FileError
from ltcl.store import BlockStore

from .scanning.helpers import corner, dense, rig

GRID = (8, 16)


class Dying(VirtualRig):
    """Fails at one of its photographs."""

    def __init__(self, at: int) -> None:
        super().__init__(corner(), GRID, bits=12, ambient=0.01)
        self._left = at

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        self._left -= 1
        if self._left == 0:
            raise OSError("unplugged")
        return super().photograph(codes, seconds)


@pytest.mark.parametrize("strategy", ["pixel", "adaptive"])
def test_what_is_photographed_is_all_it_takes(
    tmp_path: Path, strategy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that ends between the last photograph and the transport, and one that was not stopped."""
    options: dict[str, Any] = {"geometry": "aligned", "strategy": strategy}
    whole = acquire(rig(), store=tmp_path / "whole.zarr", **options)
    path = tmp_path / "T.zarr"

    def ended(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(BlockStore, "finalize", ended)
        with pytest.raises(KeyboardInterrupt):
            acquire(rig(), store=path, **options)
    assert not BlockStore.open(path).final
    told: list[tuple[str, int, int]] = []
    finalize(path, lambda *n: told.append(n))
    np.testing.assert_array_equal(dense(ltcl.load(path, on_dark="mask")), dense(whole))
    assert Report.of(path).to_json() == Report.of(tmp_path / "whole.zarr").to_json()
    assert [done for _, done, _ in told] == sorted(done for _, done, _ in told)
    assert told
    finalize(path)


@pytest.mark.parametrize(
    ("strategy", "part"),
    [("pixel", "1 of 2 batches of patterns are not"), ("adaptive", "the next batch of patterns is not")],
)
def test_what_is_missing_is_told(tmp_path: Path, strategy: str, part: str) -> None:
    path = tmp_path / "T.zarr"
    with pytest.raises(AcquisitionError, match="unplugged"):
        acquire(Dying(400), geometry="aligned", strategy=strategy, store=path)
    before = BlockStore.open(path).written
    assert before
    with pytest.raises(AcquisitionError, match=part):
        finalize(path)
    assert BlockStore.open(path).written == before
    assert not BlockStore.open(path).final


def test_other_stores_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="no such folder"):
        finalize(tmp_path / "nowhere.zarr")
    ltcl.save(tmp_path / "T.zarr", ltcl.Transport(np.eye(4), (2, 2)))
    with pytest.raises(FileError, match=r"is not of ltcl\.acquire"):
        finalize(tmp_path / "T.zarr")
    BlockStore.create(tmp_path / "b.zarr", shape=(4, 4), grid=(2, 2), provenance={"acquisition": {}})
    with pytest.raises(FileError, match="holds no whole calibration"):
        finalize(tmp_path / "b.zarr")
