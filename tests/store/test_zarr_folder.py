# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.device import Device
from ltcl.errors import FileError
from ltcl.store import BlockStore, Record, StoredRows, formats

from .blocks.helpers import fill, make, transport
from .helpers import as_dense, dense, sparse


def store(path: Path, channels: int = 1) -> Path:
    """Of a square transport without dark pixels, in blocks of 5 rows."""
    T = [sparse(12, seed=channel, pattern=channel) for channel in range(channels)]
    made = make(path, shape=(12, 12), camera_grid=None, block_rows=5, channels=channels)
    for channel, matrix in enumerate(T):
        for block in range(3):
            made.write(channel, block, matrix[block * 5 : block * 5 + 5])
    made.finalize()
    return path


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("kind", ["dense", "sparse"])
def test_save_and_load(tmp_path: Path, kind: str, channels: int) -> None:
    make_one = {"dense": dense, "sparse": sparse}[kind]
    T = [
        make_one(12, seed=channel) if kind == "sparse" else dense(seed=channel) for channel in range(channels)
    ]
    F = np.linspace(1, 2, 12 * channels).reshape(channels, 12)
    mixing = np.eye(3) + 0.1 if channels == 3 else None
    path = tmp_path / "T.zarr"
    saved = ltcl.Transport(T if channels == 3 else T[0], grid=(3, 4), first_bounce=F, mixing=mixing)
    ltcl.save(path, saved)
    ltcl.save(path, saved)  # again, onto itself
    loaded = ltcl.load(path)
    assert all(isinstance(matrix, StoredRows) for matrix in loaded.matrices)
    for matrix, expected in zip(loaded.matrices, T, strict=True):
        np.testing.assert_array_equal(matrix.tocsr().toarray(), as_dense(expected))
    np.testing.assert_array_equal(np.atleast_2d(loaded.first_bounce), F)
    assert (loaded.mixing is None) == (mixing is None)
    assert [p.name for p in tmp_path.iterdir()] == ["T.zarr"]


def test_rectangular(tmp_path: Path) -> None:
    fill(make(tmp_path / "T.zarr"))
    T = ltcl.load(tmp_path / "T.zarr")
    assert (T.grid, T.camera_grid) == ((3, 4), (2, 5))
    x = np.random.default_rng(0).random((3, 4))
    np.testing.assert_allclose((T @ x).ravel(), transport().toarray() @ x.ravel(), rtol=1e-5)


@pytest.mark.parametrize("channels", [1, 3])
def test_it_does_what_one_in_memory_does(tmp_path: Path, channels: int) -> None:
    path = store(tmp_path / "T.zarr", channels)
    T = ltcl.load(path)
    parts = [matrix.tocsr() for matrix in T.matrices]
    other = ltcl.Transport(parts if channels == 3 else parts[0], grid=(3, 4))
    desired = np.random.default_rng(0).random((3, 4, 3) if channels == 3 else (3, 4))
    for S, expected in zip(T.systems, other.systems, strict=True):
        np.testing.assert_array_equal(S.to_dense(), expected.to_dense())
        assert S.R.norms() == pytest.approx(expected.R.norms(), rel=1e-6)
        np.testing.assert_array_equal(S.R.diagonal(), expected.R.diagonal())
    np.testing.assert_allclose(T @ desired, other @ desired, rtol=1e-6)
    for made in (ltcl.separate, ltcl.compensate):
        a, b = (made(one, desired, rtol=1e-4) for one in (T, other))
        name = "direct" if made is ltcl.separate else "pattern"
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-3, atol=1e-4)
    assert T.reciprocity_defect == pytest.approx(other.reciprocity_defect, rel=1e-5)
    x = np.random.default_rng(1).random(12)
    np.testing.assert_allclose(T.systems[0].rmatvec(x), other.systems[0].rmatvec(x), rtol=1e-5)


def test_masked_pixels(tmp_path: Path) -> None:
    fill(make(tmp_path / "T.zarr", shape=(12, 12), camera_grid=None))
    T = ltcl.load(tmp_path / "T.zarr", on_dark="mask")
    other = ltcl.Transport(transport(12, 12), grid=(3, 4), on_dark="mask")
    np.testing.assert_array_equal(T.masked, other.masked)
    np.testing.assert_array_equal(T.systems[0].to_dense(), other.systems[0].to_dense())


def test_a_given_bounce_where_nothing_is_stored(tmp_path: Path) -> None:
    F = np.full(12, 0.5)
    fill(make(tmp_path / "T.zarr", shape=(12, 12), camera_grid=None))
    T = ltcl.load(tmp_path / "T.zarr", first_bounce=F)
    other = ltcl.Transport(transport(12, 12), grid=(3, 4), first_bounce=F)
    np.testing.assert_array_equal(T.systems[0].to_dense(), other.systems[0].to_dense())


def test_compress_streams_the_rows(tmp_path: Path) -> None:
    scene = ltcl.scenes.dihedral(4)
    ltcl.save(tmp_path / "T.zarr", scene.transport())
    T = ltcl.load(tmp_path / "T.zarr")
    found = ltcl.compress(T, rtol=1e-2)
    ltcl.save(tmp_path / "C.zarr", found)
    ltcl.save(tmp_path / "C.npz", found)
    b = np.random.default_rng(0).random(found.grid)
    expected = ltcl.load(tmp_path / "C.npz") @ b
    np.testing.assert_array_equal(ltcl.load(tmp_path / "C.zarr") @ b, expected)
    np.testing.assert_allclose(expected, T @ b, rtol=0.05, atol=0.01 * expected.max())
    BlockStore.open(tmp_path / "C.zarr").verify()


def test_only_one_block_is_in_memory(tmp_path: Path, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Relighting and solving ask for no matrix of all blocks."""
    path = store(tmp_path / "T.zarr")
    monkeypatch.setattr(StoredRows, "tocsr", None)
    monkeypatch.setattr(scipy.sparse, "vstack", lambda parts, *rest: parts[0] if len(parts) == 1 else 1 / 0)
    monkeypatch.setattr("ltcl.operators.csr._SLAB", 1)
    T = ltcl.load(path, device=device)
    x = np.random.default_rng(0).random((3, 4))
    expected = np.concatenate([part.toarray() for _, part in T.matrices[0].row_blocks()]) @ x.ravel()
    np.testing.assert_allclose((T @ x).ravel(), expected, rtol=1e-5)
    assert (
        ltcl.solve(T.interreflection, x.ravel(), "richardson", rtol=1e-3, maxiter=5, throw=False).products
        == 5
    )


def test_loading_notices_damage_without_being_asked(tmp_path: Path) -> None:
    path = store(tmp_path / "T.zarr")
    for file in sorted((path / "channel_0").rglob("*")):
        if file.is_file():
            good = file.read_bytes()
            file.write_bytes(good[:-1] + bytes([good[-1] ^ 128]))
            with pytest.raises(FileError, match=r"T\.zarr: channel_0/"):
                ltcl.load(path)
            file.write_bytes(good)
    ltcl.load(path)


def test_what_is_not_whole_is_not_loaded(tmp_path: Path) -> None:
    path = tmp_path / "T.zarr"
    made = make(path)
    with pytest.raises(FileError, match=r"T\.zarr: lacks 4 block\(s\) \(channel, block\) \(0, 0\), \(0, 1\)"):
        ltcl.load(path)
    fill(made, final=False)
    assert ltcl.load(path).shape == (10, 12)  # all there, though the scanner has not said so
    fill(make(path, overwrite=True, orientation="columns"), final=False)
    with pytest.raises(FileError, match="finalize it first"):
        ltcl.load(path)


def test_any_folder_that_is_a_store(tmp_path: Path) -> None:
    assert ltcl.load(store(tmp_path / "scan")).shape == (12, 12)
    (tmp_path / "other").mkdir()
    with pytest.raises(FileError, match=r"zarr\.json is missing"):
        ltcl.load(tmp_path / "other")
    with pytest.raises(FileError, match="no such folder"):
        ltcl.load(tmp_path / "nowhere.zarr")


@pytest.mark.parametrize("extension", [".npz", ".mtx", ".zarr"])
def test_export(tmp_path: Path, extension: str) -> None:
    path = store(tmp_path / "T.zarr")
    ltcl.save(tmp_path / f"out{extension}", ltcl.load(path))
    record = formats.read(tmp_path / f"out{extension}")
    assert isinstance(record, Record)
    T = record.in_memory().matrices[0]
    np.testing.assert_allclose(as_dense(T), sparse(12, seed=0, pattern=0).toarray(), rtol=1e-6)
    assert record.grid == (3, 4)


def test_a_grid_is_needed(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="does not tell it; give grid"):
        formats.write(tmp_path / "T.zarr", Record((dense(),)))
    (tmp_path / "T.zarr").mkdir()
    (tmp_path / "T.zarr" / "thesis.txt").write_text("years of work")
    with pytest.raises(FileError, match="is no store of ltcl"):
        formats.write(tmp_path / "T.zarr", Record((dense(),), (3, 4)))


def test_a_diagonal_of_float64_is_the_one_that_is_kept(tmp_path: Path) -> None:
    """Else R would have a diagonal of rounding errors."""
    ltcl.save(tmp_path / "T.zarr", ltcl.Transport(dense(dtype="float64"), grid=(3, 4)))
    T = ltcl.load(tmp_path / "T.zarr")
    np.testing.assert_array_equal(T.systems[0].R.diagonal(), 0.0)
    np.testing.assert_array_equal(T.first_bounce, dense(dtype="float64").diagonal().astype(np.float32))
