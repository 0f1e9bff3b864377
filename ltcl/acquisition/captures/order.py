# SPDX-License-Identifier: BSD-3-Clause
"""`PhotographOrder`: which file of a folder is the photograph of which pattern.

An order is a TOML file. A series of photographs, the first one of the coarsest stripes, is named by

    columns = "gray_h_{n}.png"                            # n = 0, 1, 2, ...
    columns = { name = "im{n:02}.png", first = 1, step = 2 }  # im01.png, im03.png, ...
    columns = { first = 0, step = 2 }                     # each second picture of the folder

where numbers without a name are places in the folder, whose pictures are in natural order.
"""

from __future__ import annotations

import logging
import os
import tomllib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ltcl import checks
from ltcl.acquisition.rigs.photographs import PHOTOGRAPH_SUFFIXES
from ltcl.errors import FileError, InputError
from ltcl.files import as_path, input_file
from ltcl.images.frames import natural_order

_logger = logging.getLogger(__name__)

# Orders that come along, and what they are.
ORDERS = {
    "opencv": """
columns = { first = 0, step = 2 }
columns_inverse = { first = 1, step = 2 }
rows = { after = "columns_inverse", step = 2 }
rows_inverse = { after = "rows", step = 2 }
white = -2
black = -1
""",
    "scan3d": """
white = 0
black = 1
columns = { first = 2, step = 2 }
columns_inverse = { first = 3, step = 2 }
rows = { after = "columns_inverse", step = 2 }
rows_inverse = { after = "rows", step = 2 }
centred = true
equal_bits = true
""",
}
SERIES = ("columns", "columns_inverse", "rows", "rows_inverse")
SINGLES = ("white", "black")


@dataclass(frozen=True, kw_only=True)
class Series:
    """Photographs of one kind of stripes.

    Attributes
    ----------
    name : str or None
        Pattern of the names, in which ``{n}`` is the number; None if numbers are places.
    first, step : int
        First number, and from one to the next.
    after : str or None
        The first number is the one after the first of the series of this name for an inverse, or
        else after its last.
    """

    name: str | None = None
    first: int = 0
    step: int = 1
    after: str | None = None


@dataclass(frozen=True, kw_only=True)
class AxisCode:
    """The code of columns or of rows.

    Attributes
    ----------
    bits : int
        Number of photographs.
    cells : int
        Numbers that are told apart.
    cell : int
        Projector pixels of a number.
    offset : int
        Projector pixels of the first numbers that lie beyond the picture.
    """

    bits: int
    cells: int
    cell: int
    offset: int


@dataclass(frozen=True, kw_only=True)
class PhotographOrder:
    """The order of photographs in a folder: which file shows which pattern.

    Attributes
    ----------
    columns, rows : Series
        Photographs of the stripes that tell the column, or the row, of a pixel.
    columns_inverse, rows_inverse : Series, optional
        Those of the inverse stripes: of both, or of neither.
    white, black : str or int, optional
        Name, or place in the folder, from its end if negative.
    coarsest_first : bool
        True if the first photograph of a series is of the coarsest stripes.
    cell : int
        Projector pixels, along each side, that have one code.
    centred : bool
        True if the code of a side of w pixels begins at (2^bits - w) / 2 instead of 0.
    equal_bits : bool
        True if columns and rows have as many photographs as the side of fewer bits: of a longer
        side the finest stripes are left out.

    Examples
    --------
    >>> order = PhotographOrder.read("opencv")
    >>> order.has_inverses, order.codes((600, 800))[0].bits
    (True, 10)
    """

    columns: Series
    rows: Series
    columns_inverse: Series | None = None
    rows_inverse: Series | None = None
    white: str | int | None = None
    black: str | int | None = None
    coarsest_first: bool = True
    cell: int = 1
    centred: bool = False
    equal_bits: bool = False

    def __post_init__(self) -> None:
        checks.count("cell", self.cell)
        if (self.columns_inverse is None) != (self.rows_inverse is None):
            raise InputError(
                "columns_inverse and rows_inverse must be there both, or neither of them"
            )
        if not self.has_inverses and (self.white is None or self.black is None):
            raise InputError(
                "white or black is missing; without photographs of inverse stripes both must be "
                "there"
            )
        if self.centred and self.cell != 1:
            raise InputError(f"cell is {self.cell}, but centred is true; it must be 1")

    @classmethod
    def read(cls, order: str | os.PathLike[str]) -> PhotographOrder:
        """Read an order by its name, "opencv" or "scan3d", or from a TOML file.

        FileError if there is no such file or it is not valid TOML; InputError for its keys.
        """
        if str(order) in ORDERS:
            return cls._from_table(str(order), tomllib.loads(ORDERS[str(order)]))
        path = as_path(order, "order")
        if not path.exists():
            known = " and ".join(ORDERS)
            raise FileError(f"{path}: no such file; it must be one, or one of {known}")
        try:
            table = tomllib.loads(input_file(path).read_text(encoding="utf-8"))
        except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
            raise FileError(f"{path}: is not valid TOML: {error}") from error
        return cls._from_table(str(path), table)

    @classmethod
    def _from_table(cls, source: str, table: dict[str, Any]) -> PhotographOrder:
        allowed = [field.name for field in fields(cls)]
        values: dict[str, Any] = {}
        for key, value in table.items():
            if key not in allowed:
                raise InputError(f"{source}: has {key!r}; it may have {', '.join(allowed)}")
            try:
                values[key] = _checked_value(key, value)
            except InputError as error:
                raise InputError(f"{source}: {error}") from error
        for key in ("columns", "rows"):
            if key not in values:
                raise InputError(f"{source}: has no {key!r}; it must be there")
        try:
            return cls(**values)
        except InputError as error:
            raise InputError(f"{source}: {error}") from error

    @property
    def has_inverses(self) -> bool:
        """True if each photograph of stripes has one of the inverse stripes."""
        return self.columns_inverse is not None

    def codes(self, grid: tuple[int, int]) -> tuple[AxisCode, AxisCode]:
        """Return the codes of columns and of rows for a projector of (height, width)."""
        height, width = grid
        all_bits = [_bits(-(-side // self.cell)) for side in (width, height)]
        codes = []
        for side, side_bits in zip((width, height), all_bits, strict=True):
            bits = min(all_bits) if self.equal_bits else side_bits
            codes.append(self._code(side, side_bits, bits))
        return codes[0], codes[1]

    def _code(self, side: int, side_bits: int, bits: int) -> AxisCode:
        cell = self.cell << (side_bits - bits)
        if not self.centred:
            return AxisCode(bits=bits, cells=-(-side // cell), cell=cell, offset=0)
        offset = ((1 << side_bits) - side) // 2
        return AxisCode(bits=bits, cells=1 << bits, cell=cell, offset=offset)

    def files(self, folder: Path, grid: tuple[int, int]) -> dict[str, list[Path]]:
        """Return the files of each series, the coarsest stripes first, and of white and black.

        FileError, which names the photograph, if one is not there, or would be of two patterns.
        """
        pictures = list_photographs(folder)
        columns, rows = self.codes(grid)
        files_of_series: dict[str, list[Path]] = {}
        ends: dict[str, tuple[int, int]] = {}
        for kind in SERIES:
            series = getattr(self, kind)
            if series is None:
                continue
            bits = columns.bits if kind.startswith("columns") else rows.bits
            first = _first_number(kind, series, ends)
            numbers = range(first, first + bits * series.step, series.step)
            ends[kind] = (first, first + (bits - 1) * series.step)
            files_of_series[kind] = []
            for number in numbers:
                place = number if series.name is None else series.name.format(n=number)
                files_of_series[kind].append(_find(folder, pictures, f"{kind} {number}", place))
            if not self.coarsest_first:
                files_of_series[kind].reverse()
        for kind in SINGLES:
            place = getattr(self, kind)
            if place is not None:
                files_of_series[kind] = [_find(folder, pictures, kind, place)]
        _check_once(folder, len(pictures), files_of_series)
        used = {path for files in files_of_series.values() for path in files}
        unused = [path.name for path in pictures if path not in used]
        if self._is_by_places and unused:
            _logger.warning(
                "%s: %d photographs are of no pattern, the first one %s; grid or order may be "
                "another",
                folder,
                len(unused),
                unused[0],
            )
        return files_of_series

    @property
    def _is_by_places(self) -> bool:
        """True if all photographs are found by their places in the folder."""
        places = [series.name for series in (self.columns, self.rows)]
        return not any(isinstance(place, str) for place in (*places, self.white, self.black))


def list_photographs(folder: Path) -> list[Path]:
    """List the photographs that stand directly in a folder, in natural order of their names."""
    try:
        entries = list(as_path(folder, "folder").iterdir())
    except OSError as error:
        raise FileError(f"{folder}: cannot be read: {error.strerror}") from error
    pictures = []
    for path in entries:
        is_picture = path.suffix.lower() in PHOTOGRAPH_SUFFIXES and path.is_file()
        if is_picture and not path.name.startswith("."):
            pictures.append(path)
    return sorted(pictures, key=natural_order)


def _bits(count: int) -> int:
    return (count - 1).bit_length()


def _first_number(kind: str, series: Series, ends: dict[str, tuple[int, int]]) -> int:
    """The first number of a series, which may come after that of an earlier one."""
    if series.after is None:
        return series.first
    first, last = ends[series.after]
    # The inverse of stripes follows each of them.
    return 1 + (first if kind == f"{series.after}_inverse" else last)


def _find(folder: Path, pictures: list[Path], kind: str, place: str | int) -> Path:
    """The file of a name or of a place."""
    if isinstance(place, str):
        path = folder / place
        if not path.is_file():
            raise FileError(f"{path}: no such file; it must be the photograph of {kind}")
        return path
    if not -len(pictures) <= place < len(pictures):
        raise FileError(
            f"{folder}: has {len(pictures)} photographs; that of {kind} must be number {place}, "
            "counted from 0"
        )
    return pictures[place]


def _check_once(folder: Path, count: int, files_of_series: dict[str, list[Path]]) -> None:
    """Refuse a photograph of two patterns, as places give it where some are missing."""
    kinds: dict[Path, str] = {}
    for kind, files in files_of_series.items():
        for path in files:
            if path in kinds:
                raise FileError(
                    f"{folder}: has {count} photographs, of which {path.name} would be of "
                    f"{kinds[path]} and of {kind}; some are missing, or grid or order is another"
                )
            kinds[path] = kind


def _checked_value(key: str, value: Any) -> Any:
    """A checked value of an order file."""
    if key in SERIES:
        return _checked_series(key, value)
    if key in SINGLES:
        if isinstance(value, bool) or not isinstance(value, str | int):
            raise InputError(f"{key} is {value!r}; it must be a name or a place")
        return value
    if key == "cell":
        return checks.count("cell", value)
    return checks.flag(key, value)


def _checked_series(key: str, value: Any) -> Series:
    if isinstance(value, str):
        value = {"name": value}
    if not isinstance(value, dict):
        raise InputError(f"{key} is {value!r}; it must be a name or a table")
    allowed = [field.name for field in fields(Series)]
    for name in value:
        if name not in allowed:
            raise InputError(f"{key} has {name!r}; it may have {', '.join(allowed)}")
    series = Series(**value)
    checks.count(f"first of {key}", series.first, least=0)
    checks.count(f"step of {key}", series.step)
    earlier = SERIES[: SERIES.index(key)]
    if series.after is not None and series.after not in earlier:
        raise InputError(f"after of {key} is {series.after!r}; it must be one of {earlier}")
    if series.name is not None:
        _check_name(key, series.name)
    return series


def _check_name(key: str, name: Any) -> None:
    problem = f"name of {key} is {name!r}; it must have the number as {{n}}, or as {{n:02}}"
    if not isinstance(name, str) or "{n" not in name:
        raise InputError(problem)
    try:
        names = {name.format(n=0), name.format(n=1)}
    except (LookupError, ValueError, AttributeError) as error:
        raise InputError(problem) from error
    if len(names) < 2:
        raise InputError(problem)
