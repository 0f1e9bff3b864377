# SPDX-License-Identifier: BSD-3-Clause
"""Compressed sparse rows: float32 values, 32-bit column indices, y = A x by `kernels/csr.cl`.

A transposed product uses A^T in the same format, built and uploaded at the first one: twice the memory,
but the same speed and the same bits at every call, which scattered additions would not give.

A matrix may come a block of rows at a time, as from a file. Then the host keeps row pointers alone: diagonal
and norms have all blocks read again; a transposed product and the places of nonzeros keep them, too.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.operators.rows import RowOperator, Slab, cut, largest

Blocks = Callable[[], Iterator[tuple[int, Any]]]
_SLAB = 1 << 26  # bytes: smaller blocks are joined, since each slab is a launch


class Pattern:
    """Where the nonzeros are, on the device. Colour channels with one pattern store it once.

    Made from a checked `csr_array`. Slabs are (start, stop) rows; each has pointers (rows + 1,) from 0 and
    columns (nnz,).
    """

    def __init__(self, device: Device, matrix: Any) -> None:
        self.device = device
        self.shape: tuple[int, int] = matrix.shape
        self.indptr = matrix.indptr.astype(np.int64)
        self.indices = matrix.indices
        row_bytes = np.maximum(4 * np.diff(self.indptr), 4)  # pointers weigh as much as one nonzero
        # There is one pointer more than rows.
        self.cuts = cut(row_bytes, largest(device) - 4, "the sparse matrix")
        self.slabs = [self._upload(start, stop) for start, stop in self.cuts]

    def _upload(self, start: int, stop: int) -> tuple[Array, Array]:
        pointers = self.indptr[start : stop + 1] - self.indptr[start]
        columns = self.indices[self.indptr[start] : self.indptr[stop]]
        return self.device.upload(pointers, np.int32), self.device.upload(columns, np.int32)

    def with_values(self, data: np.ndarray) -> list[Slab]:
        """The slabs of a matrix of this pattern with values `data` (nnz,)."""
        slabs = []
        for (start, stop), (pointers, columns) in zip(self.cuts, self.slabs, strict=True):
            values = self.device.upload(data[self.indptr[start] : self.indptr[stop]])
            slabs.append(Slab(start, stop - start, (pointers, columns, values)))
        return slabs

    def matches(self, matrix: Any) -> bool:
        """Whether `matrix` has its nonzeros in the same places."""
        if self.shape != matrix.shape or len(self.indices) != matrix.nnz:
            return False
        same = self.indices is matrix.indices or np.array_equal(self.indices, matrix.indices)
        return same and np.array_equal(self.indptr, matrix.indptr)


class CSR(RowOperator):
    """A sparse (M, N) matrix on the device.

    Parameters
    ----------
    device : Device
    matrix : scipy.sparse matrix or array, (M, N)
        Checked before anything is uploaded.
    pattern : Pattern, optional
        That of another channel; used, and so stored once, where the nonzeros are in the same places.

    Raises
    ------
    InputError
        Column indices out of range, row pointers that fall, NaN or infinite values.
    MemoryLimitError
        More than the device holds; said before anything is allocated.

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
        device.require(matrix.nnz * (4 if shared else 8), f"a sparse matrix of {matrix.nnz} nonzeros")
        self.pattern = pattern if pattern is not None and shared else Pattern(device, matrix)
        self.slabs = self.pattern.with_values(matrix.data)
        self.nnz: int = matrix.nnz
        self._host = matrix

    @property
    def data(self) -> np.ndarray:
        """The values on the host, (nnz,), in the order of `pattern`."""
        return self._host.data

    def blocks(self) -> Iterator[tuple[int, Any]]:
        """The matrix as it was given, in float64."""
        yield 0, self._host.astype(np.float64)

    def matrix(self) -> scipy.sparse.csr_array:
        """What it stands for: (M, N), float32 values on the host."""
        return scipy.sparse.csr_array(self._host.astype(np.float32))

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Plain arrays, of which `from_arrays` makes the same again, to the bit."""
        return {
            "shape": np.array(self.shape, np.int64),
            "data": self.data.astype(np.float32),
            "indices": self.pattern.indices.astype(np.int32),
            "indptr": self.pattern.indptr,
        }

    @classmethod
    def from_arrays(
        cls, device: Device, arrays: Mapping[str, np.ndarray], pattern: Pattern | None = None
    ) -> CSR:
        """Of what `to_arrays` gave; what does not fit together is refused."""
        rows, columns = (int(n) for n in arrays["shape"])
        data, indices, indptr = (arrays[name] for name in ("data", "indices", "indptr"))
        checks.compressed("the stored matrix", indptr, indices, checks.real("data", data), (rows, columns))
        return cls(device, scipy.sparse.csr_array((data, indices, indptr), shape=(rows, columns)), pattern)

    def _transposed_rows(self) -> CSR:
        return CSR(self.device, scipy.sparse.csr_array(self._host.T))


class RowBlocks(CSR):
    """A sparse (M, N) matrix on the device, uploaded block by block.

    Parameters
    ----------
    device : Device
    shape : (M, N)
    blocks : function
        Gives (first row, csr_array) of all blocks, in order; each is gone from memory before the next comes.
    nnz : int
        Nonzeros there are at most.

    Raises
    ------
    InputError
        A block that is malformed or holds NaN.
    MemoryLimitError
        More than the device holds; said before anything is allocated.

    Examples
    --------
    >>> import ltcl
    >>> A = scipy.sparse.csr_array([[1.0, 2.0], [0.0, 3.0]])
    >>> rows = RowBlocks(ltcl.open_device(), (2, 2), lambda: ((i, A[i : i + 1]) for i in range(2)), A.nnz)
    >>> (rows @ np.array([1.0, 1.0])).tolist()
    [3.0, 3.0]
    """

    def __init__(self, device: Device, shape: tuple[int, int], blocks: Blocks, nnz: int) -> None:
        RowOperator.__init__(self, device, shape)
        device.require(8 * nnz, f"a sparse matrix of {nnz} nonzeros")
        self._blocks = blocks
        self.slabs, pointers = [], [np.zeros(1, np.int64)]
        for first, block in self.blocks():
            slabs = Pattern(device, block).with_values(block.data)
            self.slabs += [dataclasses.replace(slab, first=first + slab.first) for slab in slabs]
            pointers.append(block.indptr[1:] + pointers[-1][-1])
        self.pattern = _PatternOfBlocks(self, np.concatenate(pointers))
        self.nnz = int(self.pattern.indptr[-1])

    def blocks(self) -> Iterator[tuple[int, Any]]:
        """Read again; neighbouring ones in one, up to `_SLAB` bytes."""
        some: list[Any] = []
        start = 0
        for first, block in self._blocks():
            if some and 8 * (sum(part.nnz for part in some) + block.nnz) > _SLAB:
                yield start, _joined(start, some)
                some, start = [], first
            some.append(block)
        yield start, _joined(start, some)

    @cached_property
    def _host(self) -> scipy.sparse.csr_array:
        checks.fits_host(f"a sparse matrix of {self.nnz} nonzeros", 24 * self.nnz)
        return _joined(0, [block for _, block in self._blocks()])


class _PatternOfBlocks(Pattern):
    """The pattern of all blocks; places of nonzeros are read again when they are asked for."""

    def __init__(self, owner: RowBlocks, indptr: np.ndarray) -> None:
        self.device, self.shape, self.indptr, self._owner = owner.device, owner.shape, indptr, owner
        self.slabs = [slab.arguments[:2] for slab in owner.slabs]

    @property
    def indices(self) -> np.ndarray:
        return self._owner._host.indices

    def matches(self, matrix: Any) -> bool:
        """Not asked: it would take all blocks in memory."""
        return False


def _joined(first: int, blocks: list[Any]) -> scipy.sparse.csr_array:
    rows = scipy.sparse.csr_array(scipy.sparse.vstack(blocks, "csr"))
    return scipy.sparse.csr_array(checks.csr(f"rows from {first}", rows).astype(np.float64))
