# SPDX-License-Identifier: BSD-3-Clause
"""A finished transport as a zarr 3 folder, written and read by zarr.

`channel_0/block_000000.0` and so on hold rows of T in binsparse CSR layout, `extra/NAME.0` small arrays and
those of a compressed transport. Each array is one chunk with zarr's own checksum (crc32c), which zarr
compares at every read. The group's zarr.json names all other files with their SHA-256, and carries its own.

Stores of schema 1 have plain chunks, whose SHA-256 is in the zarr.json of their block.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError, InputError
from ltcl.store import headers

LARGEST = 1 << 26  # bytes of the document
START, _UNSEALED = b'{"attributes": {"checksum": "', b"0" * 64
_POINTERS, _INDICES, _VALUES = _PARTS = ("pointers_to_1", "indices_1", "values")


class Block(NamedTuple):
    """Rows (or columns) of T, and the variance of each stored entry where it is known."""

    matrix: scipy.sparse.csr_array
    variance: np.ndarray | None


def seal(attributes: Mapping[str, Any]) -> bytes:
    """The zarr.json of a group with `attributes` and a checksum: of the same bytes with zeros in its place.

    >>> unseal(seal({"answer": 42}), "zarr.json")["answer"]
    42
    """
    document = {"attributes": {"checksum": _UNSEALED.decode(), **attributes}}
    try:
        raw = json.dumps({**document, "zarr_format": 3, "node_type": "group"}, allow_nan=False).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"attributes are not plain JSON: {str(error)!a:.150}") from None
    if len(raw) > LARGEST:
        raise InputError(f"attributes take {len(raw)} bytes; at most {LARGEST} can be kept")
    return raw.replace(_UNSEALED, hashlib.sha256(raw).hexdigest().encode(), 1)


def unseal(raw: bytes, name: str) -> dict[str, Any]:
    """The attributes in `raw`, a file called `name`; refused if a byte of it has changed."""
    start, stop = len(START), len(START) + len(_UNSEALED)
    if not raw.startswith(START):
        raise FileError(f"{name} is damaged, or not written by ltcl: it begins with {raw[:30]!r}")
    if hashlib.sha256(raw[:start] + _UNSEALED + raw[stop:]).hexdigest().encode() != raw[start:stop]:
        raise FileError(f"{name} is damaged: its checksum is not that of its bytes")
    with headers.library(name):
        return json.loads(raw)["attributes"]


def read_file(root: Path, name: str, most: int = LARGEST, checksum: str | None = None) -> bytes:
    """All of the regular file root / name; refuses links on the way, and another checksum."""
    place = root / name
    if not os.path.lexists(place):
        raise FileError(f"{name} is missing")
    if Path(os.path.realpath(place)) != Path(os.path.realpath(root)) / name or not place.is_file():
        raise FileError(f"{name} is a symbolic link, or no regular file")
    if place.stat().st_size > most:
        raise FileError(f"{name} has {place.stat().st_size} bytes; it must have at most {most}")
    raw = place.read_bytes()
    if checksum is not None and hashlib.sha256(raw).hexdigest() != checksum:
        raise FileError(f"{name} is damaged: its bytes have another checksum than was written")
    return raw


def write_group(folder: Path, arrays: Mapping[str, np.ndarray], attributes: Mapping[str, Any]) -> None:
    """Write arrays as a new zarr group, each in one chunk."""
    import zarr
    from zarr.codecs import Crc32cCodec

    group = zarr.create_group(folder, attributes=dict(attributes))
    for name, array in arrays.items():
        node = group.create_array(
            name,
            shape=array.shape,
            dtype=array.dtype.newbyteorder("<"),
            chunks=tuple(max(n, 1) for n in array.shape),
            compressors=Crc32cCodec(),
            config={"write_empty_chunks": True},
        )
        node[...] = array


def write_rows(root: Path, channel: int, block: int, rows: Block, dtype: str) -> None:
    """Write a block of rows of T, values as `dtype`."""
    T = rows.matrix
    arrays = {
        _POINTERS: np.asarray(T.indptr, np.int64),
        _INDICES: np.asarray(T.indices, np.int32),
        _VALUES: np.asarray(T.data, dtype),
    }
    header = {
        "version": "0.1",
        "format": "CSR",
        "shape": list(T.shape or ()),
        "number_of_stored_values": int(T.nnz),
        "data_types": {name: array.dtype.name for name, array in arrays.items()},
    }
    if rows.variance is not None:
        arrays["variance"] = np.asarray(rows.variance, np.float32)
    write_group(root / f"channel_{channel}/block_{block:06d}.0", arrays, {"binsparse": header})


def manifest(root: Path, groups: Iterable[str]) -> dict[str, str]:
    """SHA-256 of all files in some groups of a store."""
    sums = {}
    for file in sorted(file for group in groups for file in (root / group).rglob("*") if file.is_file()):
        with file.open("rb") as stream:
            sums[file.relative_to(root).as_posix()] = hashlib.file_digest(stream, "sha256").hexdigest()
    return sums


def manifest_1(root: Path, final: Mapping[str, str]) -> dict[str, str]:
    """The same of a store of schema 1, which names its groups with the checksum that each carries."""
    plain = hashlib.sha256(b'{"attributes": {}, "zarr_format": 3, "node_type": "group"}').hexdigest()
    sums = {f"{group.parent.name}/zarr.json": plain for group in sorted(root.glob("*/zarr.json"))}
    for full, checksum in final.items():
        raw = read_file(root, f"{full}/zarr.json", 1 << 16)
        attributes = unseal(raw, f"{full}/zarr.json")
        if attributes["checksum"] != checksum:
            raise FileError(f"{full}/zarr.json is not the one that the store was finished with")
        sums[f"{full}/zarr.json"] = hashlib.sha256(raw).hexdigest()
        for name, entry in attributes["arrays"].items():
            sums[f"{full}/{name}/zarr.json"] = entry["metadata"]
            if "sha256" in entry:  # none of an empty array
                chunk = "/".join(["c", *("0" for _ in entry["shape"])])
                sums[f"{full}/{name}/{chunk}"] = entry["sha256"]
    return sums


def read_array(root: Path, name: str, files: Mapping[str, str]) -> np.ndarray:
    """The array root / name, through zarr, after its declared size was compared with that of its chunk."""
    import zarr

    for node in (name.rpartition("/")[0], name):
        if f"{node}/zarr.json" not in files:
            raise FileError(f"{name} is missing")
        read_file(root, f"{node}/zarr.json", 1 << 16, files[f"{node}/zarr.json"])
    with headers.library(name):
        node = zarr.open_array(root / name, mode="r")
        codecs = [codec["name"] for codec in json.loads((root / name / "zarr.json").read_bytes())["codecs"]]
        headers.real(name, node.dtype)
        if codecs not in (["bytes"], ["bytes", "crc32c"]) or node.chunks != tuple(
            max(n, 1) for n in node.shape
        ):
            raise FileError(f"{name} has codecs {codecs} and chunks {node.chunks}; it is no array of ltcl")
        if 0 in node.shape:
            return np.empty(node.shape, node.dtype)
        chunk = "/".join([name, "c", *("0" for _ in node.shape)])
        trailer = 4 * (len(codecs) - 1)
        there = (root / chunk).stat().st_size if os.path.lexists(root / chunk) else -1
        headers.declared(name, node.dtype, node.shape, there - trailer, there - trailer)
        checks.fits_host(name, 2 * there)
        if not trailer:
            read_file(root, chunk, there, files.get(chunk, ""))
        return np.asarray(node[...]).reshape(node.shape)


def read_rows(root: Path, name: str, shape: tuple[int, int], dtype: str, files: Mapping[str, str]) -> Block:
    """The block root / name of rows of T, checked."""
    indptr, indices, values = (read_array(root, f"{name}/{part}", files) for part in _PARTS)
    for what, array, of in (
        (_POINTERS, indptr, "int64"),
        (_INDICES, indices, "int32"),
        (_VALUES, values, dtype),
    ):
        if array.dtype.name != of:
            raise FileError(f"{name}/{what} holds {array.dtype}; it must hold {of}")
    checks.compressed(name, indptr, indices, values, shape)
    matrix = scipy.sparse.csr_array((values, indices, indptr), shape=shape)
    if not matrix.has_canonical_format:
        raise FileError(f"{name} has rows whose columns do not ascend")
    known = f"{name}/variance/zarr.json" in files
    return Block(matrix, read_array(root, f"{name}/variance", files) if known else None)


def verify(root: Path, files: Mapping[str, str], passed: tuple[str, ...]) -> None:
    """Compare every file with its checksum; refuse what is missing, links, and files that do not belong."""
    for name, checksum in files.items():
        read_file(root, name, 1 << 40, checksum)
    for folder, folders, names in os.walk(root):
        if Path(folder) == root:
            folders[:] = [name for name in folders if name not in passed]
        for name in [*folders, *names]:
            place = (Path(folder) / name).relative_to(root).as_posix()
            strange = name in names and place not in files and place != "zarr.json"
            if strange or (Path(folder) / name).is_symlink():
                raise FileError(f"{place} is none of the store's files")
