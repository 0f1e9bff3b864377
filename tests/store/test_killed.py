# SPDX-License-Identifier: BSD-3-Clause
"""A process that ends at any moment loses nothing that was committed, and going on gives the same store.

It ends by SIGKILL or by Ctrl-C at a line of ltcl's code, or is killed from outside at a random time.
LTCL_KILLS=N in the environment takes N moments of each kind, and 0 every line.
"""

from __future__ import annotations

import os
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.errors import FileError
from ltcl.files import fill_folder, replace_file
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


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What an undisturbed acquisition leaves."""
    path = tmp_path_factory.mktemp("whole") / "T.zarr"
    acquire(path)
    return contents(path)


def committed_is_whole(path: Path, told: bytes) -> None:
    store = BlockStore.open(path)
    store.verify()
    if store.final:
        for channel in range(3):
            np.testing.assert_array_equal(whole(store, channel), transport(12, 12, channel).toarray())
        return
    assert set(zip(told[::2], told[1::2], strict=False)) <= store.written
    for channel, block in store.written:
        expected = part(store, transport(12, 12, channel), block)
        np.testing.assert_array_equal(store.read(channel, block).toarray(), expected.toarray())


@pytest.mark.parametrize("end", ENDS)
def test_an_acquisition_that_ends_at_any_line(tmp_path: Path, finished: dict[str, str], end: str) -> None:
    act, status = ENDS[end]
    lines = lines_of(lambda: acquire(tmp_path / "count" / "T.zarr"))
    shutil.rmtree(tmp_path / "count")
    for line in moments(lines):
        folder = tmp_path / str(line)
        path, log = folder / "T.zarr", tmp_path / f"{line}.log"
        with log.open("wb", buffering=0) as told:
            tell = told.write

            def work(line: int = line, path: Path = path, tell: Any = tell) -> None:
                at_line(line + 1, act)
                acquire(path, lambda *block: tell(bytes(block)))

            assert status_of(in_child(work)) == status, line
        if path.exists():
            committed_is_whole(path, log.read_bytes())
        acquire(path)
        assert contents(path) == finished, line
        assert os.listdir(folder) == ["T.zarr"], line


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
            committed_is_whole(path, b"")
            if BlockStore.open(path, "a").final:  # which removes a log that was left
                assert contents(path) == finished
                shutil.rmtree(path)
    acquire(path)
    assert contents(path) == finished
    assert os.listdir(tmp_path) == ["T.zarr"]


REPLACING: dict[str, Callable[[Path], object]] = {
    "create": lambda path: make(path, overwrite=True),
    "save": lambda path: ltcl.save(path, ltcl.Transport(2 * transport(12, 12), (3, 4), on_dark="mask")),
}


@pytest.mark.parametrize("end", ENDS)
@pytest.mark.parametrize("name", REPLACING)
def test_one_store_is_there_at_every_line_of_replacing_it(tmp_path: Path, name: str, end: str) -> None:
    """The old one or the new one, whole."""
    act, status = ENDS[end]
    work = REPLACING[name]
    lines = lines_of(lambda: work(tmp_path / "count" / "T.zarr"))
    shutil.rmtree(tmp_path / "count")
    fill(make(tmp_path / "good.zarr", shape=(12, 12), camera_grid=None))
    for line in moments(lines):
        path = tmp_path / str(line) / "T.zarr"
        shutil.copytree(tmp_path / "good.zarr", path)

        def ended(line: int = line, path: Path = path) -> None:
            at_line(line + 1, act)
            work(path)

        assert status_of(in_child(ended)) == status, line
        store = BlockStore.open(path, "a")
        store.verify()
        assert store.written in (frozenset(), frozenset((0, block) for block in range(4))) or name == "save"
        if store.final:
            assert abs(whole(store)).max() in (np.float32(2.0), np.float32(4.0))
        assert os.listdir(path.parent) == ["T.zarr"], line


@pytest.mark.parametrize("writer", [replace_file, fill_folder])
def test_temporaries_of_killed_processes_are_swept(tmp_path: Path, writer: Any) -> None:
    def dies() -> None:
        with writer(tmp_path / "out.npz"):
            kill()

    assert status_of(in_child(dies)) == -signal.SIGKILL
    assert len(os.listdir(tmp_path)) == 1
    with writer(tmp_path / "out.npz"):
        pass
    assert os.listdir(tmp_path) == ["out.npz"]


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
    twice, before = part(store, transport() * np.float32(2), 1), store.read(0, 1).toarray()
    real = getattr(os, name)
    for failing in range(60):
        calls = iter(range(10**6))

        def full(*given: Any, calls: Any = calls, failing: int = failing, **options: Any) -> Any:
            if next(calls) == failing:
                raise OSError(28, "No space left on device")
            return real(*given, **options)

        with monkeypatch.context() as patch:
            patch.setattr(os, name, full)
            try:
                store.write(0, 1, twice)
                store.update(step=1)
                break
            except FileError as error:
                text = str(error)
        assert str(tmp_path) in text
        assert "No space left" in text
        store.verify()
        after = store.read(0, 1).toarray()
        assert np.array_equal(after, before) or np.array_equal(after, 2 * before)
    assert store.attributes == {"step": 1}
    np.testing.assert_array_equal(store.read(0, 1).toarray(), 2 * before)
