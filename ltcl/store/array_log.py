# SPDX-License-Identifier: BSD-3-Clause
"""`ArrayLog`: sets of arrays that are committed one by one, each an .npz and its SHA-256."""

from __future__ import annotations

import hashlib
import io
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ltcl.errors import FileError, InputError
from ltcl.files import input_file, replace_file
from ltcl.store.guards import about

ENTRY_FILE = re.compile(r"([A-Za-z][A-Za-z0-9_.-]{0,120})\.npz")
CHECKSUM_CHARACTERS = 64


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
            content = temporary.read_bytes()
            temporary.write_bytes(content + _checksum(content))

    def get(self, name: str) -> dict[str, np.ndarray]:
        """The arrays under a name; FileError where their checksum differs."""
        with about(self.path, reading=True):
            raw = input_file(self.path / f"{name}.npz").read_bytes()
            content = raw[:-CHECKSUM_CHARACTERS]
            if _checksum(content) != raw[-CHECKSUM_CHARACTERS:]:
                raise FileError(f"{name}.npz is damaged: its checksum differs")
            return dict(np.load(io.BytesIO(content), allow_pickle=False))


def _checksum(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode()
