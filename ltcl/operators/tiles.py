# SPDX-License-Identifier: BSD-3-Clause
"""Sparse matrices as rows of tiles of narrow numbers, y = A x by `kernels/tile.cl`.

A tile is 1, 8 or 16 neighbouring columns of one row: with numbers of 8 or 16 bits and one place of 16 bits
for all of them, an entry takes 1.1 to 4 bytes where compressed sparse rows take 8. Sums are float32.

A transposed product uses A^T in tiles of its own, made of the same rounded numbers at the first one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.operators import slabs
from ltcl.operators.base import Norms
from ltcl.operators.narrow import PRECISIONS
from ltcl.operators.packing import Packed, pack
from ltcl.operators.rows import RowOperator, Slab


class Tiles(RowOperator):
    """A sparse (M, N) matrix in tiles on the device.

    Parameters
    ----------
    device : Device
    matrix : scipy.sparse matrix or array, or array, (M, N)
        Checked before anything is uploaded. Or what `ltcl.operators.packing.pack` made of one.
    width : 1, 8 or 16
        Neighbouring columns of a tile, which begins where the nonzeros do; 1 is for scattered ones.
    precision : str
        "float32", "bfloat16" (8 significant bits), "float16" (11) or "int8" (7, with a scale a tile).

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
    >>> A = Tiles(ltcl.open_device(), scipy.sparse.csr_array([[1.0, 2.0], [0.0, 3.01]]), 1, "bfloat16")
    >>> (A @ numpy.array([1.0, 1.0])).tolist(), round(A.quantisation, 4)
    ([3.0, 3.015625], 0.0056)
    """

    file = "tile"

    def __init__(self, device: Device, matrix: Any, width: int = 8, precision: str = "bfloat16") -> None:
        self.packed = matrix if isinstance(matrix, Packed) else pack(matrix, width, precision)
        super().__init__(device, self.packed.shape)
        device.require(self.packed.nbytes, f"a matrix of {self.packed.stored.codes.size} numbers in tiles")
        self.quantisation, self.error = self.packed.difference
        self.defines = _defines(self.packed)
        self.slabs = [self._slab(start, stop) for start, stop in _cuts(self.packed, slabs.largest(device))]
        self._transposed_copy: Tiles | None = None

    def _slab(self, start: int, stop: int) -> Slab:
        packed, pages = self.packed, self.packed.layout.pages
        pointers = packed.pointers[start * pages : stop * pages + 1]
        tiles = slice(pointers[0], pointers[-1])
        counts = self.device.upload(pointers - pointers[0], np.int32)
        starts, codes = (
            self.device.upload(array[tiles], array.dtype) for array in (packed.starts, packed.stored.codes)
        )
        scales = packed.stored.scales
        # Not read where there are none, but a kernel needs a buffer.
        scales = self.device.upload(scales[tiles], np.uint8) if scales.size else starts
        return Slab(start, stop - start, (packed.layout.last(self.shape[1]), counts, starts, codes, scales))

    @property
    def width(self) -> int:
        """Neighbouring columns of a tile; fewer than asked for where the matrix has not so many."""
        return self.packed.layout.width

    @property
    def precision(self) -> str:
        """Of the numbers."""
        return self.packed.stored.precision

    @property
    def nbytes(self) -> int:
        """Bytes on the device, those of the transpose included once it was asked for."""
        pointers = 4 * (len(self.slabs) - 1)  # each further slab has one more
        turned = self._transposed_copy.nbytes if self._transposed_copy is not None else 0
        return self.packed.nbytes + pointers + turned

    def matrix(self) -> scipy.sparse.csr_array:
        """What it stands for: (M, N) float64, exact."""
        return self.packed.matrix()

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),) float64."""
        return self.matrix().diagonal()

    def parts(self, places: Iterable[tuple[slice, slice]]) -> Iterator[np.ndarray]:
        """Dense float64 copies of the places (rows, columns)."""
        matrix = self.matrix()
        for rows, columns in places:
            yield matrix[rows, columns].toarray()

    def norms(self) -> Norms:
        """Norms of what it stands for."""
        matrix = self.matrix()
        absolute = abs(matrix)
        return Norms(
            one=float(np.max(absolute.sum(axis=0), initial=0.0)),
            inf=float(np.max(absolute.sum(axis=1), initial=0.0)),
            frobenius=float(np.linalg.norm(matrix.data)),
            lowest=float(np.min(matrix.data, initial=0.0)),
        )

    def to_dense(self) -> np.ndarray:
        """The whole matrix that it stands for, (M, N) float64, on the host."""
        checks.fits_host(f"a dense matrix {self.shape}", 8 * self.shape[0] * self.shape[1])
        return self.matrix().toarray()

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Plain arrays, of which `from_arrays` makes the same again, to the bit."""
        return self.packed.to_arrays()

    @classmethod
    def from_arrays(cls, device: Device, arrays: Mapping[str, np.ndarray]) -> Tiles:
        """Of what `to_arrays` gave; what does not fit together is refused."""
        return cls(device, Packed.from_arrays(arrays))

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        tiles = self.transposed_copy() if transpose else self
        tiles._forward(x, out, scale * tiles.packed.stored.unit, add)

    def transposed_copy(self) -> Tiles:
        """A^T in tiles of its own, made at the first call."""
        if self._transposed_copy is None:
            self._transposed_copy = Tiles(self.device, self.packed.transposed())
        return self._transposed_copy


def _defines(packed: Packed) -> dict[str, int]:
    layout = packed.layout
    chosen = {
        "LONG": 1 if layout.long else None,
        "GRANULE": layout.granule if layout.granule > 1 else None,
        "PAGES": layout.pages if layout.pages > 1 else None,
    }
    defines = {name: value for name, value in chosen.items() if value is not None}
    return {"WIDTH": layout.width, "VALUES": PRECISIONS[packed.stored.precision].number, **defines}


def _cuts(packed: Packed, limit: int) -> list[tuple[int, int]]:
    """Rows of the slabs: pointers, places and values of each fit a buffer and are counted in 32 bits."""
    layout, size = packed.layout, packed.stored.codes.itemsize
    tiles = np.diff(packed.pointers[:: layout.pages])
    per_tile = max(layout.width * size, packed.starts.itemsize)
    row_bytes = np.maximum(per_tile * tiles, 4 * layout.pages)
    most = min(limit - 4, size * ((1 << 31) - 4096))  # there is one pointer more than rows
    return slabs.cut(row_bytes, most, "the matrix of tiles")
