# SPDX-License-Identifier: BSD-3-Clause
"""Sparse matrices out of the parts that a file holds, checked before SciPy sees them.

SciPy's constructors accept column indices beyond the matrix, and its conversions then write outside their
arrays. A few entries may also declare a shape of 2**62: converting such a matrix allocates all its rows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError
from ltcl.store import arrays

Parts = Mapping[str, np.ndarray]
Shape = tuple[int, int]

_FREE_ROWS = 1 << 24  # 128 MiB of pointers; beyond, a matrix must have entries to show for its rows
_ROWS_PER_ENTRY = 64


def check_shape(shape: Shape, entries: int) -> None:
    """Refuse a shape that is empty, or so large that `entries` values cannot be a transport of it."""
    most = _FREE_ROWS + _ROWS_PER_ENTRY * entries
    if min(shape) < 1 or max(shape) > most:
        raise FileError(
            f"the matrix is declared as {shape} with {entries} entries; rows and columns must be 1..{most}"
        )


def assemble(layout: str, parts: Parts, shape: Shape) -> scipy.sparse.csr_array:
    """Return the matrix of `shape` that SciPy's `layout` (csr, csc, coo, bsr, dia) keeps in `parts`.

    Raises
    ------
    InputError
        The parts do not describe such a matrix (a FileError where sizes lie).
    """
    data = arrays.as_floats("data", parts["data"])
    check_shape(shape, data.size)
    return _BUILDERS[layout](data, {name: _signed(array) for name, array in parts.items()}, shape)


def _csr(data: np.ndarray, parts: Parts, shape: Shape) -> scipy.sparse.csr_array:
    checks.compressed("the matrix", parts["indptr"], parts["indices"], data, shape)
    return scipy.sparse.csr_array((data, parts["indices"], parts["indptr"]), shape=shape)


def _csc(data: np.ndarray, parts: Parts, shape: Shape) -> scipy.sparse.csr_array:
    checks.compressed("the matrix", parts["indptr"], parts["indices"], data, (shape[1], shape[0]))
    return scipy.sparse.csc_array((data, parts["indices"], parts["indptr"]), shape=shape).tocsr()


def _bsr(data: np.ndarray, parts: Parts, shape: Shape) -> scipy.sparse.csr_array:
    """Blocks `data` (blocks, r, c) stand at block coordinates; r and c divide the shape."""
    if data.ndim != 3 or 0 in data.shape[1:] or shape[0] % data.shape[1] or shape[1] % data.shape[2]:
        raise FileError(
            f"data has shape {data.shape}; it must be blocks (n, r, c) that tile a matrix of {shape}"
        )
    r, c = data.shape[1:]
    blocks = (shape[0] // r, shape[1] // c)
    checks.compressed("the matrix", parts["indptr"], parts["indices"], data[:, 0, 0], blocks)
    return scipy.sparse.bsr_array((data, parts["indices"], parts["indptr"]), shape=shape).tocsr()


def _coo(data: np.ndarray, parts: Parts, shape: Shape) -> scipy.sparse.csr_array:
    if "coords" in parts and parts["coords"].shape[:1] != (2,):
        raise FileError(f"coords has shape {parts['coords'].shape}; it must be (2, entries)")
    row, column = parts["coords"] if "coords" in parts else (parts["row"], parts["col"])
    for name, indices, most in (("row", row, shape[0]), ("col", column, shape[1])):
        if indices.dtype.kind not in "iu" or indices.shape != data.shape or data.ndim != 1:
            raise FileError(
                f"{name} is {indices.dtype} {indices.shape} for data {data.shape}; "
                "they must be vectors of one length"
            )
        if len(indices) and (indices.min() < 0 or indices.max() >= most):
            raise FileError(
                f"{name} holds {indices.min()}..{indices.max()}; indices must be in 0..{most - 1}"
            )
    return scipy.sparse.csr_array(scipy.sparse.coo_array((data, (row, column)), shape=shape))


def _dia(data: np.ndarray, parts: Parts, shape: Shape) -> scipy.sparse.csr_array:
    """Row k of `data` (diagonals, length) holds T[j - offsets[k], j] at column j."""
    offsets = parts["offsets"]
    if offsets.dtype.kind not in "iu" or data.ndim != 2 or offsets.shape != data.shape[:1]:
        raise FileError(
            f"offsets are {offsets.dtype} {offsets.shape} for data {data.shape}; one integer per row is due"
        )
    if len(np.unique(offsets)) < len(offsets):
        raise FileError("offsets name a diagonal twice; each may stand once")
    if len(offsets) and (offsets.min() <= -shape[0] or offsets.max() >= shape[1]):
        raise FileError(
            f"offsets hold {offsets.min()}..{offsets.max()}; they must be inside a matrix of {shape}"
        )
    return scipy.sparse.csr_array(scipy.sparse.dia_array((data, offsets), shape=shape))


def _signed(indices: np.ndarray) -> np.ndarray:
    # SciPy refuses unsigned indices. Those that wrap here turn negative, and the builders refuse them.
    return indices.astype(np.int64) if indices.dtype.kind == "u" else indices


_BUILDERS: dict[str, Callable[[np.ndarray, Parts, Shape], scipy.sparse.csr_array]] = {
    "csr": _csr,
    "csc": _csc,
    "bsr": _bsr,
    "coo": _coo,
    "dia": _dia,
}
LAYOUTS: dict[str, tuple[str, ...]] = {
    "csr": ("data", "indices", "indptr"),
    "csc": ("data", "indices", "indptr"),
    "bsr": ("data", "indices", "indptr"),
    "coo": ("data", "row", "col"),
    "dia": ("data", "offsets"),
}
"""SciPy's layouts and the arrays that each is kept in."""
