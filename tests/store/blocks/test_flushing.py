# SPDX-License-Identifier: BSD-3-Clause
"""What a power cut asks for: all is flushed before the rename that commits it, and so is the rename."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from .helpers import make, part, transport


def test_everything_is_flushed_before_it_is_renamed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = make(tmp_path / "T.zarr")
    flushed: list[int] = []
    renames: list[tuple[Path, set[int]]] = []
    monkeypatch.setattr(os, "fsync", lambda handle: flushed.append(os.fstat(handle).st_ino))
    real = os.rename

    def rename(source: Any, target: Any, **options: Any) -> None:
        inside = {path.stat().st_ino for path in [Path(source), *Path(source).rglob("*")]}
        renames.append((Path(target), inside - set(flushed)))
        real(source, target, **options)

    monkeypatch.setattr(os, "rename", rename)
    store.write(0, 1, part(store, transport(), 1))
    ((place, unflushed),) = [(target, left) for target, left in renames if "channel_0" in str(target)]
    assert place == tmp_path / "T.zarr" / "channel_0" / "block_000001.0"
    assert unflushed == set()
    assert flushed[-1] == place.parent.stat().st_ino


def test_documents_are_flushed_before_they_are_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = make(tmp_path / "T.zarr")
    events: list[str] = []
    monkeypatch.setattr(os, "fsync", lambda handle: events.append(str(os.fstat(handle).st_ino)))
    real = os.replace

    def replace(source: Any, target: Any) -> None:
        events.append(f"replaced by {os.stat(source).st_ino}")
        real(source, target)

    monkeypatch.setattr(os, "replace", replace)
    store.update(step=1)
    document = (tmp_path / "T.zarr" / "zarr.json").stat().st_ino
    assert events == [str(document), f"replaced by {document}", str((tmp_path / "T.zarr").stat().st_ino)]
