# SPDX-License-Identifier: BSD-3-Clause
"""Matrix Market text (.mtx), sparse or dense, real or integer. Values come back as float64.

A file holds one matrix, so three channels of T.mtx are T_r.mtx, T_g.mtx and T_b.mtx beside each other.

The grid stands in a comment, `%ltcl grid 3 x 4` or `%ltcl grid 3 x 4, camera grid 6 x 8`. The line of sizes
is checked against the file's length before memory is taken. SciPy writes the file but does not read it: its
parser (1.17) crashes the process where a file ends inside an exponent. NumPy's is slower, about 30 MB/s.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.io

from ltcl import checks
from ltcl.errors import FileError
from ltcl.store import sparse
from ltcl.store.record import Matrix, Record

KEEPS_FIRST_BOUNCE = False
_LONGEST_HEAD = 1 << 20
_GRID = re.compile(rb"%+\s*ltcl grid (\d{1,9}) x (\d{1,9})(?:, camera grid (\d{1,9}) x (\d{1,9}))?\s*")
_MIRROR = {b"general": 0, b"symmetric": 1, b"skew-symmetric": -1}  # T[j, i] = mirror * T[i, j], not stored


class _Head(NamedTuple):
    dense: bool
    mirror: int
    shape: tuple[int, int]
    entries: int
    grid: tuple[int, int] | None
    camera_grid: tuple[int, int] | None


def read(path: Path) -> Record:
    """Read a Matrix Market file; messages come without the file's name."""
    with path.open("rb") as file:
        head = _head(file)
        numbers = _numbers(file, head.entries * (1 if head.dense else 3), path.stat().st_size)
    T = _dense(numbers, head) if head.dense else _sparse(numbers.reshape(-1, 3), head)
    return Record((T,), head.grid, head.camera_grid)


def beside(path: Path) -> tuple[Path, ...]:
    """Where the three channels of a transport at `path` are.

    >>> [one.name for one in beside(Path("T.mtx"))]
    ['T_r.mtx', 'T_g.mtx', 'T_b.mtx']
    """
    return tuple(path.with_name(f"{path.stem}_{name}{path.suffix}") for name in "rgb")


def together(records: Sequence[Record]) -> Record:
    """Three channels as one transport; they must agree about their grids."""
    first = records[0]
    for name, told in (("shape", "shapes"), ("grid", "grids"), ("camera_grid", "camera grids")):
        values = [getattr(record, name) for record in records]
        if len(set(values)) > 1:
            raise FileError(f"has channels of the {told} {', '.join(map(str, values))}; all must be the same")
    if len({record.dense for record in records}) > 1:
        raise FileError("has dense and sparse channels; all must be one of them")
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


def _head(file: io.BufferedReader) -> _Head:
    """Banner, comments and the line of sizes; the file stands at its first value afterwards."""
    dense, mirror = _banner(file.readline(1024))
    grids: tuple[tuple[int, int] | None, tuple[int, int] | None] = (None, None)
    line = b"%"
    while not line.strip() or line.startswith(b"%"):
        found = _GRID.fullmatch(line)
        if found:
            h, w, *camera = (int(n) for n in found.groups() if n)
            grids = ((h, w), (camera[0], camera[1]) if camera else None)
        line = file.readline(_LONGEST_HEAD)
        if not line.endswith(b"\n") or file.tell() > _LONGEST_HEAD:
            raise FileError("has no line of sizes after its banner; it is truncated")
    sizes = line.split()
    wanted = "rows columns" if dense else "rows columns entries"
    if len(sizes) != len(wanted.split()) or not all(re.fullmatch(rb"\d{1,18}", n) for n in sizes):
        raise FileError(f"has the line of sizes {line.strip()!r:.60}; it must be '{wanted}'")
    rows, columns, *entries = (int(n) for n in sizes)
    if mirror and rows != columns:
        raise FileError(f"declares a symmetric matrix of ({rows}, {columns}); it must be square")
    count = entries[0] if entries else _dense_entries(rows, columns, mirror)
    sparse.check_shape((rows, columns), count)
    return _Head(dense, mirror, (rows, columns), count, *grids)


def _banner(line: bytes) -> tuple[bool, int]:
    words = line.split()
    if len(words) != 5 or words[:2] != [b"%%MatrixMarket", b"matrix"]:
        raise FileError(
            f"is no Matrix Market file: it begins with {line[:40]!r}, not '%%MatrixMarket matrix'"
        )
    layout, field, symmetry = (word.lower() for word in words[2:])
    wanted = (
        ("layout", layout, (b"coordinate", b"array")),
        ("field", field, (b"real", b"integer", b"unsigned-integer", b"double")),
        ("symmetry", symmetry, tuple(_MIRROR)),
    )
    for name, word, allowed in wanted:
        if word not in allowed:
            raise FileError(f"has the {name} {word!r:.40}; it must be {b' or '.join(allowed).decode()}")
    return layout == b"array", _MIRROR[symmetry]


def _dense_entries(rows: int, columns: int, mirror: int) -> int:
    # Of a symmetric array the lower triangle stands in the file; a skew one leaves out the diagonal, too.
    return rows * (columns + mirror) // 2 if mirror else rows * columns


def _numbers(file: io.BufferedReader, count: int, size: int) -> np.ndarray:
    """Read exactly `count` numbers up to the end of the file."""
    left = size - file.tell()
    if 2 * count > left:  # a digit and a space each
        raise FileError(
            f"declares {count} numbers, at least {2 * count} bytes, but {left} bytes follow; "
            "it is truncated, or its line of sizes lies"
        )
    checks.fits_host("the matrix", 3 * 8 * count)  # as read, split, and as a matrix
    try:
        numbers = np.fromfile(file, np.float64, count, sep=" ")
    except ValueError:
        raise FileError("holds something that is no number among its values") from None
    if len(numbers) < count:
        raise FileError(f"is truncated: {len(numbers)} of {count} numbers are there")
    while rest := file.read(1 << 20):
        if rest.strip():
            raise FileError(f"goes on with {rest.strip()[:20]!r} after the {count} numbers it declares")
    file.seek(-1, io.SEEK_END)
    if file.read(1) != b"\n":
        raise FileError("ends inside its last line; a whole file ends with a line end")
    return numbers


def _dense(numbers: np.ndarray, head: _Head) -> Matrix:
    """Values stand column by column."""
    rows, columns = head.shape
    if not head.mirror:
        return np.ascontiguousarray(numbers.reshape(columns, rows).T)
    checks.fits_host("the matrix", 8 * 3 * rows * columns)
    T = np.zeros(head.shape)
    upper = np.triu_indices(
        rows, k=0 if head.mirror > 0 else 1
    )  # row-major upper: column-major lower, mirrored
    T[upper] = head.mirror * numbers
    T.T[upper] = numbers
    return T


def _sparse(triplets: np.ndarray, head: _Head) -> Matrix:
    """Lines of row, column (from 1) and value."""
    places = []
    for name, column, most in zip(("row", "column"), triplets.T, head.shape, strict=False):
        wrong = ~((column >= 1) & (column <= most) & (column == np.floor(column)))
        if wrong.any():
            line = int(np.argmax(wrong))
            raise FileError(f"has the {name} {column[line]:g} in entry {line + 1}; it must be in 1..{most}")
        places.append(column.astype(np.int64) - 1)
    i, j, values = *places, triplets[:, 2]
    if head.mirror:
        off = i != j
        i, j = np.concatenate([i, j[off]]), np.concatenate([j, i[off]])
        values = np.concatenate([values, head.mirror * values[off]])
    return sparse.assemble("coo", {"data": values, "row": i, "col": j}, head.shape)
