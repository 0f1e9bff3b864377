# SPDX-License-Identifier: BSD-3-Clause
"""A process that ends at any moment loses nothing that was committed, and going on gives the same store.

It ends by SIGKILL or by Ctrl-C at a line of ltcl's code, or is killed from outside at a random time.
LTCL_KILLS=N in the environment takes N moments of each kind, and 0 every line.
"""

from __future__ import annotations

import functools
import itertools
import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.errors import FileError
from ltcl.store import BlockStore

from .stores import (
    acquire,
    at_line,
    contents,
    fill,
    in_child,
    interrupt,
    kill,
    make,
    part,
    status_of,
    transport,
    whole,
)

random = np.random.default_rng()
MOMENTS = int(os.environ.get("LTCL_KILLS", "8"))
ENDS = {"SIGKILL": (kill, -signal.SIGKILL), "Ctrl-C": (interrupt, 2)}


def moments(lines: int) -> list[int]:
    """Lines at which to end: some, or all."""
    return sorted(random.choice(lines, min(MOMENTS or lines, lines), replace=False).tolist())


def lines_of(work: Callable[[], object]) -> int:
    """How many lines of ltcl `work` runs through."""
    reader, writer = os.pipe()

    def counted() -> None:
        lines = at_line(-1, interrupt)
        work()
        os.write(writer, str(lines[0]).encode())

    assert status_of(in_child(counted)) == 0
    os.close(writer)
    with os.fdopen(reader) as file:
        return int(file.read())


def end_at_lines(folder: Path, prepare: Callable[[Path], object], work: Any, end: str) -> Iterator[Any]:
    """Folder of a store whose `work` (path, report) ended at a line, and the blocks it reported."""
    act, status = ENDS[end]
    prepare(folder / "count" / "T.zarr")
    lines = lines_of(lambda: work(folder / "count" / "T.zarr", lambda *_: None))
    shutil.rmtree(folder / "count")
    for line in moments(lines):
        path, log = folder / str(line) / "T.zarr", folder / f"{line}.log"
        prepare(path)
        with log.open("wb", buffering=0) as file:

            def ended(line: int = line, path: Path = path, write: Any = file.write) -> None:
                at_line(line + 1, act)
                work(path, lambda *block: write(bytes(block)))

            assert status_of(in_child(ended)) == status, line
        raw = log.read_bytes()
        yield path, set(zip(raw[::2], raw[1::2], strict=True))
        assert os.listdir(path.parent) == ["T.zarr"], line


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What an undisturbed acquisition leaves."""
    path = tmp_path_factory.mktemp("whole") / "T.zarr"
    acquire(path)
    return contents(path)


def committed_is_whole(path: Path, reported: set[tuple[int, int]]) -> None:
    store = BlockStore.open(path)
    store.verify()
    for channel in range(3 if store.final else 0):
        np.testing.assert_array_equal(whole(store, channel), transport(12, 12, channel).toarray())
    if not store.final:
        assert reported <= store.written
        for channel, block in store.written:
            expected = part(store, transport(12, 12, channel), block)
            np.testing.assert_array_equal(store.block(channel, block).matrix.toarray(), expected.toarray())


@pytest.mark.parametrize("end", ENDS)
def test_an_acquisition_that_ends_at_any_line(tmp_path: Path, finished: dict[str, str], end: str) -> None:
    for path, reported in end_at_lines(tmp_path, lambda path: None, acquire, end):
        if path.exists():
            committed_is_whole(path, reported)
        acquire(path)
        assert contents(path) == finished


def test_killed_from_outside(tmp_path: Path, finished: dict[str, str]) -> None:
    path, seconds = tmp_path / "T.zarr", 0.0
    for _ in range(MOMENTS or 100):
        started = time.perf_counter()
        child = in_child(lambda: acquire(path))
        time.sleep(float(random.uniform(0, seconds or 1.0)))
        os.kill(child, signal.SIGKILL)
        if status_of(child) == 0:
            seconds = time.perf_counter() - started
        if path.exists():
            committed_is_whole(path, set())
            if BlockStore.open(path, "a").final:  # which removes a log that was left
                assert contents(path) == finished
                shutil.rmtree(path)
    acquire(path)
    assert contents(path) == finished
    assert os.listdir(tmp_path) == ["T.zarr"]


REPLACING: dict[str, Callable[..., object]] = {
    "create": lambda path, _: make(path, overwrite=True),
    "save": lambda path, _: ltcl.save(path, ltcl.Transport(2 * transport(12, 12), (3, 4), on_dark="mask")),
}


@pytest.mark.parametrize("end", ENDS)
@pytest.mark.parametrize("name", REPLACING)
def test_one_store_is_there_at_every_line_of_replacing_it(tmp_path: Path, name: str, end: str) -> None:
    """The old one or the new one, whole."""
    good = fill(make(tmp_path / "good.zarr", shape=(12, 12), camera_grid=None)).path
    prepare = functools.partial(shutil.copytree, good)
    for path, _ in end_at_lines(tmp_path, prepare, REPLACING[name], end):
        store = BlockStore.open(path, "a")
        store.verify()
        assert store.final or (name == "create" and not store.written)
        if store.final:
            assert abs(whole(store)).max() in (np.float32(2.0), np.float32(4.0))


def test_writers_at_once(tmp_path: Path) -> None:
    """Of distinct blocks nothing is lost; of one array one of them wins; after the end all are refused."""
    path = tmp_path / "T.zarr"
    store = make(path, shape=(12, 60), grid=(6, 10), camera_grid=(3, 4), block_rows=3)
    T = transport(12, 60)

    def work(first: int) -> None:
        own = BlockStore.open(path, "a")
        for block in range(first, 20, 3):
            own.write(0, block, part(own, T, block))
            own.update(**{f"done_{block}": True})
            own.extra("same", np.full(1000, first))

    children = [in_child(lambda first=first: work(first)) for first in range(3)]
    assert [status_of(child) for child in children] == [0, 0, 0]
    assert len(np.unique(store.extra("same"))) == 1
    late = BlockStore.open(path, "a")
    store.finalize()
    store.verify()
    assert store.attributes == {f"done_{block}": True for block in range(20)}
    np.testing.assert_array_equal(whole(store), T.toarray())
    with pytest.raises(FileError, match="final"):
        late.write(0, 0, part(late, T, 0))


@pytest.mark.parametrize("name", ["write", "replace", "open", "fsync", "mkdir"])
def test_a_full_disk_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """At each call of the system in turn, until the commit gets through."""
    store = fill(make(tmp_path / "T.zarr"), final=False)
    before, real = part(store, transport(), 1), getattr(os, name)
    for failing in range(60):
        calls = itertools.count()

        def full(*arguments: Any, calls: Any = calls, failing: int = failing, **options: Any) -> Any:
            if next(calls) == failing:
                raise OSError(28, "No space left on device")
            return real(*arguments, **options)

        with monkeypatch.context() as patch:
            patch.setattr(os, name, full)
            try:
                store.write(0, 1, 2 * before)
                store.update(step=1)
                break
            except FileError as error:
                text = str(error)
        assert str(tmp_path) in text
        assert "No space left" in text
        store.verify()
        change = (store.block(0, 1).matrix - before).toarray()
        assert not change.any() or np.array_equal(change, before.toarray())
    assert store.attributes == {"step": 1}
    np.testing.assert_array_equal(store.block(0, 1).matrix.toarray(), 2 * before.toarray())
