# SPDX-License-Identifier: BSD-3-Clause
"""Matrix Market files (.mtx): one matrix, real or integer, and the grid in a comment.

The comment is `%ltcl grid 3 x 4` or `%ltcl grid 3 x 4, camera grid 6 x 8`.

SciPy (1.17) reads .mtx five times faster than NumPy; but what follows a number may crash it, and it
reads 5,1 as 5. So each line is checked first.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import scipy  # its subpackage io is loaded at the first use

from ltcl import checks
from ltcl.errors import FileError, InputError
from ltcl.store.guards import floats, sparse_floats
from ltcl.store.record import StoreRecord

# What the words of the first line may be, behind %%MatrixMarket.
KINDS = {
    "object": ("matrix",),
    "format": ("coordinate", "array"),
    "field": ("real", "double", "integer", "unsigned-integer"),
    "symmetry": ("general", "symmetric"),
}
# The first line, comments, and the line of sizes. No group here or below is repeated possessively:
# Python before 3.11.5 goes on at a wrong place where the last repetition fails half-way.
HEAD = re.compile(rb"[^\n]*+\n(?:\s*+%[^\n]*+\n)*\s*+[^\n]*+\n\s*+")
# A group that is repeated keeps a place for each repetition.
LINES_AT_ONCE = 1000
GRID = re.compile(rb"^%+\s*ltcl grid (\d+) x (\d+)(?:, camera grid (\d+) x (\d+))?\s*$", re.M)
INTEGER = rb"-?\d++"
REAL = rb"-?(?:\d++\.?+\d*+|\.\d++)(?:[eE][-+]?\d++)?"
PLACE = rb"\d++[ \t]++\d++[ \t]++"


@dataclass(frozen=True, kw_only=True)
class Header:
    """Sizes that the first lines declare."""

    rows: int
    columns: int
    entries: int
    is_dense: bool
    field: str
    symmetry: str

    @property
    def lines(self) -> int:
        """Number of lines with a value."""
        if not self.is_dense:
            return self.entries
        if self.symmetry == "general":
            return self.rows * self.columns
        return self.rows * (self.rows + 1) // 2

    @property
    def is_possible(self) -> bool:
        """True if the sizes are those of a matrix."""
        if min(self.rows, self.columns) < 1:
            return False
        if self.symmetry == "general":
            return True
        return self.symmetry == "symmetric" and self.rows == self.columns

    @property
    def line(self) -> bytes:
        """Pattern of a line with a value."""
        place = b"" if self.is_dense else PLACE
        number = INTEGER if "integer" in self.field else REAL
        return rb"[ \t]*+%b%b[ \t\r]*+\n" % (place, number)


def read_mtx(path: Path) -> StoreRecord:
    """Read a Matrix Market file; its values come back as float64."""
    with path.open("rb") as file:
        _check_kinds(file.readline(1000))
    # An entry takes 6 bytes of text or more.
    checks.fits_host("the matrix", 8 * path.stat().st_size)
    data = path.read_bytes() + b"\n"
    rows, columns, entries, layout, field, symmetry = scipy.io.mminfo(io.BytesIO(data))
    header = Header(
        rows=rows,
        columns=columns,
        entries=entries,
        is_dense=layout == "array",
        field=field,
        symmetry=symmetry,
    )
    head = _check_lines(header, data)

    def read() -> Any:
        return scipy.io.mmread(io.BytesIO(data))

    if header.is_dense:
        matrix = floats("T", read())
    else:
        matrix = sparse_floats(read, (rows, columns), header.lines)
    grid, camera_grid = _grids(head)
    return StoreRecord((matrix,), grid, camera_grid)


def _check_kinds(line: bytes) -> None:
    """Refuse a first line with other words than those of real matrices."""
    words = line.decode("ascii", "replace").lower().split()
    if len(words) != 1 + len(KINDS) or words[0].lstrip("%") != "matrixmarket":
        raise FileError(
            f"the first line is {line[:60]!r}; it must be %%MatrixMarket and {', '.join(KINDS)}"
        )
    for (name, allowed), word in zip(KINDS.items(), words[1:], strict=True):
        if word not in allowed:
            raise FileError(f"the {name} is {word:.40}; it must be {' or '.join(allowed)}")


def _check_lines(header: Header, data: bytes) -> bytes:
    """Refuse lines that are not as declared; returns the first lines."""
    head: Any = HEAD.match(data)
    last = _end_of_lines(header.line, data, head.end())
    end = _end_of(re.compile(rb"\s*+"), data, last)
    if end < len(data):
        wrong = data[end : end + 60].split(b"\n")[0]
        number = data.count(b"\n", 0, end) + 1
        place = "" if header.is_dense else "row, column, "
        raise FileError(f"line {number} is {wrong!r}; it must be {place}{header.field}")
    lines = data.count(b"\n", head.end(), last)
    if lines != header.lines or not header.is_possible:
        size = f"{header.rows} x {header.columns}, {header.symmetry}"
        raise FileError(f"declares {size}, of {header.lines} lines, but has {lines}")
    return head[0]


def _end_of(pattern: re.Pattern[bytes], data: bytes, start: int) -> int:
    """End of the match of a pattern at `start`; `start` if there is none."""
    match = pattern.match(data, start)
    return start if match is None else match.end()


def _end_of_lines(line: bytes, data: bytes, start: int) -> int:
    """End of the lines that are as declared."""
    lines = re.compile(rb"(?:%b){1,%d}" % (line, LINES_AT_ONCE))
    while True:
        end = _end_of(lines, data, start)
        if end == start:
            return end
        start = end


def _grids(head: bytes) -> tuple[Any, Any]:
    """Grids of projector and camera in the comments, each None where it is not there."""
    match = GRID.search(head)
    if match is None:
        return None, None
    height, width, camera_height, camera_width = match.groups()
    grid = int(height), int(width)
    if camera_height is None:
        return grid, None
    return grid, (int(camera_height), int(camera_width))


def write_mtx(path: Path, record: StoreRecord) -> None:
    """Write the matrix and the grids of a record of one channel."""
    if len(record.matrices) != 1:
        raise InputError("T has three channels, and a .mtx holds one matrix; save it as .npz")
    comment = ""
    if record.grid:
        comment += f"ltcl grid {record.grid[0]} x {record.grid[1]}"
    if record.camera_grid:
        comment += f", camera grid {record.camera_grid[0]} x {record.camera_grid[1]}"
    # SciPy does not notice that a disk is full, and takes names in UTF-8 alone.
    with path.open("wb") as file:
        scipy.io.mmwrite(file, record.matrices[0], comment=comment, symmetry="general")
