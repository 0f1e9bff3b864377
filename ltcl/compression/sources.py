# SPDX-License-Identifier: BSD-3-Clause
"""What is compressed: R of every channel, by its rows, a block at a time, and by products on a device.

Rows come from arrays and memory-mapped files, sparse matrices, whatever is sliced as HDF5 and zarr arrays
are, operators (by transposed products), and anything that has `shape` and `rows(start, stop)`. The whole
matrix need never be in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from ltcl import checks
from ltcl.device import Device, open_device
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import Dense, Host, Operator
from ltcl.transport import Transport, require

COLUMNS = 16  # blocks are of a multiple of this, so that kernels run alike whatever the block
_WINDOW = 64  # pixels a side of the part of a picture on which bases are compared
_PER_VALUE = 32  # bytes of host memory for a value of a block: float64, float32, transformed, kept
_BLOCK = 1 << 27  # bytes of a block unless `memory` says otherwise
_MOST = 512  # rows at once: more do not help


@runtime_checkable
class RowSource(Protocol):
    """A matrix (M, N) that gives its rows start .. stop - 1 as (stop - start, N) real numbers."""

    @property
    def shape(self) -> tuple[int, int]:
        """(M, N)."""
        ...

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Rows start .. stop - 1, (stop - start, N)."""
        ...


class Rows(scipy.sparse.linalg.LinearOperator):
    """A matrix (M, N) by a function that reads its rows; products read all of them, on the host."""

    def __init__(
        self, shape: tuple[int, int], read: Callable[[int, int], np.ndarray], memory: int | None
    ) -> None:
        super().__init__(np.float64, shape)
        self._read, self.memory = read, memory

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Rows start .. stop - 1."""
        return self._read(start, stop)

    def blocks(self, dtype: type = np.float32) -> Iterator[tuple[slice, np.ndarray]]:
        """All rows in blocks that fit into `memory`."""
        for start, stop in cut(self.shape[0], rows_at_once(self.shape[1], self.memory)):
            yield slice(start, stop), np.asarray(self.rows(start, stop), dtype)

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),) float64, not rounded: a first bounce may be made of it."""
        return np.concatenate([np.diagonal(rows, at.start) for at, rows in self.blocks(np.float64)])

    def _matmat(self, X: np.ndarray) -> np.ndarray:
        x = X.astype(np.float32)
        return np.concatenate([rows @ x for _, rows in self.blocks()]).astype(np.float64)

    def _rmatmat(self, X: np.ndarray) -> np.ndarray:
        x, product = X.astype(np.float32), np.zeros((self.shape[1], X.shape[1]))
        for at, rows in self.blocks():
            product += rows.T @ x[at]
        return product


def source(name: str, matrix: Any, memory: int | None = None) -> Rows:
    """`matrix` by its rows, in blocks of `memory` bytes, which are checked as they are read."""
    if np.size(getattr(matrix, "shape", (0, 0))) != 2:
        raise InputError(f"{name} has shape {matrix.shape}; it must be (M, N)")
    if scipy.sparse.issparse(matrix):
        csr: Any = checks.csr(name, matrix)
        read = lambda start, stop: csr[start:stop].toarray()  # noqa: E731
    elif isinstance(matrix, RowSource):
        read = matrix.rows
    elif hasattr(matrix, "matvec"):
        read = lambda start, stop: _by_products(name, matrix, start, stop)  # noqa: E731
    elif hasattr(matrix, "shape") and hasattr(matrix, "__getitem__"):
        read = lambda start, stop: matrix[start:stop]  # noqa: E731
    else:
        raise InputTypeError(
            f"{name} is a {type(matrix).__name__}; it must be an array, sparse, an operator, or have "
            "shape and rows(start, stop)"
        )
    rows, columns = matrix.shape

    def validated(start: int, stop: int) -> np.ndarray:
        block = checks.real(f"{name} in rows {start} to {stop - 1}", read(start, stop))
        return checks.shape(f"{name} in rows {start} to {stop - 1}", block, (stop - start, columns))

    return Rows((rows, columns), validated, memory)


def _by_products(name: str, operator: Any, start: int, stop: int) -> np.ndarray:
    units = np.zeros((operator.shape[0], stop - start), np.float32)
    units[np.arange(start, stop), np.arange(stop - start)] = 1.0
    try:
        return np.ascontiguousarray(operator.rmatmat(units).T)
    except (NotImplementedError, TypeError) as error:  # what SciPy raises, by its version
        kind = type(operator).__name__
        raise InputError(f"{name} is a {kind} without rmatvec; its rows cannot be had") from error


def interreflection(T: Rows, F: np.ndarray) -> Rows:
    """R = T F^-1 - I by rows, in float64 and rounded once; of a masked pixel, F = 0, the column is 0."""
    lit = F > 0

    def read(start: int, stop: int) -> np.ndarray:
        block = checks.finite(f"T in rows {start} to {stop - 1}", T.rows(start, stop))
        block = block / np.where(lit, F, np.inf)
        here = np.arange(stop - start)
        block[here, start + here] -= lit[start:stop]
        return block.astype(np.float32)

    return Rows(T.shape, read, T.memory)


@dataclass(frozen=True)
class Problem:
    """R (N, N) of a channel, on a grid: its rows, and products with it on a device."""

    R: Rows
    operator: Operator
    grid: tuple[int, int]

    @property
    def pixels(self) -> int:
        """N."""
        return self.R.shape[0]

    def window(self) -> Problem:
        """R between the pixels in the middle of the picture; itself where these are all."""
        h, w = window_of(self.grid)
        if h * w == self.pixels:
            return self
        top, left = (self.grid[0] - h) // 2, (self.grid[1] - w) // 2
        firsts = np.arange(top, top + h) * self.grid[1] + left  # of each row of the window
        pixels = np.add.outer(firsts, np.arange(w)).ravel()
        R = np.empty((h * w, h * w), np.float32)
        for row, first in enumerate(firsts.tolist()):
            R[row * w : (row + 1) * w] = self.R.rows(first, first + w)[:, pixels]
        return Problem(source("R", R, self.R.memory), Dense(self.operator.device, R), (h, w))


def window_of(grid: tuple[int, int]) -> tuple[int, int]:
    """The grid of the window of a picture."""
    return min(grid[0], _WINDOW), min(grid[1], _WINDOW)


@dataclass(frozen=True)
class Inputs:
    """R of every channel, and what else a transport is made of; `nbytes` is what T takes."""

    problems: list[Problem]
    F: np.ndarray
    grid: tuple[int, int]
    nbytes: int
    masked: bool = False
    mixing: np.ndarray | None = None


def validate_inputs(
    T: Any,
    grid: Any = None,
    first_bounce: Any = None,
    device: Device | str | None = None,
    memory: int | None = None,
) -> Inputs:
    """Whatever `compress` takes, checked: a Transport, operators, or rows."""
    if isinstance(T, Transport):
        for name, value in {"grid": grid, "first_bounce": first_bounce, "device": device}.items():
            if value is not None:
                raise InputError(f"{name} is given, but T is a Transport, which has its own; leave it out")
        return _of_transport(T, memory)
    parts = list(T) if isinstance(T, (list, tuple)) else [T]
    if len(parts) not in (1, 3):
        raise InputError(f"T has {len(parts)} channels; it must be one, or three for RGB")
    if grid is None:
        raise InputError("grid is None, but T is no Transport; it must be (h, w), the projector's pixels")
    if all(hasattr(part, "matvec") and not isinstance(part, RowSource) for part in parts):
        F = "diagonal" if first_bounce is None else first_bounce
        return _of_transport(Transport(T, grid, F, device=device), memory)
    rows = [source("T", part, memory) for part in parts]
    n = rows[0].shape[0]
    for part in rows:
        if part.shape != (n, n):
            raise InputError(f"T has shape {part.shape}; it must be square, (N, N), to have an S")
        part.rows(0, 1)  # of rows that end with the matrix nobody sees that one too many was given
    grid, F = checks.grid("grid", grid, n), _first_bounce(rows, first_bounce)
    device = device if isinstance(device, Device) else open_device(device)
    R = [interreflection(part, f) for part, f in zip(rows, F, strict=True)]
    return Inputs([Problem(one, Host(device, one), grid) for one in R], F, grid, _dense(F))


def from_products(T: Transport, memory: int | None = None) -> Inputs:
    """A transport of which products are at hand, compressed in another form already."""
    problems = [Problem(source("R of T", S.R, memory), S.R, T.grid) for S in T.systems]
    return Inputs(problems, np.atleast_2d(T.first_bounce), T.grid, T.nbytes, bool(T.masked.any()), T.mixing)


def _of_transport(T: Transport, memory: int | None) -> Inputs:
    require(T)
    if T.error > 0.0:
        raise InputError(
            f"T is compressed already, with an error of {T.error:.2g}; compress what it came from"
        )
    if T.is_compressed:  # but exact, as of an adaptive scan
        return from_products(T, memory)
    F = np.atleast_2d(T.first_bounce)
    R = [interreflection(source("T", part, memory), f) for part, f in zip(T.matrices, F, strict=True)]
    try:
        operators, nbytes = [S.R for S in T.systems], T.nbytes or _dense(F)
    except MemoryLimitError:  # of the device
        operators, nbytes = [Host(T.device, one) for one in R], _dense(F)
    problems = [Problem(one, product, T.grid) for one, product in zip(R, operators, strict=True)]
    return Inputs(problems, F, T.grid, nbytes, bool(T.masked.any()), T.mixing)


def _dense(F: np.ndarray) -> int:
    """Bytes of T in float32, of its first bounces (channels, N)."""
    return 4 * F.size * F.shape[1]


def _first_bounce(rows: list[Rows], first_bounce: Any) -> np.ndarray:
    """(channels, N) float64."""
    n = rows[0].shape[0]
    if first_bounce is None:
        F = np.stack([part.diagonal() for part in rows])
    elif isinstance(first_bounce, str):
        raise InputTypeError(f"first_bounce is {first_bounce!r}; of rows it must be an array (N,), or None")
    else:
        F = checks.finite("first_bounce", checks.real("first_bounce", first_bounce)).astype(np.float64)
        F = np.broadcast_to(checks.shape("first_bounce", F, (n,), (len(rows), n)), (len(rows), n))
    dark = np.flatnonzero(np.any(F <= 0.0, axis=0))
    if len(dark):
        raise InputError(
            f"first_bounce is zero or negative at {len(dark)} of {n} pixels, the first {dark[0]}; it must be "
            "positive; make a Transport with on_dark='mask' of it"
        )
    return F


def rows_at_once(values: int, memory: int | None = None) -> int:
    """How many rows of `values` numbers fit into `memory` bytes, a multiple of `COLUMNS`, or a refusal."""
    room = min(_BLOCK, checks.host_memory() // 4) if memory is None else memory
    count = min(room // (_PER_VALUE * max(values, 1)), _MOST) // COLUMNS * COLUMNS
    if count == 0:
        raise MemoryLimitError(
            f"memory is {checks.size(room)}; blocks of {COLUMNS} rows of {values} values need "
            f"{checks.size(COLUMNS * values * _PER_VALUE)}"
        )
    return count


def cut(count: int, size: int) -> Iterator[tuple[int, int]]:
    """(start, stop) of blocks of `size`."""
    return ((start, min(start + size, count)) for start in range(0, count, size))
