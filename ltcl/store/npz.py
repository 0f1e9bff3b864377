# SPDX-License-Identifier: BSD-3-Clause
"""NumPy's .npy and .npz: dense, sparse and compressed transports, and inverses.

An .npz holds SciPy's `save_npz` layouts; or named arrays, `T` of (M, N) or (3, M, N) or the only one of such
a shape; a compressed transport, `format` = "ltcl-compressed-1"; an inverse, "ltcl-inverse-1"; or three sparse
channels: "ltcl-rgb-csr-1" with `shape`, and of one pattern `indptr`, `indices` and `data` (3, nnz), else
`indptr_0`, `indices_0`, `data_0` and so on to 2. `EXTRAS` may be there, too. It is written uncompressed:
light hardly shrinks.
"""

from __future__ import annotations

import functools
import math
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError, InputError
from ltcl.store import record
from ltcl.store.record import CHANNELS, CSR, EXTRAS, Parts, Record

COMPRESSED, INVERSE, RGB = "ltcl-compressed-1", "ltcl-inverse-1", "ltcl-rgb-csr-1"
_LAYOUTS = ("csr", "csc", "coo", "bsr", "dia", RGB, COMPRESSED)
_INDICES = ("indices", "indptr", "row", "col", "coords", "offsets")
_EXPANSION = {zipfile.ZIP_STORED: 1, zipfile.ZIP_DEFLATED: record.EXPANSION}
_Headers = dict[str, tuple[tuple[int, ...], np.dtype]]


def read(path: Path, variable: str | None = None) -> Record | Parts:
    """Read a transport, or an inverse, from an archive."""
    headers = _headers(path)
    with np.load(path, allow_pickle=False) as archive:

        def load(name: str) -> np.ndarray:
            if name not in headers:
                raise FileError(f"array {name!r} is missing; it holds {', '.join(map(repr, headers)):.200}")
            array = archive[name]
            if array.dtype.kind in "SU" and array.size == 1:
                return array.astype(str).reshape(())
            return np.asarray(checks.real(f"array {name!r}", array), array.dtype.newbyteorder("="))

        layout = str(load("format")) if "format" in headers else None
        if layout in (COMPRESSED, INVERSE):
            return Parts({name: load(name) for name in headers if name != "format"}, layout)
        matrices = _sparse(path, layout, headers, load) if layout and variable is None else []
        named = dict(zip(("T",) if len(matrices) == 1 else CHANNELS, matrices, strict=bool(matrices)))
        known = ("T", *EXTRAS)  # others are no matrix if they hold masks or texts
        shapes = {n: of for n, (of, dtype) in headers.items() if n in known or dtype.kind in "fiu"}
        if named:
            shapes = {n: of for n, of in shapes.items() if n in EXTRAS} | dict.fromkeys(named, (1, 1))
        return record.assemble(shapes, lambda n: named[n] if n in named else load(n), variable)


def _headers(path: Path) -> _Headers:
    """Shape and type of each array by name, after they were compared with the sizes that are stored."""
    headers, size = {}, path.stat().st_size
    with zipfile.ZipFile(path) as archive, path.open("rb") as file:
        file.seek(-22 - len(archive.comment), os.SEEK_END)  # of its last record
        if file.read(4) != b"PK\5\6":
            raise FileError("does not end with its directory: bytes were appended")
        for info in archive.infolist():
            what = f"array {(name := info.filename.removesuffix('.npy'))!r}"
            most = min(info.compress_size, size) * _EXPANSION.get(info.compress_type, 0)
            if info.file_size > most:
                stored = f"by compression method {info.compress_type} at most {checks.size(most)} are stored"
                raise FileError(f"{what} is declared with {checks.size(info.file_size)}; {stored}")
            with archive.open(info) as stream:
                version = "1_0" if np.lib.format.read_magic(stream) == (1, 0) else "2_0"
                shape, _, dtype = getattr(np.lib.format, f"read_array_header_{version}")(stream)
                if not dtype.hasobject:  # which nobody loads
                    rest = info.file_size - stream.tell()
                    record.declared(what, dtype, shape, rest, rest)
            headers[name] = (shape, dtype)
    return headers


def _sparse(path: Path, layout: str, headers: _Headers, load: Callable[[str], np.ndarray]) -> list[Any]:
    """The matrix of each channel as checked rows."""
    if layout not in _LAYOUTS:
        raise FileError(f"array 'format' is {layout!r:.60}; it must be one of {', '.join(_LAYOUTS)}")
    M, N = checks.grid("array 'shape'", load("shape").tolist())
    for name, (_, dtype) in headers.items():
        if name.startswith(_INDICES) and dtype.kind not in "iu":
            raise FileError(f"array {name!r} holds {dtype}; it must hold integers")
    entries = sum(math.prod(shape) for name, (shape, _) in headers.items() if name.startswith("data"))
    if layout != RGB:
        return [record.sparse(lambda: scipy.sparse.load_npz(path), (M, N), entries)]
    if "data" in headers:
        data, indices, indptr = map(load, CSR)
        arrays = [(channel, indices, indptr) for channel in data]
    else:
        arrays = [tuple(load(f"{name}_{k}") for name in CSR) for k in range(3)]
    makers = (functools.partial(scipy.sparse.csr_array, channel, shape=(M, N)) for channel in arrays)
    return [record.sparse(make, (M, N), entries) for make in makers]


def write(path: Path, content: Record | Parts) -> None:
    """Write everything in a record, or the parts of a compressed transport or of an inverse."""
    if isinstance(content, Parts):
        arrays: dict[str, Any] = {"format": content.format, **content.arrays}
    else:
        arrays, csr = content.arrays(), [{n: getattr(T, n, 0) for n in CSR} for T in content.matrices]
        shared = all(np.array_equal(csr[0][n], T[n]) for T in csr[1:] for n in CSR[1:])
        if len(csr) == 1 and not content.dense:  # as SciPy writes it: bytes, and a flag for csr_array
            arrays |= {"format": np.array(b"csr"), "_is_array": True, "shape": content.shape, **csr[0]}
        elif not content.dense:
            separate = {f"{name}_{k}": array for k, T in enumerate(csr) for name, array in T.items()}
            stacked = {**csr[0], "data": [T["data"] for T in csr]} if shared else separate
            arrays |= {"format": RGB, "shape": content.shape, **stacked}
    with path.open("wb") as file:
        np.savez(file, **arrays)


def read_npy(path: Path) -> Record:
    """Read the matrix of a .npy file, T of (M, N) or (3, M, N)."""
    mapped = np.lib.format.open_memmap(path, "r")  # reads the header and allocates nothing
    rest = path.stat().st_size - mapped.offset
    record.declared("the array", mapped.dtype, mapped.shape, rest, rest)
    return record.assemble({"T": mapped.shape}, lambda _: np.array(mapped))


def write_npy(path: Path, content: Record) -> None:
    """Write the matrix of a record, which must be dense."""
    if not content.dense:
        raise InputError("T is sparse, and .npy holds dense arrays only; save it as .npz")
    with path.open("wb") as file:
        np.save(file, content.arrays()["T"], allow_pickle=False)
