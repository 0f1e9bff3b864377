# SPDX-License-Identifier: BSD-3-Clause
"""`ArrayLog`: sets of arrays that are committed one by one, each an .npz and its SHA-256."""

from __future__ import annotations

import hashlib
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from ltcl.errors import FileError, InputError
from ltcl.files import input_file, replace_file
from ltcl.store.guards import about

ENTRY_FILE = re.compile(r"([A-Za-z][A-Za-z0-9_.-]{0,120})\.npz")
CHECKSUM_CHARACTERS = 64
# Bytes of a file that are in memory at once.
PIECE_BYTES = 1 << 20


@dataclass
class ArrayLog:
    """Sets of arrays by name in the folder `path`, which the first `put` makes."""

    path: Path

    @property
    def names(self) -> list[str]:
        """Names of all committed sets, by whatever process they were written."""
        with about(self.path):
            files = []
            if self.path.exists():
                files = os.listdir(self.path)
        matches = map(ENTRY_FILE.fullmatch, files)
        return sorted(match[1] for match in matches if match is not None)

    def put(self, name: str, **arrays: Any) -> None:
        """Commit arrays of numbers or texts; an earlier set of this name is replaced or kept."""
        if not ENTRY_FILE.fullmatch(f"{name}.npz"):
            raise InputError(
                f"name is {name!r:.60}; it must be letters, digits, _, - and ., a letter first"
            )
        with replace_file(self.path / f"{name}.npz") as temporary:
            np.savez(temporary, **arrays)
            with open(temporary, "r+b") as file:
                checksum = _checksum(file, os.path.getsize(temporary))
                file.seek(0, os.SEEK_END)
                file.write(checksum)

    def get(self, name: str) -> dict[str, np.ndarray]:
        """The arrays under a name; FileError where their checksum differs."""
        with about(self.path, reading=True):
            path = input_file(self.path / f"{name}.npz")
            with open(path, "rb") as file:
                size = max(os.path.getsize(path) - CHECKSUM_CHARACTERS, 0)
                checksum = _checksum(file, size)
                if file.read() != checksum:
                    raise FileError(f"{name}.npz is damaged: its checksum differs")
                # The reader of archives looks for their end before other bytes, too.
                file.seek(0)
                with np.load(file, allow_pickle=False) as arrays:
                    return dict(arrays)


def _checksum(file: IO[bytes], size: int) -> bytes:
    """SHA-256 of the first bytes of a file, which is then read up to there."""
    digest = hashlib.sha256()
    file.seek(0)
    while size > 0:
        piece = file.read(min(size, PIECE_BYTES))
        if not piece:
            break
        digest.update(piece)
        size -= len(piece)
    return digest.hexdigest().encode()
