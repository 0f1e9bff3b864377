# SPDX-License-Identifier: BSD-3-Clause
"""Files for other programs: Matrix Market (.mtx), HDF5 (.h5, .hdf5) and MATLAB's .mat.

A .mtx holds one matrix, real or integer, and the grid in a comment, `%ltcl grid 3 x 4` or `%ltcl
grid 3 x 4, camera grid 6 x 8`. HDF5 (h5py, the extra `hdf5`) holds `EXTRAS` and `T` (M, N) or (3,
M, N); or `T`, or `T_0` to `T_2`, as MATLAB's sparse groups: `data`, `ir` (rows), `jc` (starts of
columns), MATLAB_sparse (how many rows). A .mat holds `EXTRAS`, `first_bounce` as (N, channels), and
`LTM`, (M, N) or (M, N, 3) or sparse, or `LTM_r`, `LTM_g`, `LTM_b`, or any one matrix. Version 7.3
is HDF5 with axes in reverse order; version 5 a list of elements: type, bytes, values (MathWorks,
"MAT-File Format").

SciPy (1.17) reads .mtx five times faster than NumPy; but what follows a number may crash it, and
5,1 is 5: so each line is checked first. Damaged .mat crash it, too: NumPy reads version 5.
"""

from __future__ import annotations

import functools
import io
import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy.io
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError, InputError
from ltcl.store.record import (
    CHANNELS,
    EXPANSION,
    EXTRAS,
    Record,
    assemble,
    declared,
    floats,
    sparse,
)

_HEAD = rb"([^\n]*+\n(?:\s*+%[^\n]*+\n)*+\s*+[^\n]*+\n\s*+)"  # comments and the line of sizes
_GRID = re.compile(rb"^%+\s*ltcl grid (\d+) x (\d+)(?:, camera grid (\d+) x (\d+))?\s*$", re.M)
_NUMBER = {True: rb"-?\d++", False: rb"-?(?:\d++\.?+\d*+|\.\d++)(?:[eE][-+]?\d++)?+"}
_OF_MATLAB = (
    "LTM",
    ("LTM_r", "LTM_g", "LTM_b"),
    True,
)  # names of T and of its channels; axes are reversed
_TYPES = {
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
_MATRIX, _COMPRESSED, _SPARSE = (
    14,
    15,
    5,
)  # types of elements of version 5, and a class of variables


def read_mtx(path: Path) -> Record:
    """Read a Matrix Market file; its values come back as float64."""
    checks.fits_host(
        "the matrix", 8 * path.stat().st_size
    )  # an entry takes 6 bytes of text or more
    rows, columns, entries, layout, field, symmetry = scipy.io.mminfo(path)
    data, dense = path.read_bytes() + b"\n", layout == "array"
    place = b"" if dense else rb"\d++[ \t]++\d++[ \t]++"
    line = rb"[ \t]*+%b%b[ \t\r]*+\n" % (place, _NUMBER["integer" in field])
    text: Any = re.match(rb"%b((?:%b)*+)\s*+" % (_HEAD, line), data)
    if (end := text.end()) < len(data):
        wrong, number = data[end : end + 60].split(b"\n")[0], data.count(b"\n", 0, end) + 1
        raise FileError(
            f"line {number} is {wrong!r}; it must be {'' if dense else 'row, column, '}{field}"
        )
    count = (
        entries
        if not dense
        else rows * columns
        if symmetry == "general"
        else rows * (rows + 1) // 2
    )
    lines, square = data.count(b"\n", *text.span(2)), symmetry == "symmetric" and rows == columns
    if count != lines or min(rows, columns) < 1 or not (symmetry == "general" or square):
        raise FileError(
            f"declares {rows} x {columns}, {symmetry}, of {count} lines, but has {lines}"
        )
    sizes = [int(n) for n in (_GRID.findall(text[1]) or [()])[0] if n]
    grids: Any = (tuple(sizes[:2]) or None, tuple(sizes[2:]) or None)
    read: Any = functools.partial(scipy.io.mmread, io.BytesIO(data))
    return Record((floats("T", read()) if dense else sparse(read, (rows, columns), count),), *grids)


def write_mtx(path: Path, record: Record) -> None:
    """Write the matrix and the grids of `record`, of one channel."""
    if len(record.matrices) != 1:
        raise InputError("T has three channels, and a .mtx holds one matrix; save it as .npz")
    sizes = (("ltcl grid", record.grid), (", camera grid", record.camera_grid))
    comment = "".join(f"{name} {size[0]} x {size[1]}" for name, size in sizes if size)
    scipy.io.mmwrite(path, record.matrices[0], comment=comment, symmetry="general")


def write_mat(path: Path, record: Record) -> None:
    """Write LTM, and grids, first bounce and mixing where they are known, as version 5."""
    T: Any = record.matrices
    variables: Any = {
        n: np.array(a, float, ndmin=2) for n, a in record.arrays().items() if n in EXTRAS
    }
    if "first_bounce" in variables:
        variables["first_bounce"] = variables["first_bounce"].T
    stacked: Any = (np.dstack(T),) if record.dense and len(T) == 3 else T
    variables |= zip(_OF_MATLAB[:1] if len(stacked) == 1 else _OF_MATLAB[1], stacked, strict=True)
    if max(16 * T.nnz if hasattr(T, "nnz") else T.nbytes for T in stacked) >= 1 << 32:
        raise FileError("a variable of .mat has less than 4 GiB; save it as .h5")
    scipy.io.savemat(path, variables)


def read_mat(path: Path, variable: str | None = None) -> Record:
    """Read a .mat of version 7.3, or 5, whose strings, cells and structures are left out."""
    with path.open("rb") as file:
        head = file.read(520)
    if b"\x89HDF\r\n\x1a\n" in (head[:8], head[512:]):
        return read_hdf5(path, variable, *_OF_MATLAB)
    if not head.startswith(b"MATLAB 5.0 MAT-file") or head[126:128] != b"IM":
        raise FileError(
            "is neither version 5, little-endian, nor 7.3; save it again with -v7 or -v7.3"
        )
    members: dict[str, Any] = {}  # as HDF5 has them
    checks.fits_host("the file", 2 * path.stat().st_size)
    for kind, content in _elements(memoryview(path.read_bytes())[128:]):
        if kind == _COMPRESSED:
            inflate = zlib.decompressobj()
            kind, size = struct.unpack("<II", inflate.decompress(content, 8))
            checks.fits_host("a variable", 3 * size)
            content = memoryview(inflate.decompress(inflate.unconsumed_tail, size + 1))
            kind = kind if inflate.eof else -1
        (_, flags), (_, dims), (_, label), *elements = _elements(
            content if kind == _MATRIX else content[:0]
        )
        number_class = int.from_bytes(flags[:2], "little") & 0x8FF
        if number_class in range(5, 16):  # and not complex
            name, shape = str(label, "ascii"), np.frombuffer(dims, "<i4").tolist()
            arrays = [np.frombuffer(values, f"<{_TYPES[kind]}") for kind, values in elements]
            if number_class == _SPARSE:
                members[name] = SimpleNamespace(attrs={"MATLAB_sparse": shape[0]})
                members |= zip((f"{name}/ir", f"{name}/jc", f"{name}/data"), arrays, strict=True)
            else:
                (members[name],) = (array.reshape(shape[::-1]) for array in arrays)
    return _record(members, variable, *_OF_MATLAB)


def _elements(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Type and bytes of each element; those of at most 4 bytes stand inside the tag."""
    while data:
        kind, size = struct.unpack_from("<II", data)
        kind, size, start = (kind & 0xFFFF, kind >> 16, 4) if kind >> 16 else (kind, size, 8)
        end = start + size
        yield kind, data[start:end]
        data = data[end + (0 if kind == _COMPRESSED else -end % 8) :]


def read_hdf5(path: Path, variable: str | None = None, *names: Any) -> Record:
    """Read T, or T_0 to T_2."""
    members: dict[str, Any] = {}
    with _open(path, "r") as file:
        file.visititems(members.__setitem__)  # follows no links
        return _record(members, variable, *names)


def _record(members: dict[str, Any], variable: str | None, *names: Any) -> Record:
    """Of datasets, and of groups of one sparse matrix; `names` and reverse axes are those of `assemble`."""
    own = {name: data for name, data in members.items() if "/" not in name}
    shapes = {
        n: getattr(a, "shape", (1, 1) if f"{n}/data" in members else ()) or ()
        for n, a in own.items()
    }

    def load(name: str) -> Any:
        if not hasattr(members[name], "dtype"):  # a group of one sparse matrix
            data, ir, jc = (_numbers(members[f"{name}/{array}"]) for array in ("data", "ir", "jc"))
            size = checks.grid(
                f"shape of {name!r}", (members[name].attrs["MATLAB_sparse"], len(jc) - 1)
            )
            return sparse(
                lambda: scipy.sparse.csc_array((data, ir, jc), shape=size), size, data.size
            )
        array = _numbers(members[name])
        if names and name == "first_bounce":  # a row or a column of one channel
            return array.ravel() if 1 in array.shape else array
        return array.swapaxes(-1, -2) if names and array.ndim > 1 else array

    return assemble(shapes, load, variable, *names)


def write_hdf5(path: Path, record: Record) -> None:
    """Write everything in `record`."""
    T: Any = record.matrices
    with _open(path, "w") as file:
        file.update(record.arrays())
        for name, csr in zip(
            ("T",) if len(T) == 1 else CHANNELS, () if record.dense else T, strict=False
        ):
            csc, group = csr.tocsc(), file.create_group(name)
            group.attrs["MATLAB_sparse"] = csc.shape[0]
            group["data"], group["ir"], group["jc"] = csc.data, csc.indices, csc.indptr


def _open(path: Path, mode: str) -> Any:
    try:
        import h5py
    except ImportError:
        raise FileError(f"{path.suffix} files need h5py; pip install 'ltcl[hdf5]'") from None
    return h5py.File(path, mode)


def _numbers(data: Any) -> np.ndarray:
    """The numbers of a dataset, after its declared size was compared with what is stored."""
    if isinstance(data, np.ndarray):
        return data
    what = f"dataset {data.name.lstrip('/')!r}"
    if data.external or data.is_virtual:
        raise FileError(f"{what} is kept in other files; those are not opened")
    declared(what, data.dtype, data.shape or (), EXPANSION * data.id.get_storage_size())
    return checks.real(what, data[()])
