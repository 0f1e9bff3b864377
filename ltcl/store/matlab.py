# SPDX-License-Identifier: BSD-3-Clause
"""Transports as MATLAB's .mat of version 7.3, which is HDF5: the variable `LTM`, full or sparse.

MATLAB's sparse matrices have two dimensions, so that those of three channels are `LTM_r`, `LTM_g`, `LTM_b`.

MATLAB stores columns first, so a variable (M, N) is a dataset (N, M), and (M, N, 3) is (3, N, M). A sparse
one is a group of `data`, `ir` (rows), `jc` (where columns start), its rows in the attribute MATLAB_sparse.
`grid`, `camera_grid`, `first_bounce` (N, channels) and `mixing` may stand beside it. Older .mat are no HDF5.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ltcl.errors import FileError
from ltcl.store import arrays, hdf5, sparse
from ltcl.store.record import Matrix, Record

KEEPS_FIRST_BOUNCE = True
NAME = "LTM"
CHANNELS = ("LTM_r", "LTM_g", "LTM_b")
_USERBLOCK = 512
_CLASSES = {"float32": b"single", "float64": b"double"}


def read(path: Path) -> Record:
    """Read the variable LTM; messages come without the file's name."""
    with path.open("rb") as file:
        if file.read(19).startswith(b"MATLAB 5.0 MAT-file"):
            raise FileError("is a .mat of an older version; save it from MATLAB with '-v7.3'")
    with hdf5.opened(path, "r") as file:
        if hdf5.member(file, NAME) is None and any(hdf5.member(file, name) is None for name in CHANNELS):
            names = ", ".join(map(repr, file.keys()))
            raise FileError(
                f"holds {names or 'nothing':.200}; the transport must be the variable {NAME}, or of three "
                f"channels {', '.join(CHANNELS)}"
            )
        bounce, mixing = (_variable(file, name) for name in ("first_bounce", "mixing"))
        if bounce is not None:
            one = bounce.shape[-1] == 1 or (len(bounce) == 1 and bounce.shape[-1] != 3)  # a row or a column
            bounce = bounce.ravel() if one else np.ascontiguousarray(bounce.T)
        grid, camera_grid = (hdf5.as_grid(name, _variable(file, name)) for name in ("grid", "camera_grid"))
        return Record(_matrices(file), grid, camera_grid, bounce, mixing)


def write(path: Path, record: Record) -> None:
    """Write LTM and what is known besides."""
    with hdf5.opened(path, "w", userblock_size=_USERBLOCK) as file:
        if record.dense:
            made = hdf5.write_dense(file, NAME, record, turned=True)
            made.attrs["MATLAB_class"] = np.bytes_(_CLASSES[made.dtype.name])
        else:
            names = CHANNELS if len(record.matrices) == 3 else (NAME,)
            for name, T in zip(names, record.matrices, strict=True):
                _write_sparse(file, name, T)
        bounce = None if record.first_bounce is None else np.atleast_2d(record.first_bounce).T
        own = {"grid": record.grid, "camera_grid": record.camera_grid, "first_bounce": bounce}
        for name, value in {**own, "mixing": record.mixing}.items():
            if value is not None:
                file[name] = np.atleast_2d(np.asarray(value, np.float64)).T
                file[name].attrs["MATLAB_class"] = np.bytes_(b"double")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, written by ltcl".ljust(124) + b"\x00\x02IM")


def _variable(file: Any, name: str) -> np.ndarray | None:
    """As MATLAB shows it."""
    return None if hdf5.member(file, name) is None else hdf5.values(file, name).T


def _matrices(file: Any) -> tuple[Matrix, ...]:
    if hdf5.member(file, NAME) is None:
        return _alike([_one(file, name) for name in CHANNELS])
    if not hasattr(hdf5.member(file, NAME), "dtype"):
        return (_sparse(NAME, hdf5.member(file, NAME)),)
    turned = hdf5.values(file, NAME)  # (N, M) or (3, N, M)
    if turned.ndim not in (2, 3) or 0 in turned.shape or (turned.ndim == 3 and len(turned) not in (1, 3)):
        raise FileError(f"{NAME} has shape {turned.shape[::-1]}; it must be (M, N) or (M, N, 3), not empty")
    parts = [turned] if turned.ndim == 2 else list(turned)
    return tuple(np.ascontiguousarray(arrays.as_floats(NAME, part.T)) for part in parts)


def _one(file: Any, name: str) -> Matrix:
    """A full or sparse variable of two dimensions."""
    if not hasattr(hdf5.member(file, name), "dtype"):
        return _sparse(name, hdf5.member(file, name))
    turned = hdf5.values(file, name)
    if turned.ndim != 2 or 0 in turned.shape:
        raise FileError(f"{name} has shape {turned.shape[::-1]}; it must be (M, N), not empty")
    return np.ascontiguousarray(arrays.as_floats(name, turned.T))


def _alike(matrices: list[Matrix]) -> tuple[Matrix, ...]:
    """Refuse channels of several shapes or kinds."""
    if len({T.shape for T in matrices}) > 1:
        shapes = ", ".join(str(T.shape) for T in matrices)
        raise FileError(f"{', '.join(CHANNELS)} have the shapes {shapes}; all must be the same")
    if len({isinstance(T, np.ndarray) for T in matrices}) > 1:
        raise FileError(f"{', '.join(CHANNELS)} are full and sparse; all must be one of them")
    return tuple(matrices)


def _sparse(name: str, group: Any) -> Matrix:
    rows = group.attrs.get("MATLAB_sparse")
    if not isinstance(rows, np.integer):
        raise FileError(f"{name} is neither a full nor a sparse matrix of MATLAB")
    starts = hdf5.values(group, "jc")
    empty = hdf5.member(group, "data") is None  # MATLAB leaves both out where nothing is stored
    data, places = (np.zeros(0) if empty else hdf5.values(group, name) for name in ("data", "ir"))
    shape = (int(rows), len(starts) - 1)
    return sparse.assemble("csc", {"data": data, "indices": places.astype(np.int64), "indptr": starts}, shape)


def _write_sparse(file: Any, name: str, T: Any) -> None:
    csc = T.tocsc()
    group = file.create_group(name)
    group.attrs["MATLAB_class"] = np.bytes_(b"double")  # the one that MATLAB's sparse matrices have
    group.attrs["MATLAB_sparse"] = np.uint64(csc.shape[0])
    group["data"] = csc.data.astype(np.float64)
    group["ir"] = csc.indices.astype(np.uint64)
    group["jc"] = csc.indptr.astype(np.uint64)
