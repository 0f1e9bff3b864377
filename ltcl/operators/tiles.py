# SPDX-License-Identifier: BSD-3-Clause
"""Sparse matrices as rows of tiles of narrow numbers, y = A x by `kernels/tile.cl`.

A tile is 1 or 8 neighbouring columns of one row: with numbers of 8 or 16 bits and one column index of 16 bits
for all of them, an entry takes 1.4 to 6 bytes where compressed sparse rows take 8. Sums are float32.

A transposed product uses A^T in tiles of its own, made of the same rounded numbers at the first one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.device import Device
from ltcl.operators.packing import PRECISIONS, Packed, pack
from ltcl.operators.rows import RowOperator, Slab, cut, largest


class Tiles(RowOperator):
    """A sparse (M, N) matrix in tiles on the device.

    Parameters
    ----------
    device : Device
    matrix : scipy.sparse matrix or array, or array, (M, N)
        Checked before anything is uploaded. Or what `ltcl.operators.packing.pack` made of one.
    width : 1 or 8
        Neighbouring columns of a tile, which begins where the nonzeros do; 1 is for scattered ones.
    precision : str
        "float32", "float16" (11 significant bits) or "int8" (7, with a scale a tile).

    Attributes
    ----------
    quantisation : float
        Frobenius norm of what rounding changed, in float64.
    error : float
        Bound on its 2-norm.

    Raises
    ------
    InputError
        Another width or precision, column indices out of range, NaN, values that are infinite in float32.
    MemoryLimitError
        More than the device holds; said before anything is allocated.

    Examples
    --------
    >>> import ltcl, numpy, scipy.sparse
    >>> from ltcl.operators import Tiles
    >>> A = Tiles(ltcl.open_device(), scipy.sparse.csr_array([[1.0, 2.0], [0.0, 3.01]]), 1, "float16")
    >>> (A @ numpy.array([1.0, 1.0])).tolist(), round(A.quantisation, 4)
    ([3.0, 3.009765625], 0.0002)
    """

    file = "tile"

    def __init__(self, device: Device, matrix: Any, width: int = 8, precision: str = "float16") -> None:
        self.packed = matrix if isinstance(matrix, Packed) else pack(matrix, width, precision)
        super().__init__(device, self.packed.shape)
        device.require(self.packed.nbytes, f"a matrix of {self.packed.codes.size} numbers in tiles")
        self.quantisation, self.error = self.packed.difference
        self.frobenius = self.packed.frobenius()
        self.defines = {"WIDTH": self.width, "VALUES": list(PRECISIONS).index(self.precision)}
        if self.packed.columns.itemsize == 4:
            self.defines["LONG"] = 1
        self.unit = self.packed.unit
        self.slabs = [self._slab(start, stop) for start, stop in _cuts(self.packed, device)]

    def _slab(self, start: int, stop: int) -> Slab:
        packed, upload = self.packed, self.device.upload
        pointers = packed.pointers[start : stop + 1]
        tiles = slice(pointers[0], pointers[-1])
        columns, codes = (upload(array[tiles], array.dtype) for array in (packed.columns, packed.codes))
        # Not read where there are none, but a kernel needs a buffer.
        scales = upload(packed.scales[tiles], np.uint8) if packed.scales.size else columns
        counts = upload(pointers - pointers[0], np.int32)
        return Slab(start, stop - start, (counts, columns, codes, scales))

    @property
    def width(self) -> int:
        """Neighbouring columns of a tile; fewer than asked for where the matrix has not so many."""
        return self.packed.width

    @property
    def precision(self) -> str:
        """Of the numbers."""
        return self.packed.precision

    def matrix(self) -> scipy.sparse.csr_array:
        """What it stands for: (M, N) float64, exact."""
        return self.packed.matrix()

    def blocks(self) -> Iterator[tuple[int, Any]]:
        """What it stands for, in one."""
        yield 0, self.matrix()

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Plain arrays, of which `from_arrays` makes the same again, to the bit."""
        return self.packed.to_arrays()

    @classmethod
    def from_arrays(cls, device: Device, arrays: Mapping[str, np.ndarray]) -> Tiles:
        """Of what `to_arrays` gave; what does not fit together is refused."""
        return cls(device, Packed.from_arrays(arrays))

    def _transposed_rows(self) -> Tiles:
        return Tiles(self.device, self.packed.transposed())


def _cuts(packed: Packed, device: Device) -> list[tuple[int, int]]:
    """Rows of the slabs: pointers, columns and values of each fit a buffer and are counted in 32 bits."""
    size = packed.codes.itemsize
    row_bytes = np.maximum(max(packed.width * size, packed.columns.itemsize) * np.diff(packed.pointers), 4)
    return cut(row_bytes, largest(device, size) - 4, "the matrix of tiles")  # one pointer more than rows
