# SPDX-License-Identifier: BSD-3-Clause
"""Files for other programs: Matrix Market (.mtx), HDF5 (.h5, .hdf5) and MATLAB's .mat.

A .mtx holds one matrix, real or integer, and the grid in a comment, `%ltcl grid 3 x 4` or `%ltcl grid 3 x 4,
camera grid 6 x 8`. HDF5 (through h5py, the extra `hdf5`) holds `T` (M, N) or (3, M, N); or groups `T`, or
`T_0` to `T_2`, of one sparse matrix in AnnData's layout: `data`, `indices`, `indptr` and attributes
`encoding-type` "csr_matrix" and `shape`; and `EXTRAS`. A .mat holds the variable `LTM` (M, N) or (M, N, 3),
full or sparse, or the only matrix; sparse ones of three channels are `LTM_r`, `LTM_g`, `LTM_b`; `EXTRAS` may
be there, `first_bounce` as (N, channels). Version 7.3 is HDF5 with the axes in reverse order, and sparse
groups of `data`, `ir` (rows), `jc` (where columns start), with their rows in the attribute MATLAB_sparse.

SciPy's readers of .mtx and .mat (1.17) crash the process on damaged values, so here NumPy reads them. Version
5 is a list of elements: type, bytes, values (MathWorks, "MAT-File Format"). Sizes are believed only as far as
bytes are stored for them; links and outside storage of HDF5 are not followed.
"""

from __future__ import annotations

import contextlib
import functools
import io
import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError, InputError
from ltcl.store.record import CHANNELS, CSR, EXPANSION, Record, assemble, declared, sparse

_LONGEST_LINE = 1 << 20
_KINDS = "(array|coordinate) (real|double|integer|unsigned-integer) (general|symmetric)"
_GRID = re.compile(rb"%+\s*ltcl grid (\d{1,9}) x (\d{1,9})(?:, camera grid (\d{1,9}) x (\d{1,9}))?\s*")
_ENCODING = {"encoding-type": "csr_matrix", "encoding-version": "0.1.0"}
_NAME, _COLOURS = "LTM", ("LTM_r", "LTM_g", "LTM_b")
# Of version 5: types of elements, and classes of variables.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_CLASSES = dict(enumerate(["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"], start=6))
_SPARSE, _COMPLEX = 5, 0x0800


def read_mtx(path: Path) -> Record:
    """Read a Matrix Market file; its values come back as float64."""
    size, line, grids = path.stat().st_size, b"%", []
    with path.open("rb") as file:
        banner = file.readline(1024)
        while line.startswith(b"%") or line.isspace():
            if comment := _GRID.fullmatch(line):
                sizes = [int(n) for n in comment.groups() if n]
                grids = [tuple(sizes[:2]), tuple(sizes[2:]) or None]
            line = file.readline(_LONGEST_LINE)
        if not re.fullmatch(rb"\s*(\d{1,18}\s*){2,3}", line):
            raise FileError(f"has the line of sizes {line.strip()!r:.60}; it must be 'rows columns entries'")
        rows, columns, entries, layout, field, symmetry = scipy.io.mminfo(io.BytesIO(banner + line))
        dense, kind = layout == "array", f"{layout} {field} {symmetry}"
        if not re.fullmatch(_KINDS, kind):
            raise FileError(f"holds {kind}; it must be real or integer, and general or symmetric")
        if symmetry == "symmetric" and (dense or rows != columns):
            raise FileError(f"holds {kind} of {rows} x {columns}; it must be sparse and square, or general")
        checks.fits_host("the matrix", 5 * size)  # a number takes 2 bytes of text or more
        numbers: np.ndarray = np.fromfile(file, np.float64, sep=" ")
        file.seek(max(size - 64, 0))
        float(file.read().split()[-1])  # of which fromfile takes what it can: 1.5 of 1.5E
    if len(numbers) != (count := rows * columns if dense else 3 * entries):
        raise FileError(f"declares {count} numbers, but holds {len(numbers)}; it is truncated or damaged")
    if dense:  # column by column
        return Record((np.ascontiguousarray(numbers.reshape(columns, rows).T),), *grids)
    places, values = numbers.reshape(-1, 3)[:, :2], numbers[2::3]
    wrong = ~((places >= 1) & (places <= (rows, columns)) & (places == np.floor(places))).all(axis=1)
    if wrong.any():
        i, j = places[np.argmax(wrong)]
        raise FileError(f"has an entry in row {i:g} and column {j:g} of {rows} x {columns}")
    coo = (values, places.T.astype(np.int64) - 1)
    T = sparse(lambda: scipy.sparse.coo_array(coo, shape=(rows, columns)), (rows, columns), entries)
    if symmetry == "symmetric":
        T = scipy.sparse.csr_array(T + T.T - scipy.sparse.diags_array(T.diagonal()))
    return Record((T,), *grids)


def write_mtx(path: Path, record: Record) -> None:
    """Write the matrix and the grids of `record`, of one channel."""
    if len(record.matrices) != 1:
        raise InputError("T has three channels, and a .mtx holds one matrix; save it as .npz")
    comment = "ltcl grid {} x {}".format(*record.grid) if record.grid else ""
    if record.grid and record.camera_grid:
        comment += ", camera grid {} x {}".format(*record.camera_grid)
    with path.open("wb") as file:  # by name, SciPy would append .mtx to .MTX
        scipy.io.mmwrite(file, record.matrices[0], comment=comment, symmetry="general")


def write_mat(path: Path, record: Record) -> None:
    """Write LTM, and grids, first bounce and mixing where they are known, as version 5."""
    variables: dict[str, Any] = {name: np.atleast_2d(array) for name, array in record.arrays().items()}
    variables |= {name: array.astype(float) for name, array in variables.items() if name != "T"}
    if "first_bounce" in variables:
        variables["first_bounce"] = variables["first_bounce"].T
    if record.dense:
        T = variables.pop("T")
        variables[_NAME] = T if T.ndim == 2 else T.transpose(1, 2, 0)
    else:
        names = (_NAME,) if len(record.matrices) == 1 else _COLOURS
        variables |= dict(zip(names, record.matrices, strict=True))
    if max(16 * T.nnz if scipy.sparse.issparse(T) else T.nbytes for T in variables.values()) >= 1 << 32:
        raise FileError("a variable of .mat has less than 4 GiB; save it as .h5")
    with path.open("wb") as file:
        scipy.io.savemat(file, variables)


def read_mat(path: Path, variable: str | None = None) -> Record:
    """Read a .mat of version 5, or of version 7.3."""
    with path.open("rb") as file:
        head = file.read(128)
    if head.startswith(b"MATLAB 5.0 MAT-file") and head[126:128] in (b"IM", b"MI"):
        variables = _variables(path, "<" if head[126:128] == b"IM" else ">")
        return _assemble(variables, lambda name: variables[name], variable)
    with _members(path) as named:
        return _assemble(named, lambda name: _matrix(named, name), variable)


def _assemble(named: dict[str, Any], load: Any, variable: str | None) -> Record:
    """Axes come in reverse order, as in the file: (N, M) of a matrix, (channels, N, M) of three."""
    if variable not in (None, *named):
        raise FileError(f"variable {variable!r} is missing; it holds {', '.join(named) or 'none':.200}")

    def turned(name: str) -> Any:
        array = load(name)
        if not isinstance(array, np.ndarray):
            return array
        if name == "first_bounce":  # a row or a column of one channel
            return array.ravel() if 1 in array.shape else array
        return array.swapaxes(-1, -2) if array.ndim > 1 else array

    return assemble({n: _shape(value) for n, value in named.items()}, turned, variable, _NAME, _COLOURS, True)


def _variables(path: Path, order: str) -> dict[str, Any]:
    """Full (axes reversed) and sparse matrices by name; strings, cells, structures, objects are left out."""
    variables: dict[str, Any] = {}
    checks.fits_host("the file", path.stat().st_size)
    for kind, content in _elements(memoryview(path.read_bytes())[128:], order):
        if kind not in (_MATRIX, _COMPRESSED):
            raise FileError(f"has an element of type {kind} in the place of a variable; it is damaged")
        elements = _elements(_inflated(content, order) if kind == _COMPRESSED else content, order)
        (_, flags), (_, dims), (_, name) = (next(elements) for _ in range(3))
        (bits,) = struct.unpack_from(f"{order}I", flags)
        shape = np.frombuffer(dims, f"{order}i4").tolist()
        if bits & 0xFF not in (_SPARSE, *_CLASSES) or bits & _COMPLEX:
            continue
        arrays = [
            np.frombuffer(values, order + _TYPES[kind]).astype(_TYPES[kind]) for kind, values in elements
        ]
        if bits & 0xFF == _SPARSE:
            ir, jc, data = arrays
            make = functools.partial(scipy.sparse.csc_array, (data, ir, jc), shape=shape)
            value: Any = sparse(make, shape, data.size)
        else:
            value = arrays[0].astype(_CLASSES[bits & 0xFF]).reshape(shape[::-1])
        variables[bytes(name).decode("ascii")] = value
    return variables


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Type and bytes of each element; those of at most 4 bytes stand inside the tag."""
    place = 0
    while place < len(data):
        kind, size = struct.unpack_from(f"{order}II", data, place)
        start = place + 8
        if kind >> 16:
            kind, size, start = kind & 0xFFFF, min(kind >> 16, 4), place + 4
        if start + size > len(data):
            raise FileError("is truncated, or damaged: an element is longer than what is there")
        yield kind, data[start : start + size]
        place = start + size + (0 if kind == _COMPRESSED else -(start + size) % 8)


def _inflated(content: memoryview, order: str) -> memoryview:
    """The matrix in a compressed element, which must be as long as it says."""
    inflate = zlib.decompressobj()
    kind, size = struct.unpack(f"{order}II", inflate.decompress(content, 8))
    if kind != _MATRIX or size > EXPANSION * len(content):
        raise FileError(f"has a compressed variable of type {kind} and {size} bytes; it is damaged")
    checks.fits_host("a variable", 3 * size)
    matrix = inflate.decompress(inflate.unconsumed_tail, size)
    if len(matrix) < size or inflate.decompress(inflate.unconsumed_tail, 1) or not inflate.eof:
        raise FileError("has a compressed variable of another size than it says; it is damaged")
    return memoryview(matrix)


def read_hdf5(path: Path, variable: str | None = None) -> Record:
    """Read T, or T_0 to T_2."""
    with _members(path) as named:
        return assemble({n: _shape(data) for n, data in named.items()}, lambda n: _matrix(named, n), variable)


def write_hdf5(path: Path, record: Record) -> None:
    """Write everything in `record`."""
    T: Any = record.matrices
    names = () if record.dense else ("T",) if len(T) == 1 else CHANNELS
    with _h5py(path).File(path, "w") as file:
        for name, array in record.arrays().items():
            file[name] = array
        for name, csr in zip(names, T, strict=bool(names)):
            group = file.create_group(name)
            group.attrs.update({**_ENCODING, "shape": csr.shape})
            for array in CSR:
                group[array] = getattr(csr, array)


@contextlib.contextmanager
def _members(path: Path) -> Iterator[dict[str, Any]]:
    """The datasets and groups of a file."""
    with _h5py(path).File(path, "r") as file:
        yield {name: _member(file, name) for name in list(file) if name[0] != "#"}  # MATLAB's own


def _shape(data: Any) -> tuple[int, ...]:
    """That of a dataset, axes in reverse order; (1, 1) of a group that may be a sparse matrix."""
    if hasattr(data, "dtype"):
        return data.shape[::-1] if scipy.sparse.issparse(data) else data.shape or ()
    return (1, 1) if {"encoding-type", "MATLAB_sparse"} & set(data.attrs) else ()


def _matrix(named: Any, name: str) -> Any:
    """A dataset, or a group of one sparse matrix in either layout."""
    if name not in named:
        raise FileError(f"{name!r} is missing; the file holds {', '.join(named) or 'nothing':.200}")
    data = named[name]
    if hasattr(data, "dtype"):
        return _numbers(data)
    make: Any = scipy.sparse.csc_array
    if "MATLAB_sparse" in data.attrs:
        jc, empty = _numbers(_member(data, "jc")).astype(np.int64), "data" not in list(data)  # left out
        values, ir = (np.zeros(0) if empty else _numbers(_member(data, n)) for n in ("data", "ir"))
        arrays, sizes = (values, ir.astype(np.int64), jc), (data.attrs["MATLAB_sparse"], len(jc) - 1)
    else:
        make = {"csr_matrix": scipy.sparse.csr_array, "csc_matrix": make}[data.attrs["encoding-type"]]
        arrays = tuple(_numbers(_member(data, n)) for n in CSR)
        sizes = np.ravel(data.attrs.get("shape", 0)).tolist()
    M, N = checks.grid(f"shape of {name!r}", sizes)
    return sparse(lambda: make(arrays, shape=(M, N)), (M, N), arrays[0].size)


def _member(group: Any, name: str) -> Any:
    """What must be in this very file."""
    if group.get(name, getlink=True).__class__.__name__ == "HardLink":
        return group[name]
    raise FileError(f"{name!r} is missing, or a link to elsewhere; links are not followed")


def _numbers(data: Any) -> np.ndarray:
    """The numbers of a dataset, after its declared size was compared with what is stored."""
    what = f"dataset {data.name.lstrip('/')!r}"
    if not hasattr(data, "dtype") or data.external or data.is_virtual:
        raise FileError(f"{what} is a group, or kept in other files; those are not opened")
    most = data.id.get_storage_size() * (1 if data.chunks is None else EXPANSION)
    declared(what, data.dtype, data.shape or (), most)
    return checks.real(what, data[()])


def _h5py(path: Path) -> Any:
    try:
        import h5py
    except ImportError:
        raise FileError(f"{path.suffix} files need h5py; pip install 'ltcl[hdf5]'") from None
    return h5py
