# SPDX-License-Identifier: BSD-3-Clause
"""Where the rows of a matrix come from, a block at a time: the whole need never be in memory.

Arrays and memory-mapped files, sparse matrices, whatever is sliced as HDF5 and zarr arrays are, operators
without rows of their own (by transposed products), and anything that has `shape` and `rows(start, stop)`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import Operator

COLUMNS = 16  # blocks are of a multiple of this, so that kernels run alike whatever the block
_PER_VALUE = 32  # bytes of host memory for a value of a block: float64, float32, transformed, chosen
_BLOCK = 1 << 27  # bytes that a block takes unless told otherwise
_MOST = 512  # rows at once: more do not help


@runtime_checkable
class RowSource(Protocol):
    """A matrix (M, N) that gives its rows start .. stop as (stop - start, N) real numbers."""

    @property
    def shape(self) -> tuple[int, int]:
        """(M, N)."""
        ...

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Rows start .. stop - 1, (stop - start, N)."""
        ...


def source(name: str, matrix: Any) -> RowSource:
    """`matrix` as a source of rows; `name` is what a refusal calls it.

    Raises
    ------
    InputError, InputTypeError
        Not two-dimensional, not of real numbers, or nothing that gives rows.
    """
    if scipy.sparse.issparse(matrix):
        return _Sliced(name, checks.csr(name, matrix))
    if isinstance(matrix, RowSource):
        return _Told(name, _of_two(name, matrix))
    if isinstance(matrix, Operator) or hasattr(matrix, "matvec"):
        return _Products(name, matrix)
    if hasattr(matrix, "shape") and hasattr(matrix, "__getitem__"):
        checks.real(name, np.zeros(0, _of_two(name, matrix).dtype))
        return _Sliced(name, matrix)
    raise InputTypeError(
        f"{name} is a {type(matrix).__name__}; it must be an array, sparse, an operator, or have "
        "shape and rows(start, stop)"
    )


def _of_two(name: str, matrix: Any) -> Any:
    if np.size(matrix.shape) != 2:
        raise InputError(f"{name} has shape {matrix.shape}; it must be (M, N)")
    return matrix


@dataclass(frozen=True)
class _Sliced:
    """Arrays, memory-mapped files, HDF5 and zarr arrays, sparse rows."""

    name: str
    matrix: Any

    @property
    def shape(self) -> tuple[int, int]:
        return self.matrix.shape

    def rows(self, start: int, stop: int) -> np.ndarray:
        part = self.matrix[start:stop]
        found = part.toarray() if scipy.sparse.issparse(part) else np.asarray(part)
        return _wanted(f"{self.name}[{start}:{stop}]", found, (stop - start, self.shape[1]))


@dataclass(frozen=True)
class _Told:
    """Somebody's own rows(start, stop), which may not give what it must."""

    name: str
    matrix: RowSource

    @property
    def shape(self) -> tuple[int, int]:
        return self.matrix.shape

    def rows(self, start: int, stop: int) -> np.ndarray:
        call = f"{self.name}.rows({start}, {stop})"
        found = checks.real(call, self.matrix.rows(start, stop))
        return _wanted(call, found, (stop - start, self.shape[1]))


def _wanted(call: str, found: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Neither more nor fewer numbers than were asked for."""
    if found.shape != shape:
        raise InputError(f"{call} gave shape {found.shape}; it must be {shape}")
    return found


@dataclass(frozen=True)
class _Products:
    """Rows of an operator as A^T times unit vectors."""

    name: str
    operator: Any

    @property
    def shape(self) -> tuple[int, int]:
        return self.operator.shape

    def rows(self, start: int, stop: int) -> np.ndarray:
        units = np.zeros((self.shape[0], stop - start), np.float32)
        units[np.arange(start, stop), np.arange(stop - start)] = 1.0
        try:
            return np.ascontiguousarray(self.operator.rmatmat(units).T)
        except (NotImplementedError, TypeError) as error:  # what SciPy raises, by its version
            kind = type(self.operator).__name__
            raise InputError(f"{self.name} is a {kind} without rmatvec; its rows cannot be had") from error


@dataclass(frozen=True)
class Interreflection:
    """Rows of R = T F^-1 - I from those of T, computed in float64 and rounded once.

    `F` is 0 where a projector pixel is masked; its column of R is 0.
    """

    T: RowSource
    F: np.ndarray

    @property
    def shape(self) -> tuple[int, int]:
        """(N, N)."""
        return self.T.shape

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Rows start .. stop - 1 of R, (stop - start, N) float32."""
        lit, name = self.F > 0, f"T in rows {start} to {stop - 1}"
        rows = checks.finite(name, checks.real(name, self.T.rows(start, stop)))
        block = rows / np.where(lit, self.F, np.inf)
        here = np.arange(stop - start)
        block[here, start + here] -= lit[start:stop]
        return block.astype(np.float32)


def difference(A: RowSource, B: RowSource, memory: int | None = None) -> float:
    """||A - B||_F of what two sources give, summed in float64; `memory` as of `at_once`."""
    squares = []
    for start, stop in cut(A.shape[0], at_once(A.shape[1], memory)):
        rows = np.subtract(A.rows(start, stop), B.rows(start, stop), dtype=np.float64)
        squares.append(float(np.vdot(rows, rows)))
    return math.sqrt(math.fsum(squares))


def at_once(values: int, memory: int | None = None) -> int:
    """How many rows of `values` numbers fit into `memory` bytes, a multiple of `COLUMNS`.

    Raises
    ------
    MemoryLimitError
        Not even `COLUMNS` of them.
    """
    room = min(_BLOCK, checks.host_memory() // 4) if memory is None else memory
    count = min(room // (_PER_VALUE * max(values, 1)), _MOST) // COLUMNS * COLUMNS
    if count == 0:
        raise MemoryLimitError(
            f"memory is {checks.size(room)}; blocks of {COLUMNS} rows of {values} values need "
            f"{checks.size(COLUMNS * values * _PER_VALUE)}"
        )
    return count


def cut(count: int, size: int) -> Iterator[tuple[int, int]]:
    """(start, stop) of blocks of `size`.

    >>> list(cut(5, 2))
    [(0, 2), (2, 4), (4, 5)]
    """
    return ((start, min(start + size, count)) for start in range(0, count, size))
