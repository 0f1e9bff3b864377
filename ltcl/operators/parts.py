# SPDX-License-Identifier: BSD-3-Clause
"""Operators whose rows lie elsewhere than on one device: on a disk, or on several devices.

A product brings x to the rows, and what they make of it back, through the host: with rows A_p of
part p,

    A x = (A_1 x; A_2 x; ...),    A^T x = sum_p A_p^T x_p

`Streamed` has a device read its rows from a disk at each product, some megabytes at a time, threads
reading ahead while it works: k right-hand sides share one reading. `MultiDevice` keeps rows on
every device of a platform, as many as it is fast, and all work at once.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from logging import getLogger
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device, tuning, vectors
from ltcl.errors import FileError, MemoryLimitError
from ltcl.files import read_ahead
from ltcl.operators.base import Epilogue, Operator
from ltcl.operators.csr import CSR, Pattern, RowBlocks
from ltcl.operators.dense import Dense
from ltcl.operators.rows import ReadableRows, RowOperator

_READ, _AHEAD = (
    1 << 22,
    2,
)  # bytes of rows in a reading, which caches hold; readings at the same time
_TRIAL = 4096  # rows and columns of the product by which devices are compared: beyond the caches


class Parts(Operator):
    """An operator (M, N) whose products arrive on the host; subclasses give `_gathered`.

    Methods that read rows on one device refuse it and say `where` the rows are.
    """

    where: str
    exact: tuple[Any, ...] | None = None  # as that of `Dense`
    _gathered: Callable[[Array, bool], np.ndarray]  # A x or A^T x, on the host

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        a, b, y, c = epilogue.without_shift(x)
        product = out.like().set(self._gathered(x, transpose).reshape(out.shape))
        vectors.axpby(a, product, b, product if y is None or not b else y, out)
        if c:
            vectors.axpy(c, x, out)


class Streamed(Parts, ReadableRows):
    """A matrix (M, N) on a disk, read at each product; host and device hold a few slabs of its rows.

    Parameters
    ----------
    matrix : numpy.memmap (M, N), or an array that looks at one; or an object with ``row_blocks()``
        Not changed afterwards. FileError at a product where the file of an array is gone or
        shorter.

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
        none = (
            matrix[:0]
            if isinstance(matrix, np.ndarray)
            else scipy.sparse.csr_array((0, matrix.shape[1]))
        )
        slab = on_device(device, none)
        super().__init__(device, matrix.shape, slab)
        self.matrix, self._slab = matrix, slab
        slab.shape = matrix.shape  # of which it has those rows that are on the device

    def bytes_read(self) -> int:
        """Bytes of the matrix on the disk."""
        return int(self.matrix.nbytes)

    def blocks(self) -> Iterator[tuple[int, Any]]:
        """(first row, rows) in float64, read once."""
        return ((first, rows.astype(np.float64)) for first, rows in row_blocks(self.matrix))

    def product(self, x: np.ndarray, transpose: bool = False) -> np.ndarray:
        """A x or A^T x on the host, of x (N, k) float64, with the numbers of the file."""
        if not transpose:
            return np.concatenate([rows @ x for _, rows in self.blocks()])
        products = (rows.T @ x[first : first + rows.shape[0]] for first, rows in self.blocks())
        return sum(products, np.zeros((self.shape[1], x.shape[1])))

    def _gathered(self, x: Array, transpose: bool) -> np.ndarray:
        return self.product(x.get().reshape(x.shape[0], -1).astype(np.float64), transpose)

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        if transpose and isinstance(
            self._slab, CSR
        ):  # rows would have to be sorted by columns first
            super()._product(x, out, epilogue, True)
            return
        for first, rows in row_blocks(self.matrix):
            self._slab.slabs = []  # makes room
            self._slab.slabs = self._slab.upload(rows, first)
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

    def __init__(self, device: Device, parts: Sequence[RowOperator]) -> None:
        ends = np.cumsum([part.shape[0] for part in parts]).tolist()
        super().__init__(device, (ends[-1], parts[0].shape[1]), *parts)
        self.parts = list(zip([0, *ends], parts, strict=False))  # (first row, rows)

    def blocks(self) -> Iterator[tuple[int, Any]]:
        """Those of all parts."""
        return (
            (start + first, rows) for start, part in self.parts for first, rows in part.blocks()
        )

    def _gathered(self, x: Array, transpose: bool) -> np.ndarray:
        host, products = x.get(), []
        for first, part in self.parts:
            own = host[first : first + part.shape[0]] if transpose else host
            A = part.T if transpose else part
            products.append(A.apply(part.device.upload(own)))
            part.device.flush()
        results = [product.get() for product in products]
        return np.sum(results, axis=0) if transpose else np.concatenate(results)


def on_devices(
    device: Device,
    matrix: Any,
    change: Callable[[int, Any], Any] = lambda first, rows: rows,
    pattern: Pattern | None = None,
    more: int = 0,
) -> Any:
    """An array, a sparse matrix or a store, after `change` of (first row, rows), on a device and its others.

    Rows of a store are uploaded block by block; `change` may give them so many `more` entries.
    """
    if not (stored := hasattr(matrix, "row_blocks")):
        if not device.others:
            return on_device(device, change(0, matrix), pattern)
        check: Any = checks.csr if scipy.sparse.issparse(matrix) else checks.real
        matrix = check("matrix", matrix)

    def make(on: Device, own: slice) -> RowOperator:
        if not stored:
            return on_device(on, change(own.start, matrix[own]))

        def blocks() -> Iterator[tuple[int, Any]]:
            for first, rows in matrix.row_blocks():
                start, stop = max(own.start - first, 0), min(own.stop - first, rows.shape[0])
                if start < stop:
                    yield first + start - own.start, change(first, rows)[start:stop]

        M, N, count = *matrix.shape, own.stop - own.start
        return RowBlocks(on, (count, N), blocks, (matrix.nnz + more) * count // M)

    A: Any = over_devices(device, matrix.shape[0], make)
    if not stored:
        A.exact = matrix, np.ones(A.shape[1]), np.zeros(A.shape[1])
    return A


def on_device(device: Device, matrix: Any, pattern: Pattern | None = None) -> CSR | Dense:
    """A sparse matrix as `CSR`, an array as `Dense`."""
    return CSR(device, matrix, pattern) if scipy.sparse.issparse(matrix) else Dense(device, matrix)


def over_devices(
    device: Device, rows: int, make: Callable[[Device, slice], RowOperator]
) -> Operator:
    """What `make` puts on a device: all rows, or of several devices or ranks as many as each is fast."""
    if (over_ranks := getattr(device, "over_ranks", None)) is not None:
        return over_ranks(rows, make)
    devices = [device, *device.others]
    speeds = np.array([1.0 / _trial(each) for each in devices]) if device.others else np.ones(1)
    ends = np.rint(rows * np.cumsum(speeds) / speeds.sum()).astype(int).tolist()
    spans = zip(devices, map(slice, [0, *ends], ends), strict=False)
    parts = [make(each, own) for each, own in spans if own.stop > own.start]
    return parts[0] if len(parts) == 1 else MultiDevice(device, parts)


def _trial(device: Device) -> float:
    """Seconds of a dense product, measured once per device and then remembered."""
    n = min(_TRIAL, int((device.max_allocation // 8) ** 0.5))
    A = Dense(device, np.ones((n, n), np.float32))
    name = f"dense product of {n} rows, {device.compute_units} units"
    return tuning.seconds(device, name, A.bind(device.empty(n), device.empty(n)))


def stays_on_disk(matrices: Sequence[Any], device: Device) -> bool:
    """Whether all `matrices` are on a disk, and their R in float32 would not fit the device or the host."""
    if not all(
        hasattr(T, "row_blocks") or isinstance(_root(intact(T)), np.memmap) for T in matrices
    ):
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
        getLogger(__name__).warning(
            "T of %s stays on the disk and is read at each product: %s", size, error
        )
        return True
    return False


def row_blocks(matrix: Any) -> Iterator[tuple[int, Any]]:
    """(first row, rows) of an array or of what has `row_blocks`; those of a file are read ahead."""
    if hasattr(matrix, "row_blocks"):
        return matrix.row_blocks()
    if scipy.sparse.issparse(matrix):
        return iter([(0, matrix)])
    rows = max(1, _READ // (matrix.itemsize * matrix.shape[1]))
    return read_ahead(_reader(matrix, rows), range(0, matrix.shape[0], rows), _AHEAD)


def intact(array: Any) -> Any:
    """`array`; FileError where it is mapped to a file that is shorter by now: reading ends the process."""
    root = _root(array)
    path = getattr(root, "filename", None)
    if (
        path is not None
        and os.path.exists(path)
        and os.path.getsize(path) < root.offset + root.nbytes
    ):
        raise FileError(f"{path}: has become shorter; it must stay as it is while T is used")
    return array


def _reader(matrix: np.ndarray, rows: int) -> Callable[[int], tuple[int, np.ndarray]]:
    """Reads some rows from one on; of a mapped file not by page faults, which are several times slower."""
    root, (height, width) = _root(matrix), matrix.shape
    path = getattr(root, "filename", None)
    if path is None or root.mode == "c" or not matrix.flags.c_contiguous:
        return lambda first: (first, matrix[first : first + rows])
    offset = root.offset + matrix.ctypes.data - root.ctypes.data
    checks.fits_host(f"{path}: reading it", (_AHEAD + 1) * rows * width * matrix.itemsize)
    # In turn, as new memory takes as long as reading: rows are valid until the third reading after
    # them.
    buffers = np.empty((_AHEAD + 1, rows * width), matrix.dtype)

    def read(first: int) -> tuple[int, np.ndarray]:
        values = buffers[first // rows % len(buffers), : min(rows, height - first) * width]
        try:
            with open(path, "rb") as file:
                file.seek(offset + first * width * matrix.itemsize)
                size = file.readinto(values.data)
        except OSError as error:
            raise FileError(f"{path}: cannot be read: {error.strerror}") from error
        if size < values.nbytes:
            intact(matrix)
        return first, values.reshape(-1, width)

    return read


def _root(array: Any) -> Any:
    """The array that others look at."""
    while isinstance(getattr(array, "base", None), np.ndarray):
        array = array.base
    return array
