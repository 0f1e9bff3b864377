# SPDX-License-Identifier: BSD-3-Clause
"""HDF5 files (.h5, .hdf5), by h5py of the extra `hdf5`.

A file holds `EXTRAS` and `T` (M, N) or (3, M, N); or `T`, or `T_0` to `T_2`, as MATLAB's sparse
groups: `data`, `ir` (rows), `jc` (starts of columns), and the attribute MATLAB_sparse (number of
rows).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError
from ltcl.store.guards import EXPANSION, check_declared, sparse_floats
from ltcl.store.record import CHANNELS, FileNames, StoreRecord, assemble


@dataclass(frozen=True)
class SparseGroup:
    """MATLAB's sparse matrix by columns; its arrays are members of the file next to it."""

    rows: int


def read_hdf5(
    path: Path, variable: str | None = None, names: FileNames | None = None
) -> StoreRecord:
    """Read T, or T_0 to T_2."""
    members: dict[str, Any] = {}
    with _open(path, "r") as file:
        file.visititems(members.__setitem__)  # follows no links
        for name, member in members.items():
            if not hasattr(member, "dtype") and f"{name}/data" in members:
                members[name] = SparseGroup(member.attrs["MATLAB_sparse"])
        return assemble_members(members, variable, names)


def assemble_members(
    members: Mapping[str, Any], variable: str | None, names: FileNames | None
) -> StoreRecord:
    """Make a record of datasets (or arrays) and of sparse groups, by name."""
    shapes = {}
    for name, member in members.items():
        if "/" not in name:
            shapes[name] = _shape(member)
    is_reversed = names is not None and names.is_reversed

    def load(name: str) -> Any:
        if not hasattr(members[name], "dtype"):
            return _sparse(members, name)
        array = _numbers(members[name])
        if not is_reversed:
            return array
        if name == "first_bounce":
            has_one_channel = 1 in array.shape
            return array.ravel() if has_one_channel else array
        return array.swapaxes(-1, -2) if array.ndim > 1 else array

    return assemble(shapes, load, variable, names)


def _shape(member: Any) -> tuple[int, ...]:
    """Shape of a member; of a sparse matrix, whose columns are not counted yet, (1, 1)."""
    if isinstance(member, SparseGroup):
        return 1, 1
    return getattr(member, "shape", ()) or ()


def _sparse(members: Mapping[str, Any], name: str) -> scipy.sparse.csr_array:
    """The matrix of a sparse group."""
    data = _numbers(members[f"{name}/data"])
    rows = _numbers(members[f"{name}/ir"])
    starts = _numbers(members[f"{name}/jc"])
    shape = checks.grid(f"shape of {name!r}", (members[name].rows, len(starts) - 1))
    return sparse_floats(
        lambda: scipy.sparse.csc_array((data, rows, starts), shape=shape), shape, data.size
    )


def _numbers(data: Any) -> np.ndarray:
    """The numbers of a dataset, after its declared size was compared with what is stored."""
    if isinstance(data, np.ndarray):
        return data
    dataset = f"dataset {data.name.lstrip('/')!r}"
    if data.external or data.is_virtual:
        raise FileError(f"{dataset} is kept in other files; those are not opened")
    most = EXPANSION * data.id.get_storage_size()
    check_declared(dataset, data.dtype, data.shape or (), most)
    return checks.real(dataset, data[()])


def write_hdf5(path: Path, record: StoreRecord) -> None:
    """Write everything in `record`."""
    matrices: Any = record.matrices
    names = ("T",) if len(matrices) == 1 else CHANNELS
    with _open(path, "w") as file:
        file.update(record.arrays())
        if record.dense:
            return
        for name, matrix in zip(names, matrices, strict=True):
            columns = matrix.tocsc()
            group = file.create_group(name)
            group.attrs["MATLAB_sparse"] = columns.shape[0]
            group["data"] = columns.data
            group["ir"] = columns.indices
            group["jc"] = columns.indptr


def _open(path: Path, mode: str) -> Any:
    try:
        import h5py
    except ImportError:
        raise FileError(f"{path.suffix} files need h5py; pip install 'ltcl[hdf5]'") from None
    return h5py.File(path, mode)
