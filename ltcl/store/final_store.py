# SPDX-License-Identifier: BSD-3-Clause
"""The files of a final store, written by zarr: rows of T in blocks, and small arrays.

Block k of a channel is the group `channel_0/block_00000k.0` in binsparse's CSR layout, a small
array the group `extra/NAME.0`. Each array is one chunk with crc32c. Last comes the zarr.json of the
store with the SHA-256 of every file: with it the store is final.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import InputError
from ltcl.files import flush, flush_tree
from ltcl.store.document import StoreLayout, write_document
from ltcl.transport import first_bounce

# Names of the arrays of a block: binsparse's, and SciPy's.
BINSPARSE = {"values": "data", "indices_1": "indices", "pointers_to_1": "indptr"}


class Block(NamedTuple):
    """Rows of T, or columns of it as rows, and the variance of their entries, None if unknown."""

    matrix: scipy.sparse.csr_array
    variance: np.ndarray | None


class PlacedBlock(NamedTuple):
    """A block of rows with its channel and number."""

    channel: int
    number: int
    rows: Block


@dataclass(frozen=True, kw_only=True)
class FinalContent:
    """Content of a final store, apart from its layout and provenance.

    The first bounce is the diagonal of T where that is above 0 by `sigmas` standard deviations.
    """

    rows: Iterable[PlacedBlock] = ()
    extras: Mapping[str, Any]
    state: Mapping[str, Any]
    sigmas: float = 0.0


def check_block(matrix: Any, variance: Any, shape: tuple[int, int]) -> Block:
    """Return a block to be written, as float32; refuse it before anything is written."""
    matrix = checks.csr("matrix", matrix)
    checks.shape("matrix", matrix, shape)
    with np.errstate(over="ignore"):
        values = checks.finite("matrix as float32", matrix.data.astype(np.float32))
    if variance is None:
        variance = np.full(matrix.nnz, np.nan)
    variance = checks.real("variance", variance)
    checks.shape("variance", variance, (matrix.nnz,))
    if np.any(variance < 0) or np.any(np.isinf(variance)):
        raise InputError(
            "variance is negative or infinite; it must be at least 0, or NaN where unknown"
        )
    rows = scipy.sparse.csr_array((values, matrix.indices, matrix.indptr), shape=shape)
    return Block(rows, variance.astype(np.float32))


def write_final(root: Path, layout: StoreLayout, provenance: Any, content: FinalContent) -> None:
    """Write all files of a final store into `root`, flushed, and last its document."""
    groups = ["extra"]
    for channel in range(layout.channels):
        groups.append(f"channel_{channel}")
    for group in groups:
        # A process may have ended here.
        shutil.rmtree(root / group, ignore_errors=True)
        _write_group(root / group, {})
    F = np.zeros((layout.channels, layout.shape[1]))
    for channel, number, rows in content.rows:
        _write_rows(root / f"channel_{channel}/block_{number:06d}.0", rows, layout.dtype)
        if layout.is_square:
            start, stop = layout.span(number)
            F[channel, start:stop] = _first_bounce(rows, start, content.sigmas)

    for name in content.extras:
        _write_group(root / "extra" / f"{name}.0", {"array": np.asarray(content.extras[name])})
    has_first_bounce = "first_bounce" in content.extras
    if layout.kind == "blocks" and layout.is_square and not has_first_bounce:
        _write_group(root / "extra" / "first_bounce.0", {"array": F})

    checksums = {}
    for group in groups:
        for file in flush_tree(root / group):
            checksum = hashlib.sha256(file.read_bytes()).hexdigest()
            checksums[file.relative_to(root).as_posix()] = checksum
    flush(root)
    write_document(root, layout, provenance, content.state, files=checksums)


def _write_rows(folder: Path, rows: Block, dtype: str) -> None:
    """Write a block of rows in the layout of binsparse."""
    matrix, variance = rows
    types = {"values": dtype, "indices_1": "int32", "pointers_to_1": "int64"}
    arrays = {}
    for name, array_type in types.items():
        arrays[name] = np.asarray(getattr(matrix, BINSPARSE[name]), array_type)
    if variance is not None:
        arrays["variance"] = variance
    header = {
        "version": "0.1",
        "format": "CSR",
        "shape": matrix.shape,
        "data_types": types,
        "number_of_stored_values": matrix.nnz,
    }
    _write_group(folder, arrays, binsparse=header)


def _first_bounce(rows: Block, start: int, sigmas: float) -> np.ndarray:
    """Diagonal of rows from `start` on, 0 where it is not certain."""
    matrix, variance = rows
    diagonal = matrix.diagonal(start)
    if sigmas > 0 and variance is not None:
        pattern = (variance, matrix.indices, matrix.indptr)
        variances = scipy.sparse.csr_array(pattern, shape=matrix.shape).diagonal(start)
    else:
        variances = np.zeros(len(diagonal))
    return first_bounce.drop_uncertain(diagonal, variances, sigmas)


def _write_group(folder: Path, arrays: Mapping[str, np.ndarray], **attributes: Any) -> None:
    """Write a zarr group of arrays, each of one chunk."""
    import zarr.codecs

    group = zarr.create_group(folder, attributes=attributes)
    config: Any = {"write_empty_chunks": True}
    for name, array in arrays.items():
        chunks = tuple(max(length, 1) for length in array.shape)
        checksum = zarr.codecs.Crc32cCodec()
        group.create_array(name, data=array, chunks=chunks, compressors=checksum, config=config)
