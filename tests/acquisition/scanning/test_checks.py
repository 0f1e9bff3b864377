# SPDX-License-Identifier: BSD-3-Clause
"""Photographs that are mixed up in a scan are refused with their batch, and named; then the scan goes on.

Each pattern is photographed at three exposures, or at one, where pictures are compared with their patterns.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import acquire, camera_map
from ltcl.errors import AcquisitionError
from ltcl.store import BlockStore
from tests.store.stores import contents

from ..stopping import Unplugged, made
from .helpers import corner

BATCH = {"pixel": (25, 25), "hadamard": (15, 15), "block": (9, 9), "adaptive": (4, 16)}
"""Patterns of the first batch, and of the second."""


Shots = list[tuple[np.ndarray, float]]
Wholes = Callable[[str, tuple[float, ...]], tuple[Shots, int, dict[str, str]]]


@pytest.fixture(scope="session")
def wholes(tmp_path_factory: pytest.TempPathFactory) -> Wholes:
    """Acquisitions in order: their photographs, how many of them before the scan, the files that are left."""

    @cache
    def acquired(strategy: str, exposures: tuple[float, ...]) -> tuple[Shots, int, dict[str, str]]:
        (rig, settings), shots, calibrated = made(strategy), [], []
        path, real = tmp_path_factory.mktemp("whole") / "T.zarr", rig.photograph

        def photograph(codes: Any, seconds: float) -> np.ndarray:
            shots.append((np.array(codes), seconds))
            return real(codes, seconds)

        def progress(step: str, done: int, total: int) -> None:
            if step == "scan":
                calibrated.append(rig.count)

        rig.photograph = photograph
        options: dict[str, Any] = settings | {"exposures": exposures}
        acquire(rig, store=path, progress=progress, **options)
        return shots, calibrated[0], contents(path)

    return acquired


def mixed_up(strategy: str, shots: Shots, calibrated: int, order: np.ndarray) -> Any:
    """The rig, of which photograph k of the scan is what is photograph ``order[k]`` of it in order."""
    rig, _ = made(strategy)
    real = rig.photograph

    def photograph(codes: Any, seconds: float) -> np.ndarray:
        k = rig.count - calibrated
        return real(*shots[calibrated + order[k]]) if k >= 0 else real(codes, seconds)

    rig.photograph = photograph
    return rig


def exchanged(order: np.ndarray, a: int, b: int) -> np.ndarray:
    return np.where(order == a, b, np.where(order == b, a, order))


WRONG: dict[str, Callable[[np.ndarray, int, int], np.ndarray]] = {
    "exchanged": lambda order, start, n: exchanged(order, start + n, start + 2 * n),
    "late": lambda order, start, n: np.concatenate([order[:start], order[start - 1 : -1]]),
    "missing": lambda order, start, n: np.concatenate([order[:start], order[start + 1 :], order[-1:]]),
    "repeated": lambda order, start, n: np.where(order == start + 2 * n, start + n, order),
    "reversed": lambda order, start, n: np.concatenate([order[:start], order[start:][::-1]]),
}


@pytest.mark.parametrize("exposures", [(0.5,), (0.5, 2.0, 8.0)], ids=["one exposure", "three"])
@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("strategy", BATCH)
def test_refused_and_put_right(
    tmp_path: Path, wholes: Wholes, strategy: str, wrong: str, exposures: tuple[float, ...]
) -> None:
    """In the second batch; the first one stays, and behind it the scan ends as if nothing had been."""
    (shots, calibrated, files), n = wholes(strategy, exposures), len(exposures)
    first, second = BATCH[strategy]
    start = first * n + 1  # behind the pattern of blocks
    order = WRONG[wrong](np.arange(len(shots) - calibrated), start, n)
    path = tmp_path / "T.zarr"
    settings: dict[str, Any] = made(strategy)[1] | {"exposures": exposures}
    with pytest.raises(AcquisitionError, match="photograph") as error:
        acquire(mixed_up(strategy, shots, calibrated, order), store=path, **settings)
    assert {batch for _, batch in BlockStore.open(path).written} == {0}
    numbers = map(int, re.findall(r"photographs? (\d+)", str(error.value)))
    assert start <= min(numbers) - calibrated - 1 <= start + second * n
    if n > 1 and wrong in ("exchanged", "missing"):
        assert wrong in str(error.value)
    acquire(made(strategy)[0], store=path, **settings)
    assert contents(path) == files


@pytest.mark.parametrize(("strategy", "after"), [("pixel", 9), ("hadamard", 9), ("adaptive", 10)])
def test_where_the_camera_moved(strategy: str, after: int) -> None:
    """By half a pixel between two patterns: photographs of each agree, and those of the blocks do not."""
    size, calibrated = (30, 56), []
    views = [camera_map(lambda u, v, x=x: ((u - x) / 3, (v - 3) / 3), size, (8, 16)) for x in (4.0, 4.5)]
    first, moved = (Unplugged(corner(), (8, 16), camera_grid=size, camera_map=view) for view in views)
    real = first.photograph

    def photograph(codes: Any, seconds: float) -> np.ndarray:
        image = real(codes, seconds)
        late = bool(calibrated) and first.count > calibrated[0] + after
        return moved.photograph(codes, seconds) if late else image

    def progress(step: str, done: int, total: int) -> None:
        if step == "scan":
            calibrated.append(first.count)

    first.photograph = photograph
    with pytest.raises(AcquisitionError, match=r"moved by 0\.[3-7]") as error:
        acquire(first, strategy=strategy, progress=progress)
    (start, stop), *_ = re.findall(r"photographs (\d+) to (\d+)", str(error.value))
    assert int(start) <= calibrated[0] + after + 1 <= int(stop) < int(start) + 6
