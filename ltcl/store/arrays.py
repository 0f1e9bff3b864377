# SPDX-License-Identifier: BSD-3-Clause
"""NumPy's .npy layout, read with suspicion: memory is taken only for bytes that exist.

Layout (NEP 1): magic, version, length of the header, a Python dict literal, the values. `numpy.load`
allocates what the header asks for, ignores bytes left over and can be told to unpickle. Not so here.
"""

from __future__ import annotations

import ast
import math
import re
import sys
from collections.abc import Sequence
from typing import IO, NamedTuple

import numpy as np

from ltcl import checks
from ltcl.errors import FileError

_MAGIC = b"\x93NUMPY"
_LONGEST_HEADER = 10_000  # NumPy's own bound; a literal may upset the parser beyond it
_DTYPE = re.compile(r"[<>|=]?([biuf](1|2|4|8|12|16)|[SU]\d{1,3})")
_CHUNK = 1 << 20


class Header(NamedTuple):
    """What the values of an array are, and where they start in their stream."""

    dtype: np.dtype
    fortran: bool
    shape: tuple[int, ...]
    start: int

    @property
    def nbytes(self) -> int:
        """Bytes of the values."""
        return math.prod(self.shape) * self.dtype.itemsize

    def __str__(self) -> str:
        return f"{self.dtype.newbyteorder('=')} {self.shape}"


def read_header(stream: IO[bytes], name: str) -> Header:
    """Parse the header at the start of `stream`, a .npy file or archive member called `name` in messages."""
    start = stream.read(8)
    if not start.startswith(_MAGIC) or len(start) < 8:
        raise FileError(f"{name} is no NumPy array: it begins with {start!r}, not {_MAGIC!r}")
    width = 2 if start[6] == 1 else 4
    length = int.from_bytes(stream.read(width), "little")
    if start[6] not in (1, 2, 3) or length > _LONGEST_HEADER:
        raise FileError(
            f"{name} has a header of version {start[6]} and {length} bytes; "
            f"it must be of version 1 to 3 with at most {_LONGEST_HEADER} bytes"
        )
    text = stream.read(length)
    if len(text) < length:
        raise FileError(f"{name} is truncated inside its header")
    return _parse(text, name, start=8 + width + length)


def check_length(header: Header, available: int, name: str) -> None:
    """Refuse a header that declares more or fewer bytes than the `available` ones after it."""
    if header.nbytes != available:
        fault = "is truncated, or its header lies" if header.nbytes > available else "is longer than it says"
        raise FileError(
            f"{name} {fault}: it declares {header}, {header.nbytes} bytes, but {available} follow the header"
        )


def read_values(stream: IO[bytes], header: Header, name: str) -> np.ndarray:
    """Read the values behind `header`, in native byte order and C order.

    Raises
    ------
    FileError
        The stream ends too early or too late.
    MemoryLimitError
        The host has no room.
    """
    native = header.dtype.newbyteorder("=")
    copies = header.fortran or native != header.dtype
    checks.fits_host(f"{name}, {header},", header.nbytes * (2 if copies else 1))
    flat = np.empty(math.prod(header.shape), header.dtype)
    if flat.size:
        _fill(stream, flat.view(np.uint8), name)
    if stream.read(1):  # in an archive, meeting the end also checks the checksum
        raise FileError(f"{name} is longer than its header says: {header}")
    array = flat.reshape(header.shape[::-1]).T if header.fortran else flat.reshape(header.shape)
    return np.asarray(array, dtype=native, order="C")


def as_floats(name: str, array: np.ndarray) -> np.ndarray:
    """Real values as float32 where that is exact by type (16 bits and fewer, float32), else as float64."""
    checks.real(name, array)
    dtype = np.float32 if np.result_type(array.dtype, np.float32) == np.float32 else np.float64
    if array.dtype != dtype:
        checks.fits_host(f"{name} as {np.dtype(dtype)}", array.size * np.dtype(dtype).itemsize)
    return array.astype(dtype, copy=False)


def write_stack(stream: IO[bytes], matrices: Sequence[np.ndarray]) -> None:
    """Write one (M, N) matrix, or several as (k, M, N), as .npy without stacking them in memory."""
    shape = matrices[0].shape if len(matrices) == 1 else (len(matrices), *matrices[0].shape)
    dtype = np.result_type(*matrices).newbyteorder("<")
    np.lib.format.write_array_header_1_0(
        stream, {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    )
    rows = max(1, (16 * _CHUNK) // (matrices[0].shape[1] * dtype.itemsize))
    for T in matrices:
        for first in range(0, T.shape[0], rows):
            stream.write(np.ascontiguousarray(T[first : first + rows], dtype=dtype).tobytes())


def _parse(text: bytes, name: str, start: int) -> Header:
    try:
        fields = ast.literal_eval(text.decode("latin-1"))
        descr, fortran, shape = fields["descr"], fields["fortran_order"], fields["shape"]
        whole = all(type(n) is int and 0 <= n <= sys.maxsize for n in shape)
    except (SyntaxError, ValueError, TypeError, KeyError, RecursionError, MemoryError):
        raise FileError(f"{name} has an unreadable header") from None
    if type(fortran) is not bool or not isinstance(shape, tuple) or len(shape) > 8 or not whole:
        raise FileError(f"{name} has an impossible header: shape {shape!r}, fortran_order {fortran!r}"[:200])
    return Header(_dtype(descr, name), fortran, shape, start)


def _dtype(descr: object, name: str) -> np.dtype:
    if isinstance(descr, str) and descr.endswith("O"):
        raise FileError(
            f"{name} holds pickled Python objects, which are never loaded; it must hold real numbers"
        )
    try:
        if isinstance(descr, str) and _DTYPE.fullmatch(descr):
            return np.dtype(descr)
    except TypeError:  # f1, i16: of no such size
        pass
    raise FileError(f"{name} holds {descr!r:.60}; it must hold real numbers")


def _fill(stream: IO[bytes], room: np.ndarray, name: str) -> None:
    filled = 0
    while filled < len(room):
        part = stream.read(min(_CHUNK, len(room) - filled))
        if not part:
            raise FileError(f"{name} is truncated: {filled} of {len(room)} bytes are there")
        room[filled : filled + len(part)] = np.frombuffer(part, np.uint8)
        filled += len(part)
