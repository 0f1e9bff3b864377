# SPDX-License-Identifier: BSD-3-Clause
"""Transports as HDF5 (.h5, .hdf5), through h5py (`pip install 'ltcl[hdf5]'`).

`T` of (M, N) or (3, M, N); or groups `T`, or `T_0` to `T_2`, of one sparse matrix in AnnData's layout:
`data`, `indices`, `indptr` and attributes `encoding-type` "csr_matrix" and `shape`. With it there may be
`grid`, `camera_grid`, `first_bounce`, `mixing`. An only matrix may have any name.

Sizes are believed only as far as bytes are stored for them; links and outside storage are not followed. HDF5
keeps no checksum of values: what turns one number into another is not noticed.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError
from ltcl.store import headers
from ltcl.store.record import EXTRAS, Matrix, Record, choose, from_arrays

_ENCODING = {"encoding-type": "csr_matrix", "encoding-version": "0.1.0"}
_PARTS = ("data", "indices", "indptr")


def read(path: Path, variable: str | None = None) -> Record:
    """Read a transport; messages come without the file's name."""
    with reading(path) as file:
        members = {name: member(file, name) for name in file.keys()}  # noqa: SIM118 - items() follows links
        shapes = {n: d.shape if hasattr(d, "dtype") else (1, 1) for n, d in members.items()}
        names = choose(shapes, variable, "T", ("T_0", "T_1", "T_2"))
        extras = {name: values(file, name) for name in EXTRAS if name in members}
        return from_arrays([_matrix(file, name) for name in names], extras)


def write(path: Path, record: Record) -> None:
    """Write everything in `record`."""
    with _h5py(path).File(path, "w") as file:
        for k, T in enumerate(record.matrices):
            if isinstance(T, np.ndarray):
                shape = T.shape if len(record.matrices) == 1 else (3, *T.shape)
                dataset = file.require_dataset("T", shape, T.dtype)
                dataset[... if len(record.matrices) == 1 else k] = T
            else:
                group = file.create_group("T" if len(record.matrices) == 1 else f"T_{k}")
                group.attrs.update({**_ENCODING, "shape": record.shape})
                for name in _PARTS:
                    group[name] = getattr(T, name)
        for name in EXTRAS:
            if getattr(record, name) is not None:
                file[name] = np.asarray(getattr(record, name))


@contextlib.contextmanager
def reading(path: Path) -> Iterator[Any]:
    """The file, and every error of HDF5 in the block as one line."""
    h5py = _h5py(path)
    _refuse_appended(path)
    with headers.library("the HDF5 file"), h5py.File(path, "r") as file:
        yield file


def member(group: Any, name: str) -> Any:
    """The dataset or group `name`, which must be in this very file."""
    if group.get(name, getlink=True).__class__.__name__ != "HardLink":
        raise FileError(f"{name!r} is a link to elsewhere; links are not followed")
    return group[name]


def values(group: Any, name: str) -> np.ndarray:
    """The numbers of a dataset, after its declared size was compared with what is stored."""
    data: Any = member(group, name) if name in list(group) else None
    if not hasattr(data, "dtype"):
        raise FileError(f"dataset {name!r} is missing")
    headers.real(f"dataset {name!r}", data.dtype)
    if data.external or data.is_virtual:
        raise FileError(f"dataset {name!r} is kept in other files; those are not opened")
    most = data.id.get_storage_size() * (1 if data.chunks is None else headers.EXPANSION)
    headers.declared(f"dataset {name!r}", data.dtype, data.shape or (), most)
    checks.fits_host(f"dataset {name!r}", 2 * data.nbytes)
    return np.asarray(data[()])


def _matrix(file: Any, name: str) -> Matrix:
    data = member(file, name) if name in list(file) else None
    if data is None or hasattr(data, "dtype"):
        return headers.floats(name, values(file, name))
    layout = str(data.attrs.get("encoding-type", "")).removesuffix("_matrix")
    shape = np.ravel(np.asarray(data.attrs.get("shape", ())))
    if layout not in ("csr", "csc") or shape.shape != (2,) or shape.dtype.kind not in "iu":
        raise FileError(f"group {name!r} is no sparse matrix; it must say 'encoding-type' and 'shape'")
    parts = tuple(values(data, part) for part in _PARTS)
    M, N = shape.tolist()
    headers.sparse_shape((M, N), parts[0].size)
    make = scipy.sparse.csr_array if layout == "csr" else scipy.sparse.csc_array
    return headers.sparse(make(parts, shape=(M, N)))


def _h5py(path: Path) -> Any:
    try:
        import h5py
    except ImportError:
        raise FileError(f"{path.suffix} files need h5py; pip install 'ltcl[hdf5]'") from None
    return h5py


def _refuse_appended(path: Path) -> None:
    """Refuse bytes behind the end of file that the superblock names."""
    size = path.stat().st_size
    with path.open("rb") as file:
        for start in (0, 512, 1024, 2048):  # behind a user block, as MATLAB has one
            file.seek(start)
            block = file.read(48)
            if block[:8] == b"\x89HDF\r\n\x1a\n":
                break
        else:
            raise FileError("is no HDF5 file, or a damaged one")
    end = block[40:48] if block[8] < 2 else block[28:36]  # by the version; addresses of 8 bytes
    if int.from_bytes(end, "little") not in (size, size - start):
        raise FileError(f"has {size} bytes, not those that HDF5 declares: bytes are missing or were appended")
