# SPDX-License-Identifier: BSD-3-Clause
"""NumPy's files: .npz, with checked sizes, and .npy; nothing is compressed or pickled.

An .npz holds SciPy's `save_npz` layouts; or named arrays, `T` (M, N) or (3, M, N) or the only
matrix; or, by its `format`, a compressed transport, an inverse, or three sparse channels
("ltcl-rgb-csr-1": `shape`, `indptr_0`, `indices_0`, `data_0` to `data_2`); and perhaps `EXTRAS`.
"""

from __future__ import annotations

import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError, InputError
from ltcl.store.combined import COMBINED_FORMAT, CombinedRecord
from ltcl.store.guards import EXPANSION, check_declared, sparse_floats
from ltcl.store.record import (
    CHANNELS,
    COMPRESSED_FORMAT,
    CSR,
    INVERSE_FORMAT,
    CompressedRecord,
    FileContents,
    StoreRecord,
    Variable,
    assemble,
)
from ltcl.transport.projectors.combined import MAX_PROJECTORS

RGB_FORMAT = "ltcl-rgb-csr-1"
# One sparse channel among the arrays of other matrices.
GREY_FORMAT = "ltcl-csr-1"
# Arrays of SciPy's layouts that hold indices begin with these.
INDEX_ARRAYS = ("indices", "indptr", "row", "col", "coords", "offsets")
# About the bytes of a stored entry: enough to bound the rows of a sparse matrix by the file's size.
ENTRY_BYTES = 8
OBJECTS = "made of Python objects (pickled), which are never loaded"
# Local headers of a zip archive: bytes, and the place of the lengths of name and extra field.
LOCAL_HEADER = 30
LOCAL_LENGTHS = struct.Struct("<26xHH")
# What may stand behind the bytes of an entry.
MAX_DATA_DESCRIPTOR = 24

Headers = dict[str, tuple[tuple[int, ...], np.dtype]]


def read_npz(
    path: Path, variable: Variable = None
) -> StoreRecord | CompressedRecord | CombinedRecord:
    """Read an .npz; MemoryLimitError or FileError before any array that does not fit is made."""
    headers = _headers(path)
    with np.load(path, allow_pickle=False) as archive:

        def load(name: str) -> np.ndarray:
            array = archive[name]
            if array.dtype.kind in "SU" and array.size == 1:
                return array.astype(str).reshape(())
            native = array.dtype.newbyteorder("=")
            return np.asarray(checks.real(f"array {name!r}", array), native)

        layout = str(load("format")) if "format" in headers else None
        if layout == COMBINED_FORMAT:
            return _read_combined(path, headers, load)
        return _read_record(path, headers, load, variable)


def _read_record(
    path: Path,
    headers: Headers,
    load: Callable[[str], np.ndarray],
    variable: Variable = None,
) -> StoreRecord | CompressedRecord:
    """The record of arrays that lie in an .npz."""
    layout = str(load("format")) if "format" in headers else None
    if layout in (COMPRESSED_FORMAT, INVERSE_FORMAT):
        arrays = {}
        for name, (_, dtype) in headers.items():
            if name != "format" and not dtype.hasobject:
                arrays[name] = load(name)
        return CompressedRecord(arrays, layout)

    shapes = {}
    unreadable = {}
    for name, (shape, dtype) in headers.items():
        kind = _kind(dtype)
        if not kind or name.startswith("noise_"):
            shapes[name] = shape
        else:
            unreadable[name] = kind
    matrices: dict[str, Any] = {}
    if layout is not None and variable is None:
        matrices = _sparse_matrices(path, layout, headers, load)
    shapes |= dict.fromkeys(matrices, (1, 1))

    def load_member(name: str) -> Any:
        if name in matrices:
            return matrices[name]
        return load(name)

    contents = FileContents(shapes=shapes, load=load_member, unreadable=unreadable)
    return assemble(contents, variable)


def _read_combined(
    path: Path, headers: Headers, load: Callable[[str], np.ndarray]
) -> CombinedRecord:
    """The record of several projectors."""

    def read_member(prefix: str) -> StoreRecord | CompressedRecord | None:
        own = {}
        for name, header in headers.items():
            if name.startswith(prefix):
                own[name.removeprefix(prefix)] = header
        if not own:
            return None
        return _read_record(path, own, lambda name: load(prefix + name))

    members = []
    for number in range(MAX_PROJECTORS):
        member = read_member(f"projector_{number}.")
        if isinstance(member, StoreRecord):
            members.append(member)
    settings = {name: load(name) for name in headers if "." not in name and name != "format"}
    for name in ("balance", "black"):
        if name not in settings:
            raise FileError(f"array {name!r} is missing")
    return CombinedRecord(members=tuple(members), scene=read_member("scene."), settings=settings)


def _kind(dtype: np.dtype) -> str:
    """The reason that an array of this type cannot be T; empty if it can."""
    if dtype.hasobject:
        return OBJECTS
    if dtype.kind in "fiubc":
        return ""
    return "text" if dtype.kind in "SU" else f"of type {dtype}"


def _sparse_matrices(
    path: Path, layout: str, headers: Headers, load: Callable[[str], np.ndarray]
) -> dict[str, scipy.sparse.csr_array]:
    """Sparse matrix in a layout of SciPy, or three channels."""
    if "shape" not in headers:
        raise FileError(f"array 'format' is {layout!r:.60}, which is unknown")
    shape = checks.grid("array 'shape'", load("shape").tolist())
    for name, (_, dtype) in headers.items():
        # SciPy would truncate other numbers.
        if name.startswith(INDEX_ARRAYS) and dtype.kind not in "iu":
            raise FileError(f"array {name!r} holds {dtype}; it must hold integers")
    entries = path.stat().st_size // ENTRY_BYTES
    if layout not in (RGB_FORMAT, GREY_FORMAT):
        return {"T": sparse_floats(lambda: scipy.sparse.load_npz(path), shape, entries)}

    matrices = {}
    names = CHANNELS if layout == RGB_FORMAT else ("T",)
    for number, channel in enumerate(names):
        csr = tuple(load(f"{name}_{number}") for name in CSR)

        def make(csr: Any = csr) -> scipy.sparse.csr_array:
            return scipy.sparse.csr_array(csr, shape=shape)

        matrices[channel] = sparse_floats(make, shape, entries)
    return matrices


def _headers(path: Path) -> Headers:
    """Shape and type of each array by name, after comparison with the sizes that are stored."""
    headers: Headers = {}
    file_size = path.stat().st_size
    with zipfile.ZipFile(path) as archive, path.open("rb") as file:
        _check_directory(archive, file)
        for info in archive.infolist():
            name = info.filename.removesuffix(".npy")
            with archive.open(info) as stream:
                # Opened all the same: a name in the directory may be damaged.
                if name == info.filename:
                    continue
                shape, dtype = _array_header(stream)
                stored = info.file_size - stream.tell()
            most = EXPANSION * min(info.compress_size, file_size)
            if not dtype.hasobject:
                check_declared(f"array {name!r}", dtype, shape, min(stored, most), stored)
            headers[name] = (shape, dtype)
    return headers


def _check_directory(archive: zipfile.ZipFile, file: IO[bytes]) -> None:
    """Refuse an archive with more in it than its directory lists, as a flipped bit leaves it."""
    end = 0
    for info in sorted(archive.infolist(), key=lambda info: info.header_offset):
        _check_gap(end, info.header_offset)
        file.seek(info.header_offset)
        lengths = LOCAL_LENGTHS.unpack(file.read(LOCAL_HEADER))
        end = info.header_offset + LOCAL_HEADER + sum(lengths) + info.compress_size
    _check_gap(end, archive.start_dir)


def _check_gap(end: int, start: int) -> None:
    if start - end > MAX_DATA_DESCRIPTOR:
        raise FileError(f"is damaged: bytes {end} to {start} are in no array that it lists")


def _array_header(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type at the beginning of NumPy's format."""
    is_version_1 = np.lib.format.read_magic(stream) == (1, 0)
    if is_version_1:
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
    return shape, dtype


def write_npz(path: Path, record: StoreRecord | CompressedRecord | CombinedRecord) -> None:
    """Write everything in `record`."""
    np.savez(path, **_arrays(record))


def _arrays(record: StoreRecord | CompressedRecord | CombinedRecord) -> dict[str, Any]:
    if isinstance(record, CombinedRecord):
        return _combined_arrays(record)
    if isinstance(record, CompressedRecord):
        return {"format": record.format, **record.arrays}
    if record.dense:
        return record.arrays()
    return record.arrays() | _sparse_arrays(record)


def _combined_arrays(record: CombinedRecord) -> dict[str, Any]:
    """Arrays of several projectors, each with the name of its part in front."""
    members: dict[str, Any] = {}
    for number, member in enumerate(record.members):
        members[f"projector_{number}."] = member
    if record.scene is not None:
        members["scene."] = record.scene
    arrays = {"format": COMBINED_FORMAT, **record.settings}
    for prefix, stored in members.items():
        own = _arrays(stored)
        if isinstance(stored, StoreRecord) and not stored.dense and len(stored.matrices) == 1:
            own = stored.arrays() | {"format": GREY_FORMAT, "shape": stored.shape}
            for name in CSR:
                own[f"{name}_0"] = getattr(stored.matrices[0], name)
        for name, value in own.items():
            arrays[prefix + name] = value
    return arrays


def _sparse_arrays(record: StoreRecord) -> dict[str, Any]:
    """Arrays of one sparse matrix as SciPy writes them, or of three channels."""
    is_grey = len(record.matrices) == 1
    layout = np.array(b"csr") if is_grey else RGB_FORMAT
    arrays: dict[str, Any] = {
        "format": layout,
        "_is_array": True,  # SciPy makes a csr_array of it
        "shape": record.shape,
    }
    for number, matrix in enumerate(record.matrices):
        ending = "" if is_grey else f"_{number}"
        for name in CSR:
            arrays[name + ending] = getattr(matrix, name)
    return arrays


def read_npy(path: Path) -> StoreRecord:
    """Read a dense matrix, or map it where memory has no room for two of it."""
    with path.open("rb") as file:
        shape, dtype = _array_header(file)
    kind = _kind(dtype)
    if kind:
        raise FileError(f"holds an array {shape} that is {kind}; it must be of real numbers")
    mapped = np.lib.format.open_memmap(path, "r")  # reads the header and allocates nothing
    has_room = 2 * mapped.nbytes <= checks.host_memory()

    def load(name: str) -> np.ndarray:
        if has_room:
            return np.array(mapped)
        return mapped

    return assemble(FileContents(shapes={"T": mapped.shape}, load=load))


def write_npy(path: Path, record: StoreRecord) -> None:
    """Write the dense matrices of `record`, (M, N) or (3, M, N)."""
    if not record.dense:
        raise InputError("T is sparse, and .npy holds dense arrays only; save it as .npz")
    array = np.ascontiguousarray(record.arrays()["T"])
    header = np.lib.format.header_data_from_array_1_0(array)
    # NumPy does not notice that a disk is full, but Python does.
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        file.write(array.data)
