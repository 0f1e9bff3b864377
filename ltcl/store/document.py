# SPDX-License-Identifier: BSD-3-Clause
"""The zarr.json of a store: its sizes (`StoreLayout`), sealed by a checksum.

It is a zarr group whose attributes hold the checksum: the SHA-256 of the same bytes with zeros in
its place.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ltcl import checks
from ltcl.errors import FileError, InputError
from ltcl.files import input_file, replace_file

SCHEMA = 2
DEFAULT_BLOCK_ENTRIES = 1 << 23  # 64 MiB where all entries of the rows are stored
MAX_PIXELS = (1 << 31) - 1  # column indices have 32 bits
MAX_BLOCKS = 1 << 20

DOCUMENT = "zarr.json"
BEGINNING = b'{"attributes": {"checksum": "'
UNSEALED = b"0" * 64


@dataclass
class StoreLayout:
    """Sizes of a stored transport.

    Parameters
    ----------
    shape : (M, N)
    grid, camera_grid : (h, w)
        Pixels of projector and camera; of the camera where they are not the projector's.
    channels : 1 or 3
    block_rows : int, optional
        Rows of T in a block, or columns of T in a batch of the log.
    kind : "blocks" or "compressed"
        Whether T is in blocks of rows, or all of it in extra arrays.
    dtype : str
        Type of the entries.
    """

    shape: tuple[int, int]
    grid: Any
    camera_grid: tuple[int, int] | None = None
    channels: int = 1
    block_rows: Any = None
    kind: str = "blocks"
    dtype: str = "float32"
    schema: int = SCHEMA

    def __post_init__(self) -> None:
        self.shape = checks.grid("shape", self.shape)
        M, N = self.shape
        self.grid = checks.grid("grid", self.grid, N)
        if self.camera_grid is not None or M != N:
            self.camera_grid = checks.grid("camera_grid", self.camera_grid, M)
        checks.count("shape", max(M, N), most=MAX_PIXELS)
        checks.one_of("channels", self.channels, (1, 3))
        checks.one_of("schema", self.schema, (SCHEMA,))
        if self.block_rows is None:
            self.block_rows = max(1, min(M, DEFAULT_BLOCK_ENTRIES // N))
        checks.count("block_rows", self.block_rows, least=max(M, N) // MAX_BLOCKS + 1)

    @property
    def is_square(self) -> bool:
        """True if camera and projector have the same pixels, so that T has a first bounce."""
        return self.camera_grid in (None, self.grid)

    def blocks(self, orientation: str = "rows") -> int:
        """Number of blocks of a channel, of "rows" or "columns"."""
        return -(-self._length(orientation) // self.block_rows)

    def span(self, block: int, orientation: str = "rows") -> tuple[int, int]:
        """First row (or column) of a block, and the one after its last."""
        start = block * self.block_rows
        return start, min(start + self.block_rows, self._length(orientation))

    def block_shape(self, block: int, orientation: str = "rows") -> tuple[int, int]:
        """(rows, N); or (columns, M) of a batch that holds columns of T as rows."""
        start, stop = self.span(block, orientation)
        M, N = self.shape
        width = N if orientation == "rows" else M
        return stop - start, width

    def _length(self, orientation: str) -> int:
        M, N = self.shape
        return M if orientation == "rows" else N


def write_document(
    root: Path, layout: StoreLayout, provenance: Any, state: Any, **files: Any
) -> None:
    """Seal and write the zarr.json of a store; `files` has the SHA-256 of files of a final one."""
    attributes = {
        "checksum": UNSEALED.decode(),
        "ltcl": asdict(layout),
        "provenance": provenance,
        "state": state,
        **files,
    }
    group = {"attributes": attributes, "zarr_format": 3, "node_type": "group"}
    try:
        raw = json.dumps(group, allow_nan=False).encode()
    except (TypeError, ValueError) as error:
        raise InputError(f"attributes are not plain JSON: {str(error)!a:.150}") from None
    checksum = hashlib.sha256(raw).hexdigest().encode()
    with replace_file(root / DOCUMENT) as temporary:
        temporary.write_bytes(raw.replace(UNSEALED, checksum, 1))


def read_document(file: Path) -> dict[str, Any]:
    """The attributes in a zarr.json; FileError if a byte of it has changed."""
    raw = input_file(file).read_bytes()
    after_checksum = raw[len(BEGINNING) + len(UNSEALED) :]
    unsealed = BEGINNING + UNSEALED + after_checksum
    checksum = hashlib.sha256(unsealed).hexdigest().encode()
    if not raw.startswith(BEGINNING + checksum):
        raise FileError(f"{file.name} is damaged, or not written by ltcl: its checksum differs")
    return json.loads(raw)["attributes"]


def is_store(folder: Path) -> bool:
    """True if a folder holds a store of ltcl, damaged or not."""
    document = folder / DOCUMENT
    return document.is_file() and document.read_bytes().startswith(BEGINNING)
