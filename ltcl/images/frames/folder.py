# SPDX-License-Identifier: BSD-3-Clause
"""The pictures in a folder as frames."""

from __future__ import annotations

import functools
import hashlib
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ltcl import images
from ltcl.errors import FileError, MemoryLimitError
from ltcl.images.codes import Encoding
from ltcl.images.frames.source import Frame, Source


class Folder(Source):
    """Every picture that stands directly in the folder, in natural order."""

    def __init__(self, path: Path, encoding: Encoding = "auto") -> None:
        super().__init__(path, encoding)
        try:
            found = [file for file in path.iterdir() if _is_picture(file)]
        except OSError as error:
            raise FileError(f"{path}: cannot be read: {error.strerror}") from error
        if not found:
            raise FileError(f"{path}: holds no pictures; frames are {', '.join(images.BITS)}")
        self.files = sorted(found, key=_natural)
        self.count = len(found)
        stem, times = Counter(file.stem for file in found).most_common(1)[0]
        if times > 1:
            twins = " and ".join(file.name for file in self.files if file.stem == stem)
            raise FileError(f"{path}: holds {twins}; each frame must be one file")

    def __iter__(self) -> Iterator[Frame]:
        for number, file in enumerate(self.files, start=1):
            yield Frame(
                number,
                file.name,
                functools.partial(self._digest, number, file),
                functools.partial(self._picture, number, file),
            )

    def _digest(self, number: int, file: Path) -> str:
        try:
            with file.open("rb") as opened:
                return hashlib.file_digest(opened, "sha256").hexdigest()
        except OSError as error:
            raise FileError(f"{self.place(number)} cannot be read: {file.name}: {error.strerror}") from error

    def _picture(self, number: int, file: Path) -> np.ndarray:
        try:
            picture = images.read(file, encoding=self.encoding)
        except (FileError, MemoryLimitError) as error:
            reason = str(error).removeprefix(f"{file}: ")
            raise type(error)(f"{self.place(number)} cannot be read: {file.name}: {reason}") from error
        return self._same_size(number, picture)


def _is_picture(file: Path) -> bool:
    hidden = file.name.startswith(".")  # among them what a killed run left half written
    return not hidden and file.suffix.lower() in images.BITS and file.is_file()


def _natural(file: Path) -> tuple[list[str | int], str]:
    """Numbers in a name compare as numbers; re.split has them at the odd places.

    >>> sorted([Path("a10.png"), Path("a9.png"), Path("A9b.png")], key=_natural)[-1].name
    'a10.png'
    """
    parts = re.split(r"(\d+)", file.stem.lower())
    return [int(part) if place % 2 else part for place, part in enumerate(parts)], file.name
