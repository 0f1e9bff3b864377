# SPDX-License-Identifier: BSD-3-Clause
"""A process killed at any moment loses nothing that was committed, and going on gives the same store.

Children are forked and kill themselves before or inside a random call of the system that changes the disk, or
are killed from outside at a random time; both without a chance to clean up. 100 times and more in all.
"""

from __future__ import annotations

import hashlib
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ltcl.errors import FileError
from ltcl.store import BlockStore
from ltcl.store.blocks import aside

from .helpers import fill, make, part, transport, variance

_CALLS = ("write", "mkdir", "rename", "replace", "open", "rmdir", "unlink", "fsync", "close")
_SIZE: dict[str, Any] = {"shape": (12, 12), "camera_grid": None, "block_rows": 5, "channels": 3}


def acquire(path: Path, orientation: str, told: Callable[[int, int], Any] | None = None) -> None:
    """What an acquisition does: begin or resume, write what is missing, finish; `told` of every block."""
    store = BlockStore.open(path, "a") if path.exists() else make(path, orientation=orientation, **_SIZE)
    if not store.final:
        for channel, block in store.missing(orientation):
            T = transport(12, 12, channel)
            store.write(channel, block, part(store, T, block), part(store, variance(T), block))
            if told is not None:
                told(channel, block)
        if "response" not in store.extras:
            store.extra("response", np.arange(5.0))
        store.update(finished=True)
    store.finalize(memory=64 * 40)


def contents(path: Path) -> dict[str, str]:
    """SHA-256 of every file by its name."""
    files = [file for file in path.rglob("*") if file.is_file()]
    return {str(file.relative_to(path)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def in_child(work: Callable[[], None]) -> int:
    """Process id of a child that does `work`."""
    child = os.fork()
    if child:
        return child
    status = 1
    try:
        work()
        status = 0
    finally:
        os._exit(status)


def status_of(child: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def dying_at(call: int) -> None:
    """From here on this process dies at its `call`-th change of the disk: half of them before, half after."""
    count = iter(range(10**9))

    def wrapped(real: Callable[..., Any]) -> Callable[..., Any]:
        def act(*arguments: Any, **options: Any) -> Any:
            place = next(count)
            if place == call and call % 2:
                os.kill(os.getpid(), signal.SIGKILL)
            if place == call and real is os_write:  # half of it gets through
                arguments = (arguments[0], bytes(arguments[1])[: len(arguments[1]) // 2])
            result = real(*arguments, **options)
            if place == call:
                os.kill(os.getpid(), signal.SIGKILL)
            return result

        return act

    os_write = os.write
    for name in _CALLS:
        setattr(os, name, wrapped(getattr(os, name)))


def committed_is_whole(path: Path, orientation: str, told: list[tuple[int, int]]) -> None:
    if not path.exists():
        assert not told
        return
    store = BlockStore.open(path)
    store.verify()
    if not store.final:
        assert set(told) <= store.held(orientation)
    for channel, block in store.held(store.orientation):
        expected = part(store, transport(12, 12, channel), block)
        np.testing.assert_array_equal(store.read(channel, block).toarray(), expected.toarray())


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, str]]:
    """What undisturbed acquisitions leave."""
    found = {}
    for orientation in ("rows", "columns"):
        path = tmp_path_factory.mktemp("whole") / "T.zarr"
        acquire(path, orientation)
        found[orientation] = contents(path)
    return found


@pytest.mark.parametrize("orientation", ["rows", "columns"])
def test_killed_inside_calls(tmp_path: Path, finished: dict[str, dict[str, str]], orientation: str) -> None:
    """Acquisitions that are killed and resumed, each time a little later, until one gets through."""
    rng, kills, acquisitions = np.random.default_rng(1), 0, 0
    while kills < 40:
        path, log = tmp_path / f"{acquisitions}.zarr", tmp_path / f"{acquisitions}.log"
        reach = 60
        while killed_at(int(rng.integers(reach)), path, orientation, log):
            kills, reach = kills + 1, reach + 200
            told = zip(*[iter(log.read_bytes())] * 2, strict=False)
            committed_is_whole(path, orientation, list(told))
        assert contents(path) == finished[orientation]
        acquisitions += 1


def killed_at(call: int, path: Path, orientation: str, log: Path) -> bool:
    """Whether an acquisition met that call before it was done; `log` gets the blocks that it committed."""

    def work() -> None:
        report = os.open(log, os.O_CREAT | os.O_APPEND | os.O_WRONLY)
        write = os.write  # of the system, not the one that kills
        dying_at(call)
        acquire(path, orientation, lambda *which: write(report, bytes(which)))

    status = status_of(in_child(work))
    assert status in (0, -signal.SIGKILL)
    return status != 0


@pytest.mark.parametrize("orientation", ["rows", "columns"])
def test_killed_from_outside(tmp_path: Path, finished: dict[str, dict[str, str]], orientation: str) -> None:
    rng, path = np.random.default_rng(3), tmp_path / "T.zarr"
    for _ in range(10):
        child = in_child(lambda: acquire(path, orientation))
        time.sleep(float(rng.uniform(0, 0.06)))
        os.kill(child, signal.SIGKILL)
        status_of(child)
        committed_is_whole(path, orientation, [])
    acquire(path, orientation)
    assert contents(path) == finished[orientation]


def test_concurrent_writers_of_distinct_blocks(tmp_path: Path) -> None:
    path = tmp_path / "T.zarr"
    store = make(path, shape=(60, 12), camera_grid=(6, 10), block_rows=3)
    T = transport(60, 12)

    def work(first: int) -> None:
        own = BlockStore.open(path, "a")
        for block in range(first, 20, 3):
            own.write(0, block, part(own, T, block))
            own.update(**{f"done_{block}": True})

    children = [in_child(lambda first=first: work(first)) for first in range(3)]
    assert [status_of(child) for child in children] == [0, 0, 0]
    store.finalize()
    store.verify()
    assert store.attributes == {f"done_{block}": True for block in range(20)}
    found = np.concatenate([store.read(0, block).toarray() for block in range(20)])
    np.testing.assert_array_equal(found, T.toarray())


def test_concurrent_writers_of_one_block(tmp_path: Path) -> None:
    """One of them wins, whole; the others are told or come after."""
    path = tmp_path / "T.zarr"
    store = make(path)
    T = transport()

    def work(factor: int) -> None:
        own = BlockStore.open(path, "a")
        for _ in range(20):
            try:
                own.write(0, 0, part(own, T, 0) * np.float32(factor))
            except FileError as error:
                assert "another process" in str(error) or "cannot be written" in str(error)  # noqa: PT017

    children = [in_child(lambda factor=factor: work(factor)) for factor in (1, 2, 4)]
    assert [status_of(child) for child in children] == [0, 0, 0]
    store.verify()
    ratio = store.read(0, 0).toarray()[0, 0] / T[0, 0]
    assert ratio in (1, 2, 4)


def test_what_the_living_write_is_not_tidied_away(tmp_path: Path) -> None:
    path = tmp_path / "T.zarr"
    fill(make(path), final=False)
    with aside.placed(path, "extra", "slow") as folder:
        assert aside.tidy(path) == 0
        (folder / "zarr.json").write_text("x")
    (path / ".aside" / "dead").mkdir()
    assert aside.tidy(path) == 1
    assert (path / "extra" / "slow.0").is_dir()
