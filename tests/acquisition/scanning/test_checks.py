# SPDX-License-Identifier: BSD-3-Clause
"""Photographs that are mixed up in a scan are refused with their batch, and named; then the scan goes on.

Each pattern is photographed at three exposures, or at one, where pictures are compared with their patterns.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from ltcl.acquisition import acquire
from ltcl.errors import AcquisitionError
from ltcl.store import BlockStore

from ..stopping import made
from ..test_killed import contents

BATCH = {"pixel": (25, 25), "hadamard": (15, 15), "block": (9, 9), "adaptive": (4, 16)}
"""Patterns of the first batch, and of the second."""


class Whole(NamedTuple):
    """An acquisition in order: what it photographed, how much of that before the scan, what it left."""

    shots: list[tuple[np.ndarray, float]]
    calibrated: int
    files: dict[str, str]


@pytest.fixture(scope="session")
def wholes(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Whole]:
    done: dict[str, Whole] = {}

    def get(strategy: str, **more: Any) -> Whole:
        key = f"{strategy} {more}"
        if key not in done:
            rig, given = made(strategy)
            path, real = tmp_path_factory.mktemp("whole") / "T.zarr", rig.photograph
            shots: list[tuple[np.ndarray, float]] = []
            calibrated: list[int] = []

            def photograph(codes: Any, seconds: float) -> np.ndarray:
                shots.append((np.array(codes), seconds))
                return real(codes, seconds)

            def progress(step: str, count: int, total: int) -> None:
                if step == "scan":
                    calibrated.append(len(shots))

            rig.photograph = photograph
            acquire(rig, store=path, progress=progress, **given | more)
            done[key] = Whole(shots, calibrated[0], contents(path))
        return done[key]

    return get


def mixed_up(strategy: str, whole: Whole, order: np.ndarray) -> Any:
    """The rig, of which photograph k of the scan is what is photograph ``order[k]`` of it in order."""
    rig, _ = made(strategy)
    real, numbers = rig.photograph, iter(range(len(whole.shots)))

    def photograph(codes: Any, seconds: float) -> np.ndarray:
        k = next(numbers) - whole.calibrated
        return real(*whole.shots[whole.calibrated + order[k]]) if k >= 0 else real(codes, seconds)

    rig.photograph = photograph
    return rig


def swapped(order: np.ndarray, a: int, b: int) -> np.ndarray:
    result = order.copy()
    result[[a, b]] = result[[b, a]]
    return result


WRONG: dict[str, Callable[[np.ndarray, int, int], np.ndarray]] = {
    "two exchanged": lambda order, start, n: swapped(order, start + n, start + 2 * n),
    "one late": lambda order, start, n: np.concatenate([order[:start], order[start - 1 : -1]]),
    "one lost": lambda order, start, n: np.concatenate([order[:start], order[start + 1 :], order[-1:]]),
    "one twice": lambda order, start, n: np.where(order == start + 2 * n, start + n, order),
    "reversed": lambda order, start, n: np.concatenate([order[:start], order[start:][::-1]]),
}


@pytest.mark.parametrize("exposures", [[0.5], [0.5, 2.0, 8.0]], ids=["one exposure", "three"])
@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("strategy", BATCH)
def test_refused_and_put_right(
    tmp_path: Path, wholes: Callable[..., Whole], strategy: str, wrong: str, exposures: list[float]
) -> None:
    """In the second batch; the first one stays, and behind it the scan ends as if nothing had been."""
    more = {"exposures": exposures}
    whole, n = wholes(strategy, **more), len(exposures)
    first, second = BATCH[strategy]
    start = first * n + 1  # behind the pattern of blocks
    order = WRONG[wrong](np.arange(len(whole.shots) - whole.calibrated), start, n)
    path = tmp_path / "T.zarr"
    given: dict[str, Any] = made(strategy)[1] | more
    with pytest.raises(AcquisitionError, match="photograph") as raised:
        acquire(mixed_up(strategy, whole, order), store=path, **given)
    assert {batch for _, batch in BlockStore.open(path).written} == {0}
    numbers = [
        int(number) - whole.calibrated - 1 for number in re.findall(r"photographs? (\d+)", str(raised.value))
    ]
    assert start <= min(numbers) <= start + second * n
    acquire(made(strategy)[0], store=path, **given)
    assert contents(path) == whole.files
