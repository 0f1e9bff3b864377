# SPDX-License-Identifier: BSD-3-Clause
"""A process that ends at any moment loses nothing committed; going on gives the same store.

It ends by SIGKILL or by Ctrl-C at a line of ltcl's code, or is killed from outside at a random
time. LTCL_KILLS=N in the environment takes N moments of each kind, and 0 every line.
"""

from __future__ import annotations

import functools
import gc
import itertools
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

import ltcl
from ltcl.errors import FileError
from ltcl.store import BlockStore, StoreRecord, formats

from . import stores

pytestmark = pytest.mark.slow

random = np.random.default_rng()
MOMENTS = int(os.environ.get("LTCL_KILLS", "8"))
ENDS = {"SIGKILL": (stores.kill, -signal.SIGKILL), "Ctrl-C": (stores.interrupt, 2)}


def end_at_lines(
    folder: Path, prepare: Callable[[Path], object], work: Any, end: str
) -> Iterator[Any]:
    """Folder of a store whose `work` (path, report) ended at a line, and the blocks it reported."""
    act, status = ENDS[end]
    prepare(folder / "count" / "T.zarr")
    trace = sys.gettrace()
    count = stores.at_line(-1, act)
    work(folder / "count" / "T.zarr", lambda *_: None)
    sys.settrace(trace)
    shutil.rmtree(folder / "count")
    for line in random.choice(count[0], MOMENTS or count[0], replace=False).tolist():
        path = folder / str(line) / "T.zarr"
        log = folder / f"{line}.log"
        prepare(path)
        with log.open("wb", buffering=0) as file:

            def ended(line: int = line, path: Path = path, write: Any = file.write) -> None:
                stores.at_line(line + 1, act)
                work(path, lambda *block: write(bytes(block)))

            assert stores.status_of(stores.in_child(ended)) == status, line
        raw = log.read_bytes()
        yield path, set(zip(raw[::2], raw[1::2], strict=True))
        assert os.listdir(path.parent) == ["T.zarr"], line


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Files that an undisturbed acquisition leaves."""
    path = tmp_path_factory.mktemp("finished") / "T.zarr"
    stores.acquire(path)
    return stores.contents(path)


def check_committed(path: Path, reported: set[tuple[int, int]]) -> None:
    store = BlockStore.open(path)
    store.verify()
    expected = [stores.transport(12, 12, channel) for channel in range(3)]
    for channel in range(3 if store.final else 0):
        np.testing.assert_array_equal(stores.rows(store, channel), expected[channel].toarray())
    assert store.final or reported <= store.written
    for channel, block in store.written if not store.final else ():
        columns = stores.batch(store, expected[channel], block).toarray()
        np.testing.assert_array_equal(store.block(channel, block).matrix.toarray(), columns)


@pytest.mark.rare
@pytest.mark.parametrize("end", ENDS)
def test_an_acquisition_that_ends_at_any_line(
    tmp_path: Path, finished: dict[str, str], end: str
) -> None:
    for path, reported in end_at_lines(tmp_path, lambda path: None, stores.acquire, end):
        if path.exists():
            check_committed(path, reported)
        stores.acquire(path)
        assert stores.contents(path) == finished


@pytest.mark.slow
def test_killed_from_outside(tmp_path: Path, finished: dict[str, str]) -> None:
    path = tmp_path / "T.zarr"
    seconds = 0.0
    for _ in range(MOMENTS or 100):
        started = time.perf_counter()
        child = stores.in_child(lambda: stores.acquire(path))
        time.sleep(float(random.uniform(0, seconds or 1.0)))
        os.kill(child, signal.SIGKILL)
        if stores.status_of(child) == 0:
            seconds = time.perf_counter() - started
        if path.exists():
            check_committed(path, set())
            if (store := BlockStore.open(path)).final:
                store.finalize()  # which removes a log that was left
                assert stores.contents(path) == finished
                shutil.rmtree(path)
    stores.acquire(path)
    assert stores.contents(path) == finished
    assert os.listdir(tmp_path) == ["T.zarr"]


T = stores.transport(12, 12)
REPLACING: dict[str, Callable[..., object]] = {
    "create": lambda path, _: stores.make(path, overwrite=True),
    "save": lambda path, _: ltcl.save(path, ltcl.Transport(2 * T, (3, 4), on_dark="mask")),
}


@pytest.mark.slow
@pytest.mark.parametrize("end", ENDS)
@pytest.mark.parametrize("name", REPLACING)
def test_one_store_is_there_at_every_line_of_replacing_it(
    tmp_path: Path, name: str, end: str
) -> None:
    """The old one or the new one, whole."""
    good = stores.fill(stores.make(tmp_path / "good.zarr", shape=(12, 12), camera_grid=None)).path
    prepare = functools.partial(shutil.copytree, good)
    for path, _ in end_at_lines(tmp_path, prepare, REPLACING[name], end):
        store = BlockStore.open(path)
        store.verify()
        (store.finalize if store.final else store.update)()  # removes what the process left
        assert store.final or (name == "create" and not store.written)
        if store.final:
            assert abs(stores.rows(store)).max() in (np.float32(2.0), np.float32(4.0))


def test_writers_at_once(tmp_path: Path) -> None:
    """Distinct blocks are never lost; one writer of an array wins; late ones are refused."""
    path = tmp_path / "T.zarr"
    T = stores.transport(12, 60)
    store = stores.make(path, shape=(12, 60), grid=(6, 10), camera_grid=(3, 4))

    def work(first: int) -> None:
        own = BlockStore.open(path)
        for block in range(first, 20, 3):
            own.write(0, block, stores.batch(own, T, block))
            own.update(**{f"done_{block}": True})
            own.extra("same", np.full(1000, first))

    children = [stores.in_child(lambda first=first: work(first)) for first in range(3)]
    assert [stores.status_of(child) for child in children] == [0, 0, 0]
    assert len(np.unique(store.extra("same"))) == 1
    late = BlockStore.open(path)
    store.finalize()
    store.verify()
    assert store.attributes == {f"done_{block}": True for block in range(20)}
    np.testing.assert_array_equal(stores.rows(store), T.toarray())
    with pytest.raises(FileError, match="final"):
        late.write(0, 0, stores.batch(late, T, 0))


@pytest.mark.parametrize("name", ["write", "replace", "open", "fsync", "mkdir"])
def test_a_full_disk_loses_nothing(tmp_path: Path, name: str) -> None:
    """The process ends at each call of the system in turn, until the commit gets through."""
    store = stores.fill(stores.make(tmp_path / "T.zarr"), final=False)
    before = stores.batch(store, stores.transport(), 1)
    works = itertools.repeat(mock.DEFAULT)
    for failing in range(60):
        calls = itertools.chain(
            [mock.DEFAULT] * failing, [OSError(28, "No space left on device")], works
        )
        with mock.patch.object(os, name, wraps=getattr(os, name), side_effect=calls):
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


@pytest.mark.slow
@pytest.mark.parametrize("can_exchange", [True, False])
def test_readers_see_one_store_while_writers_replace_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, can_exchange: bool
) -> None:
    """No save fails, no load fails, and what was loaded stays as it was."""
    if not can_exchange:
        monkeypatch.setattr("ltcl.files.exchange", lambda one, two: False)
    path = tmp_path / "T.zarr"

    def save(scale: int) -> None:
        formats.write(path, StoreRecord((scale * T,), (3, 4)))

    def write(scale: int) -> None:
        for _ in range(25):
            save(scale)

    save(1)
    writers = [stores.in_child(lambda scale=scale: write(scale)) for scale in (2, 3)]
    reads = 0
    while reads < 40:
        record: Any = formats.read(path)
        (rows,) = record.matrices
        time.sleep(0.01)
        scales = {rows.tocsr().max() / T.max(), rows.rows(0, 12).max() / T.max()}
        assert len(scales) == 1
        assert scales <= {1.0, 2.0, 3.0}
        reads += 1
    assert [stores.status_of(writer) for writer in writers] == [0, 0]
    rows = record = None
    save(1)
    assert os.listdir(tmp_path) == ["T.zarr"]


def test_a_store_in_use_is_read_as_it_was_opened(tmp_path: Path) -> None:
    path = tmp_path / "T.zarr"
    ltcl.save(path, ltcl.Transport(T, (3, 4), on_dark="mask"))
    loaded = ltcl.load(path)
    ltcl.save(path, ltcl.Transport(2 * T, (3, 4), on_dark="mask"))
    assert len(os.listdir(tmp_path)) == 2
    picture = loaded @ np.ones((3, 4))
    np.testing.assert_allclose(picture.ravel(), T @ np.ones(12), rtol=1e-6)
    ltcl.save(path, loaded)  # onto the place that it came from
    np.testing.assert_allclose(ltcl.load(path).to_numpy(), T.toarray())
    del loaded
    gc.collect()
    assert os.listdir(tmp_path) == ["T.zarr"]
