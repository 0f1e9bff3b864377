# SPDX-License-Identifier: BSD-3-Clause
"""HDF5 files (.h5, .hdf5), by h5py of the extra `hdf5`.

A file holds `EXTRAS` and `T` (M, N) or (3, M, N); or `T`, or `T_0` to `T_2`, as MATLAB's sparse
groups: `data`, `ir` (rows), `jc` (starts of columns), and the attribute MATLAB_sparse (number of
rows). Matrices in other groups have their path as a name, `entry/data/T`.

A file is written in memory first: HDF5 that finds a disk full ends the process.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError
from ltcl.store.guards import EXPANSION, check_declared, sparse_floats
from ltcl.store.record import (
    CHANNELS,
    DEFAULT_NAMES,
    FileContents,
    FileNames,
    StoreRecord,
    Variable,
    assemble,
)

ROWS = "MATLAB_sparse"
# Numbers by the kinds of NumPy; complex ones are refused by name.
NUMBERS = "fiubc"
# MATLAB keeps the contents of cells in this group.
MATLAB_CELLS = "#refs#"


@dataclass(frozen=True)
class SparseGroup:
    """MATLAB's sparse matrix by columns; its arrays are members of the file next to it."""

    rows: int


def read_hdf5(
    path: Path, variable: Variable = None, names: FileNames = DEFAULT_NAMES
) -> StoreRecord:
    """Read T, or T_0 to T_2."""
    members: dict[str, Any] = {}
    with _h5py(path).File(path, "r") as file:
        file.visititems(members.__setitem__)  # follows no links
        for name, member in members.items():
            if ROWS in member.attrs and f"{name}/jc" in members:
                members[name] = SparseGroup(member.attrs[ROWS])
        return assemble_members(members, variable, names)


def assemble_members(
    members: Mapping[str, Any], variable: Variable, names: FileNames
) -> StoreRecord:
    """Make a record of datasets (or arrays), sparse groups, and kinds of all else, by name."""
    shapes = {}
    unreadable = {}
    for name, member in members.items():
        group, _, _ = name.rpartition("/")
        is_inner = isinstance(members.get(group), SparseGroup)
        if is_inner or name.startswith(MATLAB_CELLS):
            continue
        kind = _kind(member)
        if kind:
            unreadable[name] = kind
        elif isinstance(member, SparseGroup) or hasattr(member, "dtype"):
            shapes[name] = _shape(member)

    def load(name: str) -> Any:
        if not hasattr(members[name], "dtype"):
            return _sparse(members, name)
        array = _numbers(members[name])
        if not names.is_reversed or name == "first_bounce" or array.ndim < 2:
            return array
        return array.swapaxes(-1, -2)

    contents = FileContents(shapes=shapes, load=load, unreadable=unreadable)
    return assemble(contents, variable, names)


def _kind(member: Any) -> str:
    """The reason that a member cannot be T; empty if it can, or is a group."""
    if isinstance(member, str):
        return member
    try:
        dtype = getattr(member, "dtype", None)
    except TypeError:
        return "of a type that NumPy lacks"
    if dtype is None or dtype.kind in NUMBERS:
        return ""
    if dtype.names == ("real", "imag"):
        return "complex"
    return "a table" if dtype.names else "text"


def _shape(member: Any) -> tuple[int, ...]:
    """Shape of a member; of a sparse matrix, whose columns are not counted yet, (1, 1)."""
    if isinstance(member, SparseGroup):
        return 1, 1
    return getattr(member, "shape", ()) or ()


def _sparse(members: Mapping[str, Any], name: str) -> scipy.sparse.csr_array:
    """The matrix of a sparse group, whose arrays may have room to spare."""
    starts: Any = _numbers(members[f"{name}/jc"])
    entries = max(int(starts[-1]), 0)
    # MATLAB leaves out arrays of no entries.
    empty = np.zeros(0, np.int64)
    data = _numbers(members.get(f"{name}/data", empty))[:entries]
    rows = _numbers(members.get(f"{name}/ir", empty))[:entries]
    shape = checks.grid(f"shape of {name!r}", (members[name].rows, len(starts) - 1))
    return sparse_floats(
        lambda: scipy.sparse.csc_array((data, rows, starts), shape=shape),
        shape,
        data.size,
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
    arrays = record.arrays()
    nbytes = sum(array.nbytes for array in arrays.values())
    if not record.dense:
        nbytes += sum(12 * matrix.nnz for matrix in matrices)
    checks.fits_host("the file, which is written in memory first,", nbytes)
    content = io.BytesIO()
    with _h5py(path).File(content, "w") as file:
        file.update(arrays)
        if not record.dense:
            names = CHANNELS if len(matrices) == 3 else ("T",)
            for name, matrix in zip(names, matrices, strict=True):
                _write_sparse(file.create_group(name), matrix.tocsc())
    path.write_bytes(content.getbuffer())


def _write_sparse(group: Any, columns: Any) -> None:
    group.attrs[ROWS] = columns.shape[0]
    group["data"] = columns.data
    group["ir"] = columns.indices
    group["jc"] = columns.indptr


def _h5py(path: Path) -> Any:
    return checks.load_extra("h5py", "hdf5", f"{path}: a file of this kind", FileError)
