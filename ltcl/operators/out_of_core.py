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
from ltcl.operators.base import Epilogue
from ltcl.operators.csr import CSR
from ltcl.operators.parts import Parts, upload_part
from ltcl.operators.rows import ReadableRows

READ_BYTES = 1 << 22  # of rows in a reading, which caches hold
READS_AHEAD = 2


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
        slab = upload_part(device, none)
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


def stays_on_disk(matrices: Sequence[Any], device: Device) -> bool:
    """Whether all `matrices` are on a disk, and their R in float32 would not fit the device or the host."""
    for T in matrices:
        is_mapped = isinstance(underlying_array(check_mapped_file(T)), np.memmap)
        if not is_mapped and not hasattr(T, "row_blocks"):
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
    rows = max(1, READ_BYTES // (matrix.itemsize * matrix.shape[1]))
    return read_ahead(_reader(matrix, rows), range(0, matrix.shape[0], rows), READS_AHEAD)


def _reader(matrix: np.ndarray, rows: int) -> Callable[[int], tuple[int, np.ndarray]]:
    """Reads some rows from one on; of a mapped file not by page faults, which are several times slower."""
    root, (height, width) = underlying_array(matrix), matrix.shape
    path = getattr(root, "filename", None)
    if path is None or root.mode == "c" or not matrix.flags.c_contiguous:
        return lambda first: (first, matrix[first : first + rows])
    offset = root.offset + matrix.ctypes.data - root.ctypes.data
    checks.fits_host(f"{path}: reading it", (READS_AHEAD + 1) * rows * width * matrix.itemsize)
    # In turn, as new memory takes as long as reading: rows are valid until the third reading after
    # them.
    buffers = np.empty((READS_AHEAD + 1, rows * width), matrix.dtype)

    def read(first: int) -> tuple[int, np.ndarray]:
        values = buffers[first // rows % len(buffers), : min(rows, height - first) * width]
        try:
            with open(path, "rb") as file:
                file.seek(offset + first * width * matrix.itemsize)
                size = file.readinto(values.data)
        except OSError as error:
            raise FileError(f"{path}: cannot be read: {error.strerror}") from error
        if size < values.nbytes:
            check_mapped_file(matrix)
        return first, values.reshape(-1, width)

    return read
