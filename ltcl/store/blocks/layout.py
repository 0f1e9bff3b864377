# SPDX-License-Identifier: BSD-3-Clause
"""What a store says about the transport in it: sizes, grids, how it is cut; and the header of a block."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError, InputError

SCHEMA = 1
ORIENTATIONS = ("rows", "columns")
KINDS = ("blocks", "compressed")
_FILL = 1 << 26  # bytes of a block of rows, were they full
_LARGEST = (1 << 31) - 1  # column indices are of 32 bits
_MOST_BLOCKS = 1 << 20


@dataclass(frozen=True)
class Layout:
    """Sizes of a stored transport; refused where they do not fit each other.

    Attributes
    ----------
    shape
        (M, N): camera pixels, projector pixels.
    grid, camera_grid
        (h, w) of projector and camera; camera_grid is None where the camera is on the projector's grid.
    channels
        1 or 3.
    block_rows
        Rows of T in a block, or columns of T in one that arrives by columns.
    orientation
        How blocks arrive.
    kind
        "blocks" of T, or "compressed": all of it in extra arrays, as `ltcl.transport` names them.
    """

    shape: tuple[int, int]
    grid: tuple[int, int]
    camera_grid: tuple[int, int] | None = None
    channels: int = 1
    block_rows: int = 1
    orientation: str = "rows"
    kind: str = "blocks"

    def __post_init__(self) -> None:
        checks.grid("shape", self.shape)
        checks.grid("grid", self.grid, self.shape[1])
        if self.camera_grid is not None or self.shape[0] != self.shape[1]:
            checks.grid("camera_grid", self.camera_grid, self.shape[0])
        if max(self.shape) > _LARGEST:
            raise InputError(f"shape is {self.shape}; a store holds at most {_LARGEST} rows and columns")
        if self.channels not in (1, 3):
            raise InputError(f"channels is {self.channels!r}; it must be 1 or 3")
        checks.one_of("orientation", self.orientation, ORIENTATIONS)
        checks.one_of("kind", self.kind, KINDS)
        checks.count("block_rows", self.block_rows)
        for what, length in zip(("rows", "columns"), self.shape, strict=True):
            if -(-length // self.block_rows) > _MOST_BLOCKS:
                raise InputError(
                    f"block_rows is {self.block_rows}, which cuts {length} {what} into more than "
                    f"{_MOST_BLOCKS} blocks; it must be at least {-(-length // _MOST_BLOCKS)}"
                )

    @property
    def is_square(self) -> bool:
        """Whether camera and projector have the same pixels, so that T has a first bounce."""
        return self.camera_grid in (None, self.grid)

    def blocks(self, orientation: str = "rows") -> int:
        """Number of blocks of a channel."""
        return -(-self.shape[ORIENTATIONS.index(orientation)] // self.block_rows)

    def span(self, block: int, orientation: str = "rows") -> tuple[int, int]:
        """First row (or column) of a block, and the one behind its last."""
        length = self.shape[ORIENTATIONS.index(orientation)]
        return block * self.block_rows, min((block + 1) * self.block_rows, length)

    def block_shape(self, block: int, orientation: str = "rows") -> tuple[int, int]:
        """(rows, N), or (columns, M) of one that holds columns of T as rows."""
        start, stop = self.span(block, orientation)
        return stop - start, self.shape[1 - ORIENTATIONS.index(orientation)]

    def to_json(self) -> dict[str, Any]:
        """Plain JSON, of which `from_json` makes the same again."""
        return {"schema": SCHEMA, **asdict(self)}

    @classmethod
    def from_json(cls, told: Any) -> Layout:
        """Refuses another schema, and whatever makes no sense."""
        if not isinstance(told, Mapping) or "schema" not in told:
            raise FileError("zarr.json describes no store of ltcl")
        if told["schema"] != SCHEMA:
            raise FileError(f"zarr.json is of schema {told['schema']!r:.40}; this ltcl reads schema {SCHEMA}")
        fields = {name: value for name, value in told.items() if name != "schema"}
        for name in ("shape", "grid", "camera_grid"):
            if isinstance(fields.get(name), list):
                fields[name] = tuple(fields[name])
        try:
            return cls(**fields)
        except TypeError as error:
            raise FileError(f"zarr.json describes a store that makes no sense: {str(error)!a:.100}") from None


def refuse_parts(attributes: Mapping[str, Any]) -> None:
    """Refuse the attributes of a store in which a part that is an object is something else."""
    for name in ("state", "provenance", "final"):
        part = attributes.get(name, {})
        if not isinstance(part, dict):
            raise FileError(f"zarr.json has {name} {part!r:.40}; it must be an object")


def rows_at_once(shape: tuple[int, int]) -> int:
    """Rows of a block unless told otherwise: 64 MiB if none of its entries were 0.

    >>> rows_at_once((4096, 4096)), rows_at_once((3, 5))
    (2048, 3)
    """
    return max(1, min(shape[0], _FILL // (8 * shape[1])))


def header(matrix: scipy.sparse.csr_array) -> dict[str, Any]:
    """The binsparse header of a block."""
    return {
        "version": "0.1",
        "format": "CSR",
        "shape": list(matrix.shape or ()),
        "number_of_stored_values": int(matrix.nnz),
        "data_types": {"pointers_to_1": "int64", "indices_1": "int32", "values": "float32"},
    }
