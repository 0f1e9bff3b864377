# SPDX-License-Identifier: BSD-3-Clause
"""Compressed sparse rows: float32 values, 32-bit column indices, y = A x by `kernels/csr.cl`.

A transposed product uses A^T in the same format, made at the first one: twice the memory, but the
same bits at every call, which scattered additions would not give.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.operators.rows import RowOperator, Slab, cut

Blocks = Callable[[], Iterator[tuple[int, Any]]]
_SLAB = 1 << 26  # bytes: smaller blocks are joined, since each slab is a launch


@dataclass(frozen=True, eq=False)
class Pattern:
    """Where the nonzeros are: pointers from 0 and columns of each slab, which channels may share."""

    device: Device
    shape: tuple[int, int]
    indptr: np.ndarray  # (M + 1,) int64
    indices: np.ndarray | None  # (nnz,); None where the host does not keep them
    cuts: list[tuple[int, int]]
    slabs: list[tuple[Array, Array]]

    @classmethod
    def of(cls, device: Device, matrix: Any) -> Pattern:
        """That of a checked `csr_array`, uploaded."""
        indptr, upload = matrix.indptr.astype(np.int64), device.upload
        row_bytes = np.maximum(4 * np.diff(indptr), 4)  # pointers weigh as much as one nonzero
        cuts = cut(device, row_bytes, "the sparse matrix")
        slabs = []
        for start, stop in cuts:
            pointers = indptr[start : stop + 1]
            columns = matrix.indices[pointers[0] : pointers[-1]]
            slabs.append((upload(pointers - pointers[0], np.int32), upload(columns, np.int32)))
        return cls(device, matrix.shape, indptr, matrix.indices, cuts, slabs)

    def with_values(self, data: np.ndarray, first: int = 0) -> list[Slab]:
        """The slabs of a matrix of this pattern with values `data` (nnz,), from row `first` on."""
        slabs = []
        for (start, stop), places in zip(self.cuts, self.slabs, strict=True):
            values = self.device.upload(data[self.indptr[start] : self.indptr[stop]])
            slabs.append(Slab(first + start, stop - start, (*places, values)))
        return slabs

    def matches(self, matrix: Any) -> bool:
        """Whether `matrix` has its nonzeros in the same places, as far as the host can tell."""
        if self.indices is None or self.shape != matrix.shape or len(self.indices) != matrix.nnz:
            return False
        same = self.indices is matrix.indices or np.array_equal(self.indices, matrix.indices)
        return same and np.array_equal(self.indptr, matrix.indptr)


class CSR(RowOperator):
    """A sparse (M, N) matrix on the device.

    Parameters
    ----------
    matrix : scipy.sparse matrix or array, (M, N)
        InputError where it is malformed or not finite, MemoryLimitError where the device has no
        room for it.
    pattern : Pattern, optional
        That of another channel; shared where the nonzeros are in the same places.

    Examples
    --------
    >>> import ltcl, numpy, scipy.sparse
    >>> from ltcl.operators import CSR
    >>> A = CSR(ltcl.open_device(), scipy.sparse.csr_array([[1.0, 2.0], [0.0, 3.0]]))
    >>> (A @ numpy.array([1.0, 1.0])).tolist()
    [3.0, 3.0]
    """

    file = "csr"

    def __init__(self, device: Device, matrix: Any, pattern: Pattern | None = None) -> None:
        matrix = checks.csr("matrix", matrix)
        super().__init__(device, matrix.shape)
        shared = pattern is not None and pattern.device is device and pattern.matches(matrix)
        device.require(
            matrix.nnz * (4 if shared else 8), f"a sparse matrix of {matrix.nnz} nonzeros"
        )
        self.pattern = pattern if pattern is not None and shared else Pattern.of(device, matrix)
        self.slabs = self.pattern.with_values(matrix.data)
        self.nnz: int = matrix.nnz
        self._host = matrix

    def upload(self, rows: Any, first: int) -> list[Slab]:
        """Slabs of rows from `first` on, with a pattern of their own."""
        return Pattern.of(self.device, rows).with_values(rows.data, first)

    @property
    def data(self) -> np.ndarray:
        """The values on the host, (nnz,)."""
        return self._host.data

    def blocks(self) -> Iterator[tuple[int, Any]]:
        """The whole matrix."""
        yield 0, self._host.astype(np.float64)

    def matrix(self) -> scipy.sparse.csr_array:
        """What it stands for: (M, N), float32 values on the host."""
        return scipy.sparse.csr_array(self._host.astype(np.float32))

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Plain arrays, of which `from_arrays` makes the same again, to the bit."""
        return {
            "shape": np.array(self.shape, np.int64),
            "data": self.data.astype(np.float32),
            "indices": self._host.indices.astype(np.int32),
            "indptr": self.pattern.indptr,
        }

    @classmethod
    def from_arrays(
        cls, device: Device, arrays: Mapping[str, np.ndarray], pattern: Pattern | None = None
    ) -> CSR:
        """Of what `to_arrays` gave; what does not fit together is refused."""
        rows, columns = (int(n) for n in arrays["shape"])
        data, indices, indptr = (arrays[name] for name in ("data", "indices", "indptr"))
        checks.compressed(
            "the stored matrix", indptr, indices, checks.real("data", data), (rows, columns)
        )
        return cls(
            device, scipy.sparse.csr_array((data, indices, indptr), shape=(rows, columns)), pattern
        )

    def _transposed_rows(self) -> CSR:
        return CSR(self.device, scipy.sparse.csr_array(self._host.T))


class RowBlocks(CSR):
    """A sparse (M, N) matrix on the device, uploaded block by block; refuses what `CSR` refuses.

    The host keeps row pointers alone: diagonal and norms have all blocks read again.

    Parameters
    ----------
    shape : (M, N)
    blocks : function that gives (first row, csr_array) of all blocks, in order
    nnz : int, nonzeros there are at most

    Examples
    --------
    >>> import ltcl
    >>> A = scipy.sparse.csr_array([[1.0, 2.0], [0.0, 3.0]])
    >>> rows = RowBlocks(
    ...     ltcl.open_device(), (2, 2), lambda: ((i, A[i : i + 1]) for i in range(2)), A.nnz
    ... )
    >>> (rows @ np.array([1.0, 1.0])).tolist()
    [3.0, 3.0]
    """

    def __init__(self, device: Device, shape: tuple[int, int], blocks: Blocks, nnz: int) -> None:
        RowOperator.__init__(self, device, shape)
        device.require(8 * nnz, f"a sparse matrix of {nnz} nonzeros")
        self._blocks = blocks
        self.slabs, pointers = [], [np.zeros(1, np.int64)]
        for first, block in self.blocks():
            self.slabs += self.upload(block, first)
            pointers.append(block.indptr[1:] + pointers[-1][-1])
        cuts = [(slab.first, slab.first + slab.rows) for slab in self.slabs]
        places = [slab.arguments[:2] for slab in self.slabs]
        self.pattern = Pattern(device, shape, np.concatenate(pointers), None, cuts, places)
        self.nnz = int(self.pattern.indptr[-1])

    def blocks(self) -> Iterator[tuple[int, Any]]:
        """Read again; neighbouring ones in one, up to `_SLAB` bytes."""
        gathered: list[Any] = []
        start = 0
        for first, block in self._blocks():
            if gathered and 8 * (sum(rows.nnz for rows in gathered) + block.nnz) > _SLAB:
                yield start, _joined(start, gathered)
                gathered, start = [], first
            gathered.append(block)
        yield start, _joined(start, gathered)

    @cached_property
    def _host(self) -> scipy.sparse.csr_array:
        checks.fits_host(f"a sparse matrix of {self.nnz} nonzeros", 24 * self.nnz)
        return _joined(0, [block for _, block in self._blocks()])


def _joined(first: int, blocks: list[Any]) -> scipy.sparse.csr_array:
    rows = scipy.sparse.csr_array(scipy.sparse.vstack(blocks, "csr"))
    return scipy.sparse.csr_array(checks.csr(f"rows from {first}", rows).astype(np.float64))
