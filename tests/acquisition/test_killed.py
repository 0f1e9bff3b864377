# SPDX-License-Identifier: BSD-3-Clause
"""An acquisition that is killed at any moment loses no committed block, and going on gives the same store.

100 kills in all, in each stage of each way to scan: at a random photograph or call of the system that changes
the disk, before it, inside it, behind it, and from outside some time after it.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from ltcl.acquisition import kept
from ltcl.store import BlockStore

from .stopping import MADE, Moment, Nursery, Told

KILLS = 25  # of each strategy
LEAST = {"calibrating": 3, "scanning": 3, "storing": 3, "finalizing": 3}
_BEGUN = ("scanning", "storing", "finalizing")
_REACH = {
    "calibrating": 1.0,
    "scanning": 0.4,
    "storing": 0.3,
    "finalizing": 0.8,
}  # several kills an acquisition


class Whole(NamedTuple):
    """What an acquisition that nobody stops does and leaves."""

    told: Told
    files: dict[str, str]
    scanned: BlockStore  # a copy of it, before its blocks were turned or replaced

    def shots(self, number: int) -> list[str]:
        """Those of a batch."""
        first = self.told.blocks.get((0, number - 1), 0)
        return self.told.shots[first : self.told.blocks[0, number]]


@pytest.fixture(scope="module")
def nursery() -> Iterator[Nursery]:
    made = Nursery()
    yield made
    made.close()


def contents(path: Path) -> dict[str, str]:
    """SHA-256 of every file by its name."""
    files = [file for file in path.rglob("*") if file.is_file()]
    return {str(file.relative_to(path)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def whole(nursery: Nursery, folder: Path, strategy: str) -> Whole:
    path, scanned = folder / "whole.zarr", folder / "scanned.zarr"
    told = nursery.acquire(path, strategy, None, scanned)
    assert not told.killed
    return Whole(told, contents(path), BlockStore.open(scanned))


def draw(rng: np.random.Generator, begun: bool, events: dict[str, int], so_far: Mapping[str, int]) -> Moment:
    """A moment in one of the stages that are to come: that with the fewest kills so far."""
    stages = rng.permutation(_BEGUN if begun else ("calibrating", *_BEGUN)).tolist()
    stage = min(stages, key=lambda stage: so_far.get(stage, 0))
    how = str(rng.choice(["before", "inside", "behind", "outside"]))
    last = max(1, int(_REACH[stage] * events[stage]))
    return Moment(stage, int(rng.integers(1, last + 1)), how, float(rng.uniform(0, 0.02)))


def held(path: Path) -> tuple[bool, frozenset[tuple[int, int]]]:
    """Whether a scan in `path` is to be resumed, and the blocks that are committed."""
    if not path.exists():
        return False, frozenset()
    store = BlockStore.open(path)
    store.verify()
    return "strategy" in store.attributes, store.held("columns")


def same_blocks(path: Path, expected: BlockStore) -> None:
    store = BlockStore.open(path)
    if store.final:
        return
    for channel, block in store.held("columns"):
        found, wanted = (one.block(channel, block, "columns") for one in (store, expected))
        for part in ("data", "indices", "indptr"):
            np.testing.assert_array_equal(getattr(found.matrix, part), getattr(wanted.matrix, part))
        np.testing.assert_array_equal(found.variance, wanted.variance)


def still_to_take(expected: Whole, committed: frozenset[tuple[int, int]]) -> list[str]:
    """The photographs of the batches that are not committed in all channels, in order."""
    layout = expected.scanned.layout
    batches = sorted({number for _, number in expected.told.blocks})
    lacking = [n for n in batches if any((c, n) not in committed for c in range(layout.channels))]
    return [shot for number in lacking for shot in expected.shots(number)]


@pytest.mark.parametrize("strategy", MADE)
def test_killed_and_resumed(tmp_path: Path, nursery: Nursery, strategy: str) -> None:
    expected = whole(nursery, tmp_path, strategy)
    rng, stages, path = np.random.default_rng(len(strategy)), Counter[str](), tmp_path / "0.zarr"
    while stages.total() < KILLS:
        begun, committed = held(path)
        final = path.exists() and BlockStore.open(path).final
        calibrated = kept.count(path)
        told = nursery.acquire(path, strategy, draw(rng, begun, expected.told.events, stages))
        lacking = 0 if begun else expected.told.calibrated - calibrated
        assert told.calibrated <= lacking
        if told.stage != "calibrating":
            assert told.calibrated == lacking
        if not final:
            due = still_to_take(expected, committed)
            assert told.shots == due[: len(told.shots)]
        if told.killed:
            stages[told.stage] += 1
            began, after = held(path)
            assert began or kept.count(path) >= calibrated + told.kept
            if path.exists() and not BlockStore.open(path).final:
                assert committed | told.blocks.keys() <= after
                same_blocks(path, expected.scanned)
        else:
            assert contents(path) == expected.files
            assert not kept.place(path).exists()
            path = tmp_path / f"{stages.total()}.zarr"
    if path.exists():
        assert not nursery.acquire(path, strategy, None).killed
        assert contents(path) == expected.files
    assert all(stages[stage] >= least for stage, least in LEAST.items()), stages
