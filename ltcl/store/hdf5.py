# SPDX-License-Identifier: BSD-3-Clause
"""Transports as HDF5 (.h5, .hdf5), through h5py (`pip install 'ltcl[hdf5]'`).

What is read and written: `T` of (M, N) or (3, M, N); or groups `T`, or `T_0` to `T_2`, of one sparse matrix
in AnnData's layout: `data`, `indices`, `indptr` and attributes `encoding-type` "csr_matrix" and `shape`.
Beside it there may be `grid`, `camera_grid`, `first_bounce`, `mixing`. An only matrix may have any name.

Sizes are believed only as far as bytes are stored for them. Links and outside storage are not followed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import FileError
from ltcl.store import arrays, sparse
from ltcl.store.npy import channels, is_matrix_shape
from ltcl.store.record import Record

KEEPS_FIRST_BOUNCE = True
_MOST_EXPANSION = 1032  # what deflate can reach, the filter that HDF5 has built in
_SMALL = ("grid", "camera_grid", "first_bounce", "mixing")
_MOST_NAMES = 1000
_ENCODING = {"encoding-type": "csr_matrix", "encoding-version": "0.1.0"}


def read(path: Path) -> Record:
    """Read a transport; messages come without the file's name."""
    with opened(path, "r") as file:
        matrices = _matrices(file)
        found = {name: _small(file, name) for name in _SMALL}
        grid, camera_grid = (as_grid(name, found[name]) for name in ("grid", "camera_grid"))
        return Record(matrices, grid, camera_grid, found["first_bounce"], found["mixing"])


def write(path: Path, record: Record) -> None:
    """Write everything in `record`."""
    with opened(path, "w") as file:
        if record.dense:
            write_dense(file, "T", record)
        else:
            for k, T in enumerate(record.matrices):
                group = file.create_group("T" if len(record.matrices) == 1 else f"T_{k}")
                group.attrs.update({**_ENCODING, "shape": record.shape})
                for name in sparse.LAYOUTS["csr"]:
                    group[name] = getattr(T, name)
        for name in _SMALL:
            if getattr(record, name) is not None:
                file[name] = np.asarray(getattr(record, name))


def write_dense(file: Any, name: str, record: Record, turned: bool = False) -> Any:
    """A dataset of (M, N) or (3, M, N), or of its axes in reverse order; written a matrix at a time."""
    count, first = len(record.matrices), np.asarray(record.matrices[0])
    shape: tuple[int, ...] = first.shape if count == 1 else (count, *first.shape)
    made = file.create_dataset(name, (*shape[:-2], shape[-1], shape[-2]) if turned else shape, first.dtype)
    for k, T in enumerate(record.matrices):
        made[... if count == 1 else k] = np.asarray(T).T if turned else T
    return made


def opened(path: Path, mode: str, **options: Any) -> Any:
    """The file through h5py; says which extra brings h5py where it is missing."""
    try:
        import h5py
    except ImportError:
        raise FileError(f"{path.suffix} files need h5py; pip install 'ltcl[hdf5]'") from None
    if mode == "r" and not h5py.is_hdf5(path):
        raise FileError("is no HDF5 file, or a damaged one")
    try:
        return h5py.File(path, mode, **options)
    except OSError as error:
        raise FileError(f"cannot be opened as HDF5: {' '.join(str(error).split())!a:.150}") from None


def member(group: Any, name: str) -> Any:
    """The dataset or group `name` that is in this very file; None where there is none."""
    import h5py

    if name not in group.keys():  # noqa: SIM118 - `in` itself would follow links
        return None
    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise FileError(f"{name!r} is a link to elsewhere; links are not followed")
    return group[name]


def values(group: Any, name: str) -> np.ndarray:
    """The numbers of a dataset, after its declared size was compared with what is stored."""
    data = member(group, name)
    if data is None or not hasattr(data, "dtype"):
        raise FileError(f"dataset {name!r} is missing")
    if data.dtype.kind not in "fiub":
        raise FileError(f"dataset {name!r} holds {data.dtype}; it must hold real numbers")
    if data.external or data.is_virtual:
        raise FileError(f"dataset {name!r} is kept in other files; those are not opened")
    declared = math.prod(data.shape) * data.dtype.itemsize
    most = data.id.get_storage_size() * (1 if data.chunks is None else _MOST_EXPANSION)
    if declared > most:
        raise FileError(
            f"dataset {name!r} declares {data.dtype} {data.shape}, {checks.size(declared)}; "
            f"what is stored of it holds {checks.size(most)} at most"
        )
    checks.fits_host(f"dataset {name!r}", 2 * declared)
    return _told(name, lambda: np.asarray(data[()]))


def as_grid(name: str, array: np.ndarray | None) -> tuple[int, int] | None:
    """(h, w) of an array of two numbers."""
    return None if array is None else checks.grid(name, np.ravel(array)[:3].tolist())


def _matrices(file: Any) -> tuple[Any, ...]:
    names = list(file.keys())[:_MOST_NAMES]
    if "T_0" in names:
        return tuple(_sparse(member(file, f"T_{k}"), f"T_{k}") for k in range(3))
    name = "T" if "T" in names else _only_candidate(file, names)
    found = member(file, name)
    if hasattr(found, "dtype"):
        T = values(file, name)
        if not is_matrix_shape(T.shape):
            raise FileError(f"dataset {name!r} has shape {T.shape}; T must be (M, N) or (3, M, N), not empty")
        return channels(arrays.as_floats(name, T))
    return (_sparse(found, name),)


def _only_candidate(file: Any, names: list[str]) -> str:
    found = []
    for name in names:
        part = None if name in _SMALL else member(file, name)
        if part is not None and (not hasattr(part, "dtype") or is_matrix_shape(part.shape)):
            found.append(name)
    if len(found) != 1:
        held = ", ".join(map(repr, names)) or "nothing"
        raise FileError(f"holds {held:.200}; it must hold T of (M, N) or (3, M, N), or one such dataset")
    return found[0]


def _sparse(group: Any, name: str) -> Any:
    told = {} if group is None else group.attrs
    layout = str(told.get("encoding-type", "")).removesuffix("_matrix")
    shape = np.ravel(np.asarray(told.get("shape", ())))
    if layout not in ("csr", "csc") or shape.shape != (2,) or shape.dtype.kind not in "iu":
        raise FileError(f"group {name!r} is no sparse matrix; it must say 'encoding-type' and 'shape'")
    parts = {part: values(group, part) for part in sparse.LAYOUTS[layout]}
    return sparse.assemble(layout, parts, (int(shape[0]), int(shape[1])))


def _small(file: Any, name: str) -> np.ndarray | None:
    return None if member(file, name) is None else values(file, name)


def _told(name: str, read: Callable[[], np.ndarray]) -> np.ndarray:
    try:
        return read()
    except (OSError, RuntimeError, ValueError, TypeError) as error:
        raise FileError(f"dataset {name!r} is damaged: {' '.join(str(error).split())!a:.150}") from None
