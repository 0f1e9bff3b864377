# SPDX-License-Identifier: BSD-3-Clause
"""Stores: rows come back as written, plain zarr reads them, damage to any file is noticed."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st

import ltcl
from ltcl.errors import FileError, InputError, InputTypeError
from ltcl.store import BlockStore, block_store

from .stores import batch, contents, fill, make, rows, transport, variance

random = np.random.default_rng()
SQUARE: dict[str, Any] = {"shape": (12, 12), "camera_grid": None, "block_rows": 5}


def refused(path: Path, word: str = "") -> None:
    """Assert that `verify` refuses the store in one line that names it and a word."""
    with pytest.raises(FileError, match=f"^{path}.*{word}.*$"):
        BlockStore.open(path).verify()


@pytest.mark.slow
@settings(deadline=None, max_examples=25)
@given(
    st.integers(1, 9),
    st.integers(1, 9),
    st.integers(1, 10),
    st.integers(1, 600),
    st.sampled_from((1, 3)),
)
def test_any_shape_in_any_blocks_and_memory(
    tmp_path_factory: pytest.TempPathFactory, M: int, N: int, size: int, memory: int, channels: int
) -> None:
    path = tmp_path_factory.mktemp("store") / "T.zarr"
    grids = {"shape": (M, N), "grid": (1, N), "camera_grid": (M, 1)}
    store = fill(
        make(path, **grids, block_rows=size, channels=channels), with_variance=True, final=False
    )
    assert (store.final, store.missing(), len(store.written)) == (
        False,
        [],
        -(-N // size) * channels,
    )
    store.finalize(memory=memory)
    again = BlockStore.open(path)
    assert (again.final, again.missing()) == (True, [])
    for channel in range(channels):
        T = transport(M, N, channel)
        np.testing.assert_array_equal(rows(again, channel), T.toarray())
        spread: list[Any] = [again.block(channel, b).variance for b in range(store.layout.blocks())]
        np.testing.assert_array_equal(np.concatenate(spread), variance(T).data)
    again.verify()
    assert "log" not in os.listdir(path)


def test_matrices_take_the_place_of_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """T of M pixels, in several blocks of rows, from a store of M x K pictures."""
    monkeypatch.setattr(block_store, "SPARSE_BLOCK_ROWS", 5)
    store = fill(
        make(tmp_path / "T.zarr", shape=(12, 7), grid=(1, 7), camera_grid=(3, 4)), final=False
    )
    T = transport(12, 12, 0)
    store.finalize(sigmas=0.0, matrices=[block_store.SparseMatrix(T, variance(T).data)])
    store.verify()
    assert (store.layout.shape, store.layout.grid) == ((12, 12), (3, 4))
    np.testing.assert_array_equal(rows(store, 0), T.toarray())
    spread: list[Any] = [store.block(0, b).variance for b in range(store.layout.blocks())]
    np.testing.assert_array_equal(np.concatenate(spread), variance(T).data)
    np.testing.assert_array_equal(store.extra("first_bounce")[0], np.maximum(T.diagonal(), 0.0))


def test_rows_are_changed_once_even_if_all_is_asked_for_again(tmp_path: Path) -> None:
    store = fill(make(tmp_path / "T.zarr"), with_variance=True, final=False)
    errors = iter([None, None, OSError("no more")])

    def change(channel: int, first: int, matrix: Any, spread: Any) -> tuple[Any, Any]:
        if error := next(errors, None):
            raise error
        return (1 + first) * matrix, 2.0 * spread

    with pytest.raises(FileError, match="no more"):
        store.finalize(memory=64, change=change)
    assert not store.final
    store.finalize(memory=64, change=change)
    scale = 1.0 + 3 * (np.arange(10) // 3)
    np.testing.assert_allclose(rows(store), scale[:, None] * transport().toarray())
    np.testing.assert_array_equal(store.block(0, 1).variance, 2.0 * variance(transport())[3:6].data)


def test_variance_of_some_columns_only_is_unknown_elsewhere(tmp_path: Path) -> None:
    store = make(tmp_path / "T.zarr")
    for block in range(4):
        columns = batch(store, transport(), block)
        store.write(0, block, columns, np.ones(columns.nnz) if block == 2 else None)
    store.finalize()
    T, spread = store.block(0, 0)
    assert spread is not None
    np.testing.assert_array_equal(np.isnan(spread), (T.indices < 6) | (T.indices >= 9))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_plain_zarr_reads_it_and_checks_it(tmp_path: Path, dtype: str) -> None:
    path = tmp_path / "T.zarr"
    T = transport(12, 12).astype(dtype) * 0.1
    ltcl.save(path, ltcl.Transport(T, (3, 4), on_dark="mask"))
    assert {name for name, _ in zarr.open_group(path, mode="r").groups()} == {"channel_0", "extra"}
    group = zarr.open_group(path / "channel_0" / "block_000000.0", mode="r")
    header: Any = group.attrs["binsparse"]
    arrays = {name: np.asarray(group[name]) for name in ("values", "indices_1", "pointers_to_1")}
    assert {name: array.dtype for name, array in arrays.items()} == header["data_types"]
    matrix = scipy.sparse.csr_array(tuple(arrays.values()), shape=header["shape"])
    np.testing.assert_array_equal(matrix.toarray(), T.toarray())
    assert (arrays["values"].dtype, matrix.nnz) == (dtype, header["number_of_stored_values"])
    chunk = path / "channel_0" / "block_000000.0" / "values" / "c" / "0"
    chunk.write_bytes(chunk.read_bytes()[:-9] + b"x" + chunk.read_bytes()[-8:])
    with pytest.raises(ValueError, match="checksum"):
        np.asarray(group["values"])


def test_missing_blocks_are_named_and_written_ones_replaced(tmp_path: Path) -> None:
    store = make(tmp_path / "T.zarr")
    for block in (0, 2):
        store.write(0, block, batch(store, transport(), block))
    twice = batch(store, transport() * np.float32(2), 2)
    store.write(0, 2, twice)
    np.testing.assert_array_equal(store.block(0, 2).matrix.toarray(), twice.toarray())
    assert store.missing() == [(0, 1), (0, 3)]
    assert repr(store) == f"BlockStore({str(store.path)!r}, shape=(10, 12), final=False)"
    for work in (store.finalize, lambda: store.block(0, 1), lambda: ltcl.load(store.path)):
        with pytest.raises(FileError, match=r"T\.zarr.*(\(0, 1\), \(0, 3\)|0\.000001|finalize)"):
            work()


@pytest.mark.parametrize("sigmas", [0.0, 0.5])
def test_first_bounce(tmp_path: Path, sigmas: float) -> None:
    """Variances of `fill` are 1, 2, ... in order of the entries; only the first are far above."""
    store = make(tmp_path / "T.zarr", **SQUARE, channels=3)
    fill(store, with_variance=True, final=False).finalize(sigmas=sigmas)
    expected = []
    for channel in range(3):
        T = transport(12, 12, channel)
        F = T.diagonal()
        sigma = np.sqrt(variance(T).diagonal())
        expected.append(np.where(sigmas * sigma < F, F, 0.0))
    np.testing.assert_array_equal(store.extra("first_bounce"), expected)
    assert (np.count_nonzero(expected) < 33) == (sigmas > 0)


@pytest.mark.parametrize("final", [False, True])
def test_extra_arrays_and_attributes(tmp_path: Path, final: bool) -> None:
    store = make(tmp_path / "T.zarr", provenance={"rig": "virtual", "seed": 3})
    types = ("bool", "uint8", "int64", "float16", "float64")
    shapes = ((), (0,), (3,), (2, 0, 4))
    arrays = {
        f"an.array-{dtype}-{len(shape)}": np.ones(shape, dtype)
        for dtype in types
        for shape in shapes
    }
    for name, array in arrays.items():
        store.extra(name, array)
    store.update(step=4, name="π")
    BlockStore.open(store.path).update(step=5)
    for bad in (float("nan"), object()):
        with pytest.raises(InputError, match="plain JSON"):
            store.update(bad=bad)
    fill(store, final=final)
    again = BlockStore.open(store.path)
    again.verify()
    assert set(arrays) <= set(again.extras)
    for name, array in arrays.items():
        np.testing.assert_array_equal(again.extra(name), array, strict=True)
    assert again.attributes == {"step": 5, "name": "π"}
    assert again.provenance == {"versions": {"ltcl": ltcl.__version__}, "rig": "virtual", "seed": 3}
    with pytest.raises(InputError, match=r"\.\./escape" if not final else "final"):
        store.extra("../escape", np.ones(2))
    with pytest.raises(InputTypeError, match="words"):
        store.extra("words", np.array(["a"]))


def test_update_keeps_what_others_have_changed_since_it_was_opened(tmp_path: Path) -> None:
    first = make(tmp_path / "T.zarr")
    first.update(both=0)
    second = BlockStore.open(first.path)
    first.update(one=1, both=1)
    second.update(two=2)
    expected = {"one": 1, "two": 2, "both": 1}
    assert second.attributes == expected
    assert BlockStore.open(first.path).attributes == expected


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"grid": (3, 5)}, "h \\* w must be 12"),
        ({"camera_grid": (3, 3)}, "h \\* w must be 10"),
        ({"camera_grid": None}, "camera_grid is None"),
        ({"block_rows": 0}, "block_rows is 0"),
        ({"shape": (1 << 31, 1), "grid": (1, 1), "camera_grid": (1 << 31, 1)}, "2147483647"),
        ({"provenance": {"rig": object()}}, "plain JSON"),
    ],
)
def test_bad_stores_are_not_made(tmp_path: Path, options: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError, match=text):
        make(tmp_path / "T.zarr", **options)
    assert not list(tmp_path.iterdir())


def test_bad_blocks_are_refused(tmp_path: Path) -> None:
    store = make(tmp_path / "T.zarr")
    good = batch(store, transport(), 0)
    wrong: list[tuple[int, Any, Any, str]] = [
        (0, good[:2], None, r"matrix has shape \(2, 10\)"),
        (0, good.toarray(), None, "matrix is a ndarray"),
        (4, good, None, "block is 4"),
        (-1, good, None, "block is -1"),
        (0, good * np.nan, None, "NaN"),
        (0, good.astype(np.float64) * 1e39, None, "float32"),
        (0, good, np.full(good.nnz, -1.0), "variance"),
        (0, good, np.ones(good.nnz + 1), "variance"),
    ]
    for block, matrix, spread, text in wrong:
        with pytest.raises((InputError, InputTypeError), match=text):
            store.write(0, block, matrix, spread)
    assert store.written == frozenset()
    fill(store)
    with pytest.raises(FileError, match="final"):
        BlockStore.open(store.path).write(0, 0, good)


def test_nothing_is_replaced_unasked(tmp_path: Path) -> None:
    path = tmp_path / "T.zarr"
    other = tmp_path / "other"
    record = ltcl.store.StoreRecord((np.eye(6),), (2, 3))
    fill(make(path))
    with pytest.raises(FileError, match="overwrite=True"):
        make(path)
    BlockStore.open(path).verify()
    assert make(path, overwrite=True).written == frozenset()
    other.mkdir()
    (other / "thesis.txt").write_text("years of work")
    for work in (lambda: make(other, overwrite=True), lambda: block_store.write(other, record)):
        with pytest.raises(FileError, match="no store of ltcl"):
            work()
    assert (other / "thesis.txt").exists()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["T.zarr", "other"]
    zarr.create_group(tmp_path / "plain")
    for name in ("nowhere", "other/thesis.txt", ".", "plain"):
        with pytest.raises(FileError, match=str(tmp_path / name)):
            BlockStore.open(tmp_path / name)


@pytest.fixture(params=["final", "growing"])
def store(tmp_path: Path, request: pytest.FixtureRequest) -> BlockStore:
    """A small store with everything that one can have."""
    store = make(tmp_path / "T.zarr", **SQUARE, provenance={"rig": "π"})
    store.extra("response", np.linspace(0, 1, 5))
    store.extra("scalar", np.array(2.0))
    store.update(step=3)
    return fill(store, with_variance=True, final=request.param == "final")


def damage_all_files(path: Path) -> None:
    for file in sorted(file for file in path.rglob("*") if file.is_file()):
        good = file.read_bytes()
        places = random.choice(len(good), min(len(good), 6), replace=False).tolist()
        flipped = [good[:k] + bytes([good[k] ^ (1 << k % 8)]) + good[k + 1 :] for k in places]
        for bad in (*flipped, good[:-1], good[: len(good) // 2], b"", good + b" "):
            file.write_bytes(bad)
            refused(path)
        file.unlink()
        if file.parent.name != "log":  # a batch that is not there is one to be written
            refused(path, "(no such file|without zarr.json)")
        os.mkfifo(file)
        refused(path)
        file.unlink()
        file.write_bytes(good)
    BlockStore.open(path).verify()


@pytest.mark.slow
def test_any_damage_to_any_file_is_noticed(store: BlockStore) -> None:
    damage_all_files(store.path)


def forge(file: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change a document and give it the right checksum, as an enemy could."""
    document = json.loads(file.read_bytes())
    change(document["attributes"])
    document["attributes"]["checksum"] = unsealed = "0" * 64
    raw = json.dumps(document)
    file.write_text(raw.replace(unsealed, hashlib.sha256(raw.encode()).hexdigest(), 1))


@pytest.mark.parametrize("store", ["growing"], indirect=True)
@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("schema", 3, "schema is 3"),
        ("schema", 1, "schema is 1"),
        ("shape", [12, 1 << 40], "1099511627776"),
        ("shape", "12 x 12", "shape is"),
        ("channels", 1 << 40, "channels is"),
        ("block_rows", -1, "block_rows is -1"),
        ("surprise", 1, "surprise"),
    ],
)
def test_hostile_layouts(store: BlockStore, name: str, value: Any, text: str) -> None:
    forge(store.path / "zarr.json", lambda attributes: attributes["ltcl"].update({name: value}))
    refused(store.path, text)


@pytest.mark.slow
@pytest.mark.parametrize("store", ["growing"], indirect=True)
def test_a_huge_shape_is_only_a_list_of_missing_blocks(store: BlockStore) -> None:
    huge = (1 << 31) - 1
    sizes = {"shape": [huge, huge], "grid": [1, huge], "block_rows": 1 << 12}
    forge(store.path / "zarr.json", lambda attributes: attributes["ltcl"].update(sizes))
    store = BlockStore.open(store.path)
    with pytest.raises(FileError, match="2147483647"):
        store.block(0, 0)
    with pytest.raises(FileError, match="lacks 524285 blocks"):
        store.finalize()


@pytest.mark.parametrize("store", ["final"], indirect=True)
@pytest.mark.parametrize(
    "change", [{"shape": [1 << 40]}, {"data_type": "O"}, {"codecs": [{"name": "gzip"}]}]
)
def test_arrays_that_declare_terabytes_or_hold_no_numbers(
    store: BlockStore, change: dict[str, Any]
) -> None:
    file = store.path / "channel_0" / "block_000000.0" / "values" / "zarr.json"
    file.write_text(json.dumps(json.loads(file.read_bytes()) | change))
    sums = contents(store.path)
    del sums["zarr.json"]
    forge(store.path / "zarr.json", lambda attributes: attributes.update(files=sums))
    with pytest.raises(FileError, match=r"T\.zarr: .*block_000000"):
        ltcl.load(store.path, on_dark="mask")


def test_the_folder_of_an_acquisition_names_its_stores(tmp_path: Path) -> None:
    (tmp_path / "acquisition.toml").touch()
    refused(tmp_path, "without a store yet; 'ltcl acquire run'")
    make(tmp_path / "left.zarr", **SQUARE)
    refused(tmp_path, r"give left\.zarr in it")
    make(tmp_path / "right.zarr", **SQUARE)
    refused(tmp_path, r"with left\.zarr, right\.zarr; give one of them, .*'ltcl combine'")
