# SPDX-License-Identifier: BSD-3-Clause
"""Matrix Market text (.mtx), sparse or dense, real or integer. Values come back as float64.

A file holds one matrix, so three channels of T.mtx are T_r.mtx, T_g.mtx and T_b.mtx in the same folder. The
grid stands in a comment, `%ltcl grid 3 x 4` or `%ltcl grid 3 x 4, camera grid 6 x 8`. SciPy writes the file
and reads its header; NumPy reads the values: SciPy's parser (1.17) crashes the process where one is damaged.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy.io
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError
from ltcl.store import headers
from ltcl.store.record import Matrix, Record

_LONGEST_HEAD = 1 << 20
_GRID = re.compile(rb"%+\s*ltcl grid (\d{1,9}) x (\d{1,9})(?:, camera grid (\d{1,9}) x (\d{1,9}))?\s*")
_FIELDS = ("real", "double", "integer", "unsigned-integer")
_MIRROR = {"general": 0, "symmetric": 1, "skew-symmetric": -1}  # T[j, i] = mirror * T[i, j], not stored


def read(path: Path) -> Record:
    """Read a Matrix Market file; messages come without the file's name."""
    with path.open("rb") as file:
        head, grids = _head(file)
        with headers.library("the header"):
            rows, columns, entries, layout, field, symmetry = scipy.io.mminfo(io.BytesIO(head))
        if field not in _FIELDS or symmetry not in _MIRROR:
            allowed = f"{' or '.join(_FIELDS)}, {' or '.join(_MIRROR)}"
            raise FileError(f"holds {field} {symmetry} values; they must be {allowed}")
        dense, mirror = layout == "array", _MIRROR[symmetry]
        if mirror and rows != columns:
            raise FileError(f"declares a symmetric matrix of ({rows}, {columns}); it must be square")
        if dense:  # of a symmetric one the lower triangle is stored, of a skew one without the diagonal
            entries = rows * (columns + mirror) // 2 if mirror else rows * columns
        headers.sparse_shape((rows, columns), entries)
        numbers = _numbers(file, entries if dense else 3 * entries, path.stat().st_size)
    T = _dense(numbers, rows, columns, mirror) if dense else _sparse(numbers, (rows, columns), mirror)
    return Record((T,), *grids)


def channel_files(path: Path) -> tuple[Path, ...]:
    """Where the three channels of a transport at `path` are.

    >>> [file.name for file in channel_files(Path("T.mtx"))]
    ['T_r.mtx', 'T_g.mtx', 'T_b.mtx']
    """
    return tuple(path.with_name(f"{path.stem}_{name}{path.suffix}") for name in "rgb")


def merge(records: Sequence[Record]) -> Record:
    """Three channels as one transport; they must agree about their grids."""
    first = records[0]
    for name in ("shape", "grid", "camera_grid", "dense"):
        values = [getattr(record, name) for record in records]
        if len(set(values)) > 1:
            raise FileError(f"has channels with {name} {', '.join(map(str, values))}; all must be the same")
    return Record(tuple(record.matrices[0] for record in records), first.grid, first.camera_grid)


def write(path: Path, record: Record) -> None:
    """Write the matrix and the grids of `record`, of one channel."""
    comment = ""
    if record.grid:
        comment = "ltcl grid {} x {}".format(*record.grid)
    if record.grid and record.camera_grid:
        comment += ", camera grid {} x {}".format(*record.camera_grid)
    with path.open("wb") as file:  # by name, SciPy would append .mtx to .MTX
        scipy.io.mmwrite(file, record.matrices[0], comment=comment, symmetry="general")


def _head(file: io.BufferedReader) -> tuple[bytes, tuple[tuple[int, int] | None, tuple[int, int] | None]]:
    """Banner and line of sizes without the comments, and the grids; the file stands at its first value."""
    banner, line = file.readline(1024), b"%"
    if not banner.startswith(b"%%MatrixMarket matrix"):
        raise FileError(
            f"is no Matrix Market file: it begins with {banner[:40]!r}, not '%%MatrixMarket matrix'"
        )
    grid = camera_grid = None
    while not line.strip() or line.startswith(b"%"):
        if comment := _GRID.fullmatch(line):
            h, w, *camera = (int(n) for n in comment.groups() if n)
            grid, camera_grid = (h, w), (camera[0], camera[1]) if camera else None
        line = file.readline(_LONGEST_HEAD)
        if not line or file.tell() > _LONGEST_HEAD:
            raise FileError("has no line of sizes after its banner; it is truncated")
    if not all(re.fullmatch(rb"\d{1,18}", size) for size in line.split()):
        raise FileError(f"has the line of sizes {line.strip()!r:.60}; it must be 'rows columns entries'")
    return banner + line, (grid, camera_grid)


def _numbers(file: io.BufferedReader, count: int, size: int) -> np.ndarray:
    """Read exactly `count` numbers up to the end of the file."""
    rest = size - file.tell()
    if 2 * count - 1 > rest:  # a digit and a space each
        raise FileError(
            f"declares {count} numbers, at least {2 * count - 1} bytes, but {rest} bytes follow; "
            "it is truncated, or its line of sizes lies"
        )
    checks.fits_host("the matrix", 3 * 8 * count)  # as read, split, and as a matrix
    with headers.library("one of its values"):
        numbers = np.fromfile(file, np.float64, count, sep=" ")
    if len(numbers) < count:
        raise FileError(f"is truncated: {len(numbers)} of {count} numbers are there")
    while more := file.read(1 << 20):
        if more.strip():
            raise FileError(f"goes on with {more.strip()[:20]!r} after the {count} numbers it declares")
    file.seek(max(size - 64, 0))
    with headers.library("the last value"):  # of which fromfile takes what it can: 1.5 of 1.5E
        float((file.read().split() or [b""])[-1] if count else 0)
    return numbers


def _dense(numbers: np.ndarray, rows: int, columns: int, mirror: int) -> Matrix:
    """Values stand column by column."""
    if not mirror:
        return np.ascontiguousarray(numbers.reshape(columns, rows).T)
    checks.fits_host("the matrix", 8 * 3 * rows * columns)
    T = np.zeros((rows, columns))
    upper = np.triu_indices(rows, k=0 if mirror > 0 else 1)  # row-major upper: column-major lower, mirrored
    T[upper] = mirror * numbers
    T.T[upper] = numbers
    return T


def _sparse(numbers: np.ndarray, shape: tuple[int, int], mirror: int) -> Matrix:
    """Lines of row, column (from 1) and value."""
    places, values = numbers.reshape(-1, 3)[:, :2], numbers[2::3]
    wrong = ~((places >= 1) & (places <= shape) & (places == np.floor(places))).all(axis=1)
    if wrong.any():
        line = int(np.argmax(wrong))
        raise FileError(
            f"has row {places[line, 0]:g} and column {places[line, 1]:g} in entry {line + 1}; they must be "
            f"whole numbers in 1..{shape[0]} and 1..{shape[1]}"
        )
    i, j = places.T.astype(np.int64) - 1
    if mirror:
        off = i != j
        i, j = np.concatenate([i, j[off]]), np.concatenate([j, i[off]])
        values = np.concatenate([values, mirror * values[off]])
    return headers.sparse(scipy.sparse.coo_array((values, (i, j)), shape=shape))
