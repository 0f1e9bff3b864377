# SPDX-License-Identifier: BSD-3-Clause
"""Arrays as zarr 3 nodes of one uncompressed chunk: written with their sums, read back memory-mapped.

Nothing is mapped before its declared size is that of the file, and its bytes have the sum that is due. No
symbolic link is followed, and no name is taken from a file: names are those that this package gives.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ltcl.errors import FileError

GROUP: dict[str, Any] = {"zarr_format": 3, "node_type": "group"}
PLAIN_GROUP = json.dumps({"attributes": {}, **GROUP}).encode()
_BITS = (8, 16, 32, 64)
TYPES = ("bool", *(f"{kind}{n}" for kind in ("int", "uint") for n in _BITS), "float16", "float32", "float64")
_MOST_DIMENSIONS = 8
_PART = 1 << 22


def write_array(folder: Path, array: np.ndarray) -> dict[str, Any]:
    """Write `array` as a node at `folder`, flushed; returns what `read_array` wants to know.

    >>> import tempfile
    >>> root = Path(tempfile.mkdtemp())
    >>> entry = write_array(root / "x", np.arange(3, dtype=np.float32))
    >>> read_array(root, "x", entry).tolist()
    [0.0, 1.0, 2.0]
    """
    array = np.ascontiguousarray(array).reshape(array.shape)
    metadata = json.dumps(description(array.shape, array.dtype.name)).encode()
    entry = {"shape": list(array.shape), "data_type": array.dtype.name}
    folder.mkdir()
    entry["metadata"] = write_file(folder / "zarr.json", metadata)
    chunk = folder / _chunk(array.ndim)
    chunk.parent.mkdir(parents=True, exist_ok=True)
    if array.size:  # zarr keeps no chunk of an empty array
        raw = array.astype(array.dtype.newbyteorder("<"), copy=False).reshape(-1).view(np.uint8)
        entry["sha256"] = write_file(chunk, raw.data)
    return entry


def read_array(root: Path, name: str, entry: Any, verify: bool = True) -> np.ndarray:
    """The array at root / name, memory-mapped, after its size and its sums were checked.

    Raises
    ------
    FileError
        The entry makes no sense, a file is missing, of another size, a link, or has changed.
    """
    shape, dtype = _declared(entry, name)
    if verify:
        _same(f"{name}/zarr.json", read_file(root, f"{name}/zarr.json", 1 << 16), entry.get("metadata"))
    if 0 in shape:
        return np.empty(shape, dtype)
    chunk = f"{name}/{_chunk(len(shape))}"
    with open(open_file(root, chunk), "rb") as file:
        declared, there = math.prod(shape) * dtype.itemsize, os.fstat(file.fileno()).st_size
        if declared != there:
            raise FileError(f"{name} declares {dtype} {shape}, {declared} bytes, but {chunk} has {there}")
        mapped = np.memmap(file, dtype, "r", shape=shape)
    if verify:
        _same(chunk, mapped.reshape(-1).view(np.uint8).data, entry.get("sha256"))
    return mapped.view(np.ndarray)


def description(shape: tuple[int, ...], dtype: str) -> dict[str, Any]:
    """The zarr.json of an array in one chunk of plain little-endian bytes."""
    codec: dict[str, Any] = {"name": "bytes"}
    if np.dtype(dtype).itemsize > 1:
        codec["configuration"] = {"endian": "little"}
    chunks = [max(n, 1) for n in shape]
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": list(shape),
        "data_type": dtype,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunks}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": False if dtype == "bool" else 0,
        "codecs": [codec],
        "attributes": {},
    }


def write_file(path: Path, content: bytes | memoryview) -> str:
    """Write and flush a new file; returns its SHA-256."""
    handle = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | getattr(os, "O_BINARY", 0), 0o666)
    try:
        rest = memoryview(content)
        while rest:
            rest = rest[os.write(handle, rest[:_PART]) :]
        os.fsync(handle)
    finally:
        os.close(handle)
    return hashlib.sha256(content).hexdigest()


def read_file(root: Path, name: str, most: int) -> bytes:
    """All of the file root / name, if that is no more than `most` bytes."""
    with open(open_file(root, name), "rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise FileError(f"{name} has {size} bytes; it must have at most {most}")
        return file.read(most)


def open_file(root: Path, name: str) -> int:
    """A handle of the regular file root / name; refuses links on the way, and whatever is no file."""
    place, mode = root, 0
    for part in name.split("/"):
        place /= part
        try:
            mode = os.lstat(place).st_mode
        except (FileNotFoundError, NotADirectoryError):
            raise FileError(f"{name} is missing") from None
        if stat.S_ISLNK(mode):
            raise FileError(f"{place.relative_to(root)} is a symbolic link; a store has none")
    if not stat.S_ISREG(mode):
        raise FileError(f"{name} is no regular file")
    return os.open(place, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0))


def _chunk(dimensions: int) -> str:
    return "/".join(["c"] + ["0"] * dimensions)


def files_of(name: str, entry: Mapping[str, Any]) -> list[str]:
    """The files of an array at `name`."""
    chunk = [] if 0 in entry["shape"] else [f"{name}/{_chunk(len(entry['shape']))}"]
    return [f"{name}/zarr.json", *chunk]


def _declared(entry: Any, what: str) -> tuple[tuple[int, ...], np.dtype]:
    told = entry if isinstance(entry, Mapping) else {}
    shape: Any = told.get("shape")
    dtype = told.get("data_type")
    known = isinstance(shape, list) and len(shape) <= _MOST_DIMENSIONS and dtype in TYPES
    if not known or not all(type(n) is int and 0 <= n < 1 << 62 for n in shape):
        raise FileError(f"{what} is declared as {shape!r:.60} of {dtype!r:.20}; that is no array")
    return tuple(shape), np.dtype(dtype).newbyteorder("<")


def _same(name: str, content: bytes | memoryview, due: Any) -> None:
    if hashlib.sha256(content).hexdigest() != due:
        raise FileError(f"{name} is damaged: its bytes have another checksum than was written")
