# SPDX-License-Identifier: BSD-3-Clause
"""A matrix on a disk that is read at each product.

A device reads some megabytes of rows at a time while threads read ahead: k right-hand sides share
one reading.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from logging import getLogger
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.errors import FileError, MemoryLimitError
from ltcl.files import check_mapped_file, read_ahead, underlying_array
from ltcl.operators.csr import CSR
from ltcl.operators.epilogue import Epilogue
from ltcl.operators.knowledge import Float64Form
from ltcl.operators.parts import Parts, upload_part
from ltcl.operators.rows import ReadableRows

# Bytes of rows in one reading, which caches hold.
READ_BYTES = 1 << 22
# Readings at the same time.
READS_AHEAD = 2


class Streamed(Parts, ReadableRows):
    """A matrix (M, N) on a disk, read at each product; host and device hold a few slabs of rows.

    Parameters
    ----------
    device : Device
    matrix : numpy.memmap (M, N), a view of one, or an object with ``row_blocks()``
        Not changed afterwards.

    Raises
    ------
    FileError
        At a product, if the file of an array is gone or shorter.

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
        if isinstance(matrix, np.ndarray):
            no_rows = matrix[:0]
        else:
            no_rows = scipy.sparse.csr_array((0, matrix.shape[1]))
        slab = upload_part(device, no_rows)
        super().__init__(device, matrix.shape, slab)
        self.matrix = matrix
        # An operator of the whole shape that has the rows which are on the device.
        self._slab = slab
        slab.shape = matrix.shape

    def bytes_read(self) -> int:
        """Bytes of the matrix on the disk."""
        return int(self.matrix.nbytes)

    def blocks(self) -> Iterator[tuple[int, Any]]:
        """(first row, rows) in float64, read once."""
        for first, rows in row_blocks(self.matrix):
            yield first, rows.astype(np.float64)

    def product(self, x: np.ndarray, transpose: bool = False) -> np.ndarray:
        """A x or A^T x on the host, for x (N, k) float64, with the numbers of the file."""
        if not transpose:
            return np.concatenate([rows @ x for _, rows in self.blocks()])
        total = np.zeros((self.shape[1], x.shape[1]))
        for first, rows in self.blocks():
            total = total + rows.T @ x[first : first + rows.shape[0]]
        return total

    def _float64_form(self, *, reads_blocks: bool = False) -> Float64Form | None:
        return Float64Form(matrix=self)

    def _host_product(self, x: Array, transpose: bool) -> np.ndarray:
        operand = x.get().reshape(x.shape[0], -1)
        return self.product(operand.astype(np.float64), transpose)

    def _queue_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        if transpose and isinstance(self._slab, CSR):
            # On the device rows would have to be sorted by columns first.
            super()._queue_product(x, out, epilogue, True)
            return
        for first, rows in row_blocks(self.matrix):
            # Rows of the last reading make room.
            self._slab.slabs = []
            self._slab.slabs = self._slab.upload(rows, first)
            self._slab._queue_product(x, out, epilogue, transpose)
            if transpose:
                # The following rows add to what the first have written.
                epilogue = epilogue.added_to(out)


def stays_on_disk(matrices: Sequence[Any], device: Device) -> bool:
    """True if all `matrices` are on a disk, and their R in float32 would not fit device or host."""
    for matrix in matrices:
        is_mapped = isinstance(underlying_array(check_mapped_file(matrix)), np.memmap)
        if not is_mapped and not hasattr(matrix, "row_blocks"):
            return False
    try:
        _check_room(matrices, device)
    except MemoryLimitError as error:
        nbytes = sum(matrix.nbytes for matrix in matrices)
        getLogger(__name__).warning(
            "T of %s stays on the disk and is read at each product: %s", checks.size(nbytes), error
        )
        return True
    return False


def _check_room(matrices: Sequence[Any], device: Device) -> None:
    """Refuse matrices whose R in float32 does not fit the devices, or the host while it is made."""
    nbytes = 0
    # A dense matrix is copied on the host before it is uploaded.
    copied = 0
    for matrix in matrices:
        if isinstance(matrix, np.ndarray):
            nbytes += 4 * matrix.size
            copied = max(copied, 4 * matrix.size)
        else:
            nbytes += 8 * matrix.nnz
    checks.fits_host("R", copied)
    devices = [device, *device.others]
    for part_device in devices:
        share = nbytes // len(devices)
        if part_device.is_cpu:
            share += copied
        part_device.require(share, "R")


def row_blocks(matrix: Any) -> Iterator[tuple[int, Any]]:
    """(first row, rows) of an array, a sparse matrix or a store; rows of a file are read ahead."""
    if hasattr(matrix, "row_blocks"):
        return matrix.row_blocks()
    if scipy.sparse.issparse(matrix):
        return iter([(0, matrix)])
    rows = max(1, READ_BYTES // (matrix.itemsize * matrix.shape[1]))
    return read_ahead(_reader(matrix, rows), range(0, matrix.shape[0], rows), READS_AHEAD)


def _reader(matrix: np.ndarray, rows: int) -> Callable[[int], tuple[int, np.ndarray]]:
    """A function that reads `rows` rows from one on."""
    root = underlying_array(matrix)
    path = getattr(root, "filename", None)
    is_file = path is not None and root.mode != "c"
    if is_file and matrix.flags.c_contiguous:
        return MappedRowsReader(matrix, rows).read
    return lambda first: (first, matrix[first : first + rows])


class MappedRowsReader:
    """Reads rows of a mapped file by calls: page faults are several times slower.

    It reads into a few buffers in turn, as new memory takes as long as reading: rows are valid
    until the third reading after them.
    """

    def __init__(self, matrix: np.ndarray, rows: int) -> None:
        root = underlying_array(matrix)
        height, width = matrix.shape
        self._matrix = matrix
        self._path = root.filename
        self._offset = root.offset + matrix.ctypes.data - root.ctypes.data
        self._rows = rows
        self._height = height
        self._width = width
        count = READS_AHEAD + 1
        checks.fits_host(f"{self._path}: reading it", count * rows * width * matrix.itemsize)
        self._buffers = np.empty((count, rows * width), matrix.dtype)

    def read(self, first: int) -> tuple[int, np.ndarray]:
        """(first row, rows)."""
        turn = first // self._rows % len(self._buffers)
        count = min(self._rows, self._height - first)
        values = self._buffers[turn, : count * self._width]
        try:
            with open(self._path, "rb") as file:
                file.seek(self._offset + first * self._width * self._matrix.itemsize)
                size = file.readinto(values.data)
        except OSError as error:
            raise FileError(f"{self._path}: cannot be read: {error.strerror}") from error
        if size < values.nbytes:
            check_mapped_file(self._matrix)
        return first, values.reshape(-1, self._width)
