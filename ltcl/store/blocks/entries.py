# SPDX-License-Identifier: BSD-3-Clause
"""One block as a zarr group in binsparse CSR layout; its zarr.json is its entry in the manifest of the store.

The entry holds size and SHA-256 of every file of the block, and its own. Arrays are `pointers_to_1` (int64),
`indices_1` (int32), `values` (float32) and perhaps `variance` (float32, NaN where unknown).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError, InputError
from ltcl.store.blocks import layout, nodes, sealed

_PARTS = ("pointers_to_1", "indices_1", "values")
_LARGEST_ENTRY = 1 << 16


class Block(NamedTuple):
    """Rows of T, and the variance of each stored entry where it is known; both memory-mapped."""

    matrix: scipy.sparse.csr_array
    variance: np.ndarray | None


def check(matrix: Any, variance: Any, shape: tuple[int, int]) -> Block:
    """What is to be written, as float32; refused before anything is."""
    matrix = checks.csr("matrix", matrix)
    if matrix.shape != shape:
        raise InputError(f"matrix has shape {matrix.shape}; this block is {shape}")
    with np.errstate(over="ignore"):
        values = checks.finite("matrix as float32", matrix.data.astype(np.float32))
    if variance is not None:
        variance = _variance(variance, matrix)
    return Block(scipy.sparse.csr_array((values, matrix.indices, matrix.indptr), shape=shape), variance)


def write(folder: Path, block: Block) -> None:
    """Write a block into an empty folder."""
    matrix = block.matrix
    arrays = {
        "pointers_to_1": np.asarray(matrix.indptr, np.int64),
        "indices_1": np.asarray(matrix.indices, np.int32),
        "values": np.asarray(matrix.data, np.float32),
    }
    if block.variance is not None:
        arrays["variance"] = block.variance
    write_arrays(folder, arrays, {"binsparse": layout.header(matrix)})


def write_arrays(folder: Path, arrays: Mapping[str, np.ndarray], attributes: Mapping[str, Any]) -> None:
    """Write arrays into an empty folder, and the entry that vouches for them."""
    told = {name: nodes.write_array(folder / name, array) for name, array in arrays.items()}
    nodes.write_file(folder / "zarr.json", sealed.seal({**attributes, "arrays": told}, nodes.GROUP))


def read(root: Path, name: str, shape: tuple[int, int], due: str | None = None, verify: bool = True) -> Block:
    """The block at root / name, checked; `due` is the checksum of its entry, where the store is final.

    Without `verify` only its entry is checked, and the sizes of its files.
    """
    entries = entry(root, name, due)
    if not set(_PARTS) <= set(entries) <= {*_PARTS, "variance"}:
        raise FileError(f"{name}/zarr.json describes no block")
    rows, _ = shape
    stored = entries["values"].get("shape") if isinstance(entries["values"], dict) else None
    wanted = {
        "pointers_to_1": ([rows + 1], "int64"),
        "indices_1": (stored, "int32"),
        "values": (stored, "float32"),
    }
    if "variance" in entries:
        wanted["variance"] = (stored, "float32")
    for part, (length, dtype) in wanted.items():
        told = entries[part]
        if not isinstance(told, dict) or (told.get("shape"), told.get("data_type")) != (length, dtype):
            raise FileError(f"{name}/{part} is declared as {told!r:.80}; it must be {dtype} {length}")
    arrays = {part: nodes.read_array(root, f"{name}/{part}", entries[part], verify) for part in wanted}
    indptr, indices, values = (arrays[part] for part in _PARTS)
    if verify:
        checks.compressed(name, indptr, indices, values, shape)
    matrix = scipy.sparse.csr_array((values, indices, indptr), shape=shape)
    if verify and not matrix.has_canonical_format:
        raise FileError(f"{name} has rows whose columns do not ascend")
    return Block(matrix, arrays.get("variance"))


def entry(root: Path, name: str, due: str | None = None) -> dict[str, Any]:
    """The arrays that the zarr.json of root / name vouches for, after its own sum is checked."""
    raw = nodes.read_file(root, f"{name}/zarr.json", _LARGEST_ENTRY)
    attributes = sealed.unseal(raw, f"{name}/zarr.json")["attributes"]
    if due is not None and sealed.checksum(raw) != due:
        raise FileError(f"{name}/zarr.json is another one than the store was finished with")
    arrays = attributes.get("arrays")
    if not isinstance(arrays, dict):
        raise FileError(f"{name}/zarr.json tells of no arrays")
    return arrays


def _variance(variance: Any, matrix: scipy.sparse.csr_array) -> np.ndarray:
    """One value a stored entry, of a matrix of the same pattern or in the order of its values."""
    if scipy.sparse.issparse(variance):
        other = checks.csr("variance", variance)
        same = np.array_equal(other.indptr, matrix.indptr) and np.array_equal(other.indices, matrix.indices)
        if not same:
            raise InputError("variance has its entries in other places than matrix; it must have the same")
        variance = other.data
    array = checks.real("variance", variance)
    checks.shape("variance", array, (matrix.nnz,))
    if np.any(array < 0) or np.any(np.isinf(array)):
        raise InputError("variance has negative or infinite values; it must be at least 0, or NaN if unknown")
    return array.astype(np.float32)
