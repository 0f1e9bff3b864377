# SPDX-License-Identifier: BSD-3-Clause
"""Whatever happens to the files of a store is noticed, and nothing declared is believed."""

from __future__ import annotations

import json
import os
import resource
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ltcl.errors import FileError
from ltcl.store import BlockStore
from ltcl.store.blocks import nodes, sealed

from .helpers import fill, make, part, refused, transport, whole


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A final store with everything that one can have, but small."""
    path = tmp_path_factory.mktemp("damage") / "T.zarr"
    store = make(path, shape=(12, 12), camera_grid=None, block_rows=5, provenance={"rig": "π"})
    store.extra("response", np.linspace(0, 1, 5))
    store.extra("scalar", np.array(2.0))
    store.update(step=3)
    fill(store, with_variance=True)
    store.verify()
    return path


@pytest.fixture
def copy(stored: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(stored, tmp_path / "T.zarr"))


def files(path: Path) -> list[Path]:
    return sorted(file for file in path.rglob("*") if file.is_file())


def test_any_flipped_byte_is_detected(copy: Path) -> None:
    rng = np.random.default_rng(7)
    for file in files(copy):
        good = file.read_bytes()
        places = range(len(good)) if len(good) < 64 else sorted(rng.choice(len(good), 24, replace=False))
        for place in places:
            changed = bytearray(good)
            changed[place] ^= 1 << int(rng.integers(8))
            file.write_bytes(changed)
            with pytest.raises(FileError, match=r"T\.zarr: "):
                BlockStore.open(copy).verify()
        file.write_bytes(good)
    BlockStore.open(copy).verify()


def test_every_bit_of_an_entry_counts(copy: Path) -> None:
    for name in ("zarr.json", "extra/scalar.0/array/c", "channel_0/block_000002.0/values/c/0"):
        file = copy / name
        good = file.read_bytes()
        for place in range(len(good)):
            file.write_bytes(good[:place] + bytes([good[place] ^ 1]) + good[place + 1 :])
            with pytest.raises(FileError, match=r"T\.zarr: "):
                BlockStore.open(copy).verify()
        file.write_bytes(good)


def test_truncated_and_longer_files(copy: Path) -> None:
    for file in files(copy):
        good = file.read_bytes()
        for bad in (good[:-1], good[: len(good) // 2], b"", good + b" "):
            file.write_bytes(bad)
            refused(copy)
        file.write_bytes(good)


def test_missing_files_and_folders(copy: Path) -> None:
    for file in files(copy):
        moved = copy.parent / "moved"
        file.rename(moved)
        refused(copy, "missing")
        moved.rename(file)
    (copy / "channel_0" / "block_000001.0").rename(copy.parent / "moved")
    refused(copy, "channel_0/block_000001.0 is missing")


def test_links_are_not_followed(copy: Path) -> None:
    for name in ("channel_0/block_000001.0", "channel_0/block_000001.0/values/c/0", "extra", "zarr.json"):
        moved = copy.parent / "moved"
        (copy / name).rename(moved)
        (copy / name).symlink_to(moved)
        refused(copy, "is a symbolic link")
        (copy / name).unlink()
        moved.rename(copy / name)
    (copy / "extra" / "more").symlink_to("/etc/passwd")
    refused(copy, "extra/more is a symbolic link")


def test_strangers_are_named(copy: Path) -> None:
    (copy / "channel_0" / "block_000000.0" / "notes.txt").write_text("x")
    refused(copy, "channel_0/block_000000.0/notes.txt is none of the store's files")


def test_a_pipe_is_not_waited_for(copy: Path) -> None:
    chunk = copy / "channel_0" / "block_000000.0" / "values" / "c" / "0"
    chunk.unlink()
    os.mkfifo(chunk)
    refused(copy, "values/c/0 is no regular file")


def test_a_block_of_another_time_is_none_of_a_final_store(copy: Path, stored: Path, tmp_path: Path) -> None:
    other = make(tmp_path / "other.zarr", shape=(12, 12), camera_grid=None, block_rows=5)
    other.write(0, 1, part(other, transport(12, 12) * np.float32(2), 1))
    place = copy / "channel_0" / "block_000001.0"
    shutil.rmtree(place)
    shutil.copytree(other.path / "channel_0" / "block_000001.0", place)
    refused(copy, "is another one than the store was finished with")
    shutil.copytree(stored / "channel_0" / "block_000001.0", place.with_name("block_000001.1"))
    refused(copy, "block_000001.1 is none that the store was finished with")


def forge(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change a document and seal it again, as an enemy could."""
    document = json.loads(path.read_bytes())
    attributes = document.pop("attributes")
    del attributes["checksum"]
    change(attributes)
    path.write_bytes(sealed.seal(attributes, document))


@pytest.fixture
def growing(tmp_path: Path) -> Path:
    """A store that is not final, so that its blocks may be forged."""
    fill(make(tmp_path / "grows.zarr", shape=(12, 12), camera_grid=None, block_rows=5), final=False)
    return tmp_path / "grows.zarr"


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("schema", 2, "is of schema 2; this ltcl reads schema 1"),
        ("schema", "x" * 10**5, "is of schema"),
        ("shape", [12, 1 << 40], "shape"),
        ("shape", [12], "shape is"),
        ("shape", "12 x 12", "shape is"),
        ("grid", [1 << 20, 1 << 20], "grid is 1048576 x 1048576"),
        ("channels", 1 << 40, "it must be 1 or 3"),
        ("block_rows", -1, "block_rows is -1"),
        ("block_rows", None, "block_rows is None"),
        ("orientation", ["rows"], "orientation is"),
        ("surprise", 1, "surprise"),
        ("final", None, "describes no store"),
    ],
)
def test_hostile_layouts(growing: Path, name: str, value: Any, text: str) -> None:
    def change(attributes: dict[str, Any]) -> None:
        if name == "final":
            del attributes["ltcl"]
        else:
            attributes["ltcl"][name] = value

    forge(growing / "zarr.json", change)
    refused(growing, text)


def test_a_huge_shape_is_only_a_list_of_missing_blocks(growing: Path) -> None:
    def change(attributes: dict[str, Any]) -> None:
        huge = (1 << 31) - 1
        attributes["ltcl"] |= {"shape": [huge, huge], "grid": [1, huge], "block_rows": 1 << 12}

    forge(growing / "zarr.json", change)
    with pytest.raises(FileError, match=r"pointers_to_1 is declared as"):
        BlockStore.open(growing).read(0, 0)
    with pytest.raises(FileError, match=r"lacks 524285 block\(s\)"):
        BlockStore.open(growing, "a").finalize()


@pytest.mark.parametrize("size", [1 << 40, 1 << 61, 1 << 62, -1, 2.5, "x"])
def test_declared_terabytes(growing: Path, size: Any) -> None:
    block = "channel_0/block_000000.0"

    def change(attributes: dict[str, Any]) -> None:
        for name in ("values", "indices_1"):
            attributes["arrays"][name]["shape"] = [size]

    forge(growing / block / "zarr.json", change)
    refused(growing, block)


@pytest.mark.parametrize("entry", [None, 3, [], {}, {"shape": [3]}, {"shape": {}, "data_type": "float32"}])
def test_entries_that_make_no_sense(growing: Path, entry: Any) -> None:
    block = growing / "channel_0" / "block_000000.0" / "zarr.json"
    good = block.read_bytes()
    for name in ("values", "indices_1", "pointers_to_1", "variance", "../../../escape"):
        forge(block, lambda attributes, name=name: attributes["arrays"].update({name: entry}))
        refused(growing, "channel_0/block_000000.0")
        block.write_bytes(good)
    forge(block, lambda attributes: attributes.update(arrays=entry))
    refused(growing, "channel_0/block_000000.0/zarr.json")


@pytest.mark.parametrize(
    ("part_of", "values"),
    [
        ("indices_1", lambda a: a + 100),
        ("indices_1", lambda a: a - 1),
        ("indices_1", lambda a: a[::-1]),
        ("pointers_to_1", lambda a: a[::-1]),
        ("pointers_to_1", lambda a: a * 1000),
        ("values", lambda a: a * np.nan),
    ],
)
def test_rows_that_are_none(growing: Path, part_of: str, values: Callable[[np.ndarray], np.ndarray]) -> None:
    """With all checksums right."""
    block = growing / "channel_0" / "block_000000.0"
    told = json.loads((block / "zarr.json").read_bytes())["attributes"]["arrays"][part_of]
    array = np.array(nodes.read_array(block, part_of, told))
    shutil.rmtree(block / part_of)
    entry = nodes.write_array(block / part_of, values(array).astype(array.dtype))
    forge(block / "zarr.json", lambda attributes: attributes["arrays"].update({part_of: entry}))
    refused(growing, "channel_0/block_000000.0")


def test_documents_that_are_large_or_deep(growing: Path) -> None:
    document = growing / "zarr.json"
    raw = b'{"attributes": {"checksum": "' + b"0" * 64 + b'", "deep": ' + b"[" * 10**5
    document.write_bytes(raw.replace(b"0" * 64, sealed._sum(raw), 1))
    refused(growing, "zarr.json is no JSON")
    with document.open("wb") as file:
        file.truncate(1 << 40)  # a hole: it takes no disk
    refused(growing, "zarr.json has 1099511627776 bytes; it must have at most")


@pytest.mark.parametrize("name", ["write", "fsync", "rename", "mkdir"])
def test_a_full_disk_loses_nothing(growing: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """At every call of a function of the system in turn, until the write gets through."""
    store = BlockStore.open(growing, "a")
    before, old = whole(store), store.attributes
    real = getattr(os, name)
    for failing in range(200):
        calls = iter(range(10**6))

        def full(*arguments: Any, calls: Any = calls, failing: int = failing, **options: Any) -> Any:
            if next(calls) == failing:
                raise OSError(28, "No space left on device")
            return real(*arguments, **options)

        with monkeypatch.context() as patch:
            patch.setattr(os, name, full)
            try:
                store.write(0, 1, part(store, transport(12, 12) * np.float32(2), 1))
                store.update(step=1)
                break
            except FileError as error:
                text = str(error)
        assert text.startswith(f"{growing}: ")
        assert "No space left on device" in text
        store.verify()
        after = whole(BlockStore.open(growing))
        assert np.array_equal(after, before) or np.array_equal(after[5:10], 2 * before[5:10])
        assert store.attributes in (old, {"step": 1})
    else:
        pytest.fail("the write never got through")
    assert failing > 0
    np.testing.assert_array_equal(whole(BlockStore.open(growing))[5:10], 2 * before[5:10])
    assert not [path for path in (growing / ".aside").iterdir() if path.is_dir()]


def test_a_limit_on_file_sizes_loses_nothing(growing: Path) -> None:
    """The system itself refuses, in a process of its own."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
            store = BlockStore.open(growing, "a")
            try:
                store.write(0, 1, part(store, transport(12, 12), 1))
            except FileError as error:
                status = 0 if "File too large" in str(error) else 2
        finally:
            os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    store = BlockStore.open(growing)
    store.verify()
    np.testing.assert_array_equal(whole(store), transport(12, 12).toarray())
