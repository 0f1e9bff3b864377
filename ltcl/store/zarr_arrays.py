# SPDX-License-Identifier: BSD-3-Clause
"""A finished transport as a zarr 3 folder, written and read by zarr.

`channel_0/block_000000.0` and so on hold rows of T in binsparse CSR layout, `extra/NAME.0` small arrays. Each
array is one chunk with zarr's checksum (crc32c). The group's zarr.json carries its own SHA-256 and names all
other files with theirs, which protect metadata, too, and are compared at every read. Stores of schema 1 have
them in the zarr.json of each block.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import FileError, InputError
from ltcl.store.record import CSR, about, declared

START, _UNSEALED = b'{"attributes": {"checksum": "', b"0" * 64
_LARGEST = (1 << 31) - 1  # column indices are of 32 bits
_MOST_BLOCKS = 1 << 20
_FILL = 1 << 26  # bytes of a block of rows, were they full
_ORIENTATIONS = ("rows", "columns")
_BINSPARSE: dict[str, str] = dict(zip(("values", "indices_1", "pointers_to_1"), CSR, strict=True))


@dataclass
class Layout:
    """Sizes of a stored transport; refused where they do not fit each other.

    `shape` (M, N); `grid` and `camera_grid` (h, w), None for a camera on the projector's grid; 1 or 3
    `channels`; a block is `block_rows` rows of T, or as many columns in the log: by default 64 MiB of full
    ones. Of the kind "compressed" all of T is in extra arrays, as `ltcl.transport` names them.
    """

    shape: tuple[int, int]
    grid: tuple[int, int]
    camera_grid: tuple[int, int] | None = None
    channels: int = 1
    block_rows: Any = None
    kind: str = "blocks"
    dtype: str = "float32"

    def __post_init__(self) -> None:
        M, N = self.shape = checks.grid("shape", self.shape)
        self.grid = checks.grid("grid", self.grid, N)
        if self.camera_grid is not None or M != N:
            self.camera_grid = checks.grid("camera_grid", self.camera_grid, M)
        if max(M, N) > _LARGEST:
            raise InputError(f"shape is {self.shape}; a store holds at most {_LARGEST} rows and columns")
        checks.one_of("channels", self.channels, (1, 3))
        checks.one_of("kind", self.kind, ("blocks", "compressed"))
        checks.one_of("dtype", self.dtype, ("float32", "float64"))
        if self.block_rows is None:
            self.block_rows = max(1, min(M, _FILL // (8 * N)))
        checks.count("block_rows", self.block_rows, least=-(-max(M, N) // _MOST_BLOCKS))

    @property
    def is_square(self) -> bool:
        """Whether camera and projector have the same pixels, so that T has a first bounce."""
        return self.camera_grid in (None, self.grid)

    def blocks(self, orientation: str = "rows") -> int:
        """Number of blocks of a channel."""
        return -(-self.shape[_ORIENTATIONS.index(orientation)] // self.block_rows)

    def span(self, block: int, orientation: str = "rows") -> tuple[int, int]:
        """First row (or column) of a block, and the one behind its last."""
        length = self.shape[_ORIENTATIONS.index(orientation)]
        return block * self.block_rows, min((block + 1) * self.block_rows, length)

    def block_shape(self, block: int, orientation: str = "rows") -> tuple[int, int]:
        """(rows, N), or (columns, M) of one that holds columns of T as rows."""
        start, stop = self.span(block, orientation)
        return stop - start, self.shape[1 - _ORIENTATIONS.index(orientation)]


class ZarrArrays:
    """Sets of arrays by name in the folder `root`, as an `ArrayLog` has them; `files` are their SHA-256.

    The names are `rows_0.000000` and so on of blocks, and `extra.NAME`.
    """

    def __init__(self, root: Path, files: Mapping[str, str]) -> None:
        self.root, self.files = root, files
        self._places: dict[str, list[str]] = {}
        for file in files:
            place, _, document = file.rpartition("/")
            if document == "zarr.json" and place.count("/") == 2:  # of an array
                group = place.rpartition("/")[0].rpartition(".")[0]
                name = re.sub(r"channel_(\d)/block_", r"rows_\1.", group).replace("extra/", "extra.")
                self._places.setdefault(name, []).append(place)
        self.names = sorted(self._places)

    def get(self, name: str) -> dict[str, np.ndarray]:
        """The arrays under a name, whose checksums are compared."""
        if name not in self._places:
            raise FileError(f"{name} is missing")
        arrays = {place.rpartition("/")[2]: self._read(place) for place in self._places[name]}
        return {_BINSPARSE.get(name, name): array for name, array in arrays.items()}

    def _read(self, place: str) -> np.ndarray:
        """Through zarr, after the declared size was compared with that of the chunk."""
        import zarr

        with about(place, reading=True):
            read_file(self.root, f"{place}/zarr.json", self.files[f"{place}/zarr.json"])
            array = zarr.open_array(self.root / place, mode="r")
            if 0 in array.shape:
                return np.empty(array.shape, array.dtype)
            chunk = f"{place}/c{'/0' * array.ndim}"
            stored = len(read_file(self.root, chunk, self.files[chunk]))
            declared("it", array.dtype, array.shape, stored)
            return np.asarray(array[...]).reshape(array.shape)

    def verify(self) -> None:
        """Compare all files with their checksums."""
        for name, checksum in self.files.items():
            read_file(self.root, name, checksum)


def write_group(folder: Path, arrays: Mapping[str, np.ndarray], attributes: Mapping[str, Any]) -> None:
    """Write arrays as a new zarr group, each in one chunk."""
    import zarr
    from zarr.codecs import Crc32cCodec

    group = zarr.create_group(folder, attributes=dict(attributes))
    config: Any = {"write_empty_chunks": True}
    for name, array in arrays.items():
        chunks = tuple(max(n, 1) for n in array.shape)
        group.create_array(name, data=array, chunks=chunks, compressors=Crc32cCodec(), config=config)


def write_rows(folder: Path, T: Any, variance: np.ndarray | None, dtype: str) -> None:
    """Write rows of T as a group in binsparse layout, values as `dtype`."""
    types = {"values": dtype, "indices_1": "int32", "pointers_to_1": "int64"}
    arrays = {name: np.asarray(getattr(T, _BINSPARSE[name]), of) for name, of in types.items()}
    sizes = {"shape": list(T.shape), "number_of_stored_values": int(T.nnz), "data_types": types}
    if variance is not None:
        arrays["variance"] = np.asarray(variance, np.float32)
    write_group(folder, arrays, {"binsparse": {"version": "0.1", "format": "CSR", **sizes}})


def seal(attributes: Mapping[str, Any]) -> bytes:
    """The zarr.json of a group with `attributes` and a checksum: of the same bytes with zeros in its place.

    >>> unseal(seal({"answer": 42}), "zarr.json")["answer"]
    42
    """
    document = {"attributes": {"checksum": _UNSEALED.decode(), **attributes}, "zarr_format": 3}
    try:
        raw = json.dumps(document | {"node_type": "group"}, allow_nan=False).encode()
    except (TypeError, ValueError) as error:
        raise InputError(f"attributes are not plain JSON: {str(error)!a:.150}") from None
    return raw.replace(_UNSEALED, hashlib.sha256(raw).hexdigest().encode(), 1)


def unseal(raw: bytes, name: str) -> dict[str, Any]:
    """The attributes in `raw`, a file called `name`; refused if a byte of it has changed."""
    start, stop = len(START), len(START) + len(_UNSEALED)
    checksum = hashlib.sha256(raw[:start] + _UNSEALED + raw[stop:]).hexdigest().encode()
    if not raw.startswith(START) or checksum != raw[start:stop]:
        raise FileError(f"{name} is damaged, or not written by ltcl: its checksum is not that of its bytes")
    return json.loads(raw)["attributes"]


def read_file(root: Path, name: str, checksum: str | None = None) -> bytes:
    """All of the regular file root / name; refuses links, and another checksum."""
    place = root / name
    if place.is_symlink() or not place.is_file():
        raise FileError(f"{name} is {'no regular file' if os.path.lexists(place) else 'missing'}")
    raw = place.read_bytes()
    if checksum is not None and hashlib.sha256(raw).hexdigest() != checksum:
        raise FileError(f"{name} is damaged: its checksum is not that of its bytes")
    return raw


def manifest(root: Path, groups: list[str]) -> dict[str, str]:
    """SHA-256 of all files in some groups of a store."""
    files = sorted(file for group in groups for file in (root / group).rglob("*") if file.is_file())
    return {f.relative_to(root).as_posix(): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}


def manifest_1(root: Path, final: Mapping[str, str]) -> dict[str, str]:
    """The same of a store of schema 1, which names its groups with the checksum that each carries."""
    if not final:
        raise FileError("was begun by an earlier ltcl; finish it with that version")
    plain = hashlib.sha256(b'{"attributes": {}, "zarr_format": 3, "node_type": "group"}').hexdigest()
    sums = {f"{group.parent.name}/zarr.json": plain for group in sorted(root.glob("*/zarr.json"))}
    for group, checksum in final.items():
        raw = read_file(root, f"{group}/zarr.json")
        attributes = unseal(raw, f"{group}/zarr.json")
        if attributes["checksum"] != checksum:
            raise FileError(f"{group}/zarr.json is not the one that the store was finished with")
        sums[f"{group}/zarr.json"] = hashlib.sha256(raw).hexdigest()
        for name, entry in attributes["arrays"].items():
            sums[f"{group}/{name}/zarr.json"] = entry["metadata"]
            if "sha256" in entry:  # none of an empty array
                sums[f"{group}/{name}/c{'/0' * len(entry['shape'])}"] = entry["sha256"]
    return sums
