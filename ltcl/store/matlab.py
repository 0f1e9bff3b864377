# SPDX-License-Identifier: BSD-3-Clause
"""Transports as MATLAB's .mat: the variable `LTM` (M, N) or (M, N, 3), full or sparse, or the only matrix.

Sparse matrices of three channels are `LTM_r`, `LTM_g`, `LTM_b`; `grid`, `camera_grid`, `first_bounce` (N,
channels) and `mixing` may stand with it. SciPy writes version 5, of less than 4 GiB a variable. Version 7.3
is HDF5, column first: a variable (M, N) is a dataset (N, M), a sparse one a group of `data`, `ir` (rows),
`jc` (where columns start), with its rows in the attribute MATLAB_sparse.

Version 5 is a list of elements: type, bytes, values (MathWorks, "MAT-File Format"). It is read here, every
size compared with the bytes there are: SciPy's reader (1.17) crashes the process where they lie.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError
from ltcl.store import hdf5, headers
from ltcl.store.record import EXTRAS, Record, choose, from_arrays

NAME, CHANNELS = "LTM", ("LTM_r", "LTM_g", "LTM_b")
# Of version 5: types of elements, and classes of variables.
_TYPES: dict[int, str] = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8"}
_TYPES |= {12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_CLASSES = dict(enumerate(["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"], start=6))
_SPARSE, _COMPLEX = 5, 0x0800


def read(path: Path, variable: str | None = None) -> Record:
    """Read a transport; messages come without the file's name."""
    with path.open("rb") as file:
        head = file.read(128)
    if head.startswith(b"MATLAB 5.0 MAT-file") and head[126:128] in (b"IM", b"MI"):
        with headers.library("the .mat file"):
            return _record(_variables_5(path, "<" if head[126:128] == b"IM" else ">"), variable)
    with hdf5.reading(path) as file:
        return _record({name: hdf5.member(file, name) for name in list(file) if name[0] != "#"}, variable)


def write(path: Path, record: Record) -> None:
    """Write LTM, and grids, first bounce and mixing where they are known, as version 5."""
    T: Any = record.matrices
    extras = {name: getattr(record, name) for name in EXTRAS}
    if record.first_bounce is not None:
        extras["first_bounce"] = np.atleast_2d(record.first_bounce).T
    if len(T) == 1 or record.dense:
        variables = {NAME: T[0] if len(T) == 1 else np.stack(T, axis=2)}
    else:
        variables = dict(zip(CHANNELS, T, strict=True))
    variables |= {name: np.asarray(value, float) for name, value in extras.items() if value is not None}
    if max(4 * record.shape[0] * record.shape[1] * record.dense, 16 * T[0].size) >= 1 << 32:
        raise FileError("a variable of .mat has less than 4 GiB; save it as .h5")
    with path.open("wb") as file:
        scipy.io.savemat(file, variables)


def _record(variables: dict[str, Any], variable: str | None) -> Record:
    """Of variables by name: sparse matrices, NumPy arrays, or what HDF5 has of them."""
    names = choose({name: _shape(value) for name, value in variables.items()}, variable, NAME, CHANNELS)
    matrices = [_values(variables, name) for name in names]
    if len(matrices) == 1 and matrices[0].ndim == 3:
        matrices = [matrices[0].transpose(2, 0, 1)]
    extras = {name: np.asarray(_values(variables, name)) for name in EXTRAS if name in variables}
    if "first_bounce" in extras:
        bounce = extras["first_bounce"]
        vector = bounce.shape[-1] == 1 or (len(bounce) == 1 and bounce.shape[-1] != 3)  # a column, a row
        extras["first_bounce"] = bounce.ravel() if vector else bounce.T
    return from_arrays([headers.sparse(T) if scipy.sparse.issparse(T) else T for T in matrices], extras)


def _shape(value: Any) -> tuple[int, ...]:
    """As that of T: channels first."""
    if hasattr(value, "attrs"):  # of HDF5, whose axes are in reverse order
        return value.shape if hasattr(value, "dtype") else (1, 1) if "MATLAB_sparse" in value.attrs else ()
    return value.shape[::-1]


def _values(variables: dict[str, Any], name: str) -> Any:
    """A variable as MATLAB shows it."""
    if name not in variables:
        raise FileError(f"variable {name!r} is missing; the file holds {', '.join(variables) or 'none':.200}")
    value = variables[name]
    if not hasattr(value, "attrs"):
        return value
    if hasattr(value, "dtype"):
        return hdf5.values(value.parent, name).T
    rows = value.attrs.get("MATLAB_sparse")
    if not isinstance(rows, np.integer):
        raise FileError(f"variable {name!r} is neither a full nor a sparse matrix of MATLAB")
    jc, empty = hdf5.values(value, "jc"), "data" not in list(value)  # as MATLAB leaves it out
    data, ir = (np.zeros(0) if empty else hdf5.values(value, part) for part in ("data", "ir"))
    return _csc(int(rows), len(jc) - 1, data, ir.astype(np.int64), jc.astype(np.int64))


def _csc(rows: int, columns: int, data: np.ndarray, ir: np.ndarray, jc: np.ndarray) -> Any:
    headers.sparse_shape((rows, columns), data.size)
    return scipy.sparse.csc_array((data, ir, jc), shape=(rows, columns))


def _variables_5(path: Path, order: str) -> dict[str, Any]:
    """Full and sparse matrices by name; strings, cells, structures and objects are passed over."""
    variables: dict[str, Any] = {}
    checks.fits_host("the file", path.stat().st_size)
    for kind, content in _elements(memoryview(path.read_bytes())[128:], order):
        if kind not in (_MATRIX, _COMPRESSED):
            raise FileError(f"has an element of type {kind} in the place of a variable; it is damaged")
        elements = _elements(_inflated(content, order) if kind == _COMPRESSED else content, order)
        (_, flags), (_, dims), (_, name) = (next(elements) for _ in range(3))
        (bits,) = struct.unpack_from(f"{order}I", flags)
        shape = np.frombuffer(dims, f"{order}i4").tolist()
        if bits & 0xFF == _SPARSE:
            ir, jc, data = (_numbers(*element, order) for element, _ in zip(elements, range(3), strict=False))
            value = _csc(shape[0], shape[1], data, ir, jc)
        elif bits & 0xFF in _CLASSES:
            numbers = _numbers(*next(elements), order)
            value = numbers.astype(_CLASSES[bits & 0xFF]).reshape(shape[::-1]).T
        else:
            continue
        variables[bytes(name).decode("ascii")] = value.astype(complex) if bits & _COMPLEX else value
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
    if kind != _MATRIX or size > headers.EXPANSION * len(content):
        raise FileError(f"has a compressed variable of type {kind} and {size} bytes; it is damaged")
    checks.fits_host("a variable", 3 * size)
    matrix = inflate.decompress(inflate.unconsumed_tail, size)
    if len(matrix) < size or inflate.decompress(inflate.unconsumed_tail, 1) or not inflate.eof:
        raise FileError("has a compressed variable of another size than it says; it is damaged")
    return memoryview(matrix)


def _numbers(kind: int, content: memoryview, order: str) -> np.ndarray:
    return np.frombuffer(content, order + _TYPES[kind]).astype(_TYPES[kind])
