# SPDX-License-Identifier: BSD-3-Clause
"""Photographs that are mixed up in a scan are refused with their batch, and named.

Then the scan goes on. Each pattern is photographed at three exposures, or at one, where pictures
are compared with their patterns.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import acquire, camera_map
from ltcl.acquisition.scanning import pictures
from ltcl.errors import AcquisitionError
from ltcl.store import BlockStore
from tests.store.stores import contents

from ..stopping import Unplugged, set_up
from .helpers import corner

BATCHES = {
    "pixel": (25, 25),
    "hadamard": (15, 15),
    "block": (9, 9),
    "adaptive": (4, 16),
    "sketch": (16, 12),
    "direct": (16, 3),
}
"""Patterns of the first batch, and of the second."""
Shot = tuple[np.ndarray, float]


@dataclass(frozen=True, kw_only=True)
class CleanScan:
    """A scan with nothing wrong: its shots, those before the scan, and the files of its store."""

    shots: list[Shot]
    calibrated: int
    files: dict[str, str]


@cache
def clean_scan(folder: Path, strategy: str, exposures: tuple[float, ...]) -> CleanScan:
    """Scan once with a strategy at some exposures."""
    rig, settings = set_up(strategy)
    path = folder / f"{strategy}_{len(exposures)}.zarr"
    real = rig.photograph
    shots: list[Shot] = []
    counts: list[int] = []

    def photograph(codes: Any, seconds: float) -> np.ndarray:
        shots.append((np.array(codes), seconds))
        return real(codes, seconds)

    def progress(step: str, done: int, total: int) -> None:
        if step == "scan":
            counts.append(rig.count)

    rig.photograph = photograph
    settings["exposures"] = exposures
    acquire(rig, store=path, progress=progress, **settings)
    return CleanScan(shots=shots, calibrated=counts[0], files=contents(path))


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("clean")


def exchanged(order: np.ndarray, start: int, n: int) -> np.ndarray:
    changed = order.copy()
    changed[[start + n, start + 2 * n]] = order[[start + 2 * n, start + n]]
    return changed


def late(order: np.ndarray, start: int, n: int) -> np.ndarray:
    return np.concatenate([order[:start], order[start - 1 : -1]])


def missing(order: np.ndarray, start: int, n: int) -> np.ndarray:
    return np.concatenate([order[:start], order[start + 1 :], order[-1:]])


def repeated(order: np.ndarray, start: int, n: int) -> np.ndarray:
    changed = order.copy()
    changed[start + 2 * n] = order[start + n]
    return changed


@pytest.mark.slow
@pytest.mark.parametrize("exposures", [(0.5,), (0.5, 2.0, 8.0)], ids=["one exposure", "three"])
@pytest.mark.parametrize("change", [exchanged, late, missing, repeated])
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
def test_refused_and_put_right(
    tmp_path: Path,
    folder: Path,
    strategy: str,
    change: Callable[[np.ndarray, int, int], np.ndarray],
    exposures: tuple[float, ...],
) -> None:
    assert_refused_and_put_right(tmp_path, folder, strategy, change, exposures)


def assert_refused_and_put_right(
    tmp_path: Path,
    folder: Path,
    strategy: str,
    change: Callable[[np.ndarray, int, int], np.ndarray],
    exposures: tuple[float, ...],
) -> None:
    """The second batch is wrong; the first one stays, and then the scan ends as the clean one.

    A change is of the order of a scan's photographs, n of each pattern, from `start` on.
    """
    clean = clean_scan(folder, strategy, exposures)
    path = tmp_path / "T.zarr"
    n = len(exposures)
    first, second = BATCHES[strategy]
    start = first * n + 1  # after the pattern of blocks
    order = change(np.arange(len(clean.shots) - clean.calibrated), start, n)
    rig, settings = set_up(strategy)
    settings = {**settings, "store": path, "exposures": exposures}
    real = rig.photograph

    def photograph(codes: Any, seconds: float) -> np.ndarray:
        k = rig.count - clean.calibrated
        if k < 0:
            return real(codes, seconds)
        return real(*clean.shots[clean.calibrated + order[k]])

    rig.photograph = photograph
    with pytest.raises(AcquisitionError, match="photograph") as error:
        acquire(rig, **settings)
    assert {batch for _, batch in BlockStore.open(path).written} == {0}
    named = [int(number) for number in re.findall(r"photographs? (\d+)", str(error.value))]
    assert start <= min(named) - clean.calibrated - 1 <= start + second * n
    if n > 1 and change in (exchanged, missing):
        assert change.__name__ in str(error.value)
    acquire(set_up(strategy)[0], **settings)
    assert contents(path) == clean.files


@pytest.mark.slow
def test_pictures_of_many_pixels_are_compared_at_some_of_them(
    tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures, "MAX_COMPARED_PIXELS", 60)
    assert_refused_and_put_right(tmp_path, folder, "sketch", exchanged, (0.5,))


def oblique_rig(shift: float) -> Unplugged:
    """A rig whose camera stands at a place, in its pixels."""
    size = (30, 56)
    view = camera_map(lambda u, v: ((u - shift) / 3, (v - 3) / 3), size, (8, 16))
    return Unplugged(corner(), (8, 16), camera_grid=size, camera_map=view)


@pytest.mark.slow
@pytest.mark.parametrize(("strategy", "after"), [("pixel", 9), ("hadamard", 9), ("adaptive", 10)])
@pytest.mark.parametrize(("shift", "length"), [(0.5, r"0\.[3-7]"), (2.0, r"[12](\.\d)? ")])
def test_a_camera_that_moved(strategy: str, after: int, shift: float, length: str) -> None:
    """It moves between patterns: each agrees by itself, or shows more of another; blocks do not."""
    rig = oblique_rig(4.0)
    moved = oblique_rig(4.0 + shift)
    real = rig.photograph
    starts: list[int] = []

    def photograph(codes: Any, seconds: float) -> np.ndarray:
        is_moved = bool(starts) and rig.count >= starts[0] + after
        return moved.photograph(codes, seconds) if is_moved else real(codes, seconds)

    def progress(step: str, done: int, total: int) -> None:
        if step == "scan":
            starts.append(rig.count)

    rig.photograph = photograph
    with pytest.raises(AcquisitionError, match=f"moved by {length}") as error:
        acquire(rig, strategy=strategy, progress=progress)
    [(start, stop), *_] = re.findall(r"photographs (\d+) to (\d+)", str(error.value))
    assert int(start) <= starts[0] + after + 1 <= int(stop) < int(start) + 6
