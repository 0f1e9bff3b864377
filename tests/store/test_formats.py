# SPDX-License-Identifier: BSD-3-Clause
"""Transport files: what is written comes back, others' files are read, what lies is refused in one line."""

from __future__ import annotations

import io
import logging
import struct
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
import scipy.sparse

import ltcl
from ltcl.errors import FileError, MemoryLimitError
from ltcl.store import Record, formats

from .helpers import as_dense, dense, record_in, refusal, same, sparse

random = np.random.default_rng()
NAMED = (".npz", ".h5", ".hdf5", ".mat", ".zarr")  # which keep everything
MIXING = np.eye(3) + np.triu(np.full((3, 3), 0.1))
CSR = {"format": np.array(b"csr"), "shape": np.array([2, 3])}
COORDINATE = b"%%MatrixMarket matrix coordinate real general\n"
ARRAY = b"%%MatrixMarket matrix array real general\n"


def as_rows(T: Any) -> scipy.sparse.csr_array:
    return scipy.sparse.csr_array(T)


def matrices(kind: str, channels: int, dtype: str) -> tuple[Any, ...]:
    """Of 10 x 12, or sparse of 12 x 12 with or without one pattern for all."""
    if kind == "dense":
        return tuple(dense(10, 12, dtype, seed) for seed in range(channels))
    return tuple(sparse(12, dtype, k, pattern=k if kind == "patterns" else 1) for k in range(channels))


@pytest.mark.parametrize("extension", NAMED)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize(
    ("kind", "channels"), [("dense", 1), ("dense", 3), ("sparse", 1), ("sparse", 3), ("patterns", 3)]
)
def test_everything_comes_back(tmp_path: Path, extension: str, kind: str, channels: int, dtype: str) -> None:
    T = matrices(kind, channels, dtype)
    square = kind != "dense"  # else there is no first bounce
    F = random.uniform(1, 2, (12,) if channels == 1 else (3, 12)) if square else None
    record = Record(T, (3, 4), None if square else (2, 5), F, MIXING if channels == 3 else None)
    path = tmp_path / f"T{extension}"
    formats.write(path, record)
    formats.write(path, record)  # again, onto itself
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    back = record_in(path).in_memory()
    if extension == ".zarr":  # which has sparse rows
        record = replace(record, matrices=tuple(map(scipy.sparse.csr_array, T)))
    if extension == ".mat" and kind != "dense":  # MATLAB's sparse ones are of float64
        back = replace(back, matrices=tuple(one.astype(dtype) for one in map(as_rows, back.matrices)))
    same(back, record)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize(
    "T", [(dense(5, 12),), (dense(), dense(seed=2), dense(seed=3))], ids=["one", "three"]
)
def test_npy_keeps_the_matrix_alone(tmp_path: Path, T: Any, dtype: str, caplog: Any) -> None:
    record = Record(tuple(one.astype(dtype) for one in T))
    with caplog.at_level(logging.WARNING):
        formats.write(tmp_path / "T.npy", record)
        assert not caplog.messages
        if len(T) == 3:
            formats.write(tmp_path / "T.npy", replace(record, first_bounce=np.ones(12)))
            assert "first bounce" in caplog.text
    same(record_in(tmp_path / "T.npy"), record)
    with pytest.raises(FileError, match=r"T\.npy: T is sparse"):
        formats.write(tmp_path / "T.npy", Record((sparse(),)))


@pytest.mark.parametrize("make", [sparse, dense])
@pytest.mark.parametrize("grids", [(None, None), ((3, 4), None), ((3, 4), (2, 6))])
@pytest.mark.parametrize("name", ["T.mtx", "T.MTX"])
def test_mtx_is_one_file_a_channel(tmp_path: Path, make: Any, grids: Any, name: str) -> None:
    T = tuple(make(seed=k).astype(np.float64) for k in (1, 2, 3))
    formats.write(tmp_path / "one" / name, Record(T[:1], *grids))
    same(record_in(tmp_path / "one" / name), Record(T[:1], *grids))
    formats.write(tmp_path / name, Record(T, *grids))
    same(record_in(tmp_path / name), Record(T, *grids))
    for file, one in zip(sorted(tmp_path.glob("T*"), key=lambda f: "rgb".index(f.stem[-1])), T, strict=True):
        np.testing.assert_array_equal(scipy.sparse.csr_array(scipy.io.mmread(file)).toarray(), as_dense(one))
    with pytest.raises(FileError, match="would be read in place of"):
        formats.write(tmp_path / "one" / name, Record(T, *grids))
    formats.write(sorted(tmp_path.glob("T_g*"))[0], Record((np.eye(6),)))
    assert "shape (12, 12), (6, 6), (12, 12)" in refusal(tmp_path / name, FileError)
    sorted(tmp_path.glob("T_g*"))[0].unlink()
    with pytest.raises(FileError, match=r"T_g\.(mtx|MTX): no such file"):
        formats.read(tmp_path / name)


@pytest.mark.parametrize("kind", ["array", "matrix"])
@pytest.mark.parametrize("layout", ["csr", "csc", "coo", "bsr", "dia"])
def test_every_layout_of_scipy_is_read_and_one_is_written(tmp_path: Path, layout: str, kind: str) -> None:
    T = getattr(scipy.sparse, f"{layout}_{kind}")(sparse(dtype="float64"))
    scipy.sparse.save_npz(tmp_path / "T.npz", T, compressed=kind == "matrix")
    (result,) = record_in(tmp_path / "T.npz").matrices
    assert isinstance(result, scipy.sparse.csr_array)
    np.testing.assert_array_equal(result.toarray(), T.toarray())
    formats.write(tmp_path / "T.npz", Record((result,), (3, 4)))
    loaded = scipy.sparse.load_npz(tmp_path / "T.npz")
    assert isinstance(loaded, scipy.sparse.csr_array)
    np.testing.assert_array_equal(loaded.toarray(), T.toarray())


@pytest.mark.parametrize("index", ["int8", ">i8", "uint16", "uint64"])
def test_indices_of_any_integer_type_are_read(tmp_path: Path, index: str) -> None:
    T = sparse()
    indices = {"indices": T.indices.astype(index), "indptr": T.indptr.astype(index)}
    parts: Any = {"data": T.data.astype(">f4"), "shape": T.shape, **indices}
    np.savez(tmp_path / "T.npz", format="csr", **parts)
    same(record_in(tmp_path / "T.npz"), Record((T,)))


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize(
    ("stored", "read"),
    [
        (">f4", "f4"),
        (">f8", "f8"),
        ("f2", "f4"),
        ("u1", "f4"),
        (">u2", "f4"),
        ("i4", "f8"),
        ("u8", "f8"),
        ("?", "f4"),
    ],
)
@pytest.mark.parametrize("extension", [".npy", ".npz"])
def test_types_and_byte_orders(tmp_path: Path, extension: str, stored: str, read: str, order: Any) -> None:
    T = np.asarray(dense(4, 6).astype(stored), order=order)
    np.save(tmp_path / "T.npy", T[None])  # one channel in front is dropped
    np.savez(tmp_path / "T.npz", T=T)
    (result,) = record_in(tmp_path / f"T{extension}").matrices
    assert (result.dtype, result.dtype.isnative) == (np.dtype(read), True)
    np.testing.assert_array_equal(result, T.astype(read))


def test_named_arrays_are_read(tmp_path: Path) -> None:
    path = tmp_path / "T.npz"
    np.savez_compressed(path, T=dense(), grid=[3, 4], first_bounce=np.ones(12), noise=dense())
    same(record_in(path), Record((dense(),), (3, 4), None, np.ones(12)))
    np.savez(path, light=dense(), grid=[3, 4], camera_grid=[2, 6], names=np.array(["a"]))
    same(record_in(path), Record((dense(),), (3, 4), (2, 6)))
    np.savez(path, light=dense(), notes=np.array([{"by": "me"}], object))
    same(record_in(path), Record((dense(),)))


VARIABLES = {"a": dense(), "b": 2 * dense(), "grid": np.array([3, 4])}


@pytest.mark.parametrize("extension", [".npz", ".h5", ".mat", "5.mat"])
def test_any_variable_by_its_name(tmp_path: Path, extension: str) -> None:
    path = tmp_path / f"T{extension}"
    if extension == ".npz":
        np.savez(path, a=VARIABLES["a"], b=VARIABLES["b"], grid=[3, 4])
    elif extension == "5.mat":
        scipy.io.savemat(path, VARIABLES)
    else:
        with h5py.File(path, "w", userblock_size=512) as file:
            for name, array in VARIABLES.items():
                file[name] = array.T
    for name in ("a", "b"):
        T = ltcl.load(path, variable=name).matrices[0]
        np.testing.assert_array_equal(T, VARIABLES[name].T if extension == ".h5" else VARIABLES[name])
    text = refusal(path, FileError)
    assert all(word in text for word in ("'a' (12, 12)", "'b' (12, 12)", "variable="))
    with pytest.raises(FileError, match="'c'"):
        formats.read(path, variable="c")
    formats.write(tmp_path / "T.npy", Record((dense(),)))
    with pytest.raises(FileError, match="variable is 'a'"):
        formats.read(tmp_path / "T.npy", variable="a")


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(
    "LTM",
    [dense(dtype="float64"), dense(), np.eye(12), sparse().tocsc().astype(float), random.random((12, 12, 3))],
)
def test_matlab_5(tmp_path: Path, LTM: Any, compressed: bool) -> None:
    """Integers that MATLAB keeps in fewer bytes, other variables, and colour."""
    others = {"name": "text", "cell": {"a": 1}, "grid": [3, 4], "z": 1j * np.eye(2)}
    scipy.io.savemat(tmp_path / "T.mat", {**others, "LTM": LTM}, do_compression=compressed)
    record = record_in(tmp_path / "T.mat")
    assert (record.grid, record.matrices[0].dtype) == ((3, 4), LTM.dtype)
    expected = np.atleast_3d(as_dense(LTM)).transpose(2, 0, 1)
    np.testing.assert_array_equal([as_dense(T) for T in record.matrices], expected)


def test_as_matlab_writes_7_3(tmp_path: Path) -> None:
    """Column-major, so h5py sees the axes in reverse order."""
    path, LTM = tmp_path / "T.mat", np.arange(24.0, dtype=np.float32).reshape(4, 6)
    with h5py.File(path, "w", userblock_size=512) as file:
        file["LTM"] = LTM.T
    np.testing.assert_array_equal(record_in(path).matrices[0], LTM)
    T = scipy.sparse.csc_array(np.array([[0.0, 1.0, 0.0], [2.0, 0.0, 3.0], [0.0, 0.0, 4.0]]))
    with h5py.File(path, "w", userblock_size=512) as file:
        group = file.create_group("LTM")
        group.attrs["MATLAB_sparse"] = np.uint64(3)
        group["data"], group["ir"], group["jc"] = T.data, T.indices.astype("u8"), T.indptr.astype("u8")
    np.testing.assert_array_equal(as_dense(record_in(path).matrices[0]), T.toarray())


def test_sparse_colour_of_mat_is_three_variables(tmp_path: Path) -> None:
    path, T = tmp_path / "T.mat", matrices("patterns", 3, "float64")
    formats.write(path, Record(T, (3, 4)))
    variables = scipy.io.loadmat(path, spmatrix=False)
    for name, one in zip(("LTM_r", "LTM_g", "LTM_b"), T, strict=True):
        np.testing.assert_array_equal(variables[name].toarray(), one.toarray())
    for value in (np.eye(6), np.eye(12), "LTM"):
        scipy.io.savemat(path, {"LTM_r": T[0], "LTM_g": value, "LTM_b": T[2]})
        refusal(path, FileError)


@pytest.mark.parametrize("symmetry", ["general", "symmetric", "skew-symmetric"])
@pytest.mark.parametrize("make", [np.asarray, scipy.sparse.coo_array])
@pytest.mark.parametrize("field", ["real", "integer"])
def test_mtx_of_others_with_and_without_a_last_line_end(
    tmp_path: Path, make: Any, symmetry: str, field: str
) -> None:
    path, T = tmp_path / "T.mtx", np.arange(16.0).reshape(4, 4)
    T = {"general": T, "symmetric": T + T.T, "skew-symmetric": T - T.T}[symmetry]
    scipy.io.mmwrite(path, make(T), symmetry=symmetry, field=field, comment="ltcl knows nothing of me")
    np.testing.assert_array_equal(as_dense(record_in(path).matrices[0]), T)
    path.write_bytes(path.read_bytes().rstrip())
    np.testing.assert_array_equal(as_dense(record_in(path).matrices[0]), T)


def parts(**changes: object) -> dict[str, object]:
    """A good (2, 3) matrix in SciPy's layout, with changes; None leaves one out."""
    good = {"data": np.ones(3), "indices": np.array([0, 2, 1]), "indptr": np.array([0, 2, 3])}
    return {name: value for name, value in (CSR | good | changes).items() if value is not None}


def coo(**changes: object) -> dict[str, object]:
    return CSR | {"format": "coo", "data": [1.0], "row": [1], "col": [0]} | changes


@pytest.mark.parametrize(
    ("arrays", "text"),
    [
        ({"a": dense(), "b": dense()}, "'a' (12, 12), 'b' (12, 12)"),
        ({"patterns": np.ones((5, 4, 4))}, "'patterns' (5, 4, 4)"),
        ({"words": np.array(["x"])}, "no array of numbers"),
        ({"T": np.ones((2, 4, 4))}, "T has shape (2, 4, 4)"),
        ({"T": np.array([[None]])}, "never loaded"),
        ({"T": np.ones((2, 2), complex)}, "'T' holds complex128"),
        ({"T": dense(), "grid": [3, 4, 5]}, "'grid' has shape (3,)"),
        ({"T": dense(), "grid": [0, 12]}, "'grid' is [0, 12]"),
        ({"T": dense(), "grid": [2.5, 3.0]}, "'grid' is [2.5, 3.0]"),
        ({"T": dense(), "first_bounce": np.ones(11)}, "first_bounce has shape (11,)"),
        (parts(format=np.array(b"lil")), "'lil'"),
        (parts(format=np.array(3)), "'format' is int64"),
        (parts(shape=np.array([2])), "'shape' is int64 (1,)"),
        (parts(shape=np.array([2.0, 3.0])), "'shape' is float64"),
        (parts(shape=np.array([2, -3])), "(2, -3)"),
        (parts(shape=np.array([2, 2**62])), "(2, 4611686018427387904) with 3 entries"),
        (parts(shape=np.array([3, 3])), "index pointer size 3"),
        (parts(indices=np.array([0, 3, 1])), "indices holds 3"),
        (parts(indices=np.array([0, -1, 1])), "indices holds -1"),
        (parts(indices=np.array([0, 2**63, 1], np.uint64)), "T.npz"),
        (parts(indices=np.array([0.0, 2.0, 1.0])), "'indices' holds float64"),
        (parts(indptr=np.array([0, 3, 2])), "T.npz"),
        (parts(indptr=np.array([0, 2, 9])), "T.npz"),
        (parts(indptr=np.array([1, 2, 3])), "T.npz"),
        (parts(data=np.array([1, np.nan, 2])), "1 NaN"),
        (parts(data=np.array([1, 1j, 2])), "'data' holds complex128"),
        (parts(format=np.array(b"csc")), "T.npz"),
        (parts(indices=None), "indices"),
        (parts(format=None), "'format' is missing"),
        (coo(row=[2]), "index 2"),
        (coo(col=[-1]), "-1"),
        (coo(row=[1, 1]), "same length"),
        (coo(row=[0.5]), "'row' holds float64"),
        (CSR | {"format": "dia", "data": np.ones((2, 3)), "offsets": [0, 0]}, "duplicate"),
        (parts(format="bsr", data=np.ones((3, 1, 1)), indices=[0, 9, 1]), "9"),
        (parts(format="bsr", data=np.full((3, 1, 1), np.inf)), "3 NaN or infinite"),
        (parts(format="ltcl-rgb-csr-1"), "'data' has shape (3,)"),
        (parts(format="ltcl-rgb-csr-1", data=np.ones((3, 4))), "T.npz"),
        (CSR | {"format": "ltcl-rgb-csr-1"}, "'data_0' is missing"),
    ],
)
def test_archives_that_hold_no_transport_are_refused(tmp_path: Path, arrays: Any, text: str) -> None:
    np.savez(tmp_path / "T.npz", **arrays)
    assert text in "T.npz" + refusal(tmp_path / "T.npz", FileError)


def npy(descr: str, shape: str, fortran: str = "False", body: bytes = b"") -> bytes:
    text = f"{{'descr': {descr}, 'fortran_order': {fortran}, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(text)) + text + body


@pytest.mark.parametrize(
    "data",
    [
        b"PK\x03\x04 an archive under another name",
        b"\x93NUMP",
        b"\x93NUMPY\x09\0\x76\0\0\0",
        b"\x93NUMPY\x02\0\xff\xff\xff\xff",
        b"\x93NUMPY\x01\0\x76\0{'descr'",
        npy("'<f4'", "(4, 4)", body=bytes(60)),
        npy("'<f4'", "(4, 4)", body=bytes(68)),
        npy("'<f4'", "(4000000, 4000000)"),
        npy("'<f4'", f"({2**62}, {2**62})"),
        npy("'<f4'", "(-4, -4)", body=bytes(64)),
        npy("'<f4'", "(True, 4)", body=bytes(16)),
        npy("'<f4'", "(4, 4)", "0", body=bytes(64)),
        npy("'<f4'", "(" * 3000),
        npy("__import__('os')", "(4, 4)"),
        npy("'|O'", "(4, 4)", body=bytes(128)),
        npy("'<c8'", "(4, 4)", body=bytes(128)),
        npy("[('x', '<f4')]", "(4, 4)", body=bytes(64)),
        npy("'<f4'", "(16,)", body=bytes(64)),
        npy("'<f4'", "(2, 2, 4)", body=bytes(64)),
        npy("'<f4'", "(0, 4)"),
    ],
)
def test_npy_headers_that_lie(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "T.npy").write_bytes(data)
    refusal(tmp_path / "T.npy", FileError)
    with zipfile.ZipFile(tmp_path / "T.npz", "w") as archive:
        archive.writestr("T.npy", data)
    refusal(tmp_path / "T.npz", FileError)


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"\x93NUMPY\x01\0", "no Matrix Market file"),
        (COORDINATE.replace(b"real", b"complex") + b"2 2 1\n1 1 1 1\n", "complex"),
        (COORDINATE.replace(b"real", b"pattern") + b"2 2 1\n1 1\n", "pattern"),
        (COORDINATE.replace(b"general", b"hermitian") + b"2 2 1\n1 1 1\n", "hermitian"),
        (COORDINATE + b"% words\n" * 10, "no line of sizes"),
        (COORDINATE + b"2 2\n", "header"),
        (COORDINATE + b"-2 2 1\n1 1 1\n", "'-2 2 1'"),
        (COORDINATE + b"2 2 99999999999999999999\n", "99999999999999999999"),
        (ARRAY + b"2 2 4\n1\n1\n1\n1\n", "header"),
        (COORDINATE + b"9 9 1000000000000\n1 1 1\n", "3000000000000 numbers"),
        (COORDINATE + b"9 9 3\n1 1 1\n", "9 numbers"),
        (COORDINATE + b"9 9 2\n1 1 1.00\n2 2 1.00\n3 3 1.00\n", "'3 3 1.00'"),
        (COORDINATE + b"9 9 2\n1 1 1.00000000000\n", "3 of 6 numbers"),
        (COORDINATE + b"9 9 1\n1 1 1.5E", "1.5E"),
        (COORDINATE + b"900000000000 9 1\n1 1 1\n", "(900000000000, 9) with 1 entries"),
        (COORDINATE + b"0 9 0\n", "(0, 9)"),
        (COORDINATE.replace(b"general", b"symmetric") + b"2 3 1\n1 1 1\n", "square"),
        (ARRAY + b"2000000 2000000\n1\n", "4000000000000 numbers"),
        (ARRAY + b"2 2\n1\n1\n1\nx\n", "values"),
        (COORDINATE + b"2 2 1\n3 1 1\n", "row 3"),
        (COORDINATE + b"2 2 2\n1 1 1\n1 0 1\n", "column 0"),
        (COORDINATE + b"2 2 1\n1.5 1 1\n", "row 1.5"),
        (COORDINATE + b"2 2 1\nnan 1 1\n", "row nan"),
        (COORDINATE + b"2 2 1\n1 99999999999999999999 1\n", "column 1e+20"),
    ],
)
def test_mtx_headers_and_bodies_that_lie(tmp_path: Path, data: bytes, text: str) -> None:
    (tmp_path / "T.mtx").write_bytes(data)
    assert text in refusal(tmp_path / "T.mtx", FileError)


@pytest.mark.parametrize("extension", [".h5", ".mat"])
def test_hostile_hdf5(tmp_path: Path, extension: str) -> None:
    path, name = tmp_path / f"T{extension}", "T" if extension == ".h5" else "LTM"
    secret, huge = tmp_path / "secret.bin", 1 << 20
    secret.write_bytes(bytes(4 * 144))
    cases: list[tuple[dict[str, Any], str]] = [
        ({"shape": (huge, huge), "dtype": "f4", "chunks": (8, 8)}, "4 TiB"),
        ({"shape": (huge, huge), "dtype": "f4"}, "4 TiB"),
        ({"link": h5py.ExternalLink("/etc/passwd", "T")}, "link"),
        ({"link": h5py.SoftLink("/T")}, "link"),
        ({"shape": (12, 12), "dtype": "f4", "external": [(str(secret), 0, 576)]}, "other files"),
        ({"data": np.ones((2, 2), complex)}, "complex128"),
        ({"data": np.ones((0, 2))}, "not empty"),
        ({"data": np.ones((2, 2, 2))}, "not empty"),
    ]
    for options, text in cases:
        with h5py.File(path, "w") as file:
            if "link" in options:
                file[name] = options["link"]
            else:
                file.create_dataset(name, **options)
        assert text in refusal(path, FileError)


@pytest.mark.parametrize(
    ("name", "change", "text"),
    [
        ("indices", lambda T: T.indices + 20, "column indices must be in 0..11"),
        ("indptr", lambda T: np.where(np.arange(13) == 5, -1, T.indptr), "fall"),
        ("shape", lambda T: (1 << 60, 1 << 60), "1152921504606846976"),
        ("shape", lambda T: (12,), "no sparse matrix"),
        ("data", lambda T: T.data * np.nan, "NaN"),
        ("data", lambda T: T.data[:-1], "same size"),
    ],
)
def test_sparse_groups_that_lie(tmp_path: Path, name: str, change: Any, text: str) -> None:
    path, T = tmp_path / "T.h5", sparse()
    formats.write(path, Record((T,), (3, 4)))
    with h5py.File(path, "r+") as file:
        group: Any = file["T"]
        if name == "shape":
            group.attrs["shape"] = change(T)
        else:
            del group[name]
            group[name] = change(T)
    assert text in refusal(path, FileError)


def test_a_small_archive_cannot_declare_terabytes(tmp_path: Path) -> None:
    """The sizes lie in all three places: local header, directory, and the array's own header."""
    path, array = tmp_path / "T.npz", npy("'<f4'", "(3000000, 3000000)")
    claimed = len(array) + 4 * 3000000**2
    for sizes in ({}, {"file_size": claimed}, {"file_size": claimed, "compress_size": claimed}):
        with zipfile.ZipFile(path, "w") as archive:
            info = zipfile.ZipInfo("T.npy")
            archive.writestr(info, array)
            for name, size in sizes.items():  # goes into the directory on closing
                setattr(info, name, size)
        assert "TiB" in refusal(path, FileError)


@pytest.mark.parametrize("extension", [".npz", ".npy", ".mtx", ".h5", "5.mat", ".zarr"])
def test_an_honest_giant_is_a_matter_of_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, extension: str
) -> None:
    path = tmp_path / f"T{extension}"
    if extension == "5.mat":
        scipy.io.savemat(path, {"LTM": np.zeros((400, 400))}, do_compression=True)
    else:
        formats.write(path, Record((np.ones((400, 400)),), (20, 20)))
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: 9_000)
    assert "host has" in refusal(path, MemoryLimitError)


def archive_of(array: np.ndarray, compression: int) -> bytes:
    stream, file = io.BytesIO(), io.BytesIO()
    np.save(stream, array)
    with zipfile.ZipFile(file, "w", compression) as archive:
        archive.writestr("T.npy", stream.getvalue())
    return file.getvalue()


def test_archives_that_are_none(tmp_path: Path) -> None:
    path, good = tmp_path / "T.npz", bytearray(archive_of(dense(), zipfile.ZIP_DEFLATED))
    encrypted = bytearray(good)
    encrypted[6] |= 1
    encrypted[encrypted.index(b"PK\x01\x02") + 8] |= 1
    for data, text in (
        (archive_of(dense(), zipfile.ZIP_BZIP2), "method 12"),
        (archive_of(dense(), zipfile.ZIP_LZMA), "method 14"),
        (encrypted, "encrypted"),
        (good + b"x", "appended"),
        (good[:-1], "archive"),
        (b"not an archive at all", "no .npz archive"),
    ):
        path.write_bytes(data)
        assert text in refusal(path, FileError)
    with zipfile.ZipFile(path, "w") as archive:
        for _ in range(2):
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr("warnings.warn", lambda *_, **__: None)
                archive.writestr("T.npy", b"")
    assert "of one name" in refusal(path, FileError)


@pytest.mark.parametrize("extension", [".npz", ".npy", ".mtx", ".h5", ".mat", "5.mat"])
def test_appended_bytes_are_refused(tmp_path: Path, extension: str) -> None:
    path = tmp_path / f"T{extension}"
    if extension == "5.mat":
        scipy.io.savemat(path, {"LTM": dense()})
    else:
        formats.write(path, Record((dense(),)))
    formats.read(path)
    for appended in (b"\0", b"half of another file"):
        whole = path.read_bytes()
        path.write_bytes(whole + appended)
        refusal(path, FileError)
        path.write_bytes(whole)


def test_without_h5py_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with pytest.raises(FileError, match=r"T\.h5: \.h5 files need h5py; pip install 'ltcl\[hdf5\]'"):
        formats.write(tmp_path / "T.h5", Record((dense(),), (3, 4)))
    assert not list(tmp_path.iterdir())


def test_a_transport_traced_by_others_is_read(shared_data: Path) -> None:
    path = shared_data / "transport-dihedral" / "transport.npz"
    record = record_in(path)
    assert (record.shape, record.grid, record.first_bounce) == ((4096, 4096), (64, 64), None)
    T = as_dense(record.matrices[0])
    assert np.median(T.diagonal()) > 10 * np.median(T)  # direct light stands on the diagonal
    assert "'bounces' (5, 7, 64, 64)" in refusal(path.with_name("bounces.npz"), FileError)
