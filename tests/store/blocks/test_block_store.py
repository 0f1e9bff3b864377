# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
import scipy.sparse
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st

import ltcl
from ltcl.errors import FileError, InputError, InputTypeError
from ltcl.store import BlockStore

from .helpers import fill, make, part, transport, variance, whole


@pytest.mark.parametrize("orientation", ["rows", "columns"])
@pytest.mark.parametrize("channels", [1, 3])
def test_round_trip(tmp_path: Path, orientation: str, channels: int) -> None:
    store = fill(make(tmp_path / "T.zarr", orientation=orientation, channels=channels))
    again = BlockStore.open(tmp_path / "T.zarr")
    assert again.final
    assert again.missing() == []
    assert len(again.written) == 4 * channels
    for channel in range(channels):
        T = transport(channel=channel)
        np.testing.assert_array_equal(whole(again, channel), T.toarray())
        block = again.read(channel, 1)
        assert isinstance(block, scipy.sparse.csr_array)
        assert block.dtype == np.float32
    again.verify()
    assert repr(store) == f"<ltcl BlockStore 10 x 12, {channels} channel(s), final>"


@pytest.mark.parametrize("memory", [64, 64 * 20, 1 << 20])
def test_columns_turn_the_same_with_any_memory(tmp_path: Path, memory: int) -> None:
    store = fill(make(tmp_path / "T.zarr", orientation="columns"), with_variance=True, final=False)
    store.finalize(memory=memory)
    T = transport()
    np.testing.assert_array_equal(whole(store), T.toarray())
    for block in range(4):
        start, stop = store.layout.span(block)
        np.testing.assert_array_equal(store.variance(0, block), variance(T)[start:stop].data)
    assert not list((tmp_path / "T.zarr" / "columns_0").glob("block*"))


@pytest.mark.parametrize("memory", [64, 1 << 20])
def test_rows_are_changed_once_before_they_are_committed(tmp_path: Path, memory: int) -> None:
    """Even where the change failed half way, and all is asked for again."""
    store = fill(
        make(tmp_path / "T.zarr", orientation="columns", channels=3), with_variance=True, final=False
    )
    left = [7]

    def change(channel: int, first: int, matrix: Any, spread: Any) -> tuple[Any, Any]:
        left[0] -= 1
        if left[0] == 0:
            raise OSError("no more")
        more = 1.0 + channel + np.arange(first, first + matrix.shape[0])
        return scipy.sparse.diags_array(more) @ matrix, 2.0 * spread

    with pytest.raises(OSError, match="no more"):
        store.finalize(memory=memory, change=change)
    assert not store.final
    store.finalize(memory=memory, change=change)
    for c in range(3):
        T = transport(channel=c)
        np.testing.assert_allclose(whole(store, c), (1.0 + c + np.arange(10))[:, None] * T.toarray())
        for block in range(4):
            start, stop = store.layout.span(block)
            np.testing.assert_array_equal(store.variance(c, block), 2.0 * variance(T)[start:stop].data)
    store.verify()


def test_variance_of_some_columns_only_is_unknown_elsewhere(tmp_path: Path) -> None:
    store = make(tmp_path / "T.zarr", orientation="columns")
    T = transport()
    for block in range(4):
        columns = part(store, T, block)
        store.write(0, block, columns, np.ones(columns.nnz) if block == 2 else None)
    store.finalize()
    found = store.variance(0, 0)
    assert found is not None
    known = (store.read(0, 0).indices >= 6) & (store.read(0, 0).indices < 9)
    np.testing.assert_array_equal(np.isnan(found), ~known)


def test_blocks_are_memory_mapped(tmp_path: Path) -> None:
    store = fill(make(tmp_path / "T.zarr"))
    data = store.read(0, 0).data
    while isinstance(data, np.ndarray) and not isinstance(data, np.memmap):
        assert data.base is not None
        data = data.base
    assert not store.read(0, 0).data.flags.writeable


def test_plain_zarr_reads_it(tmp_path: Path) -> None:
    fill(make(tmp_path / "T.zarr"), with_variance=True)
    root = zarr.open_group(tmp_path / "T.zarr", mode="r")
    assert {name for name, _ in root.groups()} == {".aside", "channel_0", "extra"}
    rows = []
    for block in range(4):
        group = zarr.open_group(tmp_path / "T.zarr" / "channel_0" / f"block_{block:06d}.0", mode="r")
        told: Any = group.attrs["binsparse"]
        assert (told["version"], told["format"]) == ("0.1", "CSR")
        values, indices, pointers = (
            np.asarray(group[name]) for name in ("values", "indices_1", "pointers_to_1")
        )
        for name, array in (("values", values), ("indices_1", indices), ("pointers_to_1", pointers)):
            assert array.dtype == told["data_types"][name]
        assert len(values) == told["number_of_stored_values"]
        rows.append(scipy.sparse.csr_array((values, indices, pointers), shape=told["shape"]).toarray())
    np.testing.assert_array_equal(np.concatenate(rows), transport().toarray())


@settings(deadline=None, max_examples=30)
@given(st.integers(1, 9), st.integers(1, 9), st.integers(1, 10), st.sampled_from(["rows", "columns"]))
def test_any_shape_cut_anyhow(
    tmp_path_factory: pytest.TempPathFactory, rows: int, columns: int, size: int, orientation: str
) -> None:
    path = tmp_path_factory.mktemp("store") / "T.zarr"
    grids = {"shape": (rows, columns), "grid": (1, columns), "camera_grid": (rows, 1)}
    store = fill(make(path, **grids, block_rows=size, orientation=orientation))
    np.testing.assert_array_equal(whole(store), transport(rows, columns).toarray())


def test_a_block_may_be_written_again(tmp_path: Path) -> None:
    store = fill(make(tmp_path / "T.zarr"), final=False)
    twice = part(store, transport() * np.float32(2), 1)
    store.write(0, 1, twice)
    np.testing.assert_array_equal(store.read(0, 1).toarray(), twice.toarray())
    store.verify()


def test_missing_blocks_are_named(tmp_path: Path) -> None:
    store = make(tmp_path / "T.zarr")
    for block in (0, 2):
        store.write(0, block, part(store, transport(), block))
    assert store.missing() == [(0, 1), (0, 3)]
    with pytest.raises(FileError, match=r"lacks 2 block\(s\) \(channel, block\) \(0, 1\), \(0, 3\) of rows"):
        store.finalize()
    with pytest.raises(FileError, match=r"channel_0/block_000001 is missing"):
        store.read(0, 1)


def test_first_bounce_is_found(tmp_path: Path) -> None:
    store = make(tmp_path / "T.zarr", shape=(12, 12), camera_grid=None, channels=3, orientation="columns")
    fill(store)
    expected = np.stack([transport(12, 12, channel).diagonal() for channel in range(3)])
    np.testing.assert_array_equal(store.extra("first_bounce"), expected)
    np.testing.assert_array_equal(np.flatnonzero(store.extra("masked")), [3])


def test_extra_arrays(tmp_path: Path) -> None:
    store = make(tmp_path / "T.zarr")
    for dtype in ("bool", "uint8", "int64", "float16", "float32", "float64"):
        for shape in ((), (0,), (3,), (2, 3), (2, 0, 4)):
            array = np.arange(np.prod(shape, dtype=int)).reshape(shape).astype(dtype)
            store.extra("an.array-1", array)
            found = BlockStore.open(store.path).extra("an.array-1")
            assert (found.dtype, found.shape) == (array.dtype, array.shape)
            np.testing.assert_array_equal(found, array)
    assert store.extras == ["an.array-1"]
    np.testing.assert_array_equal(
        np.asarray(zarr.open_array(next((store.path / "extra").glob("an*/array")))), found
    )
    store.verify()
    with pytest.raises(InputError, match="letter first"):
        store.extra("../escape", np.ones(2))
    with pytest.raises(InputTypeError, match="real numbers"):
        store.extra("words", np.array(["a"]))


def test_attributes(tmp_path: Path) -> None:
    store = make(tmp_path / "T.zarr", provenance={"rig": "virtual", "seed": 3})
    store.update(step=4, name="π")
    BlockStore.open(store.path, "a").update(step=5)
    assert store.attributes == {"step": 5, "name": "π"}
    versions = {"ltcl": ltcl.__version__, "numpy": np.__version__, "scipy": scipy.__version__}
    told = BlockStore.open(store.path).provenance
    assert told == {"versions": versions, "rig": "virtual", "seed": 3}
    with pytest.raises(InputError, match="plain JSON"):
        store.update(bad=float("nan"))
    with pytest.raises(InputError, match="plain JSON"):
        store.update(bad=object())
    assert store.attributes == {"step": 5, "name": "π"}
    store.verify()


def test_a_final_store_stays_as_it_is(tmp_path: Path) -> None:
    store = fill(make(tmp_path / "T.zarr"))
    store.finalize()
    for opened in (store, BlockStore.open(store.path, "a")):
        with pytest.raises(FileError, match="is final"):
            opened.write(0, 0, part(store, transport(), 0))
    with pytest.raises(FileError, match="mode 'a'"):
        BlockStore.open(store.path).finalize()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"grid": (3, 5)}, "h \\* w must be 12"),
        ({"camera_grid": (3, 3)}, "h \\* w must be 10"),
        ({"camera_grid": None}, "camera_grid is None"),
        ({"channels": 2}, "it must be 1 or 3"),
        ({"orientation": "diagonals"}, "orientation is 'diagonals'"),
        ({"block_rows": 0}, "block_rows is 0"),
        ({"shape": (1 << 31, 1), "grid": (1, 1), "camera_grid": (1 << 31, 1)}, "at most 2147483647"),
        ({"provenance": {"rig": object()}}, "plain JSON"),
    ],
)
def test_bad_stores_are_not_made(tmp_path: Path, options: dict, text: str) -> None:
    with pytest.raises(InputError, match=text):
        make(tmp_path / "T.zarr", **options)
    assert not list(tmp_path.iterdir())


def test_bad_blocks_are_refused(tmp_path: Path) -> None:
    store = make(tmp_path / "T.zarr")
    good = part(store, transport(), 0)
    for block, matrix, text in (
        (0, good[:2], r"matrix has shape \(2, 12\); this block is \(3, 12\)"),
        (4, good, "block is 4; it must be in 0..3"),
        (-1, good, "block is -1"),
        (0, good * np.nan, "NaN"),
        (0, good.astype(np.float64) * 1e39, "matrix as float32"),
    ):
        with pytest.raises(InputError, match=text):
            store.write(0, block, matrix)
    with pytest.raises(InputError, match="other places"):
        store.write(0, 0, good, good[[1, 0, 2]])
    with pytest.raises(InputError, match="negative or infinite"):
        store.write(0, 0, good, np.full(good.nnz, -1.0))
    with pytest.raises(InputTypeError, match="is a ndarray"):
        store.write(0, 0, good.toarray())
    assert store.written == frozenset()


def test_nothing_is_replaced_unasked(tmp_path: Path) -> None:
    path = tmp_path / "T.zarr"
    fill(make(path))
    with pytest.raises(FileError, match="is there already"):
        make(path)
    BlockStore.open(path).verify()
    assert make(path, overwrite=True).written == frozenset()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").write_text("years of work")
    with pytest.raises(FileError, match="is no store of ltcl"):
        make(tmp_path / "other", overwrite=True)
    assert (tmp_path / "other" / "thesis.txt").exists()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["T.zarr", "other"]


def test_what_is_no_store(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    for name, text in (
        ("nowhere", "no such folder"),
        ("file", "is no folder"),
        (".", "zarr.json is missing"),
    ):
        with pytest.raises(FileError, match=text):
            BlockStore.open(tmp_path / name)
    zarr.create_group(tmp_path / "plain")
    with pytest.raises(FileError, match="not written by ltcl"):
        BlockStore.open(tmp_path / "plain")


def test_a_diagonal_below_its_noise_is_no_first_bounce(tmp_path: Path) -> None:
    """Variances of `fill` are 1, 2, ... in the order of the entries; only the first few are far above."""
    for sigmas in (0.0, 0.5):
        store = make(tmp_path / f"{sigmas}.zarr", shape=(12, 12), camera_grid=None, block_rows=5)
        fill(store, with_variance=True, final=False)
        store.finalize(sigmas=sigmas)
        T = transport(12, 12)
        F, sigma = T.diagonal(), np.sqrt(variance(T).diagonal())
        wanted = np.where(sigmas * sigma < F, F, 0.0)
        np.testing.assert_array_equal(store.extra("first_bounce"), wanted[None])
        np.testing.assert_array_equal(store.extra("masked"), wanted <= 0)
        assert (np.count_nonzero(wanted) < np.count_nonzero(F > 0)) == (sigmas > 0)
