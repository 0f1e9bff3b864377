# SPDX-License-Identifier: BSD-3-Clause
"""Arrays in a zip archive (.npz), read with suspicion.

Before an array is allocated its declared size must agree three ways: the archive's directory, the array's own
header, and what its compressed bytes can possibly expand to. Checksums are always verified.
"""

from __future__ import annotations

import contextlib
import lzma
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, Self

import numpy as np

from ltcl import checks
from ltcl.errors import FileError
from ltcl.files import refuse_appended
from ltcl.store import arrays

_MOST_MEMBERS = 10_000
_MOST_EXPANSION = 1032  # what deflate can reach; its format has no more
_BROKEN = (
    zipfile.BadZipFile,
    zipfile.LargeZipFile,
    zlib.error,
    lzma.LZMAError,
    struct.error,
    EOFError,
    NotImplementedError,  # a compression or version of the future
    RuntimeError,  # encrypted
    UnicodeError,
    OverflowError,
    ValueError,
    IndexError,
)


class Archive:
    """The arrays of an .npz file, by name, none of them read yet.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "a.npz"
    >>> np.savez(path, T=np.eye(2))
    >>> with Archive(path) as archive:
    ...     print(archive.names, archive.numbers("T").shape)
    ['T'] (2, 2)
    """

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            start = file.read(4)
        if start[:2] != b"PK":  # of every zip file, an empty or damaged one included
            raise FileError(f"is no .npz archive: it begins with {start!r}, not {b'PK'!r}")
        with _refusing("the archive"):
            self._zip = zipfile.ZipFile(path)
        self._size = path.stat().st_size
        try:
            refuse_appended(path, self._zip.comment)
        except FileError:
            self._zip.close()
            raise
        members = [info for info in self._zip.infolist() if info.filename.endswith(".npy")]
        self._members = {info.filename.removesuffix(".npy"): info for info in members}
        self._headers: dict[str, arrays.Header] = {}
        if len(members) > _MOST_MEMBERS or len(self._members) < len(members):
            self._zip.close()
            raise FileError(f"the archive holds {len(members)} arrays, too many or some of one name")

    @property
    def names(self) -> list[str]:
        """Names of the arrays, in the order of the archive."""
        return list(self._members)

    def header(self, name: str) -> arrays.Header:
        """Type and shape of an array, checked against the sizes that the archive declares."""
        if name not in self._headers:
            info = self._members[name]
            with self._open(name) as stream:
                header = arrays.read_header(stream, f"array {name!r}")
            arrays.check_length(header, info.file_size - header.start, f"array {name!r}")
            self._headers[name] = header
        return self._headers[name]

    def numbers(self, name: str) -> np.ndarray:
        """Values of an array of real numbers, native byte order, C order."""
        header = self._wanted(name)
        if header.dtype.kind not in "fiub":
            raise FileError(f"array {name!r} holds {header.dtype}; it must hold real numbers")
        with self._open(name) as stream:
            arrays.read_header(stream, f"array {name!r}")
            return arrays.read_values(stream, header, f"array {name!r}")

    def text(self, name: str) -> str:
        """Value of a single string (or bytes) array, as SciPy keeps the name of a format."""
        header = self._wanted(name)
        if header.dtype.kind not in "SU" or header.shape not in ((), (1,)):
            raise FileError(f"array {name!r} is {header}; it must be one string")
        with self._open(name) as stream:
            arrays.read_header(stream, f"array {name!r}")
            value = arrays.read_values(stream, header, f"array {name!r}").reshape(()).item()
        return value.decode("latin-1") if isinstance(value, bytes) else value

    def _wanted(self, name: str) -> arrays.Header:
        if name not in self._members:
            raise FileError(
                f"array {name!r} is missing; the archive holds {', '.join(map(repr, self.names))}"[:300]
            )
        return self.header(name)

    @contextlib.contextmanager
    def _open(self, name: str) -> Iterator[IO[bytes]]:
        info = self._members[name]
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise FileError(
                f"array {name!r} is compressed by method {info.compress_type}; it must be deflate or none"
            )
        most = info.compress_size * (1 if info.compress_type == zipfile.ZIP_STORED else _MOST_EXPANSION)
        if info.compress_size > self._size:
            raise FileError(
                f"array {name!r} declares {info.compress_size} bytes in an archive of {self._size}"
            )
        if info.file_size > most:
            raise FileError(
                f"array {name!r} declares {checks.size(info.file_size)}, but its "
                f"{checks.size(info.compress_size)} in the archive expand to {checks.size(most)} at most"
            )
        with _refusing(f"array {name!r}"), self._zip.open(info) as stream:
            yield stream

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._zip.close()


@contextlib.contextmanager
def _refusing(what: str) -> Iterator[None]:
    try:
        yield
    except FileError:
        raise
    except _BROKEN as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FileError(f"{what} is damaged or truncated: {reason!a:.150}") from None
