# SPDX-License-Identifier: BSD-3-Clause
"""Operators whose rows lie elsewhere than on one device: on a disk, or on several devices.

A product brings x to the rows, and what they make of it back, through the host: with rows A_p of part p,

    A x = (A_1 x; A_2 x; ...),    A^T x = sum_p A_p^T x_p

`Streamed` has a device read its rows from a disk at each product, some megabytes at a time, threads reading
ahead while it works: k right-hand sides share one reading. `MultiDevice` keeps rows on every device of a
platform, as many as it is fast, and all work at once.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device, tuning, vectors
from ltcl.errors import FileError, MemoryLimitError
from ltcl.files import read_ahead
from ltcl.operators.base import Epilogue, Operator
from ltcl.operators.csr import CSR, Pattern, RowBlocks
from ltcl.operators.dense import Dense, slabs
from ltcl.operators.rows import ReadableRows, RowOperator

logger = logging.getLogger(__name__)
_READ = 1 << 22  # bytes of rows in one reading: what caches hold, while a disk is busy for long
_TRIAL = 4096  # rows and columns of the product by which devices are compared: beyond the caches


class Parts(Operator):
    """An operator (M, N) whose products arrive on the host; subclasses give `_gathered`.

    Methods that read rows on one device refuse it and say `where` the rows are.
    """

    where = "elsewhere"

    def _gathered(self, x: Array, transpose: bool) -> np.ndarray:
        """A x or A^T x, on the host, in the shape of the product."""
        raise NotImplementedError

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        a, b, y, c = epilogue
        product = out.like().set(self._gathered(x, transpose))
        vectors.axpby(a, product, b, product if y is None or not b else y, out)
        if c:
            vectors.axpy(c, x, out)


class Streamed(Parts, ReadableRows):
    """A matrix (M, N) on a disk, read at each product; host and device hold a few slabs of its rows.

    Parameters
    ----------
    matrix : numpy.memmap (M, N), or an array that looks at one; or an object with ``row_blocks()``
        Not changed afterwards. FileError at a product where the file of an array is gone or shorter.

    Examples
    --------
    >>> import ltcl, pathlib, tempfile
    >>> from ltcl.operators import Streamed
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "T.npy"
    >>> np.save(path, [[1.0, 2.0], [0.0, 3.0]])
    >>> T = Streamed(ltcl.open_device(), np.load(path, mmap_mode="r"))
    >>> (T @ np.array([1.0, 1.0])).tolist()
    [3.0, 3.0]
    """

    where = "on a disk"

    def __init__(self, device: Device, matrix: Any) -> None:
        super().__init__(device, matrix.shape)
        none, self.matrix = (0, matrix.shape[1]), matrix
        dense = isinstance(matrix, np.ndarray)
        self._slab = Dense(device, np.zeros(none)) if dense else CSR(device, scipy.sparse.csr_array(none))
        self._slab.shape = matrix.shape  # of which it has those rows that are on the device

    def arrays(self) -> set[Array]:
        """Of the slab that was used last."""
        return self._slab.arrays()

    def bytes_read(self) -> int:
        """Bytes of the matrix on the disk."""
        return int(self.matrix.nbytes)

    def blocks(self) -> Iterator[tuple[int, Any]]:
        """(first row, rows) in float64, read once."""
        for first, rows in row_blocks(self.matrix):
            yield first, rows.astype(np.float64)

    def product(self, x: np.ndarray, transpose: bool = False) -> np.ndarray:
        """A x or A^T x on the host, of x (N, k) float64, with the numbers of the file."""
        if not transpose:
            return np.concatenate([rows @ x for _, rows in self.blocks()])
        total = np.zeros((self.shape[1], x.shape[1]))
        for first, rows in self.blocks():
            total += rows.T @ x[first : first + rows.shape[0]]
        return total

    def _gathered(self, x: Array, transpose: bool) -> np.ndarray:
        shape = (self.shape[int(transpose)], *x.shape[1:])
        return self.product(x.get().reshape(x.shape[0], -1).astype(np.float64), transpose).reshape(shape)

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        dense = isinstance(self._slab, Dense)
        if transpose and not dense:  # sparse rows would have to be sorted by columns first
            super()._product(x, out, epilogue, True)
            return
        for first, rows in row_blocks(self.matrix):
            self._slab.slabs = []  # makes room
            if dense:
                self._slab.slabs = slabs(self.device, rows, first)
            else:
                self._slab.slabs = Pattern.of(self.device, rows).with_values(rows.data, first)
            self._slab._bound(x, out, epilogue, transpose)()
            if transpose:  # the following slabs add to what the first has written
                epilogue = Epilogue(epilogue.a, 1.0, out)


class MultiDevice(Parts, ReadableRows):
    """Rows of a matrix on several devices, whose products run at the same time.

    Parameters
    ----------
    device : Device
        Of the vectors.
    parts : sequence of RowOperator, (rows, N) each
        From the first row on, each on its own device.

    Examples
    --------
    >>> import ltcl
    >>> from ltcl.operators import Dense, MultiDevice
    >>> device = ltcl.open_device()
    >>> A = MultiDevice(device, [Dense(device, [[1.0, 2.0]]), Dense(device, [[0.0, 3.0]])])
    >>> (A @ np.array([1.0, 1.0])).tolist()
    [3.0, 3.0]
    """

    where = "on several devices"
    exact: tuple[Any, ...] | None = None  # as that of `Dense`

    def __init__(self, device: Device, parts: Sequence[RowOperator]) -> None:
        ends = np.cumsum([part.shape[0] for part in parts]).tolist()
        super().__init__(device, (ends[-1], parts[0].shape[1]), *parts)
        self.parts = list(zip([0, *ends], parts, strict=False))  # (first row, rows)

    def blocks(self) -> Iterator[tuple[int, Any]]:
        """Those of all parts."""
        for start, part in self.parts:
            for first, rows in part.blocks():
                yield start + first, rows

    def _gathered(self, x: Array, transpose: bool) -> np.ndarray:
        host, products = x.get(), []
        for first, part in self.parts:
            own = host[first : first + part.shape[0]] if transpose else host
            A = part.T if transpose else part
            products.append(A.apply(part.device.upload(own)))
            part.device.flush()
        results = [product.get() for product in products]
        return np.sum(results, axis=0) if transpose else np.concatenate(results)


def on_devices(device: Device, matrix: Any, pattern: Pattern | None = None) -> Operator:
    """An array or sparse matrix as `Dense` or `CSR`, over all devices where the device has others."""
    sparse = scipy.sparse.issparse(matrix)
    if not device.others:
        return CSR(device, matrix, pattern) if sparse else Dense(device, matrix)
    rows: Any = checks.csr("matrix", matrix) if sparse else checks.real("matrix", matrix)
    kind: Any = CSR if sparse else Dense
    A: Any = over_devices(device, rows.shape[0], lambda each, own: kind(each, rows[own]))
    A.exact = rows, np.ones(A.shape[1]), np.zeros(A.shape[1])
    return A


def over_devices(device: Device, rows: int, make: Callable[[Device, slice], RowOperator]) -> Operator:
    """What `make` puts on a device: all rows, or a share where there are other devices or ranks of MPI."""
    if (over_ranks := getattr(device, "over_ranks", None)) is not None:
        return over_ranks(rows, make)
    parts = [make(each, own) for each, own in shares(device, rows)]
    return parts[0] if len(parts) == 1 else MultiDevice(device, parts)


def shares(device: Device, rows: int) -> list[tuple[Device, slice]]:
    """The rows of each device, as many as it is fast; all of them where the device has no others."""
    devices = [device, *device.others]
    speeds = np.array([1.0 / _trial(each) for each in devices]) if device.others else np.ones(1)
    ends = np.rint(rows * np.cumsum(speeds) / speeds.sum()).astype(int).tolist()
    spans = zip(devices, [0, *ends], ends, strict=False)
    return [(each, slice(start, stop)) for each, start, stop in spans if stop > start]


def _trial(device: Device) -> float:
    """Seconds of a dense product, measured once per device and then remembered."""
    n = min(_TRIAL, int((device.max_allocation // 8) ** 0.5))
    A = Dense(device, np.ones((n, n), np.float32))
    name = f"dense product of {n} rows, {device.compute_units} units"
    return tuning.seconds(device, name, A.bind(device.empty(n), device.empty(n)))


def stays_on_disk(matrices: Sequence[Any], device: Device) -> bool:
    """Whether all `matrices` are on a disk, and their R in float32 would not fit the device or the host."""
    if not all(hasattr(T, "row_blocks") or isinstance(_root(T), np.memmap) for T in matrices):
        return False
    dense = [4 * T.size for T in matrices if isinstance(T, np.ndarray)]
    entries = sum(dense) + sum(8 * T.nnz for T in matrices if not isinstance(T, np.ndarray))
    copied = max(dense, default=0)  # on the host, before it is uploaded
    try:
        checks.fits_host("R", copied)
        for each in [device, *device.others]:
            each.require(entries // (1 + len(device.others)) + copied * each.is_cpu, "R")
    except MemoryLimitError as error:
        size = checks.size(sum(T.nbytes for T in matrices))
        logger.warning("T of %s stays on the disk and is read at each product: %s", size, error)
        return True
    return False


def row_blocks(matrix: Any) -> Iterator[tuple[int, Any]]:
    """(first row, rows) of an array or of what has `row_blocks`; those of a file are read ahead."""
    if hasattr(matrix, "row_blocks"):
        yield from matrix.row_blocks()
        return
    if scipy.sparse.issparse(matrix):
        yield 0, matrix
        return
    read, count = _reader(matrix), max(1, _READ // (matrix.itemsize * matrix.shape[1]))
    starts = range(0, matrix.shape[0], count)
    yield from zip(starts, read_ahead(lambda start: read(start, start + count), starts), strict=True)


def _reader(matrix: np.ndarray) -> Callable[[int, int], np.ndarray]:
    """Rows start .. stop - 1; of a mapped file by reading, as page faults are several times slower."""
    root = _root(matrix)
    name = getattr(root, "filename", None)
    if name is None or root.mode == "c" or not matrix.flags.c_contiguous:
        return lambda start, stop: matrix[start:stop]
    width, dtype, path = matrix.shape[1], matrix.dtype, Path(name)
    address = (array.__array_interface__["data"][0] for array in (matrix, root))
    offset = root.offset + next(address) - next(address)

    def read(start: int, stop: int) -> np.ndarray:
        count = (min(stop, matrix.shape[0]) - start) * width
        try:
            values = np.fromfile(path, dtype, count, offset=offset + start * width * dtype.itemsize)
        except OSError as error:
            raise FileError(f"{path}: cannot be read: {error.strerror}") from error
        except MemoryError as error:
            raise MemoryLimitError(f"{path}: {error}") from error
        if values.size < count:
            raise FileError(f"{path}: has become shorter; it must stay as it is while T is used")
        return values.reshape(-1, width)

    return read


def _root(array: Any) -> Any:
    """The array that others look at."""
    while isinstance(getattr(array, "base", None), np.ndarray):
        array = array.base
    return array


def stored_rows(
    device: Device, matrix: Any, change: Callable[[int, Any], Any] = lambda first, rows: rows, more: int = 0
) -> Operator:
    """The rows of a store on a device or several, after `change` of (first row, rows), `more` entries."""

    def make(on: Device, own: slice) -> RowBlocks:
        def blocks() -> Iterator[tuple[int, Any]]:
            for first, rows in matrix.row_blocks():
                start, stop = max(own.start - first, 0), min(own.stop - first, rows.shape[0])
                if start < stop:
                    yield first + start - own.start, change(first, rows)[start:stop]

        count = own.stop - own.start
        return RowBlocks(on, (count, N), blocks, (matrix.nnz + more) * count // M)

    M, N = matrix.shape
    return over_devices(device, M, make)
