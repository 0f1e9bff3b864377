# SPDX-License-Identifier: BSD-3-Clause
"""`ArrayLog`: arrays in a folder, one .npz file a name, each committed when `put` returns.

The comment of the archive, its last bytes, is the SHA-256 of all bytes before them.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ltcl.errors import FileError, InputError, InputTypeError
from ltcl.files import replace_file
from ltcl.store import npz
from ltcl.store.headers import about

try:
    import fcntl
except ImportError:  # Windows: nothing is locked
    fcntl = None

_SUM = 64
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.-]{0,120}")


class ArrayLog:
    """Sets of arrays by name in the folder `path`, which the first one makes.

    Examples
    --------
    >>> import tempfile
    >>> log = ArrayLog(Path(tempfile.mkdtemp()) / "log")
    >>> log.put("one", x=np.arange(3))
    >>> log.names, log.get("one")["x"].tolist()
    (['one'], [0, 1, 2])
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def names(self) -> list[str]:
        """Of what is committed, by whatever process."""
        files = (name.removesuffix(".npz") for name in self._listed() if name.endswith(".npz"))
        return sorted(name for name in files if _NAME.fullmatch(name))

    def put(self, name: str, **arrays: Any) -> None:
        """Commit arrays of numbers; what has that name already is replaced whole, or stays."""
        for what, array in arrays.items():
            if np.asarray(array).dtype.kind not in "fiubU":
                raise InputTypeError(f"{what} holds {np.asarray(array).dtype}; it must hold real numbers")
        with replace_file(self.path / f"{check_name(name)}.npz") as temporary:
            npz.write_arrays(temporary, arrays, comment=bytes(_SUM))
            with temporary.open("r+b") as file:
                checksum = hashlib.sha256(file.read()[:-_SUM]).hexdigest()
                file.seek(-_SUM, os.SEEK_END)
                file.write(checksum.encode())

    def get(self, name: str) -> dict[str, np.ndarray]:
        """The arrays under a name, whose checksums are compared."""
        file = self.path / f"{check_name(name)}.npz"
        with about(file):
            if file.is_symlink() or not file.is_file():
                raise FileError("is missing" if not os.path.lexists(file) else "is no regular file")
            raw = file.read_bytes()
            if hashlib.sha256(raw[:-_SUM]).hexdigest().encode() != raw[-_SUM:]:
                raise FileError("is damaged: its checksum is not that of its bytes")
            with npz.Archive(file) as archive:
                return archive.arrays()

    def _listed(self) -> list[str]:
        try:
            return os.listdir(self.path)
        except FileNotFoundError:
            return []
        except OSError as error:
            raise FileError(f"{self.path}: cannot be read: {error.strerror}") from error


def check_name(name: str) -> str:
    """`name`, if it can be that of a file anywhere."""
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise InputError(f"name is {name!r:.60}; it must be letters, digits, _, - and . with a letter first")
    return name


@contextlib.contextmanager
def locked(folder: Path, *, wait: bool = True) -> Iterator[None]:
    """One process at a time in a folder; without `wait` the second is refused."""
    if fcntl is None:
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        yield
    except BlockingIOError:
        raise FileError(f"{folder}: another process is at work there; one must end first") from None
    finally:
        os.close(handle)
