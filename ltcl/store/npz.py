# SPDX-License-Identifier: BSD-3-Clause
"""Transports as NumPy's .npy and .npz, dense, sparse or compressed; and any arrays in a checked .npz.

What is read of .npz: SciPy's `save_npz` layouts; named arrays, `T` of (M, N) or (3, M, N) or the only one of
such a shape; compressed transports, `format` = "ltcl-compressed-1", and inverses, "ltcl-inverse-1"; three
sparse channels: `format` = "ltcl-rgb-csr-1", `shape`, and with one pattern for all `indptr`, `indices` and
`data` (3, nnz), else `indptr_0`, `indices_0`, `data_0` and so on to 2. With it there may be `grid` (2,),
`camera_grid` (2,), `first_bounce` (N,) or (3, N), and `mixing` (3, 3). Values are written uncompressed: light
hardly shrinks.
"""

from __future__ import annotations

import contextlib
import math
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError, InputError
from ltcl.store import headers
from ltcl.store.record import EXTRAS, Parts, Record, choose, from_arrays

COMPRESSED, INVERSE, RGB = "ltcl-compressed-1", "ltcl-inverse-1", "ltcl-rgb-csr-1"
_LAYOUTS = ("csr", "csc", "coo", "bsr", "dia")
_CSR = ("data", "indices", "indptr")
_INDICES = ("indices", "indptr", "row", "col", "coords", "offsets")
_MOST_MEMBERS = 10_000


class Archive:
    """The arrays of an .npz file by name. Opening compares every header with the sizes that are stored.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "a.npz"
    >>> write_arrays(path, {"T": np.eye(2)})
    >>> with Archive(path) as archive:
    ...     print(archive.headers, archive.numbers("T").tolist())
    {'T': ((2, 2), dtype('float64'))} [[1.0, 0.0], [0.0, 1.0]]
    """

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            start = file.read(4)
        if start[:2] != b"PK":  # of every zip file, an empty or damaged one included
            raise FileError(f"is no .npz archive: it begins with {start!r}, not {b'PK'!r}")
        self.path, self.headers = path, {}
        with contextlib.ExitStack() as stack, headers.library("the archive"):
            self._zip = stack.enter_context(zipfile.ZipFile(path))
            _refuse_appended(path, self._zip.comment)
            members = [info for info in self._zip.infolist() if info.filename.endswith(".npy")]
            if len(members) > _MOST_MEMBERS or len({info.filename for info in members}) < len(members):
                raise FileError(f"the archive holds {len(members)} arrays, too many or some of one name")
            self.headers = {i.filename.removesuffix(".npy"): self._header(i) for i in members}
            stack.pop_all()

    def _header(self, info: zipfile.ZipInfo) -> tuple[tuple[int, ...], np.dtype]:
        what, size = f"array {info.filename.removesuffix('.npy')!r}", self.path.stat().st_size
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise FileError(
                f"{what} is compressed by method {info.compress_type}; it must be deflate or none"
            )
        expansion = 1 if info.compress_type == zipfile.ZIP_STORED else headers.EXPANSION
        if info.compress_size > size or info.file_size > expansion * info.compress_size:
            raise FileError(
                f"{what} is declared with {checks.size(info.file_size)}, but its "
                f"{checks.size(info.compress_size)} in an archive of {size} bytes expand to less"
            )
        with headers.library(what), self._zip.open(info) as stream:
            if np.lib.format.read_magic(stream) == (1, 0):
                shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
            else:
                shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
            if not dtype.hasobject:  # which nobody loads
                rest = info.file_size - stream.tell()
                headers.declared(what, dtype, shape, rest, rest)
        return shape, dtype

    def numbers(self, name: str) -> np.ndarray:
        """Values of an array of real numbers in native byte order; its checksum is compared."""
        shape, dtype = self._header_of(name)
        headers.real(f"array {name!r}", dtype)
        checks.fits_host(f"array {name!r} {shape}", math.prod(shape) * dtype.itemsize)
        return np.asarray(self._read(name), dtype.newbyteorder("="))

    def text(self, name: str) -> str:
        """Value of a single string (or bytes) array, as SciPy keeps the name of a format."""
        shape, dtype = self._header_of(name)
        if dtype.kind not in "SU" or shape not in ((), (1,)):
            raise FileError(f"array {name!r} is {dtype} {shape}; it must be one string")
        value = self._read(name).reshape(()).item()
        return value.decode("latin-1") if isinstance(value, bytes) else value

    def arrays(self) -> dict[str, np.ndarray]:
        """All of them, texts as arrays of one string."""
        texts = {name for name, (_, dtype) in self.headers.items() if dtype.kind in "SU"}
        return {n: np.array(self.text(n)) if n in texts else self.numbers(n) for n in self.headers}

    def parts(self) -> Parts:
        """Those of a compressed transport, or of an inverse."""
        return Parts({name: array for name, array in self.arrays().items() if name != "format"})

    def layout(self) -> str | None:
        """What the archive says that it is; None where it does not."""
        shape, dtype = self.headers.get("format", ((0,), np.dtype(int)))
        return self.text("format") if dtype.kind in "SU" and shape in ((), (1,)) else None

    def _header_of(self, name: str) -> tuple[tuple[int, ...], np.dtype]:
        if name not in self.headers:
            names = ", ".join(map(repr, self.headers))
            raise FileError(f"array {name!r} is missing; the archive holds {names}"[:300])
        return self.headers[name]

    def _read(self, name: str) -> np.ndarray:
        with headers.library(f"array {name!r}"), self._zip.open(f"{name}.npy") as stream:
            return np.lib.format.read_array(stream, allow_pickle=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._zip.close()


def write_arrays(path: Path, arrays: Mapping[str, Any], comment: bytes = b"") -> None:
    """Write arrays uncompressed, each with its checksum; equal arrays make equal files."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        archive.comment = comment
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)


def read(path: Path, variable: str | None = None) -> Record | Parts:
    """Read a transport from an archive; messages come without the file's name."""
    with Archive(path) as archive:
        layout = archive.layout()
        if layout == COMPRESSED:
            return archive.parts()
        if layout == INVERSE:
            raise FileError(
                "is a precomputed inverse, no transport; load it with ltcl.load_inverse and give it as "
                "inverse= to compensate or separate"
            )
        if variable is None and not {"format", "indptr", "indices", "offsets"}.isdisjoint(archive.headers):
            matrices = _sparse(archive)
        else:  # a mask is no matrix
            shapes = {n: of for n, (of, dtype) in archive.headers.items() if n == "T" or dtype.kind in "fiu"}
            matrices = [archive.numbers(name) for name in choose(shapes, variable, "T")]
        return from_arrays(matrices, {n: archive.numbers(n) for n in EXTRAS if n in archive.headers})


def write(path: Path, content: Record | Parts) -> None:
    """Write everything in a record, or the parts of a compressed transport."""
    if isinstance(content, Parts):
        write_arrays(path, {"format": COMPRESSED, **content.arrays})
        return
    arrays: dict[str, Any] = {}
    csr = [T for T in content.matrices if isinstance(T, scipy.sparse.csr_array)]
    if not csr:
        arrays["T"] = _stacked(content)
    elif len(csr) == 1:  # as SciPy writes it: bytes, and a flag for csr_array in place of csr_matrix
        arrays = {"format": np.array(b"csr"), "_is_array": True, **{n: getattr(csr[0], n) for n in _CSR}}
    elif all(np.array_equal(getattr(csr[0], n), getattr(T, n)) for T in csr[1:] for n in _CSR[1:]):
        arrays = {"format": RGB, **{n: getattr(csr[0], n) for n in _CSR}}
        arrays["data"] = np.stack([T.data for T in csr])
    else:
        arrays["format"] = RGB
        arrays |= {f"{name}_{k}": getattr(T, name) for k, T in enumerate(csr) for name in _CSR}
    if csr:
        arrays["shape"] = np.array(content.shape, np.int64)
    arrays |= {n: getattr(content, n) for n in EXTRAS if getattr(content, n) is not None}
    write_arrays(path, arrays)


def read_npy(path: Path) -> Record:
    """Read the matrix of a .npy file, T of (M, N) or (3, M, N)."""
    with headers.library("the array"):
        mapped = np.lib.format.open_memmap(path, "r")  # reads the header and allocates nothing
        headers.real("the array", mapped.dtype)
        rest = path.stat().st_size - mapped.offset
        headers.declared("the array", mapped.dtype, mapped.shape, rest, rest)
        checks.fits_host(f"the array, {mapped.dtype} {mapped.shape},", 2 * mapped.nbytes)
        return from_arrays([np.array(mapped)], {})


def write_npy(path: Path, record: Record) -> None:
    """Write the matrix of `record`, which must be dense."""
    if not record.dense:
        raise InputError("T is sparse, and .npy holds dense arrays only; save it as .npz")
    with path.open("wb") as file:
        np.save(file, _stacked(record), allow_pickle=False)


def _stacked(record: Record) -> np.ndarray:
    """(M, N), or (3, M, N)."""
    T: Any = record.matrices
    return T[0] if len(T) == 1 else np.stack(T)


def _sparse(archive: Archive) -> list[scipy.sparse.csr_array]:
    layout = archive.text("format")
    if layout not in (*_LAYOUTS, RGB):
        known = ", ".join([*_LAYOUTS, RGB, COMPRESSED])
        raise FileError(f"the layout of the archive is {layout!a:.60}; it must be one of {known}")
    shape = archive.numbers("shape")
    if shape.shape != (2,) or shape.dtype.kind not in "iu":
        raise FileError(f"array 'shape' is {shape.dtype} {shape.shape}; it must be two integers (M, N)")
    M, N = shape.tolist()
    for name, (of, dtype) in archive.headers.items():
        if name.startswith("data"):
            headers.real(f"array {name!r}", dtype)
            headers.sparse_shape((M, N), math.prod(of))
        elif name.startswith(_INDICES) and dtype.kind not in "iu":
            raise FileError(f"array {name!r} holds {dtype}; it must hold integers")
    checks.fits_host(
        "the matrix", 2 * sum(math.prod(of) * dtype.itemsize for of, dtype in archive.headers.values())
    )
    if layout != RGB:
        with headers.library("the matrix"):
            return [headers.sparse(scipy.sparse.load_npz(archive.path))]
    if "data" in archive.headers:
        data, indices, indptr = (archive.numbers(name) for name in _CSR)
        if data.ndim != 2 or len(data) != 3:
            raise FileError(f"array 'data' has shape {data.shape}; it must be (3, entries)")
        parts = [(channel, indices, indptr) for channel in data]
    else:
        parts = [tuple(archive.numbers(f"{name}_{k}") for name in _CSR) for k in range(3)]
    with headers.library("the matrix"):
        return [headers.sparse(scipy.sparse.csr_array(part, shape=(M, N))) for part in parts]


def _refuse_appended(path: Path, comment: bytes) -> None:
    """Refuse bytes behind the end record of the archive, which readers of zip skip."""
    size = 22 + len(comment)
    with path.open("rb") as file:
        file.seek(-size, os.SEEK_END)
        end = file.read(size)
    if not end.startswith(b"PK\x05\x06") or int.from_bytes(end[20:22], "little") != len(comment):
        raise FileError("the archive does not end where it says: bytes were appended, or it is damaged")
