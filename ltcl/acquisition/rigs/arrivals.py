# SPDX-License-Identifier: BSD-3-Clause
"""The photographs that lie in a folder, by number, and the camera's own files brought under their numbers.

A photograph is named photo_NUMBER, with the extension of a known kind. Names are matched, never followed:
whatever leads out of the folder is refused.
"""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from typing import Any

from ltcl.acquisition.rigs import photographs
from ltcl.errors import AcquisitionError, FileError, InputError
from ltcl.files import as_path, input_file, replace_file, unknown_extension

_NAME = re.compile(r"photo_(\d{1,9})", re.IGNORECASE | re.ASCII)


def inside(folder: Path, *parts: str) -> Path:
    """A path in the folder.

    Raises
    ------
    FileError
        A link on the way leads out of the folder.

    Examples
    --------
    >>> inside(Path("scan"), "..", "elsewhere")
    Traceback (most recent call last):
    ltcl.errors.FileError: scan/../elsewhere: leads out of the folder; it must stay inside
    """
    path = folder.joinpath(*parts)
    if not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder)):
        raise FileError(f"{path}: leads out of the folder; it must stay inside")
    return path


def photo_name(number: int) -> str:
    """The name of a photograph, without its extension.

    >>> photo_name(7)
    'photo_000007'
    """
    return f"photo_{number:06d}"


class Arrivals:
    """Photographs in `folder`/photographs; looked up anew when one is not known yet."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: dict[int, list[Path]] = {}
        self.strangers: list[str] = []

    def strange(self) -> str:
        """What there is beside the photographs on the list, of which the first is named; or nothing."""
        if not self.strangers:
            return ""
        name = self.strangers[0]
        if _NAME.fullmatch(Path(name).stem) and Path(name).suffix.lower() not in photographs.SUFFIXES:
            known = ", ".join(photographs.SUFFIXES)
            return f"{name!r} there is of a kind that is not read; photographs are {known}"
        return f"{name!r} there is the name of no photograph on the list"

    def make(self) -> None:
        """Make the folder, so that a person finds it."""
        path = inside(self._folder, "photographs")
        try:
            path.mkdir(exist_ok=True)
        except OSError as error:
            raise FileError(f"{path}: cannot be made: {error.strerror}") from error

    def find(self, number: int) -> Path | None:
        """The file of a photograph, or None; two for one number are refused."""
        if not all(path.exists() for path in self._files.get(number, [self._folder / "unknown"])):
            self._look()
        found = self._files.get(number, [])
        if len(found) > 1:
            names = " and ".join(path.name for path in found)
            raise AcquisitionError(f"photograph {number} is there as {names}; keep one of them")
        return inside(self._folder, "photographs", found[0].name) if found else None

    def missing(self, count: int) -> tuple[int, ...]:
        """Which of the numbers 1 to `count` are not there; `strangers` are then the names of no number."""
        self._look()
        wanted = range(1, count + 1)
        self.strangers += [files[0].name for number, files in self._files.items() if number not in wanted]
        return tuple(number for number in wanted if number not in self._files)

    def take(self, files: Any, numbers: tuple[int, ...]) -> None:
        """Copy the camera's files, in the natural order of their names, under the `numbers`."""
        paths = sorted((as_path(path) for path in files), key=_natural)
        if len(paths) != len(numbers):
            raise InputError(f"files holds {len(paths)} names; {len(numbers)} photographs are missing")
        for path in map(input_file, paths):
            if path.suffix.lower() not in photographs.SUFFIXES:
                known = ", ".join(photographs.SUFFIXES)
                raise FileError(f"{path}: {unknown_extension(path)}; photographs are {known}")
        for number, path in zip(numbers, paths, strict=True):
            name = photo_name(number) + path.suffix.lower()
            with replace_file(inside(self._folder, "photographs", name)) as temporary:
                shutil.copyfile(path, temporary)

    def _look(self) -> None:
        self._files, self.strangers = {}, []
        folder = inside(self._folder, "photographs")
        for path in sorted(folder.iterdir()) if folder.is_dir() else ():
            match = _NAME.fullmatch(path.stem)
            if match and path.suffix.lower() in photographs.SUFFIXES:
                self._files.setdefault(int(match[1]), []).append(path)
            elif not path.name.startswith("."):
                self.strangers.append(path.name)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Names in the order of the numbers in them: IMG_9 before IMG_10."""
    parts = re.findall(r"\d+|\D+", path.name)
    return [(int(part), "") if part.isascii() and part.isdigit() else (-1, part) for part in parts]
