# SPDX-License-Identifier: BSD-3-Clause
"""Compressed sparse rows: float32 values, 32-bit column indices, y = A x by `kernels/csr.cl`.

A transposed product uses A^T in the same format, made at the first one: twice the memory, but the
same bits at every call, which scattered additions would not give.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.operators.knowledge import Float64Form
from ltcl.operators.rows import ReadableRows, Slab, SparseRows, cut

Blocks = Callable[[], Iterator[tuple[int, Any]]]
# Smaller blocks of a store are joined, since each slab is a launch.
JOINED_BYTES = 1 << 26


@dataclass(frozen=True, eq=False, kw_only=True)
class Pattern:
    """The places of the nonzeros, which channels may share.

    Attributes
    ----------
    indptr : (M + 1,) int64
    indices : (nnz,) or None
        None if the host does not keep them.
    cuts : list of (start, stop)
        The rows of each slab.
    uploaded : list of (pointers, columns), optional
        What `slabs` is; None if it is uploaded at its first use, from `indices`.
    """

    device: Device
    shape: tuple[int, int]
    indptr: np.ndarray
    indices: np.ndarray | None
    cuts: list[tuple[int, int]]
    uploaded: list[tuple[Array, Array]] | None = None

    @classmethod
    def from_csr(cls, device: Device, matrix: Any) -> Pattern:
        """The pattern of a checked `csr_array`."""
        indptr = matrix.indptr.astype(np.int64)
        # Pointers weigh as much as one nonzero.
        row_bytes = np.maximum(4 * np.diff(indptr), 4)
        cuts = cut(device, row_bytes, "the sparse matrix")
        return cls(
            device=device,
            shape=matrix.shape,
            indptr=indptr,
            indices=matrix.indices,
            cuts=cuts,
        )

    @cached_property
    def slabs(self) -> list[tuple[Array, Array]]:
        """Pointers and columns of each slab on the device; pointers count from 0 in each."""
        if self.uploaded is not None:
            return self.uploaded
        assert self.indices is not None  # noqa: S101 - the host has them, or they were uploaded
        slabs = []
        for start, stop in self.cuts:
            pointers = self.indptr[start : stop + 1]
            columns = self.indices[pointers[0] : pointers[-1]]
            local_pointers = self.device.upload(pointers - pointers[0], np.int32)
            slabs.append((local_pointers, self.device.upload(columns, np.int32)))
        return slabs

    def with_values(self, data: np.ndarray, first: int = 0) -> list[Slab]:
        """The slabs of a matrix of this pattern with values `data` (nnz,), from row `first` on."""
        slabs = []
        for (start, stop), (pointers, columns) in zip(self.cuts, self.slabs, strict=True):
            values = self.device.upload(data[self.indptr[start] : self.indptr[stop]])
            arguments = {"pointers": pointers, "columns": columns, "values": values}
            slabs.append(Slab(first + start, stop - start, arguments))
        return slabs

    def matches(self, matrix: Any) -> bool:
        """True if `matrix` has its nonzeros in the same places, as far as the host can tell."""
        if self.indices is None or self.shape != matrix.shape or len(self.indices) != matrix.nnz:
            return False
        if not np.array_equal(self.indptr, matrix.indptr):
            return False
        return self.indices is matrix.indices or np.array_equal(self.indices, matrix.indices)


class CSR(SparseRows):
    """A sparse (M, N) matrix on the device.

    Parameters
    ----------
    device : Device
    matrix : scipy.sparse matrix or array, (M, N)
    pattern : Pattern, optional
        Pattern of another channel; shared if the nonzeros are in the same places.
    later : bool
        Upload the matrix at its first product, as there may be none.

    Raises
    ------
    InputError
        If the matrix is malformed or not finite.
    MemoryLimitError
        If the device has no room for it.

    Examples
    --------
    >>> import ltcl, numpy, scipy.sparse
    >>> from ltcl.operators import CSR
    >>> A = CSR(ltcl.open_device(), scipy.sparse.csr_array([[1.0, 2.0], [0.0, 3.0]]))
    >>> (A @ numpy.array([1.0, 1.0])).tolist()
    [3.0, 3.0]
    """

    file: ClassVar[str] = "csr"
    numbers: ClassVar[str] = "values"

    def __init__(
        self, device: Device, matrix: Any, pattern: Pattern | None = None, *, later: bool = False
    ) -> None:
        matrix = checks.csr("matrix", matrix)
        super().__init__(device, matrix.shape)
        if pattern is not None and (pattern.device is not device or not pattern.matches(matrix)):
            pattern = None
        self._new_bytes = matrix.nnz * (8 if pattern is None else 4)
        self.nnz: int = matrix.nnz
        self._host = matrix
        if not later:
            self._require_memory()
            self.begin(device, matrix.shape, matrix.nnz)
        if pattern is None:
            pattern = Pattern.from_csr(device, matrix)
        self.pattern = pattern
        if not later:
            self.slabs = self.pattern.with_values(matrix.data)

    def _require_memory(self) -> None:
        """Refuse a matrix for which the device has no room."""
        self.device.require(self._new_bytes, f"a sparse matrix of {self.nnz} nonzeros")

    def _upload_later(self) -> list[Slab]:
        self._require_memory()
        return self.pattern.with_values(self._host.data)

    @classmethod
    def begin(cls, device: Device, shape: tuple[int, int], nnz: int) -> None:
        """Begin to build programs for a matrix that is still to come."""
        cls.build_ahead(device, shape, 8 * nnz, {})

    def upload(self, rows: Any, first: int) -> list[Slab]:
        """Slabs of rows from `first` on, with a pattern of their own."""
        return Pattern.from_csr(self.device, rows).with_values(rows.data, first)

    @property
    def data(self) -> np.ndarray:
        """The values on the host, (nnz,)."""
        return self._host.data

    def blocks(self) -> Iterator[tuple[int, Any]]:
        """The whole matrix in one block."""
        yield 0, self._host.astype(np.float64)

    def matrix(self) -> scipy.sparse.csr_array:
        """The matrix (M, N) on the host, with the float32 values of the device, to be read only."""
        return scipy.sparse.csr_array(self._host.astype(np.float32, copy=False))

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Plain arrays, from which `from_arrays` makes the same operator, to the bit."""
        return plain_arrays(self._host)

    @classmethod
    def from_arrays(
        cls,
        device: Device,
        arrays: Mapping[str, np.ndarray],
        pattern: Pattern | None = None,
        *,
        later: bool = False,
    ) -> CSR:
        """The operator whose `to_arrays` gave `arrays`; arrays that do not fit are refused."""
        rows, columns = (int(n) for n in arrays["shape"])
        shape = rows, columns
        data = arrays["data"]
        indices = arrays["indices"]
        indptr = arrays["indptr"]
        checks.compressed("the stored matrix", indptr, indices, checks.real("data", data), shape)
        # With pointers of 64 bits SciPy would keep the indices so, too.
        index_dtype = scipy.sparse.get_index_dtype(maxval=max(len(data), columns))
        indptr = indptr.astype(index_dtype, copy=False)
        matrix = scipy.sparse.csr_array((data, indices, indptr), shape=shape)
        return cls(device, matrix, pattern, later=later)

    def _float64_form(self, *, reads_blocks: bool = False) -> Float64Form | None:
        return Float64Form(matrix=self._host)

    def _transposed_rows(self) -> CSR:
        return CSR(self.device, scipy.sparse.csr_array(self._host.T))


def plain_arrays(matrix: scipy.sparse.csr_array) -> dict[str, np.ndarray]:
    """The arrays of a matrix as `CSR` keeps them."""
    return {
        "shape": np.array(matrix.shape, np.int64),
        "data": matrix.data.astype(np.float32),
        "indices": matrix.indices.astype(np.int32),
        "indptr": matrix.indptr.astype(np.int64),
    }


class RowBlocks(CSR):
    """A sparse (M, N) matrix on the device, uploaded block by block; refuses what `CSR` refuses.

    The host keeps row pointers alone: diagonal and norms have all blocks read again.

    Parameters
    ----------
    device : Device
    shape : (M, N)
    blocks : function
        Gives (first row, csr_array) of all blocks, in order.
    nnz : int
        The most nonzeros there can be.

    Examples
    --------
    >>> import ltcl
    >>> A = scipy.sparse.csr_array([[1.0, 2.0], [0.0, 3.0]])
    >>> blocks = lambda: ((row, A[row : row + 1]) for row in range(2))
    >>> rows = RowBlocks(ltcl.open_device(), (2, 2), blocks, A.nnz)
    >>> (rows @ np.array([1.0, 1.0])).tolist()
    [3.0, 3.0]
    """

    def __init__(self, device: Device, shape: tuple[int, int], blocks: Blocks, nnz: int) -> None:
        SparseRows.__init__(self, device, shape)
        device.require(8 * nnz, f"a sparse matrix of {nnz} nonzeros")
        self._blocks = blocks
        self.begin(device, shape, nnz)
        self.slabs = []
        pointers = [np.zeros(1, np.int64)]
        for first, block in self.blocks():
            self.slabs += self.upload(block, first)
            pointers.append(block.indptr[1:] + pointers[-1][-1])
        places = [(slab.arguments["pointers"], slab.arguments["columns"]) for slab in self.slabs]
        self.pattern = Pattern(
            device=device,
            shape=shape,
            indptr=np.concatenate(pointers),
            indices=None,
            cuts=[(slab.first, slab.end) for slab in self.slabs],
            uploaded=places,
        )
        self.nnz = int(self.pattern.indptr[-1])

    def blocks(self) -> Iterator[tuple[int, Any]]:
        """All blocks, read again; neighbouring small ones are joined."""
        return joined_blocks(self._blocks)

    def _float64_form(self, *, reads_blocks: bool = False) -> Float64Form | None:
        return ReadableRows._float64_form(self, reads_blocks=reads_blocks)

    @cached_property
    def _host(self) -> scipy.sparse.csr_array:
        checks.fits_host(f"a sparse matrix of {self.nnz} nonzeros", 24 * self.nnz)
        return _joined(0, [block for _, block in self._blocks()])


def joined_blocks(blocks: Blocks) -> Iterator[tuple[int, scipy.sparse.csr_array]]:
    """(first row, rows) of all blocks, checked, in float64; neighbouring small ones are joined."""
    gathered: list[Any] = []
    start = 0
    nnz = 0
    for first, block in blocks():
        if gathered and 8 * (nnz + block.nnz) > JOINED_BYTES:
            yield start, _joined(start, gathered)
            gathered = []
            start = first
            nnz = 0
        gathered.append(block)
        nnz += block.nnz
    yield start, _joined(start, gathered)


def _joined(first: int, blocks: list[Any]) -> scipy.sparse.csr_array:
    """Blocks of rows below each other, checked, in float64."""
    rows = scipy.sparse.csr_array(scipy.sparse.vstack(blocks, "csr"))
    checked = checks.csr(f"rows from {first}", rows)
    return scipy.sparse.csr_array(checked.astype(np.float64))
