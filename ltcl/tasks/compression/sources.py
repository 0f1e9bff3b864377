# SPDX-License-Identifier: BSD-3-Clause
"""`SourceRows`: a matrix by its rows, in blocks that are read here or by workers of a cluster."""

from __future__ import annotations

import contextlib
import copy
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from ltcl import checks
from ltcl.batch.cluster import is_there, stream
from ltcl.errors import InputError, InputTypeError, MemoryLimitError

# Blocks have a multiple of so many rows, so that kernels run alike whatever the block.
COLUMNS = 16
# Bytes of host memory for a value of a block: float64, float32, transformed, kept.
BYTES_PER_VALUE = 32
# Bytes of a block unless `memory` says otherwise, and rows of a block: more do not help.
DEFAULT_BLOCK_BYTES = 1 << 27
MAX_BLOCK_ROWS = 512
# Items for workers, or up to twice as many: each costs the client some milliseconds.
MAX_ITEMS = 512

# Reads rows start .. stop - 1 of a matrix.
Fetch = Callable[[int, int], Any]
# Of first row, row behind the last, and what was fetched there; returns the rows, checked.
MakeRows = Callable[[int, int, Any], np.ndarray]
# Of the place of a block, its rows and a value of the moment.
BlockWork = Callable[[slice, np.ndarray, Any], Any]


class SourceRows(scipy.sparse.linalg.LinearOperator):
    """Matrix (M, N) by its rows, of which memory holds a few; products read all, on the host.

    Parameters
    ----------
    shape : (M, N)
    fetch : callable(start, stop)
        Reads rows of the matrix behind it.
    make : callable(start, stop, fetched)
        Checks and makes the rows.
    memory : int, optional
        Bytes of host memory for a block.
    client : distributed.Client, optional
        Its workers make the rows, and fetch them if `workers_fetch`; else the client sends them.
    chunks : int or tuple of int
        Number of rows that are best fetched at once: of each time, or always.
    """

    def __init__(
        self,
        shape: Any,
        fetch: Fetch,
        make: MakeRows,
        memory: int | None,
        *,
        client: Any = None,
        workers_fetch: bool = False,
        chunks: int | tuple[int, ...] = 1,
    ) -> None:
        super().__init__(np.float64, shape)
        self.fetch = fetch
        self.make = make
        self.memory = memory
        self.client = client
        self.workers_fetch = workers_fetch
        self.chunks = chunks

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Rows start .. stop - 1, (stop - start, N)."""
        return self.make(start, stop, self.fetch(start, stop))

    def map_blocks(
        self,
        work: BlockWork,
        value: Callable[[], Any] = lambda: None,
        dtype: Any = np.float32,
    ) -> Iterator[Any]:
        """Yield `work(place, rows, value())` of all blocks that fit into `memory`, in order.

        It runs here or on workers.
        """
        size = rows_at_once(self.shape[1], self.memory)
        task = _BlockTask(make=self.make, work=work, size=size, dtype=dtype)
        client_fetches = self.client is not None and not self.workers_fetch
        if not client_fetches:
            task.fetch = self.fetch
        spans = self._spans(size)
        spans_per_item = 1
        if self.workers_fetch:
            spans_per_item += len(spans) // MAX_ITEMS

        def items() -> Iterator[tuple[list[Any], Any]]:
            for first in range(0, len(spans), spans_per_item):
                blocks = []
                for start, stop in spans[first : first + spans_per_item]:
                    fetched = self.fetch(start, stop) if client_fetches else None
                    blocks.append((start, stop, fetched))
                yield blocks, value()

        results = stream(self.client, task, items())
        return itertools.chain.from_iterable(results)

    def _spans(self, size: int) -> list[tuple[int, int]]:
        """First row and the one behind the last of what is fetched at once."""
        if not isinstance(self.chunks, int):
            ends = itertools.accumulate(self.chunks)
            return list(itertools.pairwise([0, *ends]))
        rows = size
        if self.workers_fetch:
            rows = size * -(-self.chunks // size)
        return list(cut(self.shape[0], rows))

    def diagonal(self) -> np.ndarray:
        """Main diagonal, (min(M, N),) float64, not rounded: a first bounce may be made of it."""

        def work(place: slice, rows: np.ndarray, value: Any) -> np.ndarray:
            return rows.diagonal(place.start).copy()

        return np.concatenate(list(self.map_blocks(work, dtype=float)))

    def _matmat(self, X: np.ndarray) -> np.ndarray:
        x = X.astype(np.float32)
        products = self.map_blocks(lambda place, rows, value: rows @ x)
        return np.concatenate(list(products)).astype(np.float64)

    def _rmatmat(self, X: np.ndarray) -> np.ndarray:
        x = X.astype(np.float32)
        product = np.zeros((self.shape[1], X.shape[1]))
        for term in self.map_blocks(lambda place, rows, value: rows.T @ x[place]):
            product = product + term
        return product


@dataclass(kw_only=True)
class _BlockTask:
    """Make the rows of one item and work on their blocks; workers get it without the matrix."""

    make: MakeRows
    work: BlockWork
    size: int
    dtype: Any
    # None where the client fetches the rows and sends them.
    fetch: Fetch | None = None

    def __call__(self, item: tuple[list[Any], Any]) -> list[Any]:
        blocks, value = item
        results = []
        for start, stop, fetched in blocks:
            if self.fetch is not None:
                fetched = self.fetch(start, stop)
            count = stop - start
            for first, end in cut(count, self.size):
                # The last block takes all that is left, so that too many rows are noticed.
                fetched_end = end if end < count else None
                place = slice(start + first, start + end)
                rows = self.make(place.start, place.stop, fetched[first:fetched_end])
                rows = np.asarray(rows, self.dtype)
                results.append(self.work(place, rows, value))
        return results


def source(name: str, matrix: Any, memory: int | None = None, client: Any = None) -> SourceRows:
    """A matrix by its rows, in blocks of `memory` bytes, which are checked as they are read.

    `matrix` is sparse; sliced as arrays, memory-mapped files, HDF5, zarr and Dask arrays are; has
    ``rows(start, stop)``; or is an operator, whose rows are products with its transpose.
    """
    _check_source(name, matrix)
    if scipy.sparse.issparse(matrix):
        matrix = checks.csr(name, matrix)
    columns = matrix.shape[1]
    workers_fetch = False
    if client is not None:
        workers_fetch = _can_workers_fetch(client, matrix)

    def make(start: int, stop: int, fetched: Any) -> np.ndarray:
        place = f"{name} in rows {start} to {stop - 1}"
        if scipy.sparse.issparse(fetched):
            fetched = fetched.toarray()
        rows = checks.real(place, fetched)
        return checks.shape(place, rows, (stop - start, columns))

    chunks = getattr(matrix, "chunks", None)
    row_chunks = 1
    if chunks:
        row_chunks = chunks[0]
    return SourceRows(
        matrix.shape,
        _fetcher(name, matrix, client, workers_fetch),
        make,
        memory,
        client=client,
        workers_fetch=workers_fetch,
        chunks=row_chunks,
    )


def _check_source(name: str, matrix: Any) -> None:
    shape = getattr(matrix, "shape", None)
    if shape is not None and np.size(shape) != 2:
        raise InputError(f"{name} has shape {shape}; it must be (M, N)")
    ways = ("__getitem__", "rows", "matvec")
    is_readable = any(hasattr(matrix, way) for way in ways)
    if shape is None or not is_readable:
        kind = type(matrix).__name__
        raise InputTypeError(
            f"{name} is a {kind}; it must be an array, sparse, an operator, "
            "or have shape and rows(start, stop)"
        )


def _fetcher(name: str, matrix: Any, client: Any, workers_fetch: bool) -> Fetch:
    """Function that reads rows of a matrix of any kind."""
    if hasattr(matrix, "rows"):
        return lambda start, stop: matrix.rows(start, stop)
    if hasattr(matrix, "dask"):
        # A worker that computes by itself does not wait for others.
        scheduler = "synchronous" if workers_fetch else client
        return lambda start, stop: matrix[start:stop].compute(scheduler=scheduler)
    if scipy.sparse.issparse(matrix) or not hasattr(matrix, "matvec"):
        return lambda start, stop: matrix[start:stop]

    def rows_of_operator(start: int, stop: int) -> np.ndarray:
        units = np.zeros((matrix.shape[0], stop - start), np.float32)
        units[np.arange(start, stop), np.arange(stop - start)] = 1.0
        try:
            return np.ascontiguousarray(matrix.rmatmat(units).T)
        except (NotImplementedError, TypeError) as error:
            # Which one SciPy raises depends on its version.
            kind = type(matrix).__name__
            raise InputError(f"{name} is a {kind} without rmatvec or rows") from error

    return rows_of_operator


def _can_workers_fetch(client: Any, matrix: Any) -> bool:
    """True if workers can fetch rows: compute them (Dask), read files (zarr), or call `rows`."""
    from distributed import futures_of
    from distributed.protocol.pickle import dumps

    folder = getattr(getattr(matrix, "store", None), "root", None)
    if folder:
        return is_there(client, str(folder))
    if hasattr(matrix, "dask"):
        return not futures_of(matrix)
    if not hasattr(matrix, "rows"):
        return False
    # Whatever it holds may be impossible to send.
    with contextlib.suppress(Exception):
        return bool(dumps(matrix, buffer_callback=lambda buffer: False))
    return False


def interreflection_rows(T: SourceRows, F: np.ndarray) -> SourceRows:
    """R = T F^-1 - I by rows, computed in float64 and rounded once.

    The column of a masked pixel, F = 0, is 0.
    """
    is_lit = F > 0
    divisor = np.where(is_lit, F, np.inf)
    make_T = T.make

    def make(start: int, stop: int, fetched: Any) -> np.ndarray:
        rows = make_T(start, stop, fetched)
        rows = checks.finite(f"T in rows {start} to {stop - 1}", rows)
        block = rows / divisor
        row = np.arange(stop - start)
        block[row, start + row] -= is_lit[start:stop]
        return block.astype(np.float32)

    R = copy.copy(T)
    R.make = make
    return R


def rows_at_once(values: int, memory: int | None = None) -> int:
    """Number of rows of `values` numbers that fit into `memory` bytes, a multiple of `COLUMNS`.

    MemoryLimitError where not even `COLUMNS` rows fit.
    """
    if memory is None:
        memory = min(DEFAULT_BLOCK_BYTES, checks.host_memory() // 4)
    row_bytes = BYTES_PER_VALUE * max(values, 1)
    rows = min(memory // row_bytes, MAX_BLOCK_ROWS) // COLUMNS * COLUMNS
    if rows == 0:
        least = checks.size(COLUMNS * values * BYTES_PER_VALUE)
        raise MemoryLimitError(
            f"memory is {checks.size(memory)}; it must be at least {least}, "
            f"for {COLUMNS} rows of {values} numbers"
        )
    return rows


def cut(count: int, size: int) -> Iterator[tuple[int, int]]:
    """(start, stop) of blocks of `size`."""
    for start in range(0, count, size):
        yield start, min(start + size, count)
