# SPDX-License-Identifier: BSD-3-Clause
"""Archives: three layouts come back exactly, broken and lying ones are refused."""

from __future__ import annotations

import io
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse

from ltcl.errors import FileError, MemoryLimitError
from ltcl.store import formats
from ltcl.store.record import Record
from tests.store.helpers import as_dense, dense, record_in, refusal, same, sparse

CSR = {"format": np.array(b"csr"), "shape": np.array([2, 3])}


def csr_parts(**changes: object) -> dict[str, object]:
    """A good (2, 3) matrix in SciPy's layout, with changes."""
    parts = {"data": np.ones(3), "indices": np.array([0, 2, 1]), "indptr": np.array([0, 2, 3])}
    return CSR | parts | changes


def raw_archive(path: Path, members: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> None:
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize(
    "matrices",
    [
        lambda dtype: (dense(dtype=dtype),),
        lambda dtype: (dense(20, 12, dtype),),
        lambda dtype: tuple(dense(dtype=dtype, seed=seed) for seed in range(3)),
        lambda dtype: (sparse(dtype=dtype),),
        lambda dtype: tuple(sparse(dtype=dtype, seed=seed) for seed in range(3)),
        lambda dtype: tuple(sparse(dtype=dtype, pattern=pattern) for pattern in range(3)),
    ],
    ids=["dense", "rectangular", "rgb", "sparse", "sparse rgb, one pattern", "sparse rgb, three patterns"],
)
@pytest.mark.parametrize("extras", [False, True])
def test_records_come_back(tmp_path, matrices, dtype, extras):
    record = Record(matrices(dtype))
    if extras:
        rows, columns = record.shape
        record = Record(record.matrices, (3, 4), (1, rows), np.arange(columns, dtype=np.float64))
    formats.write(tmp_path / "T.npz", record)
    same(record_in(tmp_path / "T.npz"), record)


def test_one_sparse_channel_is_readable_by_scipy(tmp_path):
    formats.write(tmp_path / "T.npz", Record((sparse(),), (3, 4)))
    loaded = scipy.sparse.load_npz(tmp_path / "T.npz")
    assert isinstance(loaded, scipy.sparse.csr_array)
    np.testing.assert_array_equal(loaded.toarray(), sparse().toarray())


def test_one_pattern_is_stored_once(tmp_path):
    formats.write(tmp_path / "T.npz", Record(tuple(sparse(seed=seed) for seed in range(3))))
    with np.load(tmp_path / "T.npz") as archive:
        assert archive["data"].shape == (3, sparse().nnz)
        assert archive["indices"].shape == (sparse().nnz,)


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("kind", ["array", "matrix"])
@pytest.mark.parametrize("layout", ["csr", "csc", "coo", "bsr", "dia"])
def test_every_layout_of_scipy_is_read(tmp_path, layout, kind, compressed):
    T = getattr(scipy.sparse, f"{layout}_{kind}")(sparse(dtype="float64"))
    scipy.sparse.save_npz(tmp_path / "T.npz", T, compressed=compressed)
    (result,) = record_in(tmp_path / "T.npz").matrices
    assert isinstance(result, scipy.sparse.csr_array)
    np.testing.assert_array_equal(result.toarray(), T.toarray())


@pytest.mark.parametrize("index", ["int8", ">i8", "uint16", "uint64"])
def test_indices_of_any_integer_type_are_read(tmp_path, index):
    T = sparse()
    np.savez(
        tmp_path / "T.npz",
        format="csr",
        shape=np.array(T.shape),
        data=T.data.astype(">f4"),
        indices=T.indices.astype(index),
        indptr=T.indptr.astype(index),
    )
    same(record_in(tmp_path / "T.npz"), Record((T,)))


def test_coo_with_coords_is_read(tmp_path):
    T = sparse().tocoo()
    parts = {"data": T.data, "coords": np.array([T.row, T.col]), "shape": np.array(T.shape)}
    np.savez(tmp_path / "T.npz", format=b"coo", **parts)
    same(record_in(tmp_path / "T.npz"), Record((sparse(),)))


def test_named_arrays_are_read(tmp_path):
    np.savez_compressed(tmp_path / "T.npz", T=dense(), grid=[3, 4], first_bounce=np.ones(12), noise=dense())
    same(record_in(tmp_path / "T.npz"), Record((dense(),), (3, 4), None, np.ones(12)))
    np.savez(tmp_path / "T.npz", dense(), grid=[3, 4], camera_grid=[2, 6], names=np.array(["a"]))
    same(record_in(tmp_path / "T.npz"), Record((dense(),), (3, 4), (2, 6)))


def test_unreadable_neighbours_of_the_only_matrix_do_not_matter(tmp_path):
    np.savez(tmp_path / "T.npz", light=dense(), notes=np.array([{"by": "me"}], object))
    same(record_in(tmp_path / "T.npz"), Record((dense(),)))


@pytest.mark.parametrize(
    ("arrays", "text"),
    [
        ({"a": dense(), "b": dense()}, "holds 'a' (12, 12), 'b' (12, 12); it must hold T"),
        ({"patterns": np.ones((5, 4, 4))}, "'patterns' (5, 4, 4)"),
        ({"words": np.array(["x"])}, "no array of numbers"),
        ({"T": np.ones((2, 4, 4))}, "array 'T' has shape (2, 4, 4)"),
        ({"T": np.array([[None]])}, "pickled Python objects"),
        ({"T": np.ones((2, 2), complex)}, "'T' holds '<c16'; it must hold real numbers"),
        ({"T": dense(), "grid": [3, 4, 5]}, "'grid' has shape (3,)"),
        ({"T": dense(), "grid": [0, 12]}, "'grid' is [0, 12]; it must be two positive integers"),
        ({"T": dense(), "grid": [2.5, 3.0]}, "'grid' is [2.5, 3.0]"),
        ({"T": dense(), "first_bounce": np.ones(11)}, "first_bounce has shape (11,)"),
        (csr_parts(format=np.array(b"lil")), "layout of the archive is 'lil'"),
        (csr_parts(format=np.array("ltcl-rgb-csr-2")), "it must be one of csr, csc"),
        (csr_parts(format=np.array(3)), "array 'format' is int64"),
        (csr_parts(shape=np.array([2])), "'shape' is int64 (1,); it must be two integers"),
        (csr_parts(shape=np.array([2.0, 3.0])), "it must be two integers"),
        (csr_parts(shape=np.array([2, -3])), "declared as (2, -3)"),
        (csr_parts(shape=np.array([0, 3])), "declared as (0, 3)"),
        (csr_parts(shape=np.array([2, 2**62])), "declared as (2, 4611686018427387904) with 3 entries"),
        (csr_parts(shape=np.array([3, 3])), "indptr has 3 entries from 0; it must have 4"),
        (csr_parts(indices=np.array([0, 3, 1])), "indices holds 3; column indices must be in 0..2"),
        (csr_parts(indices=np.array([0, -1, 1])), "indices holds -1"),
        (csr_parts(indices=np.array([0, 2**63, 1], np.uint64)), "indices holds -"),
        (csr_parts(indices=np.array([0.0, 2.0, 1.0])), "must be a vector of integers"),
        (csr_parts(indices=np.array([0, 2])), "the three must agree"),
        (csr_parts(indptr=np.array([0, 3, 2])), "must never fall"),
        (csr_parts(indptr=np.array([0, 2, 9])), "ends at 9 with 3 indices"),
        (csr_parts(indptr=np.array([1, 2, 3])), "entries from 1"),
        (csr_parts(indptr=np.zeros(0, int)), "entries from none"),
        (csr_parts(data=np.ones((3, 3))), "data has shape (3, 3)"),
        (csr_parts(data=np.array([1, np.nan, 2])), "1 NaN"),
        (csr_parts(data=np.array([1, 1j, 2])), "real numbers"),
        (csr_parts(format=np.array(b"csc")), "indptr has 3 entries from 0; it must have 4"),
        (CSR | {"data": np.ones(3)}, "array 'indices' is missing"),
        ({"data": np.ones((3, 3)), "indices": [0, 1, 2], "indptr": [0, 3]}, "array 'format' is missing"),
        ({"data": np.ones((3, 3)), "offsets": [0, 1, 2], "format": "dia"}, "array 'shape' is missing"),
        (
            CSR | {"format": "coo", "data": [1.0], "row": [2], "col": [0]},
            "row holds 2..2; indices must be in 0..1",
        ),
        (CSR | {"format": "coo", "data": [1.0], "row": [1], "col": [-1]}, "col holds -1..-1"),
        (CSR | {"format": "coo", "data": [1.0], "row": [1, 1], "col": [0]}, "vectors of one length"),
        (CSR | {"format": "coo", "data": [1.0], "row": [0.5], "col": [0]}, "row is float64"),
        (CSR | {"format": "coo", "data": [1.0], "coords": [[0], [1], [1]]}, "coords has shape (3, 1)"),
        (CSR | {"format": "dia", "data": np.ones((1, 3)), "offsets": [3]}, "offsets hold 3..3"),
        (CSR | {"format": "dia", "data": np.ones((2, 3)), "offsets": [0, 0]}, "twice"),
        (CSR | {"format": "dia", "data": np.ones((2, 3)), "offsets": [0]}, "one integer per row"),
        (csr_parts(format="bsr", data=np.ones((3, 2, 2))), "must be blocks"),
        (csr_parts(format="bsr", data=np.ones((3, 1, 1)), indices=[0, 9, 1]), "indices holds 9"),
        (csr_parts(format="bsr", data=np.full((3, 1, 1), np.inf)), "3 NaN or infinite"),
        (csr_parts(format="ltcl-rgb-csr-1"), "data has shape (3,); it must be (3, entries)"),
        (csr_parts(format="ltcl-rgb-csr-1", data=np.ones((3, 4))), "the three must agree"),
        (CSR | {"format": "ltcl-rgb-csr-1"}, "array 'data_0' is missing"),
    ],
)
def test_archives_that_hold_no_transport_are_refused(tmp_path, arrays, text):
    np.savez(tmp_path / "T.npz", **arrays)
    assert text in refusal(tmp_path / "T.npz", FileError)


def test_damaged_archives_are_refused(tmp_path):
    path = tmp_path / "T.npz"
    formats.write(path, Record((dense(),), (3, 4)))
    good = path.read_bytes()
    payload = good.index(dense().tobytes())
    for data in (
        good[: len(good) // 2],
        good[:-1],
        good[:payload] + bytes([good[payload] ^ 1]) + good[payload + 1 :],
        b"PK\x03\x04",
    ):
        path.write_bytes(data)
        assert "damaged or truncated" in refusal(path, FileError)
    for data in (npy(dense()), b"not an archive at all"):
        path.write_bytes(data)
        assert f"is no .npz archive: it begins with {data[:4]!r}" in refusal(path, FileError)


def test_a_small_archive_cannot_declare_terabytes(tmp_path):
    """The sizes lie in all three places: local header, directory, and the array's own header."""
    path = tmp_path / "T.npz"
    text = b"{'descr': '<f4', 'fortran_order': False, 'shape': (3000000, 3000000), }"
    array = b"\x93NUMPY\x01\0" + struct.pack("<H", len(text)) + text
    raw_archive(path, {"T.npy": array})
    assert "declares float32 (3000000, 3000000)" in refusal(path, FileError)
    claimed = len(array) + 4 * 3000000**2
    with zipfile.ZipFile(path, "w") as archive:
        info = zipfile.ZipInfo("T.npy")
        archive.writestr(info, array)
        info.file_size = claimed  # goes into the directory on closing
    assert "declares 32.74 TiB, but its" in refusal(path, FileError)
    with zipfile.ZipFile(path, "w") as archive:
        info = zipfile.ZipInfo("T.npy")
        archive.writestr(info, array)
        info.file_size = info.compress_size = claimed
    assert "in an archive of" in refusal(path, FileError)


def test_a_bomb_is_a_matter_of_memory(tmp_path, monkeypatch):
    path = tmp_path / "T.npz"
    np.savez_compressed(path, T=np.zeros((2000, 2000)))
    assert path.stat().st_size < 100_000
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: 1_000_000)
    assert "32000000 bytes" not in refusal(path, MemoryLimitError)


@pytest.mark.parametrize("compression", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_compressions_are_refused(tmp_path, compression):
    raw_archive(tmp_path / "T.npz", {"T.npy": npy(dense())}, compression)
    assert "compressed by method" in refusal(tmp_path / "T.npz", FileError)


def test_encrypted_and_double_members_are_refused(tmp_path):
    path = tmp_path / "T.npz"
    raw_archive(path, {"T.npy": npy(dense())})
    data = bytearray(path.read_bytes())
    data[6] |= 1
    data[data.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(data)
    assert "encrypted" in refusal(path, FileError)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("T.npy", npy(dense()))
        with pytest.warns(UserWarning, match="Duplicate"):
            archive.writestr("T.npy", npy(dense()))
    assert "of one name" in refusal(path, FileError)


def test_bytes_after_an_array_are_refused(tmp_path):
    raw_archive(tmp_path / "T.npz", {"T.npy": npy(dense()) + b"more"})
    assert "is longer than it says" in refusal(tmp_path / "T.npz", FileError)


def test_an_archive_without_arrays_is_refused(tmp_path):
    raw_archive(tmp_path / "T.npz", {"readme.txt": b"hello"})
    assert "no array of numbers" in refusal(tmp_path / "T.npz", FileError)


def test_a_transport_traced_by_others_is_read(shared_data):
    given = shared_data / "transport-dihedral" / "transport.npz"
    record = record_in(given)
    assert (record.shape, record.grid, record.first_bounce) == ((4096, 4096), (64, 64), None)
    T = as_dense(record.matrices[0])
    assert T.dtype == np.float32
    assert np.isfinite(T).all()
    assert np.median(T.diagonal()) > 10 * np.median(T)  # direct light stands on the diagonal
    assert "'bounces' (5, 7, 64, 64)" in refusal(given.with_name("bounces.npz"), FileError)
