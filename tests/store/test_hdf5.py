# SPDX-License-Identifier: BSD-3-Clause
"""HDF5, and MATLAB's .mat of version 7.3 as MATLAB itself lays it out."""

from __future__ import annotations

import builtins
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
import scipy.sparse

import ltcl
from ltcl.errors import FileError
from ltcl.store import Record, formats

from .helpers import dense, record_in, refusal, same, sparse

EXTENSIONS = [".h5", ".hdf5", ".mat"]


@pytest.mark.parametrize("extension", EXTENSIONS)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("channels", [1, 3])
def test_dense_round_trip(tmp_path: Path, extension: str, dtype: str, channels: int) -> None:
    T = tuple(dense(10, 12, dtype, seed) for seed in range(channels))
    mixing = np.eye(3) + np.triu(np.full((3, 3), 0.1)) if channels == 3 else None
    record = Record(T, (3, 4), (2, 5), mixing=mixing)
    formats.write(tmp_path / f"T{extension}", record)
    same(record_in(tmp_path / f"T{extension}"), record)


@pytest.mark.parametrize("extension", EXTENSIONS)
@pytest.mark.parametrize("channels", [1, 3])
def test_first_bounces(tmp_path: Path, extension: str, channels: int) -> None:
    F = np.linspace(1, 2, 12 * channels).reshape((12,) if channels == 1 else (3, 12))
    record = Record(tuple(dense(seed=seed) for seed in range(channels)), (3, 4), None, F)
    formats.write(tmp_path / f"T{extension}", record)
    same(record_in(tmp_path / f"T{extension}"), record)
    np.testing.assert_array_equal(ltcl.load(tmp_path / f"T{extension}").first_bounce, F)


@pytest.mark.parametrize(("extension", "channels"), [(".h5", 1), (".h5", 3), (".mat", 1), (".mat", 3)])
def test_sparse_round_trip(tmp_path: Path, extension: str, channels: int) -> None:
    T = tuple(sparse(12, "float64", seed, pattern=seed) for seed in range(channels))
    record = Record(T, (3, 4))
    formats.write(tmp_path / f"T{extension}", record)
    same(record_in(tmp_path / f"T{extension}"), record)


def test_as_matlab_writes_it(tmp_path: Path) -> None:
    """Column-major, so h5py sees the axes in reverse order."""
    path = tmp_path / "T.mat"
    LTM = np.arange(24.0, dtype=np.float32).reshape(4, 6)
    with h5py.File(path, "w", userblock_size=512) as file:
        file["LTM"] = LTM.T
        file["LTM"].attrs["MATLAB_class"] = np.bytes_(b"single")
    np.testing.assert_array_equal(record_in(path).matrices[0], LTM)
    T = scipy.sparse.csc_array(np.array([[0.0, 1.0, 0.0], [2.0, 0.0, 3.0], [0.0, 0.0, 4.0]]))
    with h5py.File(path, "w", userblock_size=512) as file:
        group = file.create_group("LTM")
        group.attrs.update({"MATLAB_class": np.bytes_(b"double"), "MATLAB_sparse": np.uint64(3)})
        group["data"], group["ir"], group["jc"] = T.data, T.indices.astype("u8"), T.indptr.astype("u8")
    found = record_in(path).matrices[0]
    assert isinstance(found, scipy.sparse.csr_array)
    np.testing.assert_array_equal(found.toarray(), T.toarray())


def test_what_is_written_begins_as_matlab_wants_it(tmp_path: Path) -> None:
    formats.write(tmp_path / "T.mat", Record((dense(10, 12),), (3, 4), (2, 5)))
    head = (tmp_path / "T.mat").read_bytes()[:512]
    assert head.startswith(b"MATLAB 7.3 MAT-file")
    assert head[124:128] == b"\x00\x02IM"
    with h5py.File(tmp_path / "T.mat") as file:
        assert file["LTM"].shape == (12, 10)  # pyright: ignore[reportAttributeAccessIssue]
        assert file["LTM"].attrs["MATLAB_class"] == b"single"


def test_older_mat_files_are_named(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "T.mat", {"LTM": dense()})
    assert "save it from MATLAB with '-v7.3'" in refusal(tmp_path / "T.mat", FileError)


def test_an_only_dataset_by_any_name(tmp_path: Path) -> None:
    path = tmp_path / "T.h5"
    with h5py.File(path, "w") as file:
        file["light"], file["grid"] = dense(), [3, 4]
    np.testing.assert_array_equal(record_in(path).matrices[0], dense())
    assert record_in(path).grid == (3, 4)
    with h5py.File(path, "a") as file:
        file["more"] = dense()
    assert "holds 'grid', 'light', 'more'; it must hold T" in refusal(path, FileError)


@pytest.mark.parametrize("extension", [".h5", ".mat"])
def test_hostile_files(tmp_path: Path, extension: str) -> None:
    path, name = tmp_path / f"T{extension}", "T" if extension == ".h5" else "LTM"

    def made(**options: Any) -> str:
        with h5py.File(path, "w") as file:
            if "link" in options:
                file[name] = options["link"]
            else:
                file.create_dataset(name, **options)
        return refusal(path, FileError)

    huge = 1 << 20
    assert "declares float32 (1048576, 1048576), 4 TiB" in made(shape=(huge, huge), dtype="f4", chunks=(8, 8))
    assert "4 TiB; what is stored of it holds 0 B" in made(shape=(huge, huge), dtype="f4")
    assert "is a link to elsewhere" in made(link=h5py.ExternalLink("/etc/passwd", "T"))
    assert "is a link to elsewhere" in made(link=h5py.SoftLink("/T"))
    secret = tmp_path / "secret.bin"
    secret.write_bytes(bytes(4 * 144))
    outside = [(str(secret), 0, 4 * 144)]
    assert "is kept in other files" in made(shape=(12, 12), dtype="f4", external=outside)
    assert "must hold real numbers" in made(data=np.ones((2, 2), complex))
    assert "not empty" in made(data=np.ones((0, 2)))
    assert "not empty" in made(data=np.ones((2, 2, 2)))


def test_sparse_groups_that_lie(tmp_path: Path) -> None:
    path, T = tmp_path / "T.h5", sparse()

    def changed(name: str, values: Any) -> str:
        formats.write(path, Record((T,), (3, 4)))
        with h5py.File(path, "r+") as file:
            group: Any = file["T"]
            if name == "shape":
                group.attrs["shape"] = values
            else:
                del group[name]
                group[name] = values
        return refusal(path, FileError)

    assert "column indices must be in 0..11" in changed("indices", T.indices + 20)
    assert "must never fall" in changed("indptr", np.where(np.arange(13) == 5, -1, T.indptr))
    assert "rows and columns must be" in changed("shape", (1 << 60, 1 << 60))
    assert "is no sparse matrix" in changed("shape", (12,))
    assert "NaN" in changed("data", T.data * np.nan)
    assert "must agree" in changed("data", T.data[:-1])


def test_damaged_files(tmp_path: Path) -> None:
    path = tmp_path / "T.h5"
    formats.write(path, Record((dense(),), (3, 4)))
    good = path.read_bytes()
    for length in (1, 100, len(good) // 2, len(good) - 1):
        path.write_bytes(good[:length])
        refusal(path, FileError)
    path.write_bytes(b"no HDF5 at all")
    assert "is no HDF5 file" in refusal(path, FileError)


def test_without_h5py_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name == "h5py":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(FileError, match=r"T\.h5: \.h5 files need h5py; pip install 'ltcl\[hdf5\]'"):
        formats.write(tmp_path / "T.h5", Record((dense(),), (3, 4)))
    assert not list(tmp_path.iterdir())


def test_sparse_colour_of_mat_is_three_variables_as_matlab_has_them(tmp_path: Path) -> None:
    T = tuple(sparse(seed=seed, pattern=seed) for seed in range(3))
    formats.write(tmp_path / "T.mat", Record(T, (3, 4)))
    with h5py.File(tmp_path / "T.mat") as file:
        assert {"LTM_r", "LTM_g", "LTM_b"} <= set(file)
        for name, one in zip(("LTM_r", "LTM_g", "LTM_b"), T, strict=True):
            group: Any = file[name]
            parts = (group["data"][:], group["ir"][:].astype(int), group["jc"][:].astype(int))
            found = scipy.sparse.csc_array(parts, shape=(int(group.attrs["MATLAB_sparse"]), 12))
            np.testing.assert_array_equal(found.toarray(), one.toarray())


def test_channels_of_mat_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "T.mat"
    formats.write(path, Record(tuple(sparse(seed=seed) for seed in range(3)), (3, 4)))
    with h5py.File(path, "r+") as file:
        del file["LTM_g"]
        file["LTM_g"] = np.eye(6)
    assert "LTM_r, LTM_g, LTM_b have the shapes (12, 12), (6, 6), (12, 12)" in refusal(path, FileError)
    with h5py.File(path, "r+") as file:
        del file["LTM_g"]
        file["LTM_g"] = np.eye(12)
    assert "full and sparse" in refusal(path, FileError)
    with h5py.File(path, "r+") as file:
        del file["LTM_g"]
    assert "must be the variable LTM, or of three channels LTM_r, LTM_g, LTM_b" in refusal(path, FileError)
