# SPDX-License-Identifier: BSD-3-Clause
"""Transport files: what is written comes back, others' files are read, lies are refused."""

from __future__ import annotations

import logging
import resource
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
from ltcl.device import Device
from ltcl.errors import FileError, InputTypeError, LtclError, MemoryLimitError
from ltcl.store import StoreRecord, formats
from ltcl.store.record import Matrix
from ltcl.transport.noise import Noise

from .stores import contents, dense, sparse

random = np.random.default_rng()
read: Any = formats.read
COORDINATE = b"%%MatrixMarket matrix coordinate real general\n"
# SciPy reads 1 of 1..2.
NO_NUMBERS = (
    b"x",
    b"1.5E",
    b"5,1",
    b"1..2",
    b"1 2",
    b"1\0",
    b"+-1",
    b"nan",
)
ARRAY = b"%%MatrixMarket matrix array real general\n"


def same(a: StoreRecord, b: StoreRecord) -> None:
    """Assert that two records are equal in every value and type."""
    assert (a.grid, a.camera_grid) == (b.grid, b.camera_grid)
    for x, y in zip(a.matrices, b.matrices, strict=True):
        assert (type(x), x.dtype) == (type(y), y.dtype)
        np.testing.assert_array_equal(as_dense(x), as_dense(y))
    for name in ("first_bounce", "mixing"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def as_dense(T: Matrix) -> np.ndarray:
    return T if isinstance(T, np.ndarray) else T.tocsr().toarray()


def refusal(path: Path, kind: type[LtclError]) -> str:
    """Text behind the file's name of the error that reading `path` gives; it is one line."""
    with pytest.raises(kind) as error:
        formats.read(path)
    text = str(error.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    return text.removeprefix(f"{path}: ")


@pytest.mark.parametrize("extension", [".npz", ".h5", ".hdf5", ".mat", ".zarr"])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("kind", ["dense", "sparse"])
def test_everything_comes_back(
    tmp_path: Path, extension: str, kind: str, channels: int, dtype: str
) -> None:
    square = kind == "sparse"  # else there is no first bounce
    T: Any = [
        sparse(12, dtype, k, k) if square else dense(10, 12, dtype, k) for k in range(channels)
    ]
    F = random.uniform(1, 2, (12,) if channels == 1 else (3, 12)) if square else None
    record = StoreRecord(
        tuple(T), (3, 4), None if square else (2, 5), F, np.eye(3) + 0.1 if channels == 3 else None
    )
    path = tmp_path / f"T{extension}"
    formats.write(path, record)
    formats.write(path, record)  # again, onto itself
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    back = read(path).in_memory()
    if extension == ".mat" and square:  # MATLAB's sparse ones are of float64
        back = replace(
            back, matrices=tuple(scipy.sparse.csr_array(T, dtype=dtype) for T in back.matrices)
        )
    same(back, record)


@pytest.mark.parametrize("T", [(dense(5, 12),), (dense(), dense(seed=2), dense(seed=3))])
def test_npy_keeps_the_matrix_alone(tmp_path: Path, T: Any, caplog: Any) -> None:
    with caplog.at_level(logging.WARNING):
        formats.write(tmp_path / "T.npy", StoreRecord(T))
        assert not caplog.messages
        formats.write(
            tmp_path / "T.mat",
            replace(StoreRecord(T), noise=Noise.uniform(T[0].shape, [0.1] * len(T))),
        )
        assert "T.mat: .mat does not keep the noise" in caplog.text
        if len(T) == 3:
            formats.write(tmp_path / "T.npy", StoreRecord(T, first_bounce=np.ones(12)))
            assert "first bounce" in caplog.text
    same(read(tmp_path / "T.npy"), StoreRecord(T))
    with pytest.raises(FileError, match=r"T\.npy: T is sparse"):
        formats.write(tmp_path / "T.npy", StoreRecord((sparse(),)))


@pytest.mark.parametrize("make", [sparse, dense])
@pytest.mark.parametrize("grids", [(None, None), ((3, 4), None), ((3, 4), (2, 6))])
def test_mtx_keeps_one_matrix_and_the_grids(tmp_path: Path, make: Any, grids: Any) -> None:
    path = tmp_path / "T.MTX"
    T = tuple(make(seed=k).astype(np.float64) for k in (1, 2, 3))
    formats.write(path, StoreRecord(T[:1], *grids))
    same(read(path), StoreRecord(T[:1], *grids))
    np.testing.assert_array_equal(
        as_dense(scipy.sparse.csr_array(scipy.io.mmread(path))), as_dense(T[0])
    )
    with pytest.raises(FileError, match=r"three channels"):
        formats.write(path, StoreRecord(T, *grids))


@pytest.mark.parametrize("kind", ["array", "matrix"])
@pytest.mark.parametrize("layout", ["csr", "csc", "coo", "bsr", "dia"])
def test_every_layout_of_scipy_is_read_and_one_is_written(
    tmp_path: Path, layout: str, kind: str
) -> None:
    T = getattr(scipy.sparse, f"{layout}_{kind}")(sparse(dtype="float64"))
    scipy.sparse.save_npz(tmp_path / "T.npz", T, compressed=kind == "matrix")
    (result,) = read(tmp_path / "T.npz").matrices
    assert isinstance(result, scipy.sparse.csr_array)
    np.testing.assert_array_equal(result.toarray(), T.toarray())
    formats.write(tmp_path / "T.npz", StoreRecord((result,), (3, 4)))
    loaded = scipy.sparse.load_npz(tmp_path / "T.npz")
    assert isinstance(loaded, scipy.sparse.csr_array)
    np.testing.assert_array_equal(loaded.toarray(), T.toarray())


_READ = {
    ">f4": "f4",
    ">f8": "f8",
    "f2": "f4",
    "u1": "f4",
    ">u2": "f4",
    "i4": "f8",
    "u8": "f8",
    "?": "f4",
}


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize(("stored", "expected"), _READ.items())
def test_types_and_byte_orders(tmp_path: Path, stored: str, expected: str, order: Any) -> None:
    T = np.asarray(dense(4, 6).astype(stored), order=order)
    np.save(tmp_path / "T.npy", T[None])  # one channel in front is dropped
    np.savez(tmp_path / "T.npz", T=T)
    for path in tmp_path.iterdir():
        (result,) = read(path).matrices
        assert result.dtype.isnative
        np.testing.assert_array_equal(result, T.astype(expected), strict=True)


@pytest.mark.parametrize(
    "arrays",
    [
        {"T": dense(), "first_bounce": np.ones(12), "noise": dense()},
        {"light": dense(), "camera_grid": [2, 6], "names": np.array(["a"])},
    ],
)
def test_named_arrays_are_read(tmp_path: Path, arrays: Any) -> None:
    np.savez_compressed(tmp_path / "T.npz", **arrays, grid=[3, 4])
    camera_grid = (2, 6) if "camera_grid" in arrays else None
    same(
        read(tmp_path / "T.npz"),
        StoreRecord((dense(),), (3, 4), camera_grid, arrays.get("first_bounce")),
    )


VARIABLES = {"a": dense(), "b": 2 * dense(), "grid": np.array([3, 4])}


@pytest.mark.parametrize("extension", [".npz", ".h5", ".mat", "5.mat"])
def test_any_variable_by_its_name(tmp_path: Path, extension: str) -> None:
    """MATLAB's arrays are column-major, so h5py sees the axes of version 7.3 in reverse order."""
    path = tmp_path / f"T{extension}"
    if extension == ".npz":
        np.savez(path, allow_pickle=False, **VARIABLES)
    elif extension == "5.mat":
        scipy.io.savemat(path, VARIABLES)
    else:
        with h5py.File(path, "w", userblock_size=512) as file:
            file.update(
                {n: array.T if extension == ".mat" else array for n, array in VARIABLES.items()}
            )
    for name in ("a", "b"):
        np.testing.assert_array_equal(ltcl.load(path, variable=name).matrices[0], VARIABLES[name])
    text = refusal(path, FileError)
    assert all(word in text for word in ("'a' (12, 12)", "'b' (12, 12)", "variable="))
    with pytest.raises(FileError, match="'c'"):
        formats.read(path, variable="c")
    np.save(tmp_path / "T.npy", dense())
    with pytest.raises(FileError, match="variable is 'a'"):
        formats.read(tmp_path / "T.npy", variable="a")
    with pytest.raises(InputTypeError, match=r"path is .*\(2, 2\)"):
        ltcl.load(np.eye(2))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(
    "LTM",
    [
        dense(dtype="float64"),
        dense(),
        np.eye(12),
        sparse().tocsc().astype(float),
        random.random((12, 12, 3)),
    ],
)
def test_matlab_5(tmp_path: Path, LTM: Any, compressed: bool) -> None:
    """Files with other variables, and in colour."""
    others = {"name": "text", "cell": {"a": 1}, "grid": [3, 4], "z": 1j * np.eye(2)}
    scipy.io.savemat(tmp_path / "T.mat", {**others, "LTM": LTM}, do_compression=compressed)
    record = read(tmp_path / "T.mat")
    assert (record.grid, record.matrices[0].dtype) == ((3, 4), LTM.dtype)
    expected = np.atleast_3d(as_dense(LTM)).transpose(2, 0, 1)
    np.testing.assert_array_equal([as_dense(T) for T in record.matrices], expected)


def test_sparse_matrices_of_matlab_7_3(tmp_path: Path) -> None:
    path = tmp_path / "T.mat"
    T = sparse().tocsc()
    with h5py.File(path, "w", userblock_size=512) as file:
        group = file.create_group("LTM")
        group.attrs["MATLAB_sparse"] = np.uint64(12)
        group["data"] = T.data
        group["ir"] = T.indices.astype("u8")
        group["jc"] = T.indptr.astype("u8")
    np.testing.assert_array_equal(as_dense(read(path).matrices[0]), T.toarray())


@pytest.mark.parametrize("symmetry", ["general", "symmetric", "skew-symmetric"])
@pytest.mark.parametrize("make", [np.asarray, scipy.sparse.coo_array])
@pytest.mark.parametrize("field", ["real", "integer"])
def test_mtx_of_others(tmp_path: Path, make: Any, symmetry: str, field: str) -> None:
    """Files with other line ends, and with and without the last."""
    path = tmp_path / "T.mtx"
    T = np.arange(16.0).reshape(4, 4)
    T = {"general": T, "symmetric": T + T.T, "skew-symmetric": T - T.T}[symmetry]
    scipy.io.mmwrite(
        path, make(T), symmetry=symmetry, field=field, comment="ltcl knows nothing of me"
    )
    if symmetry == "skew-symmetric":
        assert symmetry in refusal(path, FileError)
        return
    text = path.read_bytes()
    for changed in (text, text.rstrip(), text + b" \n\n ", text.replace(b"\n", b" \r\n ")):
        path.write_bytes(changed)
        np.testing.assert_array_equal(as_dense(read(path).matrices[0]), T)


def parts(**changes: object) -> dict[str, object]:
    """A good (2, 3) matrix in SciPy's layout, with changes."""
    good = {
        "format": "csr",
        "shape": [2, 3],
        "data": np.ones(3),
        "indices": [0, 2, 1],
        "indptr": [0, 2, 3],
    }
    return good | changes


def npy(descr: str, shape: str, body: bytes = b"") -> bytes:
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(text)) + text + body


@pytest.mark.parametrize(
    "data",
    [
        b"\x93NUMPY\x09\0\x76\0\0\0",
        b"\x93NUMPY\x02\0\xff\xff\xff\xff",
        npy("'<f4'", "(4, 4)", body=bytes(60)),
        npy("'<f4'", "(4000000, 4000000)"),
        npy("'<f4'", "(-4, -4)", body=bytes(64)),
        npy("__import__('os')", "(4, 4)"),
        npy("'|O'", "(4, 4)", body=bytes(128)),
        npy("'<f4'", "(16,)", body=bytes(64)),
        npy("'<f4'", "(0, 4)"),
    ],
)
def test_npy_headers_that_lie(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "T.npy").write_bytes(data)
    refusal(tmp_path / "T.npy", FileError)
    with zipfile.ZipFile(tmp_path / "T.npz", "w") as archive:
        archive.writestr("T.npy", data)
    refusal(tmp_path / "T.npz", FileError)


HUGE = {"shape": (1 << 20, 1 << 20), "dtype": "f4"}


@pytest.mark.parametrize("name", ["T.h5", "LTM.mat"])
@pytest.mark.parametrize(
    ("value", "text"),
    [
        (HUGE | {"chunks": (8, 8)}, "4 TiB"),
        (HUGE, "4 TiB"),
        (h5py.ExternalLink("/etc/passwd", "T"), "no numbers"),
        (h5py.SoftLink("/T"), "no numbers"),
        ({"shape": (12, 12), "dtype": "f4", "external": [(__file__, 0, 576)]}, "other files"),
        ({"data": np.ones((2, 2), complex)}, "complex128"),
    ],
)
def test_hostile_hdf5(tmp_path: Path, name: str, value: Any, text: str) -> None:
    path = tmp_path / name
    with h5py.File(path, "w") as file:
        if isinstance(value, dict):
            file.create_dataset(path.stem, **value)
        else:
            file[path.stem] = value
    assert text in refusal(path, FileError)


@pytest.mark.parametrize(
    ("name", "change", "text"),
    [
        ("ir", lambda T: T.indices + 20, "0..11"),
        ("jc", lambda T: np.where(np.arange(13) == 5, -1, T.indptr), "indptr"),
        ("MATLAB_sparse", lambda T: 1 << 60, "1152921504606846976"),
        ("MATLAB_sparse", lambda T: 0.5, "0.5"),
        ("data", lambda T: T.data * np.nan, "NaN"),
    ],
)
def test_sparse_groups_that_lie(tmp_path: Path, name: str, change: Any, text: str) -> None:
    path = tmp_path / "T.h5"
    T = sparse().tocsc()
    formats.write(path, StoreRecord((sparse(),), (3, 4)))
    with h5py.File(path, "r+") as file:
        place: Any = file["T"] if name != "MATLAB_sparse" else file["T"].attrs
        del place[name]
        place[name] = change(T)
    assert text in refusal(path, FileError)


@pytest.mark.parametrize("claims", [(), ("file_size",), ("file_size", "compress_size")])
def test_a_small_archive_cannot_declare_terabytes(tmp_path: Path, claims: tuple[str, ...]) -> None:
    """The sizes lie in all three places: local header, directory, and the array's own header."""
    array = npy("'<f4'", "(3000000, 3000000)")
    info = zipfile.ZipInfo("T.npy")
    with zipfile.ZipFile(tmp_path / "T.npz", "w") as archive:
        archive.writestr(info, array)
        for name in claims:  # goes into the directory on closing
            setattr(info, name, len(array) + 4 * 3000000**2)
    reason = refusal(tmp_path / "T.npz", FileError)
    # Newer releases of Python refuse the third by themselves.
    assert "TiB" in reason or "Overlapped entries" in reason


# .npy stays on the disk.
@pytest.mark.parametrize("extension", [".npz", ".mtx", ".h5", "5.mat", ".zarr"])
def test_an_honest_giant_is_a_matter_of_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, extension: str
) -> None:
    path = tmp_path / f"T{extension}"
    if extension == "5.mat":
        scipy.io.savemat(path, {"LTM": np.zeros((400, 400))}, do_compression=True)
    else:
        formats.write(path, StoreRecord((np.ones((400, 400)),), (20, 20)))
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: 9_000)
    assert "host has" in refusal(path, MemoryLimitError)


REFUSED: list[tuple[str, Any, str]] = [
    (".npz", {"T": np.ones((2, 4, 4))}, "(2, 4, 4)"),
    (".npz", {"T": np.array({"by": "me"})}, "'T' is made of Python objects"),
    (".npz", {"note": np.array({"by": "me"})}, "'note' (made of Python objects"),
    (".npz", {"T": np.ones((2, 2), complex)}, "complex128"),
    (".npz", {"T": dense(), "grid": [2.5, 3.0]}, "'grid' is [2.5, 3.0]"),
    (".npz", {"T": dense(), "first_bounce": np.ones(11)}, "(11,)"),
    (".npz", parts(format=np.array(b"lil")), "lil"),
    (".npz", parts(shape=np.array([2.5, 3.0])), "'shape' is [2.5, 3.0]"),
    (".npz", parts(shape=np.array([2, 2**62])), "(2, 4611686018427387904)"),
    (".npz", parts(indices=np.array([0, -1, 1])), "-1"),
    (".npz", parts(indices=np.array([0.0, 1.5, 1.0])), "'indices' holds float64"),
    (".npz", parts(data=np.array([1, np.nan, 2])), "1 NaN"),
    (".npz", parts(format="bsr", data=np.ones((3, 1, 1)), indices=[0, 9, 1]), "9"),
    (".npz", b"not an archive at all", "zip"),
    (".mtx", COORDINATE.replace(b"real", b"complex") + b"2 2 1\n1 1 1 1\n", "complex"),
    (".mtx", COORDINATE.replace(b"real", b"pattern") + b"2 2 1\n1 1\n", "field is pattern"),
    (".mtx", COORDINATE.replace(b"matrix", b"vector", 1) + b"2 1\n1 1\n", "object is vector"),
    (".mtx", COORDINATE.replace(b"general", b"hermitian"), "symmetry is hermitian"),
    (".mtx", COORDINATE + b"-2 2 1\n1 1 1\n", "Line 2"),
    (".mtx", COORDINATE + b"9 9 1000000000000\n1 1 1\n", "1000000000000"),
    (".mtx", COORDINATE + b"9 9 2\n1 1 1.00\n2 2 1.00\n3 3 1.00\n", "3"),
    (".mtx", COORDINATE + b"900000000000 9 1\n1 1 1\n", "(900000000000, 9)"),
    (".mtx", COORDINATE.replace(b"general", b"symmetric") + b"2 3 1\n1 3 1\n", "2 x 3"),
    (".mtx", ARRAY.replace(b"general", b"symmetric") + b"1 3\n1\n1\n1\n", "1 x 3"),
    (".mtx", ARRAY + b"0 2\n", "0 x 2"),
    (".mtx", COORDINATE.replace(b"real", b"integer") + b"9 9 1\n1 1 1.5\n", "'1 1 1.5'"),
    (".mtx", COORDINATE + b"2 2 2\n1 1 1\n1 0 1\n", "Line 4"),
    *((".mtx", ARRAY + b"1 1\n" + value, f"line 3 is {value!r}") for value in NO_NUMBERS),
    (".mtx", b"no matrix\n", "no matrix"),
    (".mtx", COORDINATE.replace(b" general", b""), "symmetry"),
    (".mat", b"MATLAB 4".ljust(600), "7.3"),
    (".mat", b"MATLAB 5.0 MAT-file".ljust(124) + b"\1\0MI" + bytes(600), "7.3"),
]


@pytest.mark.parametrize(("extension", "content", "text"), REFUSED)
def test_what_holds_no_transport_is_refused(
    tmp_path: Path, extension: str, content: Any, text: str
) -> None:
    path = tmp_path / f"T{extension}"
    path.write_bytes(content) if isinstance(content, bytes) else np.savez(path, **content)
    assert text in refusal(path, FileError)


def test_without_h5py_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with pytest.raises(FileError, match=r"T\.h5: .*h5py.*ltcl\[hdf5\]"):
        formats.write(tmp_path / "T.h5", StoreRecord((dense(),), (3, 4)))
    assert not list(tmp_path.iterdir())


SHAPES = [(1, 1), (1, 2), (2, 1), (1, 3), (3, 1), (3, 3), (2, 3), (3, 2)]


@pytest.mark.parametrize("extension", [".npz", ".npy", ".mtx", ".h5", ".mat", ".zarr"])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("make", [np.asarray, scipy.sparse.csr_array])
@pytest.mark.parametrize("shape", SHAPES)
def test_the_smallest_transports_come_back(
    tmp_path: Path, shape: tuple[int, int], make: Any, channels: int, extension: str
) -> None:
    """Axes of length 1 and 3 are told apart."""
    M, N = shape
    is_sparse = make is not np.asarray
    if (extension == ".mtx" and channels == 3) or (extension == ".npy" and is_sparse):
        return
    is_bare = extension in (".npy", ".mtx")
    F = None
    if M == N and not is_bare:
        F = random.uniform(1, 2, (N,) if channels == 1 else (3, N))
    record = StoreRecord(
        tuple(make(random.uniform(1, 2, shape)) for _ in range(channels)),
        None if extension == ".npy" else (1, N),
        None if extension == ".npy" or M == N else (1, M),
        F,
        np.eye(3) + 0.1 if channels == 3 and not is_bare else None,
    )
    formats.write(tmp_path / f"T{extension}", record)
    loaded = read(tmp_path / f"T{extension}")
    if loaded.stored:
        loaded = replace(
            loaded, matrices=tuple(make(as_dense(matrix)) for matrix in loaded.matrices)
        )
    same(loaded, record)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["dense", "sparse", "compressed"])
def test_a_flipped_bit_in_the_directory_of_an_archive_loses_nothing(
    tmp_path: Path, kind: str, device: Device
) -> None:
    path = tmp_path / "T.npz"
    T = ltcl.scenes.dihedral(4).transport()
    if kind == "compressed":
        small = ltcl.Transport(T.matrices[0], T.grid, device=device)
        ltcl.save(path, ltcl.compress(small, rtol=1e-2))
    else:
        matrix: Any = dense() if kind == "dense" else sparse()
        formats.write(path, StoreRecord((matrix,), (3, 4), first_bounce=np.ones(12)))
    good = path.read_bytes()
    record: Any = read(path)
    names = record.arrays if kind == "compressed" else record.arrays()
    with zipfile.ZipFile(path) as archive:
        start = archive.start_dir
    # The lengths of names, extra fields and comments, and bits anywhere.
    places = [start + 28 + offset for offset in range(6)]
    places += random.integers(start, len(good), 60).tolist()
    for place in places:
        changed = bytearray(good)
        changed[place] ^= 1 << int(random.integers(8))
        path.write_bytes(changed)
        try:
            loaded: Any = read(path)
        except FileError:
            continue
        assert set(loaded.arrays if kind == "compressed" else loaded.arrays()) == set(names)


@pytest.mark.parametrize("name", ["T.npz", "T.npy", "T.mtx", "T.h5", "T.mat", "T.zarr", "s.npz",
                                  "s.mtx", "s.h5", "s.mat", "s.zarr"])  # fmt: skip
def test_a_full_disk_is_noticed_and_the_earlier_file_stays(tmp_path: Path, name: str) -> None:
    """Files cannot become larger than a limit, in the place of a full disk."""
    path = tmp_path / name
    matrix: Any = dense(60, 60) if name.startswith("T") else sparse(60)
    record = StoreRecord((matrix,), (6, 10))
    formats.write(path, record)
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    size = max(file.stat().st_size for file in files)
    before = contents(tmp_path)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    for share in (0.01, 0.5, 0.9, 0.999):
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(share * size), limits[1]))
        try:
            with pytest.raises(FileError, match=f"^{path}: .*large"):
                formats.write(path, record)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert contents(tmp_path) == before


def test_objects_beside_a_matrix_are_left_out(tmp_path: Path) -> None:
    np.savez(tmp_path / "T.npz", T=dense(), note=np.array({"by": "me"}), name=np.array("wall"))
    with zipfile.ZipFile(tmp_path / "T.npz", "a") as archive:
        archive.writestr("README.txt", "a wall")
    np.testing.assert_array_equal(read(tmp_path / "T.npz").matrices[0], dense())
    np.save(tmp_path / "T.npy", np.array([{"T": 1}], object), allow_pickle=True)
    assert "Python objects" in refusal(tmp_path / "T.npy", FileError)


GROUPS = {
    "entry/data/transport": dense(),
    "entry/title": "a wall",
    "entry/time": np.arange(5.0),
}


def test_matrices_in_groups_of_hdf5(tmp_path: Path) -> None:
    """A group with a member `data` is no sparse matrix."""
    path = tmp_path / "T.h5"
    with h5py.File(path, "w") as file:
        file.update(GROUPS)
    np.testing.assert_array_equal(read(path).matrices[0], dense())
    with h5py.File(path, "a") as file:
        file["entry/data/other"] = 2 * dense()
    text = refusal(path, FileError)
    assert "'entry/data/transport' (12, 12)" in text
    assert "'entry/title' (text)" in text
    for name in ("entry/data/other", "/entry/data/other"):
        np.testing.assert_array_equal(read(path, variable=name).matrices[0], 2 * dense())
    with pytest.raises(FileError, match=r"'nowhere'.*entry/data/transport"):
        formats.read(path, variable="nowhere")
    with pytest.raises(FileError, match=r"'entry/title' is text"):
        formats.read(path, variable="entry/title")


@pytest.mark.parametrize(
    ("value", "kind"),
    [
        (1j * np.eye(3), "complex"),
        (scipy.sparse.csc_array(1j * np.eye(3)), "complex"),
        ({"T": np.eye(3)}, "a struct"),
        (np.array([[np.eye(3)], [np.eye(2)]], object), "a cell array"),
        ("some text", "text"),
    ],
)
@pytest.mark.parametrize("name", ["LTM", "wall"])
def test_variables_of_matlab_that_are_no_matrix(
    tmp_path: Path, name: str, value: Any, kind: str
) -> None:
    path = tmp_path / "T.mat"
    scipy.io.savemat(path, {name: value})
    text = refusal(path, FileError)
    assert name in text
    assert kind in text
    with pytest.raises(FileError, match=f"'{name}' is {kind}"):
        formats.read(path, variable=name)


def test_complex_numbers_of_matlab_7_3(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "T.mat", "w", userblock_size=512) as file:
        file["LTM"] = np.zeros((3, 3), [("real", "f8"), ("imag", "f8")])
    assert "'LTM' is complex" in refusal(tmp_path / "T.mat", FileError)


@pytest.mark.parametrize("spare", [{"ir"}, {"data"}, {"ir", "data"}])
@pytest.mark.parametrize("entries", [0, 7])
def test_sparse_matrices_with_room_to_spare(tmp_path: Path, entries: int, spare: set[str]) -> None:
    """MATLAB reserves more entries than there are."""
    T = sparse().tocsc()
    if entries == 0:
        T = scipy.sparse.csc_array((12, 12))
    arrays = {"data": T.data, "ir": T.indices.astype("u8"), "jc": T.indptr.astype("u8")}
    for name in spare:
        arrays[name] = np.append(arrays[name], np.full(5, 3, arrays[name].dtype))
    path = tmp_path / "T.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        file.create_group("LTM").update(arrays)
        file["LTM"].attrs["MATLAB_sparse"] = np.uint64(12)
    np.testing.assert_array_equal(as_dense(read(path).matrices[0]), T.toarray())


COLORS = {"T_red": dense(seed=1), "T_green": dense(seed=2), "T_blue": dense(seed=3)}


@pytest.mark.parametrize(
    "variable", [None, "T_red,T_green,T_blue", " T_red, T_green ,T_blue", tuple(COLORS)]
)
@pytest.mark.parametrize("extension", [".npz", ".h5", ".mat"])
def test_three_matrices_by_their_names(tmp_path: Path, extension: str, variable: Any) -> None:
    path = tmp_path / f"T{extension}"
    if extension == ".npz":
        np.savez(path, allow_pickle=False, **COLORS)
    elif extension == ".mat":
        scipy.io.savemat(path, COLORS)
    else:
        with h5py.File(path, "w") as file:
            file.update(COLORS)
    T = ltcl.load(path, grid=(3, 4), variable=variable)
    np.testing.assert_array_equal(T.to_numpy(), list(COLORS.values()))
    for wrong in ("T_red,T_green", "T_red,T_green,T_blue,T_red", "T_red,T_green,T_blu"):
        with pytest.raises(FileError, match="variable"):
            ltcl.load(path, grid=(3, 4), variable=wrong)


@pytest.mark.parametrize(
    "names", [("B", "g", "R"), ("scan-b", "scan-g", "scan-r"), ("Blue", "GREEN", "red")]
)
def test_three_matrices_of_colours_are_t_without_being_named(tmp_path: Path, names: Any) -> None:
    arrays = dict(zip(names, reversed(COLORS.values()), strict=True))
    np.savez(tmp_path / "T.npz", allow_pickle=False, **arrays)
    T = ltcl.load(tmp_path / "T.npz", grid=(3, 4))
    np.testing.assert_array_equal(T.to_numpy(), list(COLORS.values()))


@pytest.mark.parametrize(
    "names", [("A_red", "B_green", "C_blue"), ("x", "y", "z"), ("r", "g", "a")]
)
def test_three_other_matrices_have_to_be_named(tmp_path: Path, names: Any) -> None:
    arrays = dict(zip(names, COLORS.values(), strict=True))
    np.savez(tmp_path / "T.npz", allow_pickle=False, **arrays)
    with pytest.raises(FileError, match="variable= names"):
        ltcl.load(tmp_path / "T.npz", grid=(3, 4))


def test_three_matrices_are_one_channel_each(tmp_path: Path) -> None:
    stacks = {name: np.stack([matrix] * 3) for name, matrix in COLORS.items()}
    np.savez(tmp_path / "T.npz", allow_pickle=False, **stacks)
    with pytest.raises(FileError, match=r"\(3, 12, 12\)"):
        read(tmp_path / "T.npz", variable=tuple(COLORS))
