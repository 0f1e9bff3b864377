# SPDX-License-Identifier: BSD-3-Clause
"""Photographs that are mixed up in a scan, through `acquire` as a whole.

They are named, and refused with their batch; those before stay; once they are put right, the acquisition goes
on to the bytes that it would have ended with.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from ltcl.acquisition import acquire
from ltcl.errors import AcquisitionError
from ltcl.store import BlockStore

from .stopping import made
from .test_killed import contents

STRATEGIES = {"pixel": (65, 130), "hadamard": (15, 30), "block": (19, 38), "adaptive": (4, 20)}
"""Patterns before the second batch, and behind it."""
WRONG: dict[str, Callable[[np.ndarray, int], np.ndarray]] = {
    "two exchanged": lambda order, start: np.concatenate(
        [order[: start + 1], order[[start + 2, start + 1]], order[start + 3 :]]
    ),
    "a batch reversed": lambda order, start: np.concatenate([order[:start], order[start:][::-1]]),
    "one late": lambda order, start: np.concatenate([order[:start], order[start - 1 : -1]]),
    "one lost": lambda order, start: np.concatenate([order[:start], order[start + 1 :], order[-1:]]),
    "one twice": lambda order, start: np.concatenate(
        [order[: start + 2], order[start + 1 : start + 2], order[start + 3 :]]
    ),
    "all reversed": lambda order, start: order[::-1],
}


class Whole(NamedTuple):
    """An acquisition in order: what it photographed, how much of that before the scan, what it left."""

    shots: list[tuple[np.ndarray, float]]
    calibrated: int
    files: dict[str, str]


def whole(strategy: str, path: Path, **more: Any) -> Whole:
    rig, given = made(strategy)
    shots: list[tuple[np.ndarray, float]] = []
    calibrated: list[int] = []
    real = rig.photograph

    def photograph(codes: Any, seconds: float) -> np.ndarray:
        shots.append((np.array(codes), seconds))
        return real(codes, seconds)

    rig.photograph = photograph
    acquire(rig, store=path, progress=lambda done, total: calibrated.append(len(shots)), **given | more)
    return Whole(shots, calibrated[0], contents(path))


def mixed_up(strategy: str, found: Whole, order: np.ndarray) -> Any:
    """The rig, of which photograph k of the scan is what is photograph ``order[k]`` of it in order."""
    rig, _ = made(strategy)
    real, to = rig.photograph, iter(range(len(found.shots)))

    def photograph(codes: Any, seconds: float) -> np.ndarray:
        k = next(to) - found.calibrated
        return real(*found.shots[found.calibrated + order[k]]) if k >= 0 else real(codes, seconds)

    rig.photograph = photograph
    return rig


@pytest.fixture(scope="module")
def wholes(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Whole]:
    kept: dict[str, Whole] = {}

    def get(strategy: str, **more: Any) -> Whole:
        key = f"{strategy} {more}"
        if key not in kept:
            kept[key] = whole(strategy, tmp_path_factory.mktemp("whole") / "T.zarr", **more)
        return kept[key]

    return get


FEW = ("adaptive", "one twice")  # where few pixels are lit, which may be mirrors: that is logged at most


@pytest.mark.parametrize(("strategy", "wrong"), [case for case in product(STRATEGIES, WRONG) if case != FEW])
def test_refused_and_put_right(
    tmp_path: Path, wholes: Callable[..., Whole], strategy: str, wrong: str
) -> None:
    """In the second batch, but where all are."""
    found, (start, stop) = wholes(strategy), STRATEGIES[strategy]
    count = len(found.shots) - found.calibrated
    order = WRONG[wrong](np.arange(count), start)
    path, given = tmp_path / "T.zarr", made(strategy)[1]
    with pytest.raises(
        AcquisitionError, match=r"^photographs? \d+ shows? .* order of their patterns"
    ) as told:
        acquire(mixed_up(strategy, found, order), store=path, **given)
    batches = {batch for _, batch in BlockStore.open(path).written}
    first = int(np.flatnonzero(order != np.arange(count))[0])
    assert batches == (set() if first < start else {0})
    named = int(str(told.value).split()[1]) - found.calibrated - 1
    assert first <= named < (start if first < start else stop)
    acquire(made(strategy)[0], store=path, **given)
    assert contents(path) == found.files


MIXED: dict[str, Callable[[np.ndarray, int], np.ndarray]] = {
    "one late": WRONG["one late"],
    "one lost": WRONG["one lost"],
    "short ones exchanged": lambda order, start: swapped(order, start, start + 3),
    "long ones exchanged": lambda order, start: swapped(order, start + 2, start + 5),
}


def swapped(order: np.ndarray, a: int, b: int) -> np.ndarray:
    found = order.copy()
    found[[a, b]] = found[[b, a]]
    return found


@pytest.mark.parametrize("wrong", MIXED)
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_one_photograph_of_three_of_a_pattern(
    tmp_path: Path, wholes: Callable[..., Whole], strategy: str, wrong: str
) -> None:
    """Exposures then are of several patterns."""
    more: dict[str, Any] = {"exposures": [0.5, 0.5, 8.0]}
    found, start = wholes(strategy, **more), 3 * STRATEGIES[strategy][0]
    order = MIXED[wrong](np.arange(len(found.shots) - found.calibrated), start)
    path, given = tmp_path / "T.zarr", made(strategy)[1] | more
    first = found.calibrated + start
    text = rf"^photographs {first + 1} to {first + 3}: (light does not rise|images\[2\] has 8 s and is not)"
    with pytest.raises(AcquisitionError, match=text):
        acquire(mixed_up(strategy, found, order), store=path, **given)
    assert {batch for _, batch in BlockStore.open(path).written} == {0}
    acquire(made(strategy)[0], store=path, **given)
    assert contents(path) == found.files
