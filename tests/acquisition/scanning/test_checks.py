# SPDX-License-Identifier: BSD-3-Clause
"""Photographs that are mixed up in a scan are refused with their batch, and named; then the scan goes on.

Each pattern is photographed at three exposures, or at one, where pictures are compared with their
patterns.
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

from ..stopping import Unplugged, set_up
from .helpers import corner

BATCH = {"pixel": (25, 25), "hadamard": (15, 15), "block": (9, 9), "adaptive": (4, 16)}
"""Patterns of the first batch, and of the second."""


@pytest.fixture(scope="session")
def in_order(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Photographs of a scan with nothing wrong: shots, how many before the scan, the files that are left."""

    @cache
    def acquired(
        strategy: str, exposures: tuple[float, ...]
    ) -> tuple[list[Any], int, dict[str, str]]:
        (rig, settings), shots, counts = set_up(strategy), [], []
        path, real = tmp_path_factory.mktemp("whole") / "T.zarr", rig.photograph

        def photograph(codes: Any, seconds: float) -> np.ndarray:
            shots.append((np.array(codes), seconds))
            return real(codes, seconds)

        rig.photograph = photograph
        settings |= {
            "exposures": exposures,
            "progress": lambda *step: counts.append((rig.count, *step)),
        }
        acquire(rig, store=path, **settings)
        return shots, next(count for count, step, *_ in counts if step == "scan"), contents(path)

    return acquired


WRONG: dict[str, Callable[[np.ndarray, int, int], np.ndarray]] = {
    "exchanged": lambda order, start, n: np.where(
        np.isin(order, (start + n, start + 2 * n)), 2 * start + 3 * n - order, order
    ),
    "late": lambda order, start, n: np.concatenate([order[:start], order[start - 1 : -1]]),
    "missing": lambda order, start, n: np.concatenate(
        [order[:start], order[start + 1 :], order[-1:]]
    ),
    "repeated": lambda order, start, n: np.where(order == start + 2 * n, start + n, order),
}
"""Which photograph of a scan is taken in place of each; n are of a pattern, from `start` on of batch 1."""


@pytest.mark.parametrize("exposures", [(0.5,), (0.5, 2.0, 8.0)], ids=["one exposure", "three"])
@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("strategy", BATCH)
def test_refused_and_put_right(
    tmp_path: Path, in_order: Any, strategy: str, wrong: str, exposures: tuple[float, ...]
) -> None:
    """In the second batch; the first one stays, and then the scan ends as if nothing had been."""
    (shots, calibrated, files), n, path = (
        in_order(strategy, exposures),
        len(exposures),
        tmp_path / "T.zarr",
    )
    first, second = BATCH[strategy]
    start = first * n + 1  # after the pattern of blocks
    order = WRONG[wrong](np.arange(len(shots) - calibrated), start, n)
    rig, settings = set_up(strategy)
    settings, real = {**settings, "store": path, "exposures": exposures}, rig.photograph

    def photograph(codes: Any, seconds: float) -> np.ndarray:
        k = rig.count - calibrated
        return real(*shots[calibrated + order[k]]) if k >= 0 else real(codes, seconds)

    rig.photograph = photograph
    with pytest.raises(AcquisitionError, match="photograph") as error:
        acquire(rig, **settings)
    assert {batch for _, batch in BlockStore.open(path).written} == {0}
    numbers = map(int, re.findall(r"photographs? (\d+)", str(error.value)))
    assert start <= min(numbers) - calibrated - 1 <= start + second * n
    if n > 1 and wrong in ("exchanged", "missing"):
        assert wrong in str(error.value)
    acquire(set_up(strategy)[0], **settings)
    assert contents(path) == files


@pytest.mark.parametrize(("strategy", "after"), [("pixel", 9), ("hadamard", 9), ("adaptive", 10)])
def test_where_the_camera_moved(strategy: str, after: int) -> None:
    """By half a pixel between two patterns: photographs of each agree, and those of the blocks do not."""
    views = [
        camera_map(lambda u, v, x=x: ((u - x) / 3, (v - 3) / 3), (30, 56), (8, 16))
        for x in (4, 4.5)
    ]
    first, moved = (
        Unplugged(corner(), (8, 16), camera_grid=(30, 56), camera_map=view) for view in views
    )
    real, starts = first.photograph, []

    def photograph(codes: Any, seconds: float) -> np.ndarray:
        is_moved = bool(starts) and first.count >= starts[0] + after
        return moved.photograph(codes, seconds) if is_moved else real(codes, seconds)

    def progress(step: str, done: int, total: int) -> None:
        starts.extend([first.count] * (step == "scan"))

    first.photograph = photograph
    with pytest.raises(AcquisitionError, match=r"moved by 0\.[3-7]") as error:
        acquire(first, strategy=strategy, progress=progress)
    (start, stop), *_ = re.findall(r"photographs (\d+) to (\d+)", str(error.value))
    assert int(start) <= starts[0] + after + 1 <= int(stop) < int(start) + 6
