# SPDX-License-Identifier: BSD-3-Clause
"""Matrix Market text (.mtx): one channel, sparse or dense, real or integer. Values come back as float64.

The grid stands in a comment, `%ltcl grid 3 x 4` or `%ltcl grid 3 x 4, camera grid 6 x 8`. SciPy parses the
entries, but allocates what the line of sizes declares; that line is checked against the file's length first.
"""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.io
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError, InputError
from ltcl.store.record import Record
from ltcl.store.sparse import check_shape

KEEPS_FIRST_BOUNCE = False
_LONGEST_HEAD = 1 << 20
_GRID = re.compile(rb"%+\s*ltcl grid (\d{1,9}) x (\d{1,9})(?:, camera grid (\d{1,9}) x (\d{1,9}))?\s*")


class _Head(NamedTuple):
    dense: bool
    symmetric: bool
    shape: tuple[int, int]
    entries: int  # lines of values to come
    end: int  # first byte after the line of sizes
    grid: tuple[int, int] | None
    camera_grid: tuple[int, int] | None


def read(path: Path) -> Record:
    """Read a Matrix Market file; messages come without the file's name."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = _head(file)
    shortest = len("0\n") if head.dense else len("1 1 0\n")
    if head.entries * shortest > size - head.end + 1:  # the last line may lack its end
        raise FileError(
            f"declares {head.entries} entries, at least {head.entries * shortest} bytes, but "
            f"{size - head.end} bytes follow; it is truncated, or its line of sizes lies"
        )
    # Values and two indices, once more with their mirror images, once more as rows.
    checks.fits_host("the matrix", head.entries * (8 if head.dense else 48) * (2 if head.symmetric else 1))
    try:
        T = scipy.io.mmread(path)
    except (ValueError, OverflowError, TypeError) as error:
        raise FileError(f"is damaged: {' '.join(str(error).split())!a:.150}") from None
    if isinstance(T, np.ndarray):
        return Record((T.astype(np.float64, copy=False),), head.grid, head.camera_grid)
    return Record((scipy.sparse.csr_array(T, dtype=np.float64),), head.grid, head.camera_grid)


def write(path: Path, record: Record) -> None:
    """Write the matrix and the grids of `record`, which must have one channel."""
    if len(record.matrices) != 1:
        raise InputError("T has three channels, and .mtx holds one; save it as .npz (or .npy if dense)")
    comment = ""
    if record.grid:
        comment = "ltcl grid {} x {}".format(*record.grid)
    if record.grid and record.camera_grid:
        comment += ", camera grid {} x {}".format(*record.camera_grid)
    with path.open("wb") as file:  # by name, SciPy would append .mtx to .MTX
        scipy.io.mmwrite(file, record.matrices[0], comment=comment, symmetry="general")


def _head(file: io.BufferedReader) -> _Head:
    dense, symmetric = _banner(file.readline(1024))
    grids: tuple[tuple[int, int] | None, ...] = (None, None)
    line = b"%"
    while not line.strip() or line.startswith(b"%"):
        found = _GRID.fullmatch(line)
        if found:
            h, w, *camera = (int(n) for n in found.groups() if n)
            grids = ((h, w), (camera[0], camera[1]) if camera else None)
        line = file.readline(_LONGEST_HEAD)
        if not line or file.tell() > _LONGEST_HEAD:
            raise FileError("has no line of sizes after its banner; it is truncated")
    sizes = line.split()
    wanted = "rows columns" if dense else "rows columns entries"
    if len(sizes) != len(wanted.split()) or not all(re.fullmatch(rb"\d{1,18}", n) for n in sizes):
        raise FileError(f"has the line of sizes {line.strip()!r:.60}; it must be '{wanted}'")
    rows, columns, *entries = (int(n) for n in sizes)
    count = entries[0] if entries else _dense_entries(rows, columns, symmetric)
    check_shape((rows, columns), count)
    return _Head(dense, symmetric, (rows, columns), count, file.tell(), *grids)


def _banner(line: bytes) -> tuple[bool, bool]:
    words = line.split()
    if len(words) != 5 or words[:2] != [b"%%MatrixMarket", b"matrix"]:
        raise FileError(
            f"is no Matrix Market file: it begins with {line[:40]!r}, not '%%MatrixMarket matrix'"
        )
    layout, field, symmetry = (word.lower() for word in words[2:])
    wanted = (
        ("layout", layout, (b"coordinate", b"array")),
        ("field", field, (b"real", b"integer", b"unsigned-integer", b"double")),
        ("symmetry", symmetry, (b"general", b"symmetric", b"skew-symmetric")),
    )
    for name, word, allowed in wanted:
        if word not in allowed:
            raise FileError(f"has the {name} {word!r:.40}; it must be {b' or '.join(allowed).decode()}")
    return layout == b"array", symmetry != b"general"


def _dense_entries(rows: int, columns: int, symmetric: bool) -> int:
    # Of a symmetric array the lower triangle stands in the file (a skew one leaves out the diagonal).
    return rows * (columns - 1) // 2 if symmetric else rows * columns
