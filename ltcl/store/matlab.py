# SPDX-License-Identifier: BSD-3-Clause
"""MATLAB's .mat files.

A file holds `EXTRAS`, `first_bounce` as (N, channels), and `LTM`, (M, N) or (M, N, 3) or sparse,
or `LTM_r`, `LTM_g`, `LTM_b`, or any one matrix. Version 7.3 is HDF5 with axes in reverse order;
version 5 is a list of elements: type, bytes, values (MathWorks, "MAT-File Format").

Damaged files of version 5 crash SciPy, so they are read with NumPy, here.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scipy  # its subpackage io is loaded at the first use

from ltcl import checks
from ltcl.errors import FileError
from ltcl.store.hdf5 import SparseGroup, assemble_members, read_hdf5
from ltcl.store.record import EXTRAS, FileNames, StoreRecord, Variable

NAMES = FileNames(matrix="LTM", channels=("LTM_r", "LTM_g", "LTM_b"), is_reversed=True)
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
USER_BLOCK = 512  # bytes before the HDF5 of version 7.3
HEADER = 128  # bytes before the elements of version 5
VARIABLE_LIMIT = 1 << 32  # bytes

# Version 5: types of elements, and how NumPy calls those of numbers.
MATRIX = 14
COMPRESSED = 15
NUMBER_TYPES = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
# Classes of variables: sparse, and all of real numbers. The mask takes the flag of complex ones
# along.
SPARSE_CLASS = 5
NUMBER_CLASSES = range(5, 16)
OTHER_CLASSES = {1: "a cell array", 2: "a struct", 3: "an object", 4: "text"}
COMPLEX = 0x800
CLASS_AND_COMPLEX = 0x8FF


def write_mat(path: Path, record: StoreRecord) -> None:
    """Write LTM, and grids, first bounce and mixing where they are known, as version 5."""
    variables: dict[str, Any] = {}
    for name, array in record.arrays().items():
        if name in EXTRAS:
            variables[name] = np.array(array, float, ndmin=2)
    if "first_bounce" in variables:
        variables["first_bounce"] = variables["first_bounce"].T
    matrices: Any = record.matrices
    if len(matrices) == 1:
        variables[NAMES.matrix] = matrices[0]
    elif record.dense:
        variables[NAMES.matrix] = np.dstack(matrices)
    else:
        variables |= zip(NAMES.channels, matrices, strict=True)
    if max(map(_variable_bytes, variables.values())) >= VARIABLE_LIMIT:
        raise FileError("a variable of .mat has less than 4 GiB; save it as .h5")
    scipy.io.savemat(path, variables)


def _variable_bytes(variable: Any) -> int:
    """Bytes of a variable; a sparse entry takes a float64 and two indices."""
    if hasattr(variable, "nnz"):
        return 16 * variable.nnz
    return variable.nbytes


def read_mat(path: Path, variable: Variable = None) -> StoreRecord:
    """Read a .mat of version 7.3, or of 5, whose strings, cells and structures are left out."""
    with path.open("rb") as file:
        head = file.read(USER_BLOCK + len(HDF5_SIGNATURE))
    if HDF5_SIGNATURE in (head[: len(HDF5_SIGNATURE)], head[USER_BLOCK:]):
        return read_hdf5(path, variable, NAMES)
    if not head.startswith(b"MATLAB 5.0 MAT-file") or head[126:128] != b"IM":
        raise FileError(
            "is neither version 5, little-endian, nor 7.3; save it again with -v7 or -v7.3"
        )
    checks.fits_host("the file", 2 * path.stat().st_size)
    content = memoryview(path.read_bytes())[HEADER:]
    members: dict[str, Any] = {}
    for kind, element in _elements(content):
        if kind == COMPRESSED:
            kind, element = _inflate(element)
        members |= _variable(kind, element)
    return assemble_members(members, variable, NAMES)


def _elements(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Type and bytes of each element; those of at most 4 bytes stand inside the tag."""
    while data:
        kind, size = struct.unpack_from("<II", data)
        start = 8
        if kind >> 16:  # a small element: its size is in the upper half of the type
            size = kind >> 16
            kind &= 0xFFFF
            start = 4
        end = start + size
        yield kind, data[start:end]
        padding = 0 if kind == COMPRESSED else -end % 8
        data = data[end + padding :]


def _inflate(content: memoryview) -> tuple[int, memoryview]:
    """Type and bytes of a compressed element; type -1 where it is longer than it declares."""
    inflate = zlib.decompressobj()
    kind, size = struct.unpack("<II", inflate.decompress(content, 8))
    checks.fits_host("a variable", 3 * size)
    element = memoryview(inflate.decompress(inflate.unconsumed_tail, size + 1))
    if not inflate.eof:
        kind = -1
    return kind, element


def _other_kind(number_class: int) -> str:
    """The kind of a variable that holds no real numbers."""
    if number_class & COMPLEX:
        return "complex"
    return OTHER_CLASSES.get(number_class, "of a type of MATLAB's own")


def _variable(kind: int, content: memoryview) -> dict[str, Any]:
    """The members of one variable of real numbers, as HDF5 has them; of others their kind."""
    if kind != MATRIX:
        content = content[:0]
    (_, flags), (_, dimensions), (_, label), *elements = _elements(content)
    number_class = int.from_bytes(flags[:2], "little") & CLASS_AND_COMPLEX
    name = str(label, "ascii", "replace")
    if number_class not in NUMBER_CLASSES:
        # MATLAB keeps data of its own under an empty name.
        return {name: _other_kind(number_class)} if name else {}
    shape = np.frombuffer(dimensions, "<i4").tolist()
    arrays = []
    for element_kind, values in elements:
        arrays.append(np.frombuffer(values, f"<{NUMBER_TYPES[element_kind]}"))
    if number_class == SPARSE_CLASS:
        rows, starts, values = arrays
        group = SparseGroup(shape[0])
        return {name: group, f"{name}/ir": rows, f"{name}/jc": starts, f"{name}/data": values}
    (array,) = arrays
    return {name: array.reshape(shape[::-1])}
