# SPDX-License-Identifier: BSD-3-Clause
"""Transports as .npz archives, dense or sparse.

What is read:

- SciPy's own `save_npz` layouts: `format` (csr, csc, coo, bsr, dia), `shape`, `data` and indices;
- named arrays: `T` of (M, N) or (3, M, N), or the only array of such a shape under another name;
- compressed transports: `format` = "ltcl-compressed-1"; see `ltcl.store.compressed`;
- three sparse channels: `format` = "ltcl-rgb-csr-1", `shape`; with one pattern for all, `indptr`, `indices`
  and `data` (3, nnz); else `indptr_0`, `indices_0`, `data_0` and so on to 2.

Each may have beside it `grid` (2,), `camera_grid` (2,), `first_bounce` (N,) or (3, N), and `mixing` (3, 3) of
the projector's colours where there are three channels. What is written is the first layout (csr, readable by
`scipy.sparse.load_npz`), the second or the third. Values are not compressed: measured light hardly shrinks,
and stored arrays move at the speed of the disk.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError
from ltcl.store import arrays, compressed, sparse
from ltcl.store.archive import Archive
from ltcl.store.compressed import Parts
from ltcl.store.npy import channels, check_shape, is_matrix_shape
from ltcl.store.record import Matrix, Record

KEEPS_FIRST_BOUNCE = True
RGB_LAYOUT = "ltcl-rgb-csr-1"
_SPARSE_PARTS = {"format", "indptr", "indices", "offsets"}
_EXTRAS = ("grid", "camera_grid", "first_bounce", "mixing")


def read(path: Path) -> Record | Parts:
    """Read a transport from an archive; messages come without the file's name."""
    with Archive(path) as archive:
        if compressed.is_layout(archive):
            return compressed.read(archive)
        if compressed.is_layout(archive, compressed.INVERSE):
            raise FileError(
                "is a precomputed inverse, no transport; load it with ltcl.load_inverse and give it as "
                "inverse= to compensate or separate"
            )
        matrices = _dense(archive) if _SPARSE_PARTS.isdisjoint(archive.names) else _sparse(archive)
        bounce, mixing = (
            arrays.as_floats(name, archive.numbers(name)) if name in archive.names else None
            for name in ("first_bounce", "mixing")
        )
        return Record(matrices, _grid(archive, "grid"), _grid(archive, "camera_grid"), bounce, mixing)


def write(path: Path, record: Record | Parts) -> None:
    """Write everything in `record`."""
    if isinstance(record, Parts):
        compressed.write(path, record)
        return
    csr = [T for T in record.matrices if isinstance(T, scipy.sparse.csr_array)]
    small = _sparse_members(csr, record.shape) if csr else {}
    for name in _EXTRAS:
        value = getattr(record, name)
        if value is not None:
            small[name] = np.asarray(value)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        if not csr:
            with archive.open("T.npy", "w", force_zip64=True) as member:
                arrays.write_stack(member, [T for T in record.matrices if isinstance(T, np.ndarray)])
        for name, array in small.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def _dense(archive: Archive) -> tuple[Matrix, ...]:
    name = "T" if "T" in archive.names else _only_candidate(archive)
    check_shape(archive.header(name), f"array {name!r}")
    return channels(arrays.as_floats(f"array {name!r}", archive.numbers(name)))


def _only_candidate(archive: Archive) -> str:
    """Name of the one array that can be a transport; the others need not even be readable."""
    shapes = {}
    for name in archive.names:
        try:
            header = archive.header(name)
        except FileError:
            continue
        if header.dtype.kind in "fiu" and name not in _EXTRAS:  # not a mask of bool
            shapes[name] = header.shape
    found = [name for name, shape in shapes.items() if is_matrix_shape(shape)]
    if len(found) != 1:
        held = ", ".join(f"{name!r} {shape}" for name, shape in shapes.items()) or "no array of numbers"
        raise FileError(
            f"the archive holds {held:.300}; it must hold T of (M, N) or (3, M, N), or one such array"
        )
    return found[0]


def _sparse(archive: Archive) -> tuple[Matrix, ...]:
    layout = archive.text("format")
    if layout not in (*sparse.LAYOUTS, RGB_LAYOUT):
        known = ", ".join([*sparse.LAYOUTS, RGB_LAYOUT, compressed.LAYOUT])
        raise FileError(f"the layout of the archive is {layout!a:.60}; it must be one of {known}")
    shape = _shape(archive)
    if layout == RGB_LAYOUT:
        return _rgb(archive, shape)
    names = sparse.LAYOUTS[layout]
    if layout == "coo" and "coords" in archive.names:
        names = ("data", "coords")
    return (sparse.assemble(layout, {name: archive.numbers(name) for name in names}, shape),)


def _rgb(archive: Archive, shape: sparse.Shape) -> tuple[Matrix, ...]:
    if "data" not in archive.names:
        every = [{name: archive.numbers(f"{name}_{k}") for name in sparse.LAYOUTS["csr"]} for k in range(3)]
        return tuple(sparse.assemble("csr", parts, shape) for parts in every)
    data, indices, indptr = (archive.numbers(name) for name in sparse.LAYOUTS["csr"])
    if data.ndim != 2 or len(data) != 3:
        raise FileError(f"data has shape {data.shape}; it must be (3, entries)")
    parts = {"indices": indices, "indptr": indptr}
    return tuple(sparse.assemble("csr", {**parts, "data": channel}, shape) for channel in data)


def _shape(archive: Archive) -> sparse.Shape:
    shape = archive.numbers("shape")
    if shape.shape != (2,) or shape.dtype.kind not in "iu":
        raise FileError(f"array 'shape' is {archive.header('shape')}; it must be two integers (M, N)")
    return int(shape[0]), int(shape[1])


def _grid(archive: Archive, name: str) -> tuple[int, int] | None:
    if name not in archive.names:
        return None
    if archive.header(name).shape != (2,):
        raise FileError(f"array {name!r} has shape {archive.header(name).shape}; it must be (h, w)")
    return checks.grid(f"array {name!r}", archive.numbers(name).tolist())


def _sparse_members(csr: list[scipy.sparse.csr_array], shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    first = csr[0]
    members: dict[str, np.ndarray] = {"shape": np.array(shape, np.int64)}
    if len(csr) == 1:
        # Bytes, and a flag for csr_array instead of csr_matrix: as SciPy writes it.
        members |= {"format": np.array(b"csr"), "_is_array": np.array(True), **_parts(first)}
    elif all(_same_pattern(first, T) for T in csr[1:]):
        members |= {"format": np.array(RGB_LAYOUT), **_parts(first), "data": np.stack([T.data for T in csr])}
    else:
        members["format"] = np.array(RGB_LAYOUT)
        for k, T in enumerate(csr):
            members |= {f"{name}_{k}": array for name, array in _parts(T).items()}
    return members


def _parts(T: scipy.sparse.csr_array) -> Mapping[str, np.ndarray]:
    return {"data": T.data, "indices": T.indices, "indptr": T.indptr}


def _same_pattern(a: scipy.sparse.csr_array, b: scipy.sparse.csr_array) -> bool:
    return np.array_equal(a.indptr, b.indptr) and np.array_equal(a.indices, b.indices)
